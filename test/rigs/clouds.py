# SPDX-License-Identifier: Apache-2.0
"""
The clouds as the tests of ``test/integration/clouds`` use them: one adapter for each, and a robot.

An adapter says by value what differs: names, options, codes of errors, and what else there is
to look at. The tests themselves are the same for all clouds.
"""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
import os
from pathlib import Path
import subprocess
from typing import Any, ClassVar, Optional

from fogros2.provider.vm.provider import VmProvider
from fogros2.waiting import wait_until
from rigs.computers.box import Box, Call, Instance
from rigs.launched import Launched, ros2

#: A talker on a machine, and a listener on the robot.
LAUNCH = '''\
from fogros2 import {machine}, CloudNode, FogROSLaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    machine = {machine}(name={name!r}, robot_timeout=6, **{options!r})
    words = {{'package': 'fogros2_examples', 'output': 'screen'}}
    return FogROSLaunchDescription([
        CloudNode(machine=machine, executable='talker', **words),
        Node(executable='listener', **words),
    ])
'''


class Cloud(abc.ABC):
    """One cloud in a box."""

    name: ClassVar[str]
    #: The class of its machines in launch files.
    machine: ClassVar[str]
    #: Python packages that the box takes.
    needs: ClassVar[Sequence[str]]
    #: Region, type and price of the example's machine.
    region: ClassVar[str]
    kind: ClassVar[str]
    price: ClassVar[str] = ''
    #: Options of two machines in different places.
    places: ClassVar[tuple[Mapping[str, Any], Mapping[str, Any]]]
    #: Its words at the end of ``make cloud-check``'s first page.
    checked: ClassVar[str] = ''
    #: The most requests of a listing over all regions.
    listing: ClassVar[int]
    #: The pattern of the request for a machine.
    order: ClassVar[str]

    @abc.abstractmethod
    def open(self, **words: Any) -> Box:
        """Return a box, made with these words, that is not open yet."""

    @abc.abstractmethod
    def provider(self) -> VmProvider:
        """Return a provider of this process."""

    @abc.abstractmethod
    def variables(self, box: Any, folder: Path, *, here: bool = False) -> dict[str, str]:
        """Return the variables of the box's user on the robot, or ``here`` in this process."""

    @abc.abstractmethod
    def left(self, box: Any) -> Any:
        """Return what there is besides machines; false without anything."""

    @abc.abstractmethod
    def clear(self, box: Any) -> None:
        """Delete everything."""

    @abc.abstractmethod
    def secrets(self, variables: Mapping[str, str]) -> list[str]:
        """Return the credentials in a user's variables, which no machine and no tag may have."""

    @abc.abstractmethod
    def described(self, box: Any) -> str:
        """Return all that the cloud tells of its resources, user data left out."""

    @abc.abstractmethod
    def look(self, box: Any, instance: Instance, name: str) -> None:
        """Check what is special of a machine whose launch has closed its SSH port."""

    def asked(self, box: Any) -> list[Call]:
        """Return the requests to the API."""
        return [call for call in box.calls() if call.service]

    def reset(self, box: Any) -> None:
        """Undo what a test has changed about the user's account."""

    def tags(self, instance: Instance) -> Mapping[str, str]:
        """Return the tags of a machine."""
        return instance.tags

    def end_command(self, box: Any, command: Sequence[str]) -> list[str]:
        """Return a machine's end command with the address of the box."""
        return list(command)


class Robot:
    """
    A robot whose user has an account at a box's cloud.

    :param folder: holds its home.
    :param start: starts launches that end with the test.
    """

    def __init__(self, cloud: Cloud, box: Any, folder: Path, start: Any) -> None:
        self.cloud, self.box, self.home, self._start = cloud, box, folder, start
        self.variables = {
            **cloud.variables(box, folder), 'FOGROS2_AWS_CHECKIP': box.checkip,
            'HOME': str(folder), 'ROS_LOG_DIR': str(folder / 'log')}

    def environment(self, **variables: str) -> dict[str, str]:
        """Return the variables of its programs."""
        return {**os.environ, **self.variables, **variables}

    def launch(self, *words: str, **variables: str) -> Launched:
        """Start ``ros2 launch`` on the robot."""
        started: Launched = self._start(*words, environment=self.environment(**variables),
                                        prefix=self.box.on_robot([]))
        return started

    def talker(self, name: str, *words: str, **variables: str) -> Launched:
        """Start the cloud's example of a talker."""
        return self.launch('fogros2_examples', f'talker.{self.cloud.name}.launch.py',
                           f'name:={name}', *words, **variables)

    def own(self, name: str, options: Optional[Mapping[str, Any]] = None, **variables: str,
            ) -> Launched:
        """Start a launch file with a talker on a machine that has these options."""
        return self.launch(self.write(f'{name}.launch.py', LAUNCH.format(
            machine=self.cloud.machine, name=name, options=dict(options or {}))), **variables)

    def ros2(self, *words: str, **variables: str) -> subprocess.CompletedProcess[str]:
        """Run ``ros2`` on the robot."""
        return ros2(*words, environment=self.environment(**variables),
                    prefix=self.box.on_robot([]))

    def fog(self, *words: str, **variables: str) -> str:
        """Run ``ros2 fog``, which has to succeed, and return its output."""
        done = self.ros2('fog', *words, **variables)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def run(
        self, words: Sequence[str], **variables: str,
    ) -> subprocess.CompletedProcess[str]:
        """Run a program on the robot."""
        return subprocess.run(
            [*self.box.on_robot([]), *words], env=self.environment(**variables),
            stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=180)

    def things(self) -> Any:
        """Return what there is besides machines."""
        return self.cloud.left(self.box)

    def write(self, name: str, text: str) -> str:
        """Write a launch file and return its path."""
        path = self.home / name
        path.write_text(text)
        return str(path)

    def api(self, service: str = 'ec2', region: str = 'us-east-1') -> Any:
        """Return a boto3 client of this process."""
        import boto3
        return boto3.client(service, region_name=region, **self.box.client_arguments)


class Aws(Cloud):
    """EC2 in a box."""

    name, machine, needs = 'aws', 'AWSCloudInstance', ('boto3', 'moto')
    region, kind, price = 'us-east-1', 't3.medium', '0.0416'
    places = ({'region': 'us-east-1'},
              {'region': 'eu-central-1', 'ec2_instance_type': 'c5.large'})
    listing = 72  # twice, for machines and volumes: the regions, and one request for each
    order = 'Action=RunInstances'

    def open(self, **words: Any) -> Box:
        """Return a box."""
        from rigs.ec2 import Ec2Box
        return Ec2Box(**words)

    def provider(self) -> VmProvider:
        """Return the provider."""
        from fogros2.provider.aws.provider import AWSProvider
        return AWSProvider()

    def variables(self, box: Any, folder: Path, *, here: bool = False) -> dict[str, str]:
        """Return boto3's variables."""
        found: dict[str, str] = box.environment(self.region)
        return {**found, 'AWS_ENDPOINT_URL': box.endpoint} if here else found

    def _api(self, box: Any, region: str) -> Any:
        import boto3
        return boto3.client('ec2', region_name=region, **box.client_arguments)

    def left(self, box: Any) -> dict[str, list[str]]:
        """Return what there is in the regions that were used, by kind."""
        found: dict[str, list[str]] = {}
        for region in sorted({self.region, *(i.region for i in box.instances())}):
            ec2 = self._api(box, region)
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

    def clear(self, box: Any) -> None:
        """Delete everything."""
        for found in box.alive():
            self._api(box, found.region).terminate_instances(InstanceIds=[found.id])
        wait_until(lambda: not box.alive(), timeout=60, what='instances to end')
        delete = {'groups': ('delete_security_group', 'GroupId'),
                  'keys': ('delete_key_pair', 'KeyName'),
                  'disks': ('delete_volume', 'VolumeId'),
                  'images': ('deregister_image', 'ImageId'),
                  'snapshots': ('delete_snapshot', 'SnapshotId')}
        for kind, names in self.left(box).items():
            for place in names:
                region, _, which = place.partition('/')
                if kind in delete:
                    operation, word = delete[kind]
                    getattr(self._api(box, region), operation)(**{word: which})

    def secrets(self, variables: Mapping[str, str]) -> list[str]:
        """Return the secret access key."""
        return [variables['AWS_SECRET_ACCESS_KEY']]

    def described(self, box: Any) -> str:
        """Return the answers of all lists."""
        api = self._api(box, self.region)
        return repr([getattr(api, f'describe_{what}')() for what in (
            'instances', 'tags', 'security_groups', 'key_pairs', 'volumes')])

    def look(self, box: Any, instance: Instance, name: str) -> None:
        """Check the group, the disk, the tags and the metadata service."""
        api = self._api(box, self.region)
        (group,) = [group for group in api.describe_security_groups()['SecurityGroups']
                    if group['GroupName'] != 'default']
        assert [rule['IpProtocol'] for rule in group['IpPermissions']] == ['udp']
        described = api.describe_instances(InstanceIds=[instance.id])['Reservations'][0][
            'Instances'][0]
        assert described['MetadataOptions']['HttpTokens'] == 'required'
        (disk,) = api.describe_volumes()['Volumes']
        assert (disk['VolumeType'], disk['Encrypted'], disk['Size']) == ('gp3', True, 30)
        for thing in (described, group, disk, *api.describe_key_pairs()['KeyPairs']):
            assert {tag['Key']: tag['Value'] for tag in thing['Tags']}['fogros2-name'] == name
        assert api.describe_instance_attribute(
            InstanceId=instance.id, Attribute='userData')['UserData']['Value']

    def asked(self, box: Any) -> list[Call]:
        """Return the requests in the machine's region."""
        return [call for call in box.calls() if call.region == self.region]


class Gcp(Cloud):
    """Compute Engine in a box."""

    name, machine = 'gcp', 'GCPCloudInstance'
    needs = ('google.auth', 'googleapiclient')
    region, kind = 'us-central1', 'e2-medium'
    places = ({'region': 'nearest'},
              {'zone': 'europe-west3-b', 'machine_type': 'n2-standard-2'})
    checked = 'gcp: project robots, us-central1'
    listing = 2
    order = '^POST .*/instances '

    def __init__(self, project: str = 'robots') -> None:
        self._project = project

    def open(self, **words: Any) -> Box:
        """Return a box with the project."""
        from rigs.gce import GceBox
        return GceBox(project=self._project, **words)

    def provider(self) -> VmProvider:
        """Return the provider."""
        from fogros2.provider.gcp.provider import GCPProvider
        return GCPProvider()

    def variables(self, box: Any, folder: Path, *, here: bool = False) -> dict[str, str]:
        """Return Google's variables, and write a key file."""
        found: dict[str, str] = box.here(folder) if here else box.environment(folder)
        return found

    def left(self, box: Any) -> Any:
        """Return the names of what exists in the project, by kind."""
        return box.things()

    def clear(self, box: Any) -> None:
        """Delete everything."""
        box.clear()

    def secrets(self, variables: Mapping[str, str]) -> list[str]:
        """Return a line of the service account's private key."""
        import json
        key = json.loads(Path(variables['GOOGLE_APPLICATION_CREDENTIALS']).read_text())
        return [str(key['private_key']).splitlines()[3]]

    def described(self, box: Any) -> str:
        """Return the instances and the firewall rules."""
        shown = [{**vars(one), 'tags': dict(one.tags)} for one in box.instances()]
        return repr([shown, *map(box.firewall, box.things().get('firewalls', ()))])

    def look(self, box: Any, instance: Instance, name: str) -> None:
        """Check the firewall rules: that for SSH is gone, everybody else is denied."""
        from rigs.gce import catalogue

        (host,) = box.things()['instances']
        assert sorted(box.things()['firewalls']) == [f'{host}-deny', f'{host}-vpn']
        deny = box.firewall(f'{host}-deny')
        assert (deny['denied'], deny['sourceRanges'], deny['targetTags']) == (
            [{'IPProtocol': 'all'}], [catalogue.ANYWHERE], [host])
        assert 1000 < deny['priority'] < 65534

    def tags(self, instance: Instance) -> Mapping[str, str]:
        """Return the tags that the labels stand for."""
        from fogros2.provider.gcp.instances import RULES
        return RULES.decode(instance.tags)

    def end_command(self, box: Any, command: Sequence[str]) -> list[str]:
        """Name the API of the box, as the machine reaches it."""
        return [*command[:-1], f'{box.inside}/compute/v1/']


class Azure(Cloud):
    """Azure in a box."""

    name, machine = 'azure', 'AzureCloudInstance'
    needs = ('azure.identity', 'azure.mgmt.compute', 'azure.mgmt.network', 'werkzeug')
    region, kind, price = 'westeurope', 'Standard_B2als_v2', '0.0376'
    places = ({'region': 'westeurope'}, {'region': 'eastus', 'vm_size': 'Standard_D2s_v5'})
    listing = 3
    order = '^PUT .*/virtualMachines/[^/]* '

    def open(self, **words: Any) -> Box:
        """Return a box."""
        from rigs.azure.box import AzureBox
        return AzureBox(**words)

    def provider(self) -> VmProvider:
        """Return a provider that remembers nothing of earlier tests."""
        from fogros2.provider.azure.account import Account
        from fogros2.provider.azure.cloud import Azure
        from fogros2.provider.azure.provider import AzureProvider
        return AzureProvider(Azure(Account()))

    def variables(self, box: Any, folder: Path, *, here: bool = False) -> dict[str, str]:
        """Return the variables of a managed identity."""
        from rigs.azure import service
        return service.environment(box.endpoint if here else box.inside)

    def left(self, box: Any) -> list[str]:
        """Return the resource groups, and disks in that of volumes, which stays without any."""
        things = box.things()
        return [*(name for name in things['groups'] if name != 'fogros2-volumes'),
                *(name for name in things['resources'] if '/fogros2-volumes/' in name)]

    def clear(self, box: Any) -> None:
        """Delete everything."""
        box.clear()
        wait_until(lambda: not self.left(box) and not box.alive(), timeout=60,
                   what='groups to be deleted')

    def secrets(self, variables: Mapping[str, str]) -> list[str]:
        """Return the user's token, and the secret of the service that gives it."""
        from rigs.azure import service
        return [service.TOKEN, service.HEADER]

    def described(self, box: Any) -> str:
        """Return all groups and resources."""
        return repr(box.things())

    def reset(self, box: Any) -> None:
        """Let the user be an owner."""
        box.set_rights(owner=True)

    def look(self, box: Any, instance: Instance, name: str) -> None:
        """Check that the group has everything, with its tags, and the rights of the machine."""
        things = box.things()
        (group,) = things['groups']
        kinds = {}
        for path, entry in things['resources'].items():
            kinds[entry['type'].rpartition('/')[2]] = entry
            if 'tags' in entry:
                assert entry['tags']['fogros2-name'] == name
            assert f'/resourceGroups/{group}/' in path or 'roleDefinitions' in path
        assert kinds['disks'] and kinds['virtualMachines']['properties']['storageProfile'][
            'osDisk']['deleteOption'] == 'Delete'
        rules = [path.rpartition('/')[2] for path in things['resources']
                 if '/securityRules/' in path]
        assert sorted(rules) == ['nothing-else', 'vpn']
        # the machine may end itself, and nothing else
        assert kinds['roleDefinitions']['properties']['permissions'][0]['actions'] == [
            'Microsoft.Compute/virtualMachines/deallocate/action',
            'Microsoft.Resources/subscriptions/resourceGroups/delete']

    def end_command(self, box: Any, command: Sequence[str]) -> list[str]:
        """Name the API of the box, as the machine reaches it."""
        return [*command[:-1], box.inside]


CLOUDS: Mapping[str, type[Cloud]] = {'aws': Aws, 'azure': Azure, 'gcp': Gcp}
