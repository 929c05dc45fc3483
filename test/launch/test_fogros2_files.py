# SPDX-License-Identifier: Apache-2.0
"""
Launch files written for FogROS2 are read, and run where that takes no machine.

Those here are our own, with the names, keywords and order of calls that FogROS2's documentation
has. Where ``FOGROS2_UPSTREAM`` names a folder with checkouts of ``FogROS2`` and
``fogros2-examples``, their own files are read too, byte for byte. The runs on machines are in
test/integration/clouds and test/integration/kubernetes.
"""

from __future__ import annotations

import os
import shutil
import subprocess

import pytest

import fogros2
from rigs.launched import launching, ros2

pytestmark = pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH')

HEAD = """
import fogros2
from launch_ros.actions import Node


def generate_launch_description():
    description = fogros2.FogROSLaunchDescription()
"""

#: Machines with the names and the order of arguments that FogROS2 has.
MACHINES = """
    machines = [
        fogros2.AWSCloudInstance(
            ami_image='ami-0123', region='us-west-1', ec2_instance_type='t2.micro', disk_size=30,
            ros_workspace='', working_dir_base='/nowhere', launch_foxglove=True),
        fogros2.AWSCloudInstance('ami-0123', 'us-west-1', 't2.micro', 30),
        fogros2.KubeInstance(
            container_image='robots/base', zone='us-central1-a', mcpu=500, mb=512),
        fogros2.KubeInstance(),
        fogros2.GCPCloudInstance(project_id='robots'),
        fogros2.GCPCloudInstance('robots-prod', 'projects/p12345/global/images/i',
                                 'us-central1-a', 'e2-medium', 10),
        fogros2.AzureCloudInstance(resource_group='robots'),
        fogros2.AzureCloudInstance('robots', 'UbuntuLTS', 'eastus', 'Standard_DS2_v2', 10)]
    for machine in machines:
        description.add_entity(fogros2.CloudNode(
            package='fogros2_examples', executable='talker', machine=machine))
    for option in ('-it', '-d'):
        machine.add_docker_container(f'sudo docker run --net=host {option} robots/arm')
"""

TAIL = """
    description.add_action(Node(package='fogros2_examples', executable='listener'))
    description.add_entity(fogros2.CloudNode(
        package='fogros2_examples', executable='talker', machine=machine, output='screen',
        stream_topics=[('/camera/image_raw', 'h264'), ('/other/image_raw', 'compressed')]))
    return description
"""

@pytest.fixture(autouse=True)
def logs(tmp_path, monkeypatch):
    """Keep what launch logs out of the user's home."""
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))


def test_launch_file_of_fogros2_is_read_without_a_request(tmp_path):
    path = tmp_path / 'own.launch.py'
    path.write_text(f"""{HEAD}{MACHINES}
    from fogros2 import ec2_instance_type_selection as types, region_ami_selection as places
    region, image = places.find_nearest_region_and_ami({{'us-west-1': {{'ami_image': 'ami-1'}}}})
    kind = types.find_cheapest_ec2_instance_type(region)
    print('chosen', region, image, kind)
    machine = fogros2.AWSCloudInstance(image, region=region, ec2_instance_type=kind)
{TAIL}""")
    # a proxy where nobody answers: what asks would fail
    shown = ros2('launch', str(path), '-s', environment={
        **os.environ, 'HTTPS_PROXY': 'http://127.0.0.1:9', 'AWS_ENDPOINT_URL':
        'http://127.0.0.1:9'})
    check(shown, '')
    assert 'chosen <the nearest AWS region>' in shown.stdout


def test_streams_of_fogros2_may_be_positional():
    node = fogros2.CloudNode('planner', [('/image', 'h264')], package='p', executable='e')
    assert node.lists == {'stream_topics': [('/image', 'h264')]}


def check(shown: subprocess.CompletedProcess[str], error: str) -> None:
    assert (shown.returncode != 0) == bool(error), shown.stdout + shown.stderr
    assert error in shown.stdout + shown.stderr
    # launch leaves a traceback of every error in a launch file
    assert error or 'Traceback' not in shown.stdout + shown.stderr


#: FogROS2's own files, by repository, and what each says where it is refused.
FILES = {
    'FogROS2/fogros2_examples/launch/talker.local.launch.py': '',
    'FogROS2/fogros2_examples/launch/talker.aws.launch.py': '',
    'FogROS2/fogros2_examples/launch/talker.kube.launch.py': '',
    'FogROS2/fogros2_examples/launch/talker.gcp.launch.py': '',
    'FogROS2/fogros2_examples/launch/talker.auto_aws.launch.py': "No module named 'utils'",
    'fogros2-examples/gqcnn_docker.launch.py': '',
    'fogros2-examples/vslam/vslam.launch.py': '',
    'fogros2-examples/mpt/mpt_ros/launch/mpt.launch.py': '',
}


@pytest.mark.parametrize('file', FILES, ids=lambda file: file.rpartition('/')[2])
def test_fogros2s_own_files_byte_for_byte(upstream, jammy, file):
    """On a simulated Ubuntu 22.04, which two of them ask for."""
    check(ros2('launch', str(upstream / file), '-s', environment=jammy), FILES[file])


def test_fogros2s_talker_local_runs_byte_for_byte(upstream):
    with launching() as start:
        run = start(str(upstream / 'FogROS2/fogros2_examples/launch/talker.local.launch.py'))
        run.wait_for('I heard: [Hello World from ')
        run.interrupt()
        assert run.ended() == 0, run.text
        assert run.errors == [] and 'Traceback' not in run.text, run.text
