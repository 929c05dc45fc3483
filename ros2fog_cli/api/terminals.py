# SPDX-License-Identifier: Apache-2.0
"""Let terminals of this computer take part in the launch of a machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import os
from pathlib import Path
import shlex
import signal
from typing import NoReturn

from fogros2 import ros2_daemon
from fogros2.errors import ConfigurationError
from fogros2.store import Store, write_private
from ros2fog_cli.api import reach


def launch_of(name: str, store: Store) -> tuple[Path, dict[str, str]]:
    """
    Return the folder of a machine's launch, and its environment variables.

    :raises ConfigurationError: no running launch uses the machine, and this computer has not
        joined it.
    """
    folder = store.other_vpns().get(name)
    if folder is not None and not store.exists(name):
        return folder, reach.variables_of(folder)
    record = store.load(name)
    variables = reach.robot_environment(record, store)
    if variables is None:
        raise ConfigurationError(f"no launch is running with the machine '{name}'",
                                 'join its nodes while a launch runs')
    return store.launch_folder(record.launch), variables


def shell_lines(folder: Path, variables: Mapping[str, str]) -> list[str]:
    """Return lines for a POSIX shell whose nodes are in a launch; its end stops their daemon."""
    lines = [f'export {name}={shlex.quote(value)}' for name, value in sorted(variables.items())]
    if (first := ros2_daemon.programs(folder)) is not None:
        lines.append(f'export PATH={shlex.quote(str(first))}:"$PATH"')
    return lines


def run(name: str, words: Sequence[str] = ()) -> NoReturn:
    """
    Replace this process by a command or the user's shell in the environment of a launch.

    :raises ConfigurationError: no running launch uses the machine, or there is no such program.
    """
    folder, variables = launch_of(name, Store())
    words = list(words) or [os.environ.get('SHELL') or '/bin/sh']
    if Path(words[0]).name == 'bash' and len(words) == 1:
        # .bashrc may set the same variables, so the exports come after it.
        start = folder / f'{name}.bashrc'
        write_private(start, '\n'.join([
            '[ ! -f ~/.bashrc ] || . ~/.bashrc', *shell_lines(folder, variables),
            f'PS1="({shlex.quote(name)}) $PS1"', '']).encode())
        words = [words[0], '--rcfile', str(start), '-i']
    path = [str(ros2_daemon.programs(folder) or ''), os.environ.get('PATH', os.defpath)]
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # Python ignores it
    try:
        os.execvpe(words[0], words, {
            **os.environ, **variables, 'PATH': os.pathsep.join(filter(None, path))})
    except OSError as error:
        signal.signal(signal.SIGPIPE, signal.SIG_IGN)
        raise ConfigurationError(f"'{words[0]}' can not be run: {error.strerror}",
                                 'name a program of this computer after --') from error
