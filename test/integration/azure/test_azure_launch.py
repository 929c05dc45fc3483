# SPDX-License-Identifier: Apache-2.0
"""Launches on machines of Azure, from nothing to messages to nothing."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.timeout(120)

#: What Azure may be asked for one launch at the most, from its beginning to its end.
CALLS = 25
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
TALKER = ('fogros2_examples', 'talker.azure.launch.py')


def clean(run):
    """Return whether it said nothing that would worry anybody; Ctrl-C is a warning to launch."""
    others = run.text.replace('[WARNING] [launch]: user interrupted with ctrl-c', '')
    return run.errors == [] and 'WARNING' not in others and 'Traceback' not in others


def test_the_talker_from_nothing_to_nothing(robot, box, name):
    run = robot.launch(*TALKER, f'name:={name}')
    run.wait_for(f'I heard: [Hello World from {name} ')
    (machine,) = box.alive()
    assert (machine.type, machine.region, machine.state) == (
        'Standard_B2als_v2', 'westeurope', 'running')
    assert machine.tags['fogros2-name'] == name
    things = box.things()
    (group,) = things['groups']
    # the group has everything, and all of it has the tags
    kinds = {}
    for path, entry in things['resources'].items():
        kinds[entry['type'].rpartition('/')[2]] = entry
        if 'tags' in entry:
            assert entry['tags']['fogros2-name'] == name
        assert f'/resourceGroups/{group}/' in path or 'roleDefinitions' in path
    assert kinds['disks'] and kinds['virtualMachines']['properties']['storageProfile'][
        'osDisk']['deleteOption'] == 'Delete'
    # SSH goes through the VPN by now, and its port is closed to everybody
    rules = [path.rpartition('/')[2] for path in things['resources'] if '/securityRules/' in path]
    assert sorted(rules) == ['nothing-else', 'vpn']
    # the machine may end itself, and nothing else
    assert kinds['roleDefinitions']['properties']['permissions'][0]['actions'] == [
        'Microsoft.Compute/virtualMachines/deallocate/action',
        'Microsoft.Resources/subscriptions/resourceGroups/delete']
    # the host key that went through user data is nobody's any more
    now = box.run(machine.id, 'cat /etc/ssh/ssh_host_ed25519_key.pub').split()[1]
    assert now in machine.tags['fogros2-host-key']
    heard = run.text.count('I heard: ')
    box.move_robot()
    try:
        run.wait_for('I heard: ', times=heard + 2)
        run.interrupt()
        assert run.ended() == 0, run.text
    finally:
        box.move_robot(back=True)
    assert clean(run), run.text
    asked = [call for call in box.calls() if call.service]
    assert f'{name}: ' in run.text and 'h at $0.0376 an hour, $' in run.text
    assert len(asked) <= CALLS, asked


@pytest.mark.soak
def test_launch_file_of_pull_request_109_runs(robot, box):
    run = robot.launch(robot.write('talker.azure.launch.py', PULL_REQUEST),
                       AZURE_DEFAULTS_LOCATION='')
    run.wait_for('I heard: [Hello World from ')
    (machine,) = box.alive()
    assert machine.region == 'eastus' and list(box.things()['groups']) == [machine.id]
    run.interrupt()
    assert run.ended() == 0, run.text
    assert clean(run), run.text
