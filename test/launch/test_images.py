# SPDX-License-Identifier: Apache-2.0
"""Nodes that run in an image on their machine."""

from __future__ import annotations

import re

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
import pytest

from fogros2 import CloudNode, ContainerInstance, FogMachine, FogROSLaunchDescription
from fogros2.actions.override import OverrideMachines
from fogros2.describe.overrides import Overrides
from rigs.launching import ends


def test_executable_of_an_image_is_not_checked_on_the_robot(run, fake, planner):
    fake.on_start = ends
    assert run(FogROSLaunchDescription([
        DeclareLaunchArgument('image', default_value='ros:jazzy'),
        CloudNode(machine=planner, package='elsewhere', executable='eyes', name='eyes',
                  parameters=[{'rate': 5}], image=LaunchConfiguration('image'),
                  image_options=['--gpus', LaunchConfiguration('gpus', default='all')]),
        CloudNode(machine=planner, package='demo', executable='talker')])) == 0
    (prepared,) = (note[1:] for note in fake.notes if note[0] == 'prepare')
    assert prepared == (['planner'], {'planner': [('demo', 'talker')]})
    eyes, talker = fake.machines['planner'].all
    assert (eyes.package, eyes.executable) == ('elsewhere', 'eyes')
    assert eyes.features == {
        'containers': {'image': 'ros:jazzy', 'image_options': ['--gpus', 'all']}}
    assert any(re.search(r'"?rate"?: 5', text) for text in eyes.files.values())
    assert talker.features == {}


@pytest.mark.parametrize(('given', 'options'), [
    ('', []), ('--gpus=all', ['--gpus=all']), ('-v, /a b:/c:ro', ['-v', '/a b:/c:ro']),
    ("['-e', 'A=1,2']", ['-e', 'A=1,2'])])
def test_image_options_may_be_one_argument(run, fake, planner, given, options):
    fake.on_start = ends
    assert run(LaunchDescription([
        DeclareLaunchArgument('options', default_value=given),
        CloudNode(machine=planner, package='demo', executable='talker', image='ros:jazzy',
                  image_options=LaunchConfiguration('options'))])) == 0
    (talker,) = fake.machines['planner'].all
    assert talker.features['containers']['image_options'] == options


@pytest.mark.parametrize(('provider', 'given', 'mounts'), [
    ('container', '', []), ('container', '/usr, /etc:/other', ['/usr', '/etc:/other']),
    ('aws', '', None)])
def test_mounts_of_a_machine_may_be_one_argument(provider, given, mounts):
    context = LaunchContext()
    context.launch_configurations.update(provider=provider, mounts=given)
    action = FogMachine(LaunchConfiguration('provider'), {
        'name': 'planner', 'ros_workspace': '', 'mounts': LaunchConfiguration('mounts')})
    action.execute(context)
    assert action.machine.spec(context).options.get('mounts') == mounts


def test_idle_machine_runs_no_containers(run, fake, caplog):
    planner = ContainerInstance(name='planner', ros_workspace='', idle_timeout='1m')
    assert run(LaunchDescription([CloudNode(
        machine=planner, package='demo', executable='talker', image='ros:jazzy')])) == 1
    assert "the machine 'planner' has an idle_timeout and runs a container" in caplog.text
    assert fake.noted('up') == []


@pytest.mark.parametrize(('overrides', 'more', 'why'), [
    (['*=robot'], {}, 'the robot runs this node itself'),
    ([], {'shell': True}, 'in a shell of the machine'),
])
def test_invalid_image_is_reported(run, fake, planner, caplog, overrides, more, why):
    node = CloudNode(
        machine=planner, package='demo', executable='talker', image='ros:jazzy', **more)
    assert run(LaunchDescription(
        [OverrideMachines(Overrides(overrides), [node])] if overrides else [node])) == 1
    assert why in caplog.text
    assert fake.machines == {}
