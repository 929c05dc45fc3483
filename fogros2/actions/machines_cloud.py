# SPDX-License-Identifier: Apache-2.0
"""Machines that somebody rents out: an EC2 instance, a pod. They too ask nobody when written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from decimal import Decimal
from typing import Any, ClassVar, Optional, TYPE_CHECKING, TypedDict, Union

from fogros2.actions import words
from fogros2.actions.machines import CloudInstance
from fogros2.errors import ConfigurationError

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.actions.machines import Truth, Value

    #: One value, or one for each region.
    ByRegion = Union[SomeSubstitutionsType, Mapping[str, SomeSubstitutionsType]]


class Toleration(TypedDict, total=False):
    """Lets a pod onto nodes that keep others off, as in its specification."""

    key: str
    operator: str
    value: str
    effect: str
    tolerationSeconds: int


class AWSCloudInstance(CloudInstance):
    """
    An EC2 instance, made for the launch.

    What isn't said is left to the provider: the region of the user's AWS configuration, an image
    baked before with what the launch needs or else Ubuntu 24.04, and of the types t3.medium, or
    the cheapest with what is asked for below.

    ``ami_image``, ``ec2_instance_type`` and ``subnet`` may depend on the region: a mapping such as
    ``{'us-west-1': 'ami-1', 'eu-west-1': 'ami-2'}`` has a value for each, and the launch takes the
    one of the region that it chooses.

    :param ami_image: id of an image.
    :param region: such as 'eu-central-1'; 'nearest' for the one that answers first.
    :param ec2_instance_type: such as 't3.medium'; 'cheapest' for the cheapest that has what is
        asked for below.
    :param disk_size: GB, 30 unless said.
    :param spot: take a spot instance: cheaper, and AWS may take it back at two minutes' notice.
    :param arch: x86_64 or arm64.
    :param min_cpu: vCPUs at the least.
    :param min_memory_gb: GiB at the least.
    :param cpu_type: the processor's maker: intel, amd, aws.
    :param gpu: how many GPUs, True for one, or part of the name of one.
    :param gpu_memory_gb: GB of each at the least.
    :param max_price: US dollars an hour; what costs more is refused, and it caps a spot price.
    :param iam_instance_profile: name or ARN of what the instance itself may do at AWS.
    :param subnet: id; None for one of the default VPC's.
    :param security_groups: ids of groups besides the instance's own.
    :param tags: on everything that is made, besides FogROS2's own.
    :param regions: more regions to try, in this order, when one has no room.
    :param instance_types: more types to try, in this order, when there is no room for one.
    :param user: the image's login user.
    :param ssh_from: networks (CIDR) that may reach the SSH port; None for this robot's public
        address alone.
    """

    provider = 'aws'

    def __init__(
        self, ami_image: Optional[ByRegion] = None,
        region: Optional[SomeSubstitutionsType] = None,
        ec2_instance_type: Optional[ByRegion] = None,
        disk_size: Optional[Value] = None, *,
        spot: Optional[Truth] = None,
        arch: Optional[SomeSubstitutionsType] = None,
        min_cpu: Optional[Value] = None,
        min_memory_gb: Optional[Value] = None,
        cpu_type: Optional[SomeSubstitutionsType] = None,
        gpu: Optional[Union[Value, bool]] = None,
        gpu_memory_gb: Optional[Value] = None,
        max_price: Optional[Union[Value, Decimal]] = None,
        iam_instance_profile: Optional[SomeSubstitutionsType] = None,
        subnet: Optional[ByRegion] = None,
        security_groups: Optional[Sequence[SomeSubstitutionsType]] = None,
        tags: Optional[Mapping[str, SomeSubstitutionsType]] = None,
        regions: Optional[Sequence[SomeSubstitutionsType]] = None,
        instance_types: Optional[Sequence[SomeSubstitutionsType]] = None,
        user: Optional[SomeSubstitutionsType] = None,
        ssh_from: Optional[Sequence[SomeSubstitutionsType]] = None,
        **common: Any,
    ) -> None:
        super().__init__(options={
            'ami_image': ami_image, 'region': region, 'ec2_instance_type': ec2_instance_type,
            'disk_size': words.number(disk_size), 'spot': words.truth(spot), 'arch': arch,
            'min_cpu': words.number(min_cpu), 'min_memory_gb': words.number(min_memory_gb),
            'cpu_type': cpu_type, 'gpu': gpu, 'gpu_memory_gb': words.number(gpu_memory_gb),
            'max_price': words.number(max_price),
            'iam_instance_profile': iam_instance_profile, 'subnet': subnet,
            'security_groups': words.items(security_groups), 'tags': tags,
            'regions': words.items(regions), 'instance_types': words.items(instance_types),
            'user': user, 'ssh_from': words.items(ssh_from),
        }, **common)

    def info(self, flush_to_disk: bool = False) -> dict[str, Any]:
        """Return what is known of the machine, with FogROS2's keys."""
        machine = self._running.machine if self._running else None
        region = self._option('region')

        def regional(name: str) -> Any:
            value = self._option(name)
            return value.get(region, value) if isinstance(value, Mapping) else value

        return {
            **super().info(flush_to_disk),
            'ec2_region': region,
            'ec2_instance_type': regional('ec2_instance_type'),
            'disk_size': self._option('disk_size'),
            'aws_ami_image': regional('ami_image'),
            'ec2_instance_id': machine.id.rpartition('/')[2] if machine else None,
        }


class KubeInstance(CloudInstance):
    """
    A pod of a Kubernetes cluster, made for the launch in the context's namespace.

    :param container_image: has Python 3.10 and ``sh`` at the least; ROS 2 in it saves installing.
    :param zone: the pod runs there if it can.
    :param mcpu: thousandths of a CPU, asked for and allowed; 0 for no say.
    :param mb: MiB of memory, asked for and allowed; 0 for no say.
    :param namespace: None for the context's own.
    :param context: of the kubeconfig; None for the current one.
    :param gpus: how many devices of the kind ``gpu_resource``.
    :param gpu_resource: such as 'nvidia.com/gpu'.
    :param node_selector: labels that the node has to carry.
    :param tolerations: as in a pod's specification.
    :param runtime_class: such as 'nvidia'.
    :param image_pull_secrets: names of secrets in the namespace.
    :param service_account: by whose rights the pod is admitted; its token isn't mounted.
    :param expose: how the VPN gets to the pod: 'load_balancer', 'node_port', 'pod_dials_robot',
        'pod_ip'; 'auto' tries in this order.
    :param robot_host: address at which pods reach the robot, where they have to dial it.
    :param user: login user, made where the image has none of this name.
    :param env: variables of every login; ``environment`` is for the nodes alone.
    :param annotations: of the Service, such as what a cloud wants for its load balancer.
    """

    provider = 'kubernetes'

    def __init__(
        self, container_image: Optional[SomeSubstitutionsType] = None,
        zone: Optional[SomeSubstitutionsType] = None,
        mcpu: Optional[Value] = None, mb: Optional[Value] = None, *,
        namespace: Optional[SomeSubstitutionsType] = None,
        context: Optional[SomeSubstitutionsType] = None,
        gpus: Optional[Value] = None,
        gpu_resource: Optional[SomeSubstitutionsType] = None,
        node_selector: Optional[Mapping[str, SomeSubstitutionsType]] = None,
        tolerations: Optional[Sequence[Toleration]] = None,
        runtime_class: Optional[SomeSubstitutionsType] = None,
        image_pull_secrets: Optional[Sequence[SomeSubstitutionsType]] = None,
        service_account: Optional[SomeSubstitutionsType] = None,
        expose: Optional[SomeSubstitutionsType] = None,
        robot_host: Optional[SomeSubstitutionsType] = None,
        user: Optional[SomeSubstitutionsType] = None,
        env: Optional[Mapping[str, SomeSubstitutionsType]] = None,
        annotations: Optional[Mapping[str, SomeSubstitutionsType]] = None,
        **common: Any,
    ) -> None:
        super().__init__(options={
            'container_image': container_image, 'zone': zone, 'mcpu': mcpu, 'mb': mb,
            'namespace': namespace, 'context': context, 'gpus': gpus,
            'gpu_resource': gpu_resource, 'node_selector': node_selector,
            'tolerations': words.items(tolerations), 'runtime_class': runtime_class,
            'image_pull_secrets': words.items(image_pull_secrets),
            'service_account': service_account, 'expose': expose, 'robot_host': robot_host,
            'user': user, 'env': env, 'annotations': annotations,
        }, **common)

    def info(self, flush_to_disk: bool = False) -> dict[str, Any]:
        """Return what is known of the machine, with FogROS2's keys."""
        machine = self._running.machine if self._running else None
        return {
            **super().info(flush_to_disk),
            'compute_region': self._option('zone'),
            'compute_instance_type':
                f'{self._option("mcpu") or 0}mx{self._option("mb") or 0}Mb',
            'compute_instance_id': machine.id if machine else None,
        }


class _NoProvider(CloudInstance):
    """A machine of FogROS2's for which there is no provider here; building one is an error."""

    cloud: ClassVar[str]

    def __init__(self, *given: object, **keywords: object) -> None:
        raise ConfigurationError(
            f'{type(self).__name__} is not available: FogROS2 for Jazzy has no provider for '
            f'{self.cloud}',
            'use KubeInstance for a cluster there, SSHInstance(host=..., user=...) for a VM that '
            'you create there yourself, AWSCloudInstance, or ContainerInstance on this computer')


class GCPCloudInstance(_NoProvider):
    """A virtual machine of Google Cloud, which launch files of FogROS2 name."""

    cloud = 'Google Cloud'


class AzureCloudInstance(_NoProvider):
    """A virtual machine of Azure, which launch files of FogROS2 name."""

    cloud = 'Azure'
