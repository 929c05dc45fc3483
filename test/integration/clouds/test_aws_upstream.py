# SPDX-License-Identifier: Apache-2.0
"""Launch files written for FogROS2 on EC2."""

from __future__ import annotations

import difflib
from pathlib import Path

CLOUDS = ('aws',)


def talks(robot, box, path, **variables):
    """Launch a file until the robot hears the machine, end it, and return its instance."""
    run = robot.launch(str(path), **variables)
    run.wait_for('I heard: [Hello World from ')
    (instance,) = box.alive()
    run.interrupt()
    assert run.ended() == 0, run.text
    assert run.clean, run.text
    return instance


def test_fogros2s_talker_aws_on_a_simulated_ubuntu_22_04(upstream, robot, box, jammy):
    """Byte for byte: the file is launched where it lies."""
    box.publish('ami-034160df82745c454', region='us-west-1')
    instance = talks(robot, box, upstream / 'FogROS2/fogros2_examples/launch/talker.aws.launch.py',
                     PYTHONPATH=jammy['PYTHONPATH'])
    assert (instance.region, instance.type, instance.image) == (
        'us-west-1', 'c5.4xlarge', 'ami-034160df82745c454')


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
