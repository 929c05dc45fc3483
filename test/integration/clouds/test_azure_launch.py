# SPDX-License-Identifier: Apache-2.0
"""A launch file of the form of FogROS2's pull request for Azure."""

from __future__ import annotations

import pytest

CLOUDS = ('azure',)

#: A launch file of the form that FogROS2's pull request 109 shows.
PULL_REQUEST = '''\
from launch_ros.actions import Node

import fogros2


def generate_launch_description():
    description = fogros2.FogROSLaunchDescription()
    machine = fogros2.AzureCloudInstance(resource_group='fogros', ami_image='UbuntuLTS')
    words = {'package': 'fogros2_examples', 'output': 'screen'}
    description.add_action(fogros2.CloudNode(executable='talker', machine=machine, **words))
    description.add_action(Node(executable='listener', **words))
    return description
'''


@pytest.mark.soak
def test_launch_file_of_pull_request_109_runs(robot, box):
    run = robot.launch(robot.write('talker.azure.launch.py', PULL_REQUEST),
                       AZURE_DEFAULTS_LOCATION='')
    run.wait_for('I heard: [Hello World from ')
    (machine,) = box.alive()
    assert machine.region == 'eastus' and list(box.things()['groups']) == [machine.id]
    run.interrupt()
    assert run.ended() == 0, run.text
    assert run.clean, run.text
