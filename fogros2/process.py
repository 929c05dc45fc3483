# SPDX-License-Identifier: Apache-2.0
"""Commands on this computer that we wait for: the only place that calls subprocess for them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import os
import shutil
import signal
import subprocess
import threading
import time
from typing import Optional

from fogros2.errors import Cancelled, CommandError, DeadlineExceeded, PrerequisiteError
from fogros2.model import Command, Result

HERE = 'this computer'
#: launch empties ``os.environ`` for a moment whenever a scoped group ends, while our threads run.
_ENVIRONMENT = dict(os.environ)


def argv(command: Command) -> list[str]:
    """Return the words to execute here: with ``sudo -n`` in front where root is needed."""
    if command.sudo and os.geteuid() != 0:
        return ['sudo', '-n', '--', *command.argv]
    return list(command.argv)


def require(programs: Sequence[str], *, package_of: Optional[dict[str, str]] = None) -> None:
    """
    Check that programs are installed.

    :raises PrerequisiteError: names the missing ones and the packages to install.
    """
    missing = [p for p in programs if not which(p)]
    if missing:
        packages = sorted({(package_of or {}).get(p, p) for p in missing})
        raise PrerequisiteError(
            f"{', '.join(missing)} not found on this computer",
            f"sudo apt-get install {' '.join(packages)}")


def which(program: str) -> Optional[str]:
    """Return a program's path, looking into the sbin folders too, or None."""
    path = _ENVIRONMENT.get('PATH', os.defpath)
    return shutil.which(program, path=f'{path}:/usr/local/sbin:/usr/sbin:/sbin')


def run(
    command: Command,
    *,
    timeout: float,
    check: bool = True,
    cancel: Optional[threading.Event] = None,
    on_output: Optional[Callable[[str], None]] = None,
) -> Result:
    """
    Run a command here and wait for it.

    It gets a session of its own, so that a Ctrl-C in the terminal reaches the launch alone and
    an undo isn't shot down by the signal that caused it.

    :param timeout: seconds, then the command's whole process group is killed.
    :param check: raise CommandError for an exit status other than zero.
    :param on_output: gets each line of standard output as it comes.
    :raises CommandError: it failed and ``check`` is set.
    :raises DeadlineExceeded: it ran out of time.
    :raises Cancelled: ``cancel`` was set while it ran.
    :raises PrerequisiteError: there is no such program.
    """
    words = argv(command)
    begin = time.monotonic()
    path = _ENVIRONMENT.get('PATH', os.defpath)
    environment = {**_ENVIRONMENT, 'PATH': f'{path}:/usr/sbin:/sbin', **command.environment}
    try:
        child = subprocess.Popen(
            words, env=environment, start_new_session=True,
            stdin=subprocess.PIPE if command.input else subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    except FileNotFoundError as error:
        raise PrerequisiteError(
            f'{words[0]} not found on this computer',
            f'sudo apt-get install {words[0]}') from error
    output: dict[str, bytes] = {'stdout': b'', 'stderr': b''}

    def read(name: str) -> None:
        stream = getattr(child, name)
        lines = []
        for line in iter(stream.readline, b''):
            lines.append(line)
            if on_output is not None and name == 'stdout':
                on_output(line.decode(errors='replace').rstrip('\n'))
        output[name] = b''.join(lines)
        stream.close()

    def feed() -> None:
        assert child.stdin is not None
        try:
            child.stdin.write(command.input)
            child.stdin.close()
        except BrokenPipeError:
            pass  # the command ended without reading; its exit status says why

    threads = [threading.Thread(target=read, args=(name,), daemon=True) for name in output]
    if command.input:
        threads.append(threading.Thread(target=feed, daemon=True))
    for thread in threads:
        thread.start()
    deadline = begin + timeout
    while True:
        left = deadline - time.monotonic()
        try:
            # without a cancel event there is nothing to look at meanwhile
            child.wait(max(0.0, left if cancel is None else min(left, 0.05)))
            break
        except subprocess.TimeoutExpired:
            cancelled = cancel is not None and cancel.is_set()
            if left > 0 and not cancelled:
                continue
            _end(child)
            what = command.what or words[0]
            if cancelled:
                raise Cancelled(what) from None
            raise DeadlineExceeded(f'{what} took longer than {timeout:g} s') from None
    for thread in threads:
        # a daemon that the command left behind may hold the pipe open
        thread.join(2.0)
    result = Result(
        child.returncode, output['stdout'].decode(errors='replace'),
        output['stderr'].decode(errors='replace'), time.monotonic() - begin)
    if check and result.returncode != 0:
        hint = ''
        if command.sudo and 'password is required' in result.stderr:
            hint = 'run `sudo -v` first, or allow it without a password'
        raise CommandError(command, result, HERE, hint)
    return result


def _end(child: subprocess.Popen[bytes]) -> None:
    for number in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(child.pid, number)
        except ProcessLookupError:
            return
        except PermissionError:
            # sudo relays a SIGTERM to what it runs
            child.send_signal(number)
        try:
            child.wait(2.0)
            return
        except subprocess.TimeoutExpired:
            continue
