# SPDX-License-Identifier: Apache-2.0
"""Tests of fogros2.process where sudo is between us and the command."""

from __future__ import annotations

import os
from pathlib import Path
import signal
import subprocess
from typing import Any
import uuid

import pytest

from fogros2 import process
from fogros2.deploy import robot
from fogros2.errors import CommandError, DeadlineExceeded, PrerequisiteError
from fogros2.model import Command, Result
from fogros2.waiting import wait_until


@pytest.fixture
def as_user(root: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the way through sudo, also where root runs the tests."""
    if process.which('sudo') is None:
        pytest.skip('needs sudo')
    monkeypatch.setattr(os, 'geteuid', lambda: 1000)


def started(command: Command) -> subprocess.Popen[bytes]:
    return process.start(command, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def test_sudo_stays_in_the_session_whose_ticket_it_has(as_user: None) -> None:
    child = started(Command(('sleep', '60'), sudo=True))
    try:
        assert os.getsid(child.pid) == os.getsid(0), 'sudo would ask for the password again'
        assert os.getpgid(child.pid) == child.pid, 'Ctrl-C would reach it'
    finally:
        process.end(child, sudo=True)
    assert child.poll() is not None


def test_missing_sudo_is_named_with_what_helps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, 'geteuid', lambda: 1000)
    monkeypatch.setattr(process, '_ENVIRONMENT', {'PATH': '/nowhere'})
    monkeypatch.setenv('PATH', '/nowhere')
    with pytest.raises(PrerequisiteError, match='sudo not found .*run it as root, or install'):
        process.run(Command(('nft', 'list', 'tables'), sudo=True), timeout=10.0)


def test_without_sudo_it_is_a_session_of_its_own() -> None:
    child = started(Command(('sleep', '60')))
    try:
        assert os.getsid(child.pid) == child.pid
    finally:
        process.end(child, sudo=False)
    assert child.returncode == -signal.SIGTERM


@pytest.mark.parametrize('script', ['sleep $1; true', "trap '' TERM; sleep $1; sleep $1"])
def test_command_under_sudo_ends_with_its_children(as_user: None, script: str) -> None:
    # a number that tells its sleep from every other one's
    seconds = f'6{uuid.uuid4().int % 10 ** 8}'
    with pytest.raises(DeadlineExceeded):
        process.run(Command(('sh', '-c', script, 'sh', seconds), sudo=True), timeout=0.5)

    def gone() -> bool:
        return not any(seconds.encode() in words(entry) for entry in Path('/proc').glob('[0-9]*'))

    wait_until(gone, timeout=60.0, what='the sleep to be gone')


def words(entry: Path) -> bytes:
    try:
        return (entry / 'cmdline').read_bytes()
    except OSError:
        return b''


def test_the_ticket_is_asked_for_without_a_question(as_user: None) -> None:
    assert process.sudo_trouble() is None


def test_a_program_that_cannot_be_started_is_one_clear_error(monkeypatch):
    def none_left(*arguments, **options):
        raise BlockingIOError(11, 'Resource temporarily unavailable')

    monkeypatch.setattr(process.subprocess, 'Popen', none_left)
    with pytest.raises(PrerequisiteError, match='processes and memory'):
        process.run(Command(('true',)), timeout=5.0)


@pytest.mark.parametrize('missing', ['tempfile.TemporaryFile', 'os.memfd_create'])
def test_input_needs_one_of_two_kinds_of_memory(
        monkeypatch: pytest.MonkeyPatch, missing: str) -> None:
    """``/dev/shm`` may be full or missing, and a Python may have no ``memfd_create``."""
    monkeypatch.delattr(missing)
    data = os.urandom(100_000).hex()
    assert process.run(Command(('cat',), input=data.encode()), timeout=20.0).stdout == data


@pytest.mark.parametrize(('said', 'reason', 'hint'), [
    (['sudo: a password is required', 'sudo: a password is required'],
     'sudo wants a password', 'run `sudo -v` first, or allow it without a password'),
    (['sudo: a password is required', 'Sorry, user eve may not run sudo on robot.'],
     'this user may not use sudo', 'administrator'),
    (['eve is not in the sudoers file.'], 'this user may not use sudo', 'administrator'),
    (['sudo: unable to resolve host robot: Name or service not known\n'
      'sudo: The "no new privileges" flag is set, which prevents sudo from running as root.\n'
      'sudo: If sudo is running in a container, you may need to adjust the container '
      'configuration to disable the flag.\n'], "sudo doesn't work here: The", 'as root'),
    ([''], 'it says nothing', 'as root')])
def test_failure_of_sudo_has_its_reason(monkeypatch, said, reason, hint):
    answers = list(said)
    monkeypatch.setattr(process.os, 'geteuid', lambda: 1000)
    monkeypatch.setattr(process, 'run', lambda command, **more: Result(1, '', answers.pop(0)))
    trouble = process.sudo_trouble()
    assert trouble is not None and not answers
    assert reason in trouble[0] and hint in trouble[1]


@pytest.fixture
def sudo(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Return a program that stands in for sudo, of a user with a German locale."""
    program = tmp_path / 'sudo'
    program.write_text("""#!/bin/sh
[ "$LC_ALL" = C ] && echo 'sudo: a password is required' >&2 && exit 1
echo 'sudo: Ein Passwort ist notwendig' >&2; exit 1
""")
    program.chmod(0o755)
    monkeypatch.setattr(os, 'geteuid', lambda: 1000)
    monkeypatch.setattr(process, '_ENVIRONMENT', {
        **os.environ, 'PATH': f'{tmp_path}:{os.environ["PATH"]}', 'LC_ALL': 'de_DE.UTF-8'})
    monkeypatch.setenv('PATH', f'{tmp_path}:{os.environ["PATH"]}')
    return program


def test_sudo_wants_a_password_in_any_language(sudo: Path) -> None:
    assert process.sudo_trouble() == process.PASSWORD
    with pytest.raises(CommandError, match='run `sudo -v` first'):
        process.run(Command(('true',), sudo=True), timeout=10.0)


@pytest.mark.parametrize(('words', 'asks'), [
    ('a password is required', True), ('interactive authentication is required', True),
    ('eve is not in the sudoers file.', False)])
def test_password_is_asked_for_whatever_sudo_calls_it(
    sudo: Path, monkeypatch: pytest.MonkeyPatch, words: str, asks: bool,
) -> None:
    sudo.write_text(f'#!/bin/sh\necho "sudo: {words}" >&2; exit 1\n')
    asked: list[str] = []

    def ask(what: str) -> bool:
        asked.append(what)
        sudo.write_text('#!/bin/sh\nexit 0\n')
        return True

    monkeypatch.setattr(process, 'ask_for_ticket', ask)
    if asks:
        robot.check_sudo(ask=True)
    else:
        with pytest.raises(PrerequisiteError, match='may not use sudo'):
            robot.check_sudo(ask=True)
    assert asked == ['for the VPN interface'] * asks


def test_user_without_sudo_rights_is_reported(root, monkeypatch):
    if os.geteuid() != 0 or process.which('sudo') is None:
        pytest.skip('takes root, to become a user who may not')

    def as_nobody(command, **more):
        words = ['sudo', '-n', *command.argv] if command.sudo else command.argv
        done = subprocess.run(words, user='nobody', group='nogroup', extra_groups=[], text=True,
                              capture_output=True, cwd='/')
        return Result(done.returncode, done.stdout, done.stderr)

    monkeypatch.setattr(process, 'run', as_nobody)
    monkeypatch.setattr(process.os, 'geteuid', lambda: 65534)
    trouble = process.sudo_trouble()
    assert trouble is not None and trouble[0] == 'this user may not use sudo'


def test_sudo_that_hangs_and_cannot_be_killed_is_left(monkeypatch):
    class Hanging:
        returncode = None

        def communicate(self, timeout):
            raise subprocess.TimeoutExpired('sudo', timeout)

        def kill(self):
            raise PermissionError

        wait = communicate

    signalled = []
    monkeypatch.setattr(process, 'start', lambda *_, **__: Hanging())
    monkeypatch.setattr(process.os, 'killpg', lambda *words: signalled.append(words))
    process._signal_as_root(77, signal.SIGTERM)
    assert signalled == [(77, signal.SIGTERM)]


def test_an_interrupt_ends_the_command(tmp_path: Path) -> None:
    written = tmp_path / 'pid'

    def interrupt(*_: object) -> None:
        if written.read_text():
            signal.setitimer(signal.ITIMER_REAL, 0.0)  # a second one would end the ending
            raise KeyboardInterrupt

    written.write_text('')
    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, 0.05, 0.05)
    try:
        with pytest.raises(KeyboardInterrupt):
            process.run(Command.script(f'echo $$ > {written}; sleep 60'), timeout=60.0)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert not Path('/proc', written.read_text().strip()).exists()


def test_an_interrupt_before_the_output_is_read_ends_the_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    children: list[subprocess.Popen[bytes]] = []

    def interrupt(thread: object) -> None:
        raise KeyboardInterrupt

    def start(*words: Any, **options: Any) -> subprocess.Popen[bytes]:
        children.append(original(*words, **options))
        return children[0]

    original = process.start
    monkeypatch.setattr(process, 'start', start)
    monkeypatch.setattr(process.threading.Thread, 'start', interrupt)
    with pytest.raises(KeyboardInterrupt):
        process.run(Command.script('exec sleep 60'), timeout=60.0)
    with children[0] as child:
        try:
            assert child.returncode == -signal.SIGTERM
        finally:
            child.kill()
