# SPDX-License-Identifier: Apache-2.0
"""A robot beside EC2 in a box: launches there know of AWS's API alone, and of no simulation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import metadata
import os
from pathlib import Path
import shutil
import subprocess
from typing import Any
import uuid

import pytest

from fogros2.waiting import wait_until
from rigs.ec2 import Ec2Box
from rigs.launched import Launched, launching, ros2

HERE = Path(__file__).parent
BOX = 'test_ec2_box.py'
#: The region that the user of these tests has configured.
REGION = 'us-east-1'


#: What is tried on ROS 2 as well as on the embedded default: what its launch and nodes have a part
#: in. All else is AWS's and the box's, the same on either, and takes minutes.
ON_BOTH = (
    'test_the_talker_from_nothing_to_nothing', 'test_two_regions_hear_each_other',
    'test_fogros2s_form_on_a_simulated_ubuntu_22_04',
    'test_fogros2s_talker_aws_on_a_simulated_ubuntu_22_04',
    'test_fogros2s_form_of_choosing_region_and_type',
    'test_fogros2s_talker_auto_aws_with_one_line_changed')


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave to the embedded default what is the same there, unless it is asked for by name."""
    embedded = any(found.name == 'ros2-embedded' for found in metadata.distributions())
    named = any('aws' in word or 'ec2' in word for word in config.args)
    if embedded or named or config.option.keyword:
        return
    left = [item for item in items if item.path.parent == HERE or item.path.name == BOX
            if item.name not in ON_BOTH]
    items[:] = [item for item in items if item not in left]
    config.hook.pytest_deselected(items=left)


class Robot:
    """
    A robot whose user has an account at the box's AWS.

    :param folder: holds its home.
    :param start: starts launches that end with the test.
    """

    def __init__(self, box: Ec2Box, folder: Path, start: Any) -> None:
        self.box = box
        self.home = folder
        self._start = start
        self.variables = {
            **box.environment(REGION), 'FOGROS2_AWS_CHECKIP': box.checkip,
            'HOME': str(folder), 'ROS_LOG_DIR': str(folder / 'log')}

    def environment(self, **variables: str) -> dict[str, str]:
        return {**os.environ, **self.variables, **variables}

    def launch(self, *words: str, **variables: str) -> Launched:
        """Start ``ros2 launch`` on the robot."""
        started: Launched = self._start(*words, environment=self.environment(**variables),
                                        prefix=self.box.on_robot([]))
        return started

    def ros2(self, *words: str, timeout: float = 60.0, **variables: str,
             ) -> subprocess.CompletedProcess[str]:
        """Run ``ros2`` on the robot."""
        return ros2(*words, environment=self.environment(**variables), timeout=timeout,
                    prefix=self.box.on_robot([]))

    def api(self, service: str = 'ec2', region: str = REGION) -> Any:
        """Return a boto3 client of this process."""
        import boto3
        return boto3.client(service, region_name=region, **self.box.client_arguments)

    def things(self) -> dict[str, list[str]]:
        """Return what there is beside instances in the regions that were used, by kind."""
        found: dict[str, list[str]] = {}
        for region in sorted({REGION, *(i.region for i in self.box.instances())}):
            ec2 = self.api(region=region)
            kinds: Mapping[str, list[str]] = {
                'groups': [group['GroupId'] for group in ec2.describe_security_groups()[
                    'SecurityGroups'] if group['GroupName'] != 'default'],
                'keys': [pair['KeyName'] for pair in ec2.describe_key_pairs()['KeyPairs']],
                'disks': [disk['VolumeId'] for disk in ec2.describe_volumes()['Volumes']],
                'addresses': [a['PublicIp'] for a in ec2.describe_addresses()['Addresses']],
                'images': [i['ImageId'] for i in ec2.describe_images(Owners=['self'])['Images']],
                # those of published images are the publisher's
                'snapshots': [s['SnapshotId'] for s in ec2.describe_snapshots()['Snapshots']
                              if 'CreateImage' in s['Description']],
            }
            for kind, names in kinds.items():
                found.setdefault(kind, []).extend(f'{region}/{name}' for name in names)
        return {kind: names for kind, names in found.items() if names}

    def clear(self) -> None:
        """Delete what is left, so that the next test begins with nothing."""
        delete = {'groups': ('delete_security_group', 'GroupId'),
                  'keys': ('delete_key_pair', 'KeyName'),
                  'disks': ('delete_volume', 'VolumeId'),
                  'images': ('deregister_image', 'ImageId'),
                  'snapshots': ('delete_snapshot', 'SnapshotId')}
        for kind, names in self.things().items():
            for place in names:
                region, _, which = place.partition('/')
                if kind in delete:
                    operation, word = delete[kind]
                    getattr(self.api(region=region), operation)(**{word: which})

    def write(self, name: str, text: str) -> str:
        """Write a launch file and return its path."""
        path = self.home / name
        path.write_text(text)
        return str(path)


@pytest.fixture(scope='session')
def box(engine: str) -> Iterator[Ec2Box]:
    """Open a box for all tests of this folder."""
    if shutil.which('ros2') is None:
        pytest.skip('needs ros2 on PATH')
    if os.geteuid() != 0:
        pytest.skip("needs root itself: sudo, the way into the robot's network, takes no Ctrl-C")
    pytest.importorskip('boto3', reason='needs boto3')
    pytest.importorskip('moto', reason='needs moto[server]')
    with Ec2Box() as box:
        yield box


@pytest.fixture
def robot(box: Ec2Box, tmp_path: Path) -> Iterator[Robot]:
    """Yield a robot; when the test ends, nothing that somebody would pay for is left."""
    box.heal()
    box.forget_calls()
    box.set_boot_delay(0.0)
    with launching() as start:
        robot = Robot(box, tmp_path, start)
        yield robot
    left = box.alive()
    kept = robot.things()
    for found in left:
        robot.api(region=found.region).terminate_instances(InstanceIds=[found.id])
    wait_until(lambda: not box.alive(), timeout=20, what='instances to end')
    robot.clear()
    assert not left, f'left running: {left}'
    assert not kept, f'left at AWS: {kept}'


@pytest.fixture
def name() -> str:
    """Return a name that no other machine has."""
    return f'fogt-{uuid.uuid4().hex[:6]}'
