# SPDX-License-Identifier: Apache-2.0
"""A box keeps its robot in, and leaves nothing."""

from __future__ import annotations

import os
from pathlib import Path
import signal
import subprocess
import sys

import pytest

from fogros2 import process
from fogros2.model import Command
from fogros2.waiting import wait_until
from rigs.computers.network import ROBOT
from rigs.ec2 import Ec2Box

boto3 = pytest.importorskip('boto3', reason='needs boto3')
CLOUDS = ('aws',)


def test_the_robot_has_no_way_out_and_may_move(box):
    def on_robot(*words):
        return subprocess.run(box.on_robot(words), capture_output=True, text=True, timeout=60)

    assert on_robot('curl', '-s', box.checkip).stdout.strip() == ROBOT
    assert on_robot('curl', '-s', '-m', '2', 'http://192.0.2.1/').returncode != 0
    connect = ('import socket, sys; socket.create_connection((sys.argv[1], 443), 2).close()')
    assert on_robot(sys.executable, '-c', connect,
                    'ec2.eu-central-1.amazonaws.com').returncode == 0
    assert on_robot(sys.executable, '-c', connect,
                    'ec2.sa-east-1.amazonaws.com').returncode != 0
    assert not any(Path('/sys/class/net', name).exists() for name in (box.robot, 'robot'))
    moved = box.move_robot()
    try:
        assert on_robot('curl', '-s', box.checkip).stdout.strip() == moved != ROBOT
    finally:
        box.move_robot(back=True)


STARTER = """
import sys, time, boto3
from rigs.ec2 import Ec2Box
with Ec2Box() as box:
    ec2 = boto3.client('ec2', region_name='us-east-1', **box.client_arguments)
    box.publish('ami-0123456789abcdef0', region='us-east-1')
    made = ec2.run_instances(ImageId='ami-0123456789abcdef0', InstanceType='t3.medium',
                             MinCount=1, MaxCount=1)
    box.wait_for(made['Instances'][0]['InstanceId'], 'running', computer=True)
    print(box.mark, box._child.pid, flush=True)
    time.sleep(600)
"""


def traces_of(mark):
    """Return what a box with this mark has on this computer now."""
    found = [name for name in process.run(
        Command(('ip', 'netns', 'list'), sudo=True), timeout=60).stdout.split()
        if name.startswith(f'fogt{mark}')]
    found += process.run(Command(
        ('podman', 'ps', '-aq', f'--filter=label=fogros2-ec2={mark}'), sudo=True),
        timeout=60).stdout.split()
    found += [str(path) for path in Path('/var/lib/fogros2-ec2').glob(mark)]
    return found + [str(path) for path in Path('/etc/netns').glob(f'fogt{mark}*')]


@pytest.mark.soak
@pytest.mark.parametrize('whose', ['test', 'box'])
def test_box_leaves_nothing_whichever_process_dies(box, whose, tmp_path):
    # its log's folder is what the one that is killed can't take away
    child = subprocess.Popen([sys.executable, '-c', STARTER], stdout=subprocess.PIPE, text=True,
                             env={**os.environ, 'TMPDIR': str(tmp_path)})
    mark, pid = child.stdout.readline().split()
    assert traces_of(mark)
    if whose == 'test':
        child.kill()
    else:
        process.run(Command(('kill', '-KILL', pid), sudo=True), timeout=60)
        assert traces_of(mark)
        os.kill(child.pid, signal.SIGKILL)
        with Ec2Box():
            pass  # the next one tidies up
    child.wait(60)
    child.stdout.close()
    wait_until(lambda: not traces_of(mark), timeout=60, what='the box to be gone')
