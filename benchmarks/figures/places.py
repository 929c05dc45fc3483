# SPDX-License-Identifier: Apache-2.0
"""Places of robots' machines: this computer's podman, a cloud in a box, a cluster, a host."""

from __future__ import annotations

import abc
from collections.abc import Iterator, Mapping
import contextlib
import json
import os
from pathlib import Path
import secrets
import subprocess
import tempfile
import time
from typing import Any

from fogros2.provider.container import root
from rigs.bare_computer import bare_computer, BareComputer
from rigs.clouds import Cloud, CLOUDS
from rigs.cluster import Client, Cluster, cluster, READY, running_cluster
from rigs.cluster.namespaces import making_namespaces, Namespace
from rigs.computers.box import Instance

ROOT = Path(__file__).resolve().parents[2]
REGION = 'us-east-1'
#: Seconds without the launch after which a machine of the short time-outs ends.
ROBOT_TIMEOUT = 5.0

LAUNCH = """\
import functools
from fogros2 import CloudNode, {kind}, FogROSLaunchDescription
{patch}

def generate_launch_description():
    return FogROSLaunchDescription([CloudNode(
        machine={kind}(name='{name}'{options}), package='fogros2_examples', executable='talker',
        name='{node}')])
"""
TIMEOUTS = """\
from fogros2.deploy import launch
launch.Timeouts = functools.partial(launch.Timeouts, boot={boot}, ssh={ssh})
"""


class Place(abc.ABC):
    """
    Machines of one provider.

    :param short: whether time-outs are seconds.
    """

    kind: str
    #: Time-outs in seconds of the boot and of SSH where they are short; see ``Timeouts``.
    boot, ssh = 10.0, 5.0
    options = ''
    patch = ''
    prefix: list[str] = []
    environment: Mapping[str, str] = {}
    #: Name or file of the robot's network namespace.
    network = '/proc/self/ns/net'

    def __init__(self, *, short: bool = True) -> None:
        self.short = short

    @property
    def bound(self) -> float:
        """Seconds that a machine may run after its launch was killed."""
        return ROBOT_TIMEOUT + self.boot + self.ssh if self.short else 120.0 + 360.0

    def launch_file(self, name: str) -> str:
        """Return a launch file with a talker on a machine of that name."""
        patch, options = '', self.options
        if self.short:
            patch = TIMEOUTS.format(boot=self.boot, ssh=self.ssh) + self.patch
            options += f', robot_timeout={ROBOT_TIMEOUT}'
        return LAUNCH.format(kind=self.kind, name=name, node=name.replace('-', '_'), patch=patch,
                             options=options)

    @abc.abstractmethod
    def things(self, name: str) -> dict[str, bool]:
        """Return what there is for machines of that name, and whether it is a running machine."""

    def clear(self, name: str) -> None:
        """Delete what there is for machines of that name, after it was counted."""

    def admit(self, name: str) -> None:
        """Open the provider's firewall of a machine for all UDP."""


class Container(Place):
    """Containers on this computer."""

    kind = 'ContainerInstance'

    def things(self, name: str) -> dict[str, bool]:
        """Return the container."""
        listed = subprocess.run(
            ['podman', 'ps', '-a', '--filter', f'label=fogros2-machine={name}', '--format',
             'json'], capture_output=True, text=True, timeout=60, check=True).stdout
        return {f"container {each['Id'][:12]}": each['State'] == 'running'
                for each in json.loads(listed)}

    def clear(self, name: str) -> None:
        """Delete the container."""
        for thing in self.things(name):
            subprocess.run(['podman', 'rm', '-f', '-t', '0', thing.split()[1]],
                           capture_output=True, timeout=60, check=False)


class Boxed(Place):
    """
    Instances of a cloud in a box.

    :param folder: for files of its user.
    """

    boot, ssh = 15.0, 10.0

    def __init__(self, cloud: Cloud, box: Any, folder: Path, *, short: bool = True) -> None:
        super().__init__(short=short)
        self.cloud, self.box, self.kind = cloud, box, cloud.machine
        self.prefix = box.on_robot([])
        self.network = box.robot
        self.environment = {**cloud.variables(box, folder), 'FOGROS2_AWS_CHECKIP': box.checkip}

    def instances(self, name: str) -> list[Instance]:
        """Return the running instances of that name."""
        return [each for each in self.box.alive()
                if self.cloud.tags(each).get('fogros2-name') == name]

    def things(self, name: str) -> dict[str, bool]:
        """Return instances by their tags."""
        return {f'instance {each.id}': True for each in self.instances(name)}


class Ec2(Boxed):
    """Instances of EC2 in a box."""

    def __init__(self, cloud: Cloud, box: Any, folder: Path, *, short: bool = True) -> None:
        super().__init__(cloud, box, folder, short=short)
        self.environment = {**self.environment, 'FOGROS2_AWS_REGIONS': REGION}

    def api(self) -> Any:
        """Return a client of the box's EC2."""
        import boto3
        return boto3.client('ec2', region_name=REGION, **self.box.client_arguments)

    def things(self, name: str) -> dict[str, bool]:
        """Return instances, and groups, keys and disks by their tags."""
        found = super().things(name)
        api, tag = self.api(), [{'Name': 'tag:fogros2-name', 'Values': [name]}]
        for kind, entries in (
                ('GroupId', api.describe_security_groups(Filters=tag)['SecurityGroups']),
                ('KeyName', api.describe_key_pairs(Filters=tag)['KeyPairs']),
                ('VolumeId', api.describe_volumes(Filters=tag)['Volumes'])):
            found.update({f'{kind} {entry[kind]}': False for entry in entries})
        return found

    def admit(self, name: str) -> None:
        """Open the machine's security groups for all UDP."""
        api, tag = self.api(), [{'Name': 'tag:fogros2-name', 'Values': [name]}]
        for group in api.describe_security_groups(Filters=tag)['SecurityGroups']:
            api.authorize_security_group_ingress(GroupId=group['GroupId'], IpPermissions=[{
                'IpProtocol': 'udp', 'FromPort': 0, 'ToPort': 65535,
                'IpRanges': [{'CidrIp': '0.0.0.0/0'}]}])

    def plant(self, name: str) -> None:
        """Create the group and the key of a machine whose instance another robot now creates."""
        api, attempt = self.api(), f'{name}-{time.time():.3f}'
        tags = [{'Key': f'fogros2-{key}', 'Value': value} for key, value in {
            'name': name, 'attempt': attempt, 'made': str(int(time.time())),
            'robot': 'neighbour-0-00000000'}.items()]
        api.create_security_group(
            GroupName=f'fogros2-{attempt}', Description=name,
            TagSpecifications=[{'ResourceType': 'security-group', 'Tags': tags}])
        api.create_key_pair(KeyName=f'fogros2-{attempt}', TagSpecifications=[
            {'ResourceType': 'key-pair', 'Tags': tags}])


class Pod(Place):
    """Pods of a real cluster of one node."""

    kind = 'KubeInstance'
    options = f", container_image='{READY}'"
    patch = 'from fogros2.provider.kubernetes import manifests\nmanifests.BOOT = 20.0\n'
    boot, ssh = 20.0, 5.0

    def __init__(self, nodes: Cluster, space: Namespace, *, short: bool = True) -> None:
        super().__init__(short=short)
        self.nodes, self.space = nodes, space
        self.environment = {'KUBECONFIG': str(space.kubeconfig)}

    @property
    def bound(self) -> float:
        """Seconds that a machine may run: without an agent, ten minutes unless it is short."""
        return super().bound if self.short else 600.0 + 60.0

    def things(self, name: str) -> dict[str, bool]:
        """Return the objects with the machine's label."""
        return {
            f"{kind} {each['metadata']['name']}":
                kind == 'pods' and each['status'].get('phase') in ('Pending', 'Running')
            for kind in ('jobs', 'pods', 'services', 'secrets', 'configmaps')
            for each in self.space.all(kind)
            if name in json.dumps(each['metadata'].get('labels', {}))}


class Host(Place):
    """A computer with an SSH server."""

    kind = 'SSHInstance'

    def __init__(self, computer: BareComputer, *, short: bool = True) -> None:
        super().__init__(short=short)
        self.computer = computer
        self.options = (f", host='{computer.address}', user='{computer.user}', "
                        f"key='{computer.key}', host_key='{computer.host_key}'")

    def things(self, name: str) -> dict[str, bool]:
        """Return the processes that name the machine."""
        return {f'process {line}': True for line in self.computer.leftovers() if name in line}


@contextlib.contextmanager
def computer() -> Iterator[BareComputer]:
    """Run a computer of this robot's environment on podman's default network."""
    with tempfile.TemporaryDirectory(prefix='place-') as folder, bare_computer(
            f'fogt-{secrets.token_hex(4)}', Path(folder, 'computer'), 'podman',
            mounts=root.environment_mounts()) as running:
        yield running


@contextlib.contextmanager
def place(provider: str, *, short: bool = True) -> Iterator[Place]:
    """Open a place, for as long as the block runs."""
    with contextlib.ExitStack() as stack:
        if provider == 'container':
            yield Container(short=short)
        elif provider in CLOUDS:
            cloud = CLOUDS[provider]()
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix='place-'))
            yield (Ec2 if provider == 'aws' else Boxed)(
                cloud, stack.enter_context(cloud.open()), Path(folder), short=short)
        elif provider == 'ssh':
            yield Host(stack.enter_context(computer()), short=short)
        else:
            there = _cluster(stack)
            make = stack.enter_context(making_namespaces(
                there, Client(there.kubeconfig), ROOT / 'packaging' / 'kubernetes' / 'role.yaml'))
            yield Pod(there, make(), short=short)


def _cluster(stack: contextlib.ExitStack) -> Cluster:
    if folder := os.environ.get('FOGROS2_CLUSTER'):
        return running_cluster(Path(folder))
    binaries = Path(subprocess.check_output([ROOT / 'tools' / 'kubernetes.sh'], text=True).strip())
    return stack.enter_context(cluster(binaries.parent, binaries))
