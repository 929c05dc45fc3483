# SPDX-License-Identifier: Apache-2.0
"""Join the launch of a machine from a terminal of this computer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import contextlib
import importlib.util
import os
from pathlib import Path
import shlex
import signal
import subprocess
import sys
import tempfile
from typing import Optional

from fogros2 import invitation, ros2_daemon
from fogros2.errors import ConfigurationError
from fogros2.store import Store
from ros2fog_cli.api import reach

#: Seconds to wait for a command's end after each signal.
TIMEOUT = 3.0


def launch_of(name: str, store: Store) -> tuple[Path, dict[str, str]]:
    """
    Return the folder of a machine's launch, and its environment variables.

    :raises ConfigurationError: no running launch uses the machine, and this computer has not
        joined it.
    """
    folder = invitation.joined(store).get(name)
    if folder is not None and not store.exists(name):
        return folder, reach.variables_of(folder)
    record = store.load(name)
    variables = reach.robot_environment(record, store)
    if variables is None:
        raise ConfigurationError(f"no launch is running with the machine '{name}'",
                                 'join its nodes while a launch runs')
    return store.launch(record.launch), variables


def has_daemon() -> bool:
    """Return whether ``ros2`` here starts a daemon; the embedded default has none."""
    return importlib.util.find_spec('ros2cli.daemon') is not None


def shell_lines(folder: Path, variables: Mapping[str, str]) -> list[str]:
    """Return lines for a POSIX shell whose nodes join a launch; its end stops their daemon."""
    return exports(variables, ros2_daemon.install(folder, sys.executable)
                   if has_daemon() else None)


def exports(variables: Mapping[str, str], programs: Optional[Path]) -> list[str]:
    """
    Return lines for a POSIX shell that export the variables.

    :param programs: folder to put first into PATH, or None.
    """
    lines = [f'export {name}={shlex.quote(value)}' for name, value in sorted(variables.items())]
    if programs is not None:
        lines.append(f'export PATH={shlex.quote(str(programs))}:"$PATH"')
    return lines


def run(name: str, words: Sequence[str] = ()) -> int:
    """
    Run a command or the user's shell in the environment of a launch; return the exit status.

    A ROS 2 daemon that the command started ends with the command.

    :raises ConfigurationError: no running launch uses the machine.
    """
    _, variables = launch_of(name, Store())
    with tempfile.TemporaryDirectory(prefix='fogros2-shell-') as folder:
        programs = ros2_daemon.install(Path(folder), sys.executable) if has_daemon() else None
        path = os.environ.get('PATH', os.defpath)
        environment = {**os.environ, **variables,
                       'PATH': f'{programs}:{path}' if programs else path}
        try:
            return _wait(list(words) or _shell(name, Path(folder), exports(variables, programs)),
                         environment)
        finally:
            ros2_daemon.stop(Path(folder))


def _shell(name: str, folder: Path, lines: Sequence[str]) -> list[str]:
    """Return the command line of the user's shell."""
    shell = os.environ.get('SHELL') or '/bin/sh'
    if Path(shell).name != 'bash':
        return [shell]
    # .bashrc may set the same variables, so the exports come after it.
    start = folder / 'bashrc'
    start.write_text('\n'.join(
        ['[ ! -f ~/.bashrc ] || . ~/.bashrc', *lines, f'PS1="({shlex.quote(name)}) $PS1"', '']))
    return [shell, '--rcfile', str(start), '-i']


def _wait(words: list[str], environment: Mapping[str, str]) -> int:
    """Run a command to its end. Ctrl-C reaches only the command; SIGHUP and SIGTERM end both."""
    child: Optional[subprocess.Popen[bytes]] = None
    signals: list[int] = []

    def leave(number: int, frame: object) -> None:
        signals.append(number)
        # An exception inside Popen would lose the process that it started.
        if child is not None and len(signals) == 1:
            raise SystemExit(128 + number)

    before = {number: signal.signal(number, leave)
              for number in (signal.SIGHUP, signal.SIGTERM)}
    try:
        child = subprocess.Popen(words, env=dict(environment))
        # Only after Popen: the command would inherit the ignored SIGINT.
        before[signal.SIGINT] = signal.signal(signal.SIGINT, signal.SIG_IGN)
        if signals:
            raise SystemExit(128 + signals[0])
        status = child.wait()
    except OSError as error:
        raise ConfigurationError(f"'{words[0]}' can not be run: {error.strerror}",
                                 'name a program of this computer after --') from error
    except SystemExit:
        if child is not None:
            _end(child)
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    return status if status >= 0 else 128 - status


def _end(child: subprocess.Popen[bytes]) -> None:
    """End a command. An interactive bash ignores SIGTERM, but ends at SIGHUP."""
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGKILL):
        child.send_signal(number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(TIMEOUT)
            return
