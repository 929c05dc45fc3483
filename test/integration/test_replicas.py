# SPDX-License-Identifier: Apache-2.0
"""Replicas on machines: a node that dies, machines that are lost, the robot as the last one."""

from __future__ import annotations

import re
import shutil
import subprocess
import time
import uuid

import pytest

from fogros2.model import Command
from fogros2.process import argv
from fogros2.waiting import wait_until
from rigs import replicated
from rigs.launched import launching, ros2

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]

RUN = uuid.uuid4().hex[:6]
#: Milliseconds until the next replica is asked: more than a busy computer takes to report a death.
HEDGE = 3000.0
CALL = re.compile(r'call (\d+) by (\d+): ([\d.]+) ms')


def calls(run):
    return [(int(number), int(by), float(taken)) for number, by, taken in CALL.findall(run.text)]


def take_away(engine, *names):
    subprocess.run(argv(Command((
        engine, 'rm', '-f', '-t', '0', *(f'fogros2-{name}' for name in names)), sudo=True)),
        check=True, capture_output=True, timeout=60)


def test_calls_go_on_when_a_node_dies_and_machines_are_lost(
    cloud_network, engine, tmp_path, monkeypatch,
):
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    names = [f'replica-{RUN}-{number}' for number in range(3)]
    path = replicated.write(tmp_path / 'replicated.launch.py', names, cloud_network, HEDGE,
                            deadline=2 * HEDGE / 1000, vpn_path='stream')
    with launching() as launch:
        run = launch(str(path))
        run.wait_for('VPN path', times=3)
        run.wait_for('death of', times=1)
        cost = float(re.search(r'death of \d: ([\d.]+) ms from then', run.text)[1])
        assert cost < HEDGE, 'the agent reports the end before the next one is asked'
        # let its node start again, then take away the machine that answers
        run.wait_for('process started with pid', times=7)
        before = calls(run)
        wait_until(lambda: len(calls(run)) > len(before) + 10, timeout=60.0, what='calls')
        gone = calls(run)[-1][1]
        take_away(engine, names[gone])
        begin = time.monotonic()
        run.wait_for(f"the machine '{names[gone]}' is gone")
        run.wait_for('the other replicas go on')
        count = len(calls(run))
        wait_until(lambda: len(calls(run)) > count + 20, timeout=60.0, what='calls')
        after = [by for at, line in run.since(begin, 'call ') for by in [CALL.search(line)] if by]
        assert all(int(match[2]) != gone for match in after[5:])
        assert not re.search(r'call \d+ is lost', run.text)
        # the client lets the one that answers die now and then, also while this looks
        wait_until(lambda: re.search(
            r'REPLICA OF +STATE.*\n/plan +live',
            ros2('fog', 'status', names[(gone + 1) % 3]).stdout),
            timeout=60.0, what='a live replica')
        # the robot's copy is asked when no machine is left
        others = [name for name in names if name != names[gone]]
        take_away(engine, *others)
        run.wait_for(f' by {replicated.ROBOT}: ', times=20)
        for name in others:
            run.wait_for(f"the machine '{name}' is gone")
        assert not re.search(r'call \d+ is lost', run.text)
        run.interrupt()
        assert run.ended() == 0, run.text
