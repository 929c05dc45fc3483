# SPDX-License-Identifier: Apache-2.0
"""Kill the agent of a machine: what keeps it running starts it again, and nothing stays behind."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import io
import json
import os
from pathlib import Path
import signal
import subprocess
import tarfile

import pytest

from fogros2.provider.container import entry
from fogros2.waiting import wait_until
from rigs.agents import gone, Rig


def parent(pid: int) -> int:
    """Return the pid of a process's parent."""
    return int(Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[1])


class Detached(Rig):
    """An agent of a computer that is the user's own: started over SSH, or with a pod's exec."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        done = subprocess.run(self.words('--detach'), capture_output=True, timeout=60, check=True)
        self.program.unlink()
        self.pid: int = json.loads(done.stdout)['pid']
        self.supervisor = parent(self.pid)

    def successor(self) -> int:
        """Return the pid of the agent after this one."""
        before = self.pid
        wait_until(lambda: self.ask('status').get('pid', before) != before, timeout=60,
                   what='an agent in its place')
        self.pid = self.ask('status')['pid']
        return self.pid

    def close(self) -> None:
        for pid in (self.supervisor, self.pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)


@pytest.fixture
def agent(tmp_path: Path) -> Iterator[Detached]:
    with contextlib.closing(Detached(tmp_path)) as agent:
        yield agent


def test_killed_agent_starts_again_with_its_launch(agent: Detached) -> None:
    assert agent.ask('configure', launch='def456', force='abc123')['ok']
    for _ in range(2):
        os.kill(agent.pid, signal.SIGKILL)
        assert parent(agent.successor()) == agent.supervisor
        assert agent.ask('status')['launch'] == 'def456'


@pytest.mark.parametrize('how', ['release', 'signal'])
def test_agent_that_ends_in_order_stays_away(agent: Detached, how: str) -> None:
    if how == 'release':
        agent.ask('release', exit=True)
    else:
        os.kill(agent.pid, signal.SIGTERM)
    wait_until(gone(agent.supervisor), timeout=60, what='its supervisor to end')
    assert gone(agent.pid)() and not agent.ask('ping')
    assert agent.directory.exists() == (how == 'signal')


def test_agent_whose_folder_was_removed_stays_away(agent: Detached) -> None:
    agent.directory.rename(agent.directory.with_name('aside'))
    os.kill(agent.pid, signal.SIGKILL)
    wait_until(gone(agent.supervisor), timeout=60, what='its supervisor to end')
    assert not agent.directory.exists()


def test_supervisor_leaves_the_folder_to_another_agent(agent: Detached) -> None:
    os.kill(agent.supervisor, signal.SIGSTOP)
    os.kill(agent.pid, signal.SIGKILL)
    wait_until(lambda: not agent.ask('ping'), timeout=60, what='the end of the agent')
    other = Detached(agent.directory.parent)
    with contextlib.closing(other):
        os.kill(agent.supervisor, signal.SIGCONT)
        wait_until(gone(agent.supervisor), timeout=60, what='its supervisor to end')
        assert other.ask('status')['pid'] == other.pid


@pytest.mark.parametrize('status', [0, 1, 'signal'])
def test_agent_of_a_container_always_starts_again(tmp_path: Path, status: object) -> None:
    archive = entry.archive(user='fog', number=1000, authorized_key='',
                            agent_config={'machine': 'planner'})
    with tarfile.open(fileobj=io.BytesIO(archive.data())) as tar:
        member = tar.extractfile('opt/fogros2/entry.sh')
        assert member is not None
        script = member.read().decode()
    loop = script[script.index('# deadlines of an agent before this boot'):]
    calls = tmp_path / 'calls'
    python = tmp_path / 'python3'
    end = 'kill -s TERM $$' if status == 'signal' else f'exit {status}'
    python.write_text(f'#!/bin/sh\necho "$@" >>{calls}\n{end}\n')
    python.chmod(0o755)
    first = subprocess.Popen(['sh', '-c', loop], start_new_session=True, env={
        'PATH': f'{tmp_path}:{os.environ["PATH"]}'})
    try:
        wait_until(lambda: calls.exists() and len(calls.read_text().splitlines()) > 1,
                   timeout=60, what='a second agent')
        assert first.poll() is None
    finally:
        os.killpg(first.pid, signal.SIGKILL)
        first.wait()
