# SPDX-License-Identifier: Apache-2.0
"""What a hijacked machine may say, and the robot's launch goes on."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest

pytest.importorskip('launch.actions', reason='needs ROS 2, or its embedded default')

from fogros2.actions.session import Session
from fogros2.model import MachineSpec
from fogros2.shell import ssh


class Endless:
    """A channel on which no line ever ends."""

    closed = False

    def settimeout(self, seconds):
        pass

    def recv(self, size):
        return b'x' * size

    def recv_stderr_ready(self):
        return False

    def close(self):
        self.closed = True


def test_a_line_without_an_end_fills_no_memory(monkeypatch):
    monkeypatch.setattr(ssh, 'MAX_LINE', 1 << 20)
    channel = Endless()
    assert ssh.SSHStream(channel, 'planner').readline() == b''
    assert channel.closed


@pytest.mark.parametrize('event', [
    {'event': ['started']}, {'event': 'started', 'node': ['n']}, {'event': 'started', 'node': 'n'},
    {'event': 'started', 'node': 'n', 'pid': 1, 'cmd': [1]},
    {'event': 'output', 'node': 'n', 'text': 5}, {'event': 'exited', 'node': 'n'},
    {'event': 'exited', 'node': 'n', 'returncode': 'x'}, {'event': 'refused', 'node': 'n'},
    {'event': 'vpn_repaired', 'seconds': 'x'}, {'event': 'connection', 'state': {}},
    {'event': 'launch_exited', 'returncode': []}])
def test_an_event_that_makes_no_sense_is_left_aside(event):
    heard = []
    loop = asyncio.new_event_loop()
    try:
        session = Session(MachineSpec('planner', 'ssh'), loop, in_thread=None, fail=heard.append,
                          changed=lambda: None)
        session._runs['n'] = SimpleNamespace(on_event=heard.append)
        session._on_event(event)
    finally:
        loop.close()
    assert heard == []
