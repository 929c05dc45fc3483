# SPDX-License-Identifier: Apache-2.0
"""Launch files written for FogROS2 on EC2, and values that depend on the region."""

from __future__ import annotations

import difflib
from pathlib import Path

import pytest

CLOUDS = ('aws',)

#: Ours, with what FogROS2's talker.aws.launch.py uses: a release that the robot doesn't have, an
#: image by its id, and entities that are added one by one.
FORM = """
import fogros2
import lsb_release
from launch_ros.actions import Node

IMAGES = {'20.04': 'ami-00000020', '22.04': 'ami-00000022'}


def generate_launch_description():
    release = lsb_release.get_os_release()['RELEASE']
    if release not in IMAGES:
        raise ValueError(f'no image for {release}')
    description = fogros2.FogROSLaunchDescription()
    machine = fogros2.AWSCloudInstance(
        region='us-west-1', ec2_instance_type='c5.4xlarge', ami_image=IMAGES[release])
    description.add_action(fogros2.CloudNode(
        package='fogros2_examples', executable='talker', output='screen', machine=machine))
    description.add_action(Node(
        package='fogros2_examples', executable='listener', output='screen'))
    return description
"""

#: Ours, with what its talker.auto_aws.launch.py uses, after the change of one line.
AUTO = """
import fogros2
from fogros2 import ec2_instance_type_selection, region_ami_selection
from launch_ros.actions import Node


def generate_launch_description():
    region, image = region_ami_selection.find_nearest_region_and_ami({
        'us-west-1': {'ami_image': 'ami-00000011'}, 'us-east-1': {'ami_image': 'ami-00000012'}})
    kind = ec2_instance_type_selection.find_cheapest_ec2_instance_type(region)
    print('on', region, image, kind)
    description = fogros2.FogROSLaunchDescription()
    description.add_action(fogros2.CloudNode(
        package='fogros2_examples', executable='talker', output='screen',
        machine=fogros2.AWSCloudInstance(
            region=region, ec2_instance_type=kind, ami_image=image)))
    description.add_action(Node(
        package='fogros2_examples', executable='listener', output='screen'))
    return description
"""

#: The region is known as late as the image is looked for in the mapping.
MISSING = """
from fogros2 import AWSCloudInstance, CloudNode, find_nearest_aws_region, FogROSLaunchDescription


def generate_launch_description():
    machine = AWSCloudInstance(
        name='{name}', region=find_nearest_aws_region(['us-east-1']),
        ami_image={{'us-west-1': 'ami-00000011'}})
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='talker')])
"""


def talks(robot, box, path, **variables):
    """Launch a file until the robot hears the machine, end it, and return its instance."""
    run = robot.launch(str(path), **variables)
    run.wait_for('I heard: [Hello World from ')
    (instance,) = box.alive()
    run.interrupt()
    assert run.ended() == 0, run.text
    assert run.clean, run.text
    return instance


def test_fogros2s_form_on_a_simulated_ubuntu_22_04(robot, box, jammy):
    box.publish('ami-00000022', region='us-west-1')
    instance = talks(robot, box, robot.write('form.launch.py', FORM),
                     PYTHONPATH=jammy['PYTHONPATH'])
    assert (instance.region, instance.type, instance.image) == (
        'us-west-1', 'c5.4xlarge', 'ami-00000022')


def test_fogros2s_talker_aws_on_a_simulated_ubuntu_22_04(upstream, robot, box, jammy):
    """Byte for byte: the file is launched where it lies."""
    box.publish('ami-034160df82745c454', region='us-west-1')
    instance = talks(robot, box, upstream / 'FogROS2/fogros2_examples/launch/talker.aws.launch.py',
                     PYTHONPATH=jammy['PYTHONPATH'])
    assert (instance.region, instance.type, instance.image) == (
        'us-west-1', 'c5.4xlarge', 'ami-034160df82745c454')


@pytest.mark.soak
def test_fogros2s_form_of_choosing_region_and_type(robot, box):
    box.publish('ami-00000011', region='us-west-1')
    box.publish('ami-00000012', region='us-east-1')
    instance = talks(robot, box, robot.write('auto.launch.py', AUTO))
    assert (instance.region, instance.image) in (
        ('us-west-1', 'ami-00000011'), ('us-east-1', 'ami-00000012'))


def test_fogros2s_talker_auto_aws_with_one_line_changed(upstream, robot, box):
    for region, image in (('us-west-1', 'ami-02ea247e531eb3ce6'),
                          ('us-east-1', 'ami-08c40ec9ead489470')):
        box.publish(image, region=region)
    file = upstream / 'FogROS2/fogros2_examples/launch/talker.auto_aws.launch.py'
    # as doc/migration.md has it
    page = (Path(__file__).resolve().parents[3] / 'doc' / 'migration.md').read_text()
    old = 'from utils import region_ami_selection, ec2_instance_type_selection'
    new = 'from fogros2 import region_ami_selection, ec2_instance_type_selection'
    assert old in page and new in page
    before = file.read_text()
    after = before.replace(old, new)
    changed = [line for line in difflib.ndiff(before.splitlines(), after.splitlines())
               if line.startswith(('+', '-'))]
    assert changed == [f'- {old}', f'+ {new}']
    instance = talks(robot, box, robot.write('auto.launch.py', after))
    assert (instance.region, instance.image) in (
        ('us-west-1', 'ami-02ea247e531eb3ce6'), ('us-east-1', 'ami-08c40ec9ead489470'))


@pytest.mark.soak
def test_the_image_and_the_type_follow_the_region(robot, box, name):
    for region, image in (('eu-central-1', 'ami-0fedcba9876543210'),
                          ('us-east-1', 'ami-0123456789abcdef0')):
        box.publish(image, region=region)
    run = robot.launch('fogros2_examples', 'talker.regions.aws.launch.py', f'name:={name}',
                       'count:=1')
    assert run.ended() == 0, run.text
    assert run.clean, run.text
    (instance,) = [found for found in box.instances()
                   if found.tags.get('fogros2-name') == name]
    assert (instance.region, instance.image, instance.type) in (
        ('eu-central-1', 'ami-0fedcba9876543210', 't3.medium'),
        ('us-east-1', 'ami-0123456789abcdef0', 't3a.medium'))


@pytest.mark.soak
def test_a_region_that_a_mapping_lacks_ends_the_launch(robot, box, name):
    run = robot.launch(robot.write('missing.launch.py', MISSING.format(name=name)))
    assert run.ended() == 1, run.text
    assert 'ami_image has no value for the region us-east-1 (add one, or choose the region ' \
        'among us-west-1)' in '\n'.join(run.errors), run.text
    assert 'Traceback' not in run.text
    assert box.calls() == []
