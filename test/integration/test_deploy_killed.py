# SPDX-License-Identifier: Apache-2.0
"""A launch that was killed while it had a kept machine, and the next one, which comes at once."""

from __future__ import annotations

from collections.abc import Iterator
import os
import shutil
import signal
import subprocess
import sys
import uuid

import pytest

from fogros2 import process
from fogros2.deploy import Launch
from fogros2.model import Command, MachineSpec
from fogros2.store import Store
from rigs.launched import ros2
from ros2fog_cli.api import endings

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]

KILLED = """
import signal, sys
from fogros2.deploy import Launch
from fogros2.model import MachineSpec
machine = Launch().up(MachineSpec(sys.argv[1], 'container', {'network': sys.argv[2]},
                                  on_exit='keep'))
print(machine.interface.name, flush=True)
signal.pause()
"""


def test_the_next_launch_takes_the_kept_machine_of_a_killed_one(cloud_network):
    name = f'killed-{uuid.uuid4().hex[:6]}'
    first = subprocess.Popen([sys.executable, '-c', KILLED, name, cloud_network],
                             stdout=subprocess.PIPE, preexec_fn=os.setpgrp)
    assert first.stdout is not None
    interface = first.stdout.readline().decode().strip()
    first.send_signal(signal.SIGKILL)
    first.communicate()
    store = Store()
    before = store.load(name)
    assert interface and before.launch and not before.launch_alive
    launch = Launch(store=store)
    try:
        machine = launch.up(MachineSpec(name, 'container', {'network': cloud_network}))
        assert machine.machine.id == before.machine_id
        there = machine.shell.run(Command(('ls', '/sys/class/net')), timeout=60).stdout.split()
        assert machine.interface.name in there
        assert interface not in there, 'the VPN of the killed launch'
    finally:
        assert launch.down() == []
        for leftover in endings.leftovers(store):
            endings.clear(leftover)
    assert os.listdir(store.root / 'machines') == []


ROBOT = """
import signal
from fogros2.deploy import Launch
launch = Launch()
launch.robot_vpn().ensure()
print(launch.id, flush=True)
signal.pause()
"""


@pytest.fixture
def alone(tun: None) -> Iterator[tuple[str, ...]]:
    """Return the words that lead into a network without any gc of other tests."""
    if os.geteuid() != 0:
        pytest.skip('needs root itself: sudo, the way into another network, keeps no variables')
    name = f'fogt{os.getpid()}'
    run(['ip', 'netns', 'add', name])
    yield 'ip', 'netns', 'exec', name
    run(['ip', 'netns', 'delete', name])


def test_gc_deletes_interface_without_the_launchs_notes(alone, monkeypatch, tmp_path):
    """From another state folder: the interface names its owner; one of a live launch stays."""
    launches = [subprocess.Popen([*alone, sys.executable, '-c', ROBOT], stdout=subprocess.PIPE)
                for _ in range(2)]
    killed, alive = (launch.stdout.readline().decode().strip() for launch in launches)
    store = Store()
    try:
        launches[0].kill()
        launches[0].communicate()
        monkeypatch.setenv('FOGROS2_STATE_HOME', str(tmp_path))
        said = ros2('fog', 'gc', prefix=alone).stdout
        assert f'cleared leftovers of launch {killed}' in said and alive not in said
        assert f'fog{alive}' in run([*alone, 'ls', '/sys/class/net'])
    finally:
        launches[1].kill()
        launches[1].communicate()
        monkeypatch.setenv('FOGROS2_STATE_HOME', str(store.root))
        ros2('fog', 'gc', prefix=alone)
    left = run([*alone, 'sh', '-c', 'ls /sys/class/net; nft list tables; ps -eo args'])
    assert f'fog{killed}' not in left and f'fog{alive}' not in left


def run(words):
    """Return what a command of root prints."""
    return process.run(Command(tuple(words), sudo=True), timeout=60).stdout
