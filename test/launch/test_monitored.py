# SPDX-License-Identifier: Apache-2.0
"""The bridges of a launch with ``launch_foxglove=True`` and with ``Foxglove`` actions."""

from __future__ import annotations

from launch import LaunchDescription
import pytest

from fogros2 import CloudNode, ContainerInstance, Foxglove


@pytest.fixture
def planner():
    return ContainerInstance(name='planner', ros_workspace='', launch_foxglove=True,
                             monitor_allow=['198.51.100.0/28'])


@pytest.fixture
def bridges(run, fake, planner):
    """Return a function that runs actions beside a node, and returns what runs until the end."""
    def beside(*actions, first=False):
        def started(machine, node):
            for own in machine.all if len(machine.all) == 2 else ():
                if own.name.startswith('own'):
                    machine.say('exited', own, returncode=0, respawns=False)

        fake.on_start = started
        node = CloudNode(machine=planner, package='demo', executable='talker', exec_name='own')
        status = run(LaunchDescription([*actions, node] if first else [node, *actions]))
        assert status == 0
        return [node for node in fake.machines['planner'].all if 'bridge' in node.name]

    return beside


@pytest.mark.parametrize('first', [True, False])
def test_bridge_of_an_action_takes_the_place_of_the_default(bridges, planner, first):
    bridge, = bridges(Foxglove(planner, topics=['/tf']), first=first)
    words = list(bridge.arguments)
    assert words[-3:] == ['--topic', '/tf', '--ros-args']
    assert words[words.index('--allow') + 1] == '198.51.100.0/28'


def test_default_bridge_shows_all(bridges):
    bridge, = bridges()
    assert list(bridge.arguments)[-3:] == ['--topic', '*', '--ros-args']


def test_two_bridges_at_one_port_are_refused(run, planner, capfd):
    assert run(LaunchDescription([Foxglove(planner), Foxglove(planner, topics=['/tf'])])) == 1
    said = ''.join(capfd.readouterr())
    assert "'planner' has two bridges at port 8765 (give one of them" in said
