# SPDX-License-Identifier: Apache-2.0
"""Shared topics: which machine runs the relay, and what is refused."""

from __future__ import annotations

import json

from launch import LaunchDescription
import pytest

from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription, SSHInstance
from fogros2.errors import Unsupported
from fogros2.model import MachineSpec
from fogros2_features.share import Share


def talker(machine):
    return CloudNode(machine=machine, package='demo', executable='talker')


def test_machine_runs_one_relay_of_its_topics(run, fake):
    nodes = []

    def start(machine, node):
        nodes.append((machine.spec.name, node))
        if len(nodes) == 4:
            machines = {one.spec.name: one for one in fake.machines.values()}
            for name, each in nodes:
                if each.name.startswith('talker'):
                    machines[name].say('exited', each, returncode=0, respawns=False)

    fake.on_start = start
    shared = ContainerInstance(
        name='planner', ros_workspace='', share=['/map', '/tf_static'], on=SSHInstance('box'))
    assert run(FogROSLaunchDescription([
        talker(shared), talker(shared),
        talker(ContainerInstance(name='other', ros_workspace=''))])) == 0
    relay, = (node for _, node in nodes if node.executable == 'share')
    assert (relay.package, relay.executable, relay.respawn) == ('fogros2', 'share', True)
    assert json.loads(relay.arguments[0]) == {
        'topics': ['/map', '/tf_static'],
        'folders': ['/opt/fogros2/share', '/opt/fogros2/shared']}
    assert [name for name, node in nodes if node is relay] == ['planner']


def test_second_sharing_machine_is_refused(run, fake, capfd):
    """Each would send the other's messages back, without an end."""
    machines = [ContainerInstance(name=name, ros_workspace='', share=['/map'])
                for name in ('one', 'two')]
    assert run(LaunchDescription([talker(each) for each in machines])) == 1
    assert "'two' is the second machine of this launch with share=" in capfd.readouterr().out


def test_machine_without_a_host_shares_nothing():
    own = Share.options(share=['/map'])
    Share().check(MachineSpec('planner', 'hosted'), own)
    with pytest.raises(Unsupported, match="'planner' can't share topics") as error:
        Share().check(MachineSpec('planner', 'ssh'), own)
    assert 'ContainerInstance(on=' in error.value.hint


def test_launch_without_share_runs_no_relay(run, fake):
    nodes = []

    def start(machine, node):
        nodes.append(node)
        machine.say('exited', node, returncode=0, respawns=False)

    fake.on_start = start
    assert run(FogROSLaunchDescription([
        talker(ContainerInstance(name='planner', ros_workspace=''))])) == 0
    assert [node.executable for node in nodes] == ['talker']
