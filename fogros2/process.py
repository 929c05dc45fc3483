# SPDX-License-Identifier: Apache-2.0
"""Commands on this computer that we wait for: the only place that calls subprocess for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import errno
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from typing import Optional

from fogros2.errors import Cancelled, CommandError, DeadlineExceeded, PrerequisiteError
from fogros2.model import Command, Result

HERE = 'this computer'
#: Why sudo gives no root before its password was asked, and what to do about it.
PASSWORD = 'sudo wants a password', 'run `sudo -v` first'
#: launch empties ``os.environ`` for a moment whenever a scoped group ends, while our threads run.
_ENVIRONMENT = dict(os.environ)


def argv(command: Command) -> list[str]:
    """Return the words to execute here: with ``sudo -n`` in front where root is needed."""
    if _through_sudo(command):
        return ['sudo', '-n', '--', *command.argv]
    return list(command.argv)


def start(
    command: Command, *, environment: Mapping[str, str], stdin: int, stderr: int,
) -> subprocess.Popen[bytes]:
    """
    Start a command here, its standard output a pipe, and don't wait for it.

    It gets a session of its own, so that a Ctrl-C in the terminal reaches the launch alone and
    an undo isn't shot down by the signal that caused it. With sudo it gets a process group
    instead, which Ctrl-C doesn't reach either: sudo keeps its ticket by the terminal, and in a
    session without one it would ask for the password again.

    :raises FileNotFoundError: there is no such program.
    """
    words = argv(command)
    if not _through_sudo(command):
        return subprocess.Popen(words, env=environment, stdin=stdin, stdout=subprocess.PIPE,
                                stderr=stderr, start_new_session=True)
    if sys.version_info >= (3, 11):
        return subprocess.Popen(words, env=environment, stdin=stdin, stdout=subprocess.PIPE,
                                stderr=stderr, process_group=0)
    return subprocess.Popen(words, env=environment, stdin=stdin, stdout=subprocess.PIPE,
                            stderr=stderr, preexec_fn=os.setpgrp)


def _through_sudo(command: Command) -> bool:
    return command.sudo and os.geteuid() != 0


def refresh_ticket(*, timeout: float = 10.0) -> bool:
    """
    Put off the moment at which sudo wants the password again; False if it gives no root now.

    Where sudo asks nobody for one, there is nothing to put off.
    """
    return not sudo_trouble(timeout=timeout)


def ask_for_ticket(what: str) -> bool:
    """
    Have sudo ask for the password at the terminal; False if nobody sits there or it is refused.

    :param what: a few words that the question names, such as 'for the VPN interface'.
    """
    try:
        # who is in the background would be stopped for reading
        if not os.isatty(0) or os.tcgetpgrp(0) != os.getpgrp():
            return False
    except OSError:
        return False
    prompt = f'[sudo] password for %p, {what}: '
    # Ctrl-C at the question is for sudo as for us, so it stays in our group
    return subprocess.run(('sudo', '-v', '-p', prompt), env=_ENVIRONMENT).returncode == 0


def sudo_trouble(*, timeout: float = 10.0) -> tuple[str, str] | None:
    """Return why sudo gives no root at this moment and what to do about it, None if it does."""
    if os.geteuid() == 0:
        return None
    asked = run(Command(('true',), sudo=True), timeout=timeout, check=False)
    if asked.returncode == 0:
        return None
    said = asked.stderr
    if 'password is required' in said:
        # it says so to those, too, who may not use it at all; asked for a ticket alone it doesn't
        said = run(Command(('sudo', '-n', '-v')), timeout=timeout, check=False).stderr or said
    if 'password is required' in said or 'terminal is required' in said:
        return PASSWORD
    if 'may not run sudo' in said or 'not in the sudoers' in said or 'not allowed' in said:
        return ('this user may not use sudo',
                "ask the computer's administrator, or let a user who may launch it")
    reason = (said.strip().splitlines() or ['it says nothing'])[-1].removeprefix('sudo: ')
    return f"sudo doesn't work here: {reason}", 'run it as root'


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
    Run a command here and wait for it; Ctrl-C doesn't reach it (see ``start``).

    :param timeout: seconds, then the command's whole process group is killed.
    :param check: raise CommandError for an exit status other than zero.
    :param on_output: gets each line of standard output as it comes.
    :raises CommandError: it failed and ``check`` is set.
    :raises DeadlineExceeded: it ran out of time.
    :raises Cancelled: ``cancel`` was set while it ran.
    :raises PrerequisiteError: there is no such program, or it can't be started.
    """
    words = argv(command)
    begin = time.monotonic()
    path = _ENVIRONMENT.get('PATH', os.defpath)
    environment = {**_ENVIRONMENT, 'PATH': f'{path}:/usr/sbin:/sbin', **command.environment}
    try:
        child = start(
            command, environment=environment, stderr=subprocess.PIPE,
            stdin=subprocess.PIPE if command.input else subprocess.DEVNULL)
    except FileNotFoundError as error:
        raise PrerequisiteError(
            f'{words[0]} not found on this computer',
            f'sudo apt-get install {words[0]}') from error
    except OSError as error:
        raise PrerequisiteError(
            f"{words[0]} can't be started on this computer: {error.strerror}",
            'are there processes and memory left?' if isinstance(error, BlockingIOError)
            or error.errno == errno.ENOMEM else '') from error
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
            end(child, sudo=_through_sudo(command))
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


def end(child: subprocess.Popen[bytes], *, sudo: bool) -> None:
    """
    Terminate, then kill what ``start`` started, with all that it started itself.

    :param sudo: it was started through sudo. What runs there is root's, and a signal to its
        group would reach sudo alone, which passes on SIGTERM to the first process only.
    """
    for number in (signal.SIGTERM, signal.SIGKILL):
        try:
            if sudo:
                _signal_as_root(child.pid, number)
            else:
                os.killpg(child.pid, number)
        except ProcessLookupError:
            return
        try:
            child.wait(2.0)
            return
        except subprocess.TimeoutExpired:
            continue


def _signal_as_root(group: int, number: signal.Signals) -> None:
    command = Command.script(f'kill -s {number.name[3:]} -- -{group}', sudo=True)
    killer = start(command, environment=_ENVIRONMENT, stdin=subprocess.DEVNULL,
                   stderr=subprocess.DEVNULL)
    try:
        killer.communicate(timeout=10.0)
    except subprocess.TimeoutExpired:
        killer.kill()
        killer.wait()
    if killer.returncode != 0:
        # the ticket is over, or there is nobody left
        try:
            os.killpg(group, number)
        except PermissionError:
            pass  # root's, as the helper of the VPN is, which has a time limit of its own
