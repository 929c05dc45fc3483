# SPDX-License-Identifier: Apache-2.0
"""A launch that was killed while it had a kept machine, and the next one, which comes at once."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import uuid

import pytest

from fogros2.deploy import Launch
from fogros2.model import Command, MachineSpec
from fogros2.store import Store
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
        there = machine.shell.run(Command(('ls', '/sys/class/net')), timeout=10).stdout.split()
        assert machine.interface.name in there
        assert interface not in there, 'the VPN of the killed launch'
    finally:
        assert launch.down() == []
        for leftover in endings.leftovers(store):
            endings.clear(leftover)
    assert os.listdir(store.root / 'machines') == []
