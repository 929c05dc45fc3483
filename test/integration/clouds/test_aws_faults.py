# SPDX-License-Identifier: Apache-2.0
"""Robots that vanish while an EC2 instance comes up."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import uuid

import pytest

from fogros2.waiting import wait_until
from rigs.colcon_workspace import colcon_workspace

CLOUDS = ('aws',)
pytestmark = pytest.mark.soak

#: A launch with little patience for the boot.
BOOTING = '''\
import sys
from fogros2.deploy import Launch
from fogros2.model import MachineSpec
from fogros2.waiting import Timeouts
Launch(timeouts=Timeouts(boot=2.0, ssh=2.0)).up(MachineSpec(sys.argv[1], 'aws'))
'''

UBUNTU = 'ID=ubuntu\nVERSION_ID="24.04"\nVERSION_CODENAME=noble\nUBUNTU_CODENAME=noble\n'
SLEEPS = '#!/bin/sh\necho "$0 $*" >>/tmp/slow.$(id -u)\nexec sleep 600\n'


def test_instance_ends_whose_robot_vanished_early(robot, box, name, tmp_path):
    """In the boot, while ROS is installed, and while the workspace is on its way."""
    installing, syncing = 'ami-0bbbbbbbbbbbbbbbb', 'ami-0cccccccccccccccc'
    box.publish(installing, region='us-east-1', files={
        '/etc/os-release': UBUNTU, '/usr/local/bin/apt-get': SLEEPS})
    box.publish(syncing, region='us-east-1', files={'/usr/local/bin/rsync': SLEEPS})
    package = f'fogt_{uuid.uuid4().hex[:6]}'
    variables = colcon_workspace(tmp_path / 'workspace', package, programs={'nothing': 'pass'})
    box.set_boot_delay(1.0)
    phases = {
        'install': {'ami_image': installing, 'bootstrap': 'apt'},
        'sync': {'ami_image': syncing, 'ros_workspace': str(tmp_path / 'workspace')}}
    runs = {phase: robot.own(
        f'{name}-{phase}', options, **(variables if phase == 'sync' else {}))
        for phase, options in phases.items()}
    booting = subprocess.Popen(
        box.on_robot([sys.executable, '-c', BOOTING, f'{name}-boot']),
        env=robot.environment(), start_new_session=True)
    try:
        def instance(phase):
            return next((found for found in box.instances()
                         if found.tags.get('fogros2-name') == f'{name}-{phase}'), None)

        wait_until(lambda: instance('boot'), timeout=60, what='a machine that boots')
    finally:
        os.killpg(booting.pid, signal.SIGKILL)
        booting.wait(60)

    def slow(phase, word):
        assert runs[phase].child.poll() is None, runs[phase].text
        found = instance(phase)  # on a busy computer, the third machine may be the first
        return found and word in box.run(found.id, 'cat /tmp/slow.*', check=False)

    for phase, word in (('install', 'apt-get'), ('sync', 'rsync')):
        wait_until(lambda p=phase, w=word: slow(p, w), timeout=60, what=f'the {phase} to begin')
    for run in runs.values():
        run.kill()
    wait_until(lambda: not box.alive(), timeout=60, what='the machines to end by themselves')
    for phase in (*phases, 'boot'):
        assert instance(phase).reason == 'Client.InstanceInitiatedShutdown'
    # what a machine can't take along goes when the robot forgets it; of the one that was killed
    # before it knew its machine, gc finds group and key by their tags, a quarter of an hour later
    deleted = robot.ros2('fog', 'delete', '--yes', 'all')
    assert deleted.returncode == 0, deleted.stdout + deleted.stderr
    assert {kind: len(names) for kind, names in robot.things().items()} in (
        {}, {'groups': 1, 'keys': 1})
    robot.cloud.clear(box)
