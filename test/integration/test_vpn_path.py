# SPDX-License-Identifier: Apache-2.0
"""Launches whose UDP is blocked: their VPN goes by the connection of the machine's shell."""

from __future__ import annotations

import shutil
import uuid

import pytest

from fogros2.deploy import Launch
from fogros2.errors import VpnError
from fogros2.model import MachineSpec
from fogros2.waiting import Timeouts
from rigs.launched import launching
from rigs.networks import without_udp

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]

#: Other runs of these tests may be under way on the same computer.
RUN = uuid.uuid4().hex[:6]

LAUNCH = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    return FogROSLaunchDescription([
        CloudNode(machine=ContainerInstance(name='{name}', network='{network}'),
                  package='fogros2_examples', executable='talker'),
        Node(package='fogros2_examples', executable='listener', output='screen')])
"""


@pytest.fixture
def spec(cloud_network):
    def make(path='auto'):
        return MachineSpec(f'path-{RUN}', 'container', {'network': cloud_network},
                           features={'vpn_path': {'vpn_path': path}})
    return make


def test_udp_alone_fails_and_names_the_remedy(cloud_network, spec):
    launch = Launch(timeouts=Timeouts(vpn=5.0))
    try:
        with without_udp(cloud_network), pytest.raises(VpnError, match="vpn_path='auto'"):
            launch.up(spec('udp'))
    finally:
        assert launch.down() == []


def test_nodes_of_a_machine_are_heard(cloud_network, tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    path = tmp_path / 'nodes.launch.py'
    path.write_text(LAUNCH.format(name=f'path-{RUN}', network=cloud_network))
    with without_udp(cloud_network), launching() as start:
        run = start(str(path))
        run.wait_for(f'I heard: [Hello World from path-{RUN} ', times=2)
        run.interrupt()
        assert run.ended() == 0, run.text
    assert 'VPN path' in run.text and run.clean, run.text
