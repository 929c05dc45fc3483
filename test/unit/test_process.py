# SPDX-License-Identifier: Apache-2.0
"""Tests of fogros2.process where sudo is between us and the command."""

from __future__ import annotations

import os
from pathlib import Path
import signal
import subprocess
import uuid

import pytest

from fogros2 import process
from fogros2.errors import DeadlineExceeded, PrerequisiteError
from fogros2.model import Command
from fogros2.waiting import wait_until


@pytest.fixture
def as_user(root: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the way through sudo, also where root runs the tests."""
    if process.which('sudo') is None:
        pytest.skip('needs sudo')
    monkeypatch.setattr(os, 'geteuid', lambda: 1000)


def started(command: Command) -> subprocess.Popen[bytes]:
    return process.start(command, environment=os.environ, stdin=subprocess.DEVNULL,
                         stderr=subprocess.DEVNULL)


def test_sudo_stays_in_the_session_whose_ticket_it_has(as_user: None) -> None:
    child = started(Command(('sleep', '60'), sudo=True))
    try:
        assert os.getsid(child.pid) == os.getsid(0), 'sudo would ask for the password again'
        assert os.getpgid(child.pid) == child.pid, 'Ctrl-C would reach it'
    finally:
        process.end(child, sudo=True)
    assert child.poll() is not None


def test_without_sudo_it_is_a_session_of_its_own() -> None:
    child = started(Command(('sleep', '60')))
    try:
        assert os.getsid(child.pid) == child.pid
    finally:
        process.end(child, sudo=False)
    assert child.returncode == -signal.SIGTERM


@pytest.mark.parametrize('script', ['sleep $1; true', "trap '' TERM; sleep $1; sleep $1"])
def test_what_sudo_runs_ends_with_all_that_it_started(as_user: None, script: str) -> None:
    # a number that tells its sleep from every other one's
    seconds = f'6{uuid.uuid4().int % 10 ** 8}'
    with pytest.raises(DeadlineExceeded):
        process.run(Command(('sh', '-c', script, 'sh', seconds), sudo=True), timeout=0.5)

    def gone() -> bool:
        return not any(seconds.encode() in words(entry) for entry in Path('/proc').glob('[0-9]*'))

    wait_until(gone, timeout=5.0, what='the sleep to be gone')


def words(entry: Path) -> bytes:
    try:
        return (entry / 'cmdline').read_bytes()
    except OSError:
        return b''


def test_the_ticket_is_asked_for_without_a_question(as_user: None) -> None:
    assert process.refresh_ticket()


def test_a_program_that_cannot_be_started_is_one_clear_error(monkeypatch):
    def none_left(*arguments, **options):
        raise BlockingIOError(11, 'Resource temporarily unavailable')

    monkeypatch.setattr(process.subprocess, 'Popen', none_left)
    with pytest.raises(PrerequisiteError, match='processes and memory'):
        process.run(Command(('true',)), timeout=5.0)
