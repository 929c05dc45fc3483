# SPDX-License-Identifier: Apache-2.0
"""Run commands on this computer and wait for them; only this module does so by subprocess."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import contextlib
import errno
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any, BinaryIO, Optional

from fogros2.errors import Cancelled, CommandError, DeadlineExceeded, PrerequisiteError
from fogros2.model import Command, Result
from fogros2.waiting import noted

HERE = 'this computer'
#: sudo's reason for refusing without a password, and the remedy.
PASSWORD = 'sudo wants a password', 'run `sudo -v` first, or allow it without a password'
#: The same for a user without rights.
NO_RIGHTS = ('this user may not use sudo',
             "ask the computer's administrator, or let a user who may launch it")
#: Debian packages of programs, where these have another name.
PACKAGES = {'ip': 'iproute2', 'nft': 'nftables', 'ping': 'iputils-ping',
            'ssh': 'openssh-client', 'ssh-keygen': 'openssh-client', 'wg': 'wireguard-tools'}
#: Maximum bytes of a line of output; a longer one is several.
_LINE = 1 << 16
#: Variables that name proxies, in upper or lower case.
_PROXIES = ('all_proxy', 'ftp_proxy', 'http_proxy', 'https_proxy', 'no_proxy')
#: A copy: launch empties ``os.environ`` briefly when a scoped group ends, while threads run.
_ENVIRONMENT = dict(os.environ)


def argv(command: Command) -> list[str]:
    """Return the words to execute, with ``sudo -n`` in front if root is needed."""
    if _through_sudo(command):
        return ['sudo', '-n', '--', *command.argv]
    return list(command.argv)


def proxies() -> tuple[str, ...]:
    """
    Return the proxies of this process's environment, as NAME=VALUE, for a download by sudo.

    sudo passes no variables on. A proxy with a password is left out: all users see command lines.
    """
    return tuple(f'{name}={value}' for name, value in _ENVIRONMENT.items()
                 if name.lower() in _PROXIES and '@' not in value)


def start(
    command: Command, *, stdin: int, stderr: int, stdout: int = subprocess.PIPE,
    environment: Optional[Mapping[str, str]] = None, inherited: Sequence[int] = (),
) -> subprocess.Popen[bytes]:
    """
    Start a command on this computer; do not wait for it.

    It gets its own session, so that Ctrl-C in the terminal reaches only the launch and does not
    kill an undo step. With sudo it gets a process group instead, which Ctrl-C does not reach
    either: sudo binds its ticket to the terminal, and would ask for the password in a session
    without one.

    :param environment: None for this process's variables and the command's.
    :raises FileNotFoundError: there is no such program.
    """
    apart: dict[str, Any] = {'start_new_session': True, 'pass_fds': inherited}
    if _through_sudo(command):
        apart = {'process_group': 0} if sys.version_info >= (3, 11) else {
            'preexec_fn': os.setpgrp}
    if environment is None:
        path = _ENVIRONMENT.get('PATH', os.defpath)
        environment = {**_ENVIRONMENT, 'PATH': f'{path}:/usr/sbin:/sbin'}
        if _through_sudo(command):
            environment['LC_ALL'] = 'C'  # the reasons for which sudo refuses, in English
        environment.update(command.environment)
    return subprocess.Popen(argv(command), env=environment, stdin=stdin, stdout=stdout,
                            stderr=stderr, **apart)


def _through_sudo(command: Command) -> bool:
    return command.sudo and os.geteuid() != 0


def ask_for_ticket(what: str) -> bool:
    """
    Let sudo ask for the password at the terminal; return False without one or if refused.

    :param what: short text for the prompt, such as 'for the VPN interface'.
    """
    try:
        # a background process would be stopped when it reads
        if not os.isatty(0) or os.tcgetpgrp(0) != os.getpgrp():
            return False
    except OSError:
        return False
    prompt = f'[sudo] password for %p, {what}: '
    # Ctrl-C at the prompt is for both, so sudo stays in this process group
    return subprocess.run(('sudo', '-v', '-p', prompt), env=_ENVIRONMENT).returncode == 0


def sudo_trouble() -> tuple[str, str] | None:
    """
    Return why sudo refuses at the moment, and the remedy; None if it does not refuse.

    A call extends the time until sudo asks for a password again.
    """
    if os.geteuid() == 0:
        return None
    result = run(Command(('true',), sudo=True), timeout=10.0, check=False)
    if result.returncode == 0:
        return None
    text = result.stderr
    if 'password is required' in text:
        # sudo gives this reason to users without rights, too; ``sudo -v`` distinguishes them
        text = run(Command(('sudo', '-n', '-v'), environment={'LC_ALL': 'C'}), timeout=10.0,
                   check=False).stderr or text
    if 'password is required' in text or 'terminal is required' in text:
        return PASSWORD
    if 'may not run sudo' in text or 'not in the sudoers' in text or 'not allowed' in text:
        return NO_RIGHTS
    # advice may follow the reason
    reasons = [line for line in text.strip().splitlines() if 'unable to resolve host' not in line]
    reason = (reasons or ['it says nothing'])[0].removeprefix('sudo: ')
    return f"sudo doesn't work here: {reason}", 'run it as root'


def require(programs: Sequence[str], *, package_of: Optional[dict[str, str]] = None) -> None:
    """
    Check that programs are installed.

    :raises PrerequisiteError: names the missing programs and the packages to install.
    """
    missing = [p for p in programs if not which(p)]
    if missing:
        packages = sorted({(package_of or {}).get(p, p) for p in missing})
        raise PrerequisiteError(
            f"{', '.join(missing)} not found on this computer",
            f"sudo apt-get install {' '.join(packages)}")


def which(program: str) -> Optional[str]:
    """Return a program's path, also from the sbin folders, or None."""
    path = _ENVIRONMENT.get('PATH', os.defpath)
    return shutil.which(program, path=f'{path}:/usr/local/sbin:/usr/sbin:/sbin')


def run(
    command: Command,
    *,
    timeout: float,
    check: bool = True,
    cancel: Optional[threading.Event] = None,
    on_output: Optional[Callable[[str], None]] = None,
    inherited: Sequence[int] = (),
    kept: float = math.inf,
) -> Result:
    """
    Run a command on this computer and wait for it; Ctrl-C does not reach it (see ``start``).

    :param timeout: seconds after which the command's whole process group is killed.
    :param check: raise CommandError for an exit status other than zero.
    :param on_output: receives each line of standard output when it is printed.
    :param inherited: file descriptors that the command inherits; not with ``sudo``.
    :param kept: bytes of each output that are kept, the last ones; for commands that pass on what
        a machine sends.
    :raises CommandError: it failed and ``check`` is set.
    :raises DeadlineExceeded: it timed out.
    :raises Cancelled: ``cancel`` was set while it ran.
    :raises PrerequisiteError: the program is missing, or cannot be started.
    """
    words = argv(command)
    try:
        with _file_of(command.input) if command.input else open(os.devnull, 'rb') as stdin:
            child = start(command, stdin=stdin.fileno(), stderr=subprocess.PIPE,
                          inherited=inherited)
    except FileNotFoundError as error:
        raise PrerequisiteError(
            f'{words[0]} not found on this computer',
            'run it as root, or install sudo' if words[0] == 'sudo'
            else f'sudo apt-get install {PACKAGES.get(words[0], words[0])}') from error
    except OSError as error:
        raise PrerequisiteError(
            f"{words[0]} can't be started on this computer: {error.strerror}",
            'are there processes and memory left?' if isinstance(error, BlockingIOError)
            or error.errno == errno.ENOMEM else '') from error
    output = {'stdout': Tail(kept), 'stderr': Tail(kept)}

    def read(name: str) -> None:
        with getattr(child, name) as stream:
            for line in iter(lambda: stream.readline(_LINE), b''):
                output[name].add(line)
                if on_output is not None and name == 'stdout':
                    on_output(line.decode(errors='replace').rstrip('\n'))

    threads = [threading.Thread(target=read, args=(name,), daemon=True) for name in output]
    deadline = time.monotonic() + timeout
    what = command.what or words[0]
    try:
        for thread in threads:
            thread.start()
        with noted(what):
            while True:
                remaining = deadline - time.monotonic()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    # without a cancel event, no polling is needed
                    child.wait(max(0.0, remaining if cancel is None else min(remaining, 0.05)))
                    break
                if cancel is not None and cancel.is_set():
                    raise Cancelled(what)
                if remaining <= 0:
                    raise DeadlineExceeded(f'{what} took longer than {timeout:g} s')
    except BaseException:  # Ctrl-C too: the command must not outlive this call
        end(child, sudo=_through_sudo(command))
        raise
    for thread in threads:
        # a daemon that the command left may keep the pipe open
        thread.join(2.0)
    result = Result(child.returncode, output['stdout'].text(), output['stderr'].text())
    if check and result.returncode != 0:
        hint = ''
        if command.sudo and 'password is required' in result.stderr:
            hint = PASSWORD[1]
        raise CommandError(command, result, HERE, hint)
    return result


def last_error(text: str) -> str:
    """Return the last error among the messages of a container engine or of apt."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if line.lower().startswith(('error', 'e: '))]
    return (errors or lines or ['no reason given'])[-1]


class Tail:
    """
    The last bytes of a stream.

    :param kept: their number; infinite for all.
    """

    def __init__(self, kept: float) -> None:
        self._kept = kept
        self._data = bytearray()
        self._dropped = 0

    def add(self, data: bytes) -> None:
        """Add new bytes."""
        self._data += data
        if len(self._data) > 1.25 * self._kept:
            self._dropped += len(self._data) - int(self._kept)
            del self._data[:-int(self._kept)]

    def text(self) -> str:
        """Return them as text, with a note of what was dropped."""
        text = self._data.decode(errors='replace')
        return f'[{self._dropped} earlier bytes were dropped]\n{text}' if self._dropped else text


def _file_of(data: bytes) -> BinaryIO:
    """
    Return a file in memory with this content; unlike a pipe, it needs no thread that writes.

    ``/dev/shm`` may be full or missing. But a Python built for an old libc, such as conda's, has
    no ``os.memfd_create``.
    """
    file = os.fdopen(os.memfd_create('input'), 'w+b') if hasattr(os, 'memfd_create') \
        else tempfile.TemporaryFile(dir='/dev/shm')
    file.write(data)
    file.seek(0)
    return file


def end(child: subprocess.Popen[bytes], *, sudo: bool) -> None:
    """
    Terminate, then kill a process that ``start`` started, with its children.

    :param sudo: it was started by sudo and runs as root. A signal to its group would reach only
        sudo, which passes SIGTERM on to the first process only.
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
    killer = start(command, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        killer.communicate(timeout=10.0)
    except subprocess.TimeoutExpired:
        with contextlib.suppress(PermissionError):  # sudo runs as root
            killer.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            killer.wait(1.0)
    if killer.returncode != 0:
        # the ticket has expired, or the processes have ended
        try:
            os.killpg(group, number)
        except PermissionError:
            pass  # they belong to root, such as the VPN helper, which has its own time limit
