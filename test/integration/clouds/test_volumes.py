# SPDX-License-Identifier: Apache-2.0
"""Volumes in each cloud, with a real file system on a loop device of this computer."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.soak

LAUNCH = '''
from fogros2 import {machine}, CloudNode, FogROSLaunchDescription


def generate_launch_description():
    machine = {machine}(name={name!r}, ros_workspace='', robot_timeout=6,
                        volumes={{'models': '/data:1GB'}})
    return FogROSLaunchDescription([CloudNode(
        machine=machine, package='fogros2_examples', executable='talker', output='screen')])
'''


@pytest.fixture(scope='module')
def box(cloud, engine):
    with cloud.open(volumes=True) as box:
        yield box


def test_data_come_back_with_the_next_machine(cloud, robot, box, name):
    def start(machine):
        return robot.launch(robot.write(f'{machine}.launch.py', LAUNCH.format(
            machine=cloud.machine, name=machine)))

    run = start(f'{name}-one')
    run.wait_for('Publishing')
    assert 'models at /data, new' in run.text
    (instance,) = box.alive()
    assert box.run(instance.id, 'findmnt -n -o FSTYPE /data').strip() == 'ext4'
    box.run(instance.id, 'echo kept >/data/model')
    other = start(f'{name}-two')
    assert other.ended() != 0
    assert "the volume 'models' in" in other.text and 'is in use by' in other.text
    assert 'models' in robot.fog('volume', 'list')
    assert 'volumes: about $0.' in robot.fog('list')
    run.interrupt()
    assert run.ended() == 0, run.text
    assert 'models' in robot.fog('volume', 'list')

    again = start(f'{name}-two')
    again.wait_for('Publishing')
    assert 'models at /data' in again.text and 'new' not in again.text.split('models at')[1][:12]
    (instance,) = box.alive()
    assert box.run(instance.id, 'cat /data/model').strip() == 'kept'
    again.interrupt()
    assert again.ended() == 0, again.text
    assert 'deleted models' in robot.fog('volume', 'delete', 'models', '--yes')
    assert robot.fog('volume', 'list') == 'no volumes\n'


def test_replacement_has_the_volume_in_its_zone(cloud, robot, box, name):
    if cloud.name != 'aws':
        pytest.skip('only EC2 confirms its notice before the end')
    run = robot.launch(robot.write('replaced.launch.py', LAUNCH.format(
        machine=cloud.machine, name=name).replace(
            'robot_timeout=6,', "robot_timeout=6, spot=True, on_interrupt='replace',")))
    run.wait_for('Publishing')
    (first,) = box.alive()
    box.run(first.id, 'echo kept >/data/model')
    box.interrupt(first.id, notice=60.0)
    run.wait_for('models at /data', times=2)
    (second,) = [one for one in box.alive() if one.id != first.id]
    assert second.zone == first.zone
    assert box.run(second.id, 'cat /data/model').strip() == 'kept'
    run.interrupt()
    assert run.ended() == 0, run.text
    assert 'deleted models' in robot.fog('volume', 'delete', 'models', '--yes')
