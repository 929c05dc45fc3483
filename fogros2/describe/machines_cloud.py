# SPDX-License-Identifier: Apache-2.0
"""Machines of cloud providers in launch files: virtual machines, a pod. They make no request."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from decimal import Decimal
from typing import Any, ClassVar, Optional, TYPE_CHECKING, TypedDict, Union

from fogros2.describe.kinds import options_of
from fogros2.describe.machines import CloudInstance
from fogros2.errors import ConfigurationError

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.describe.machines import Bool, Value

    #: One value, or one for each region.
    ByRegion = Union[SomeSubstitutionsType, Mapping[str, SomeSubstitutionsType]]


class Toleration(TypedDict, total=False):
    """Allow a pod on tainted nodes, with the fields of a pod's specification."""

    key: str
    operator: str
    value: str
    effect: str
    tolerationSeconds: int


class VmInstance(CloudInstance):
    """
    A virtual machine of a cloud, created for the launch; each cloud's class adds keywords.

    ``arch``, ``min_cpu``, ``min_memory_gb``, ``cpu_type``, ``gpu`` and ``gpu_memory_gb`` are the
    requirements of the type, from which the launch chooses the cheapest if it names none.

    :param spot: use a spot machine: cheaper, but the cloud may reclaim it. AWS gives two minutes'
        notice, the others half a minute's.
    :param arch: x86_64 or arm64.
    :param min_cpu: minimum number of vCPUs.
    :param min_memory_gb: minimum memory in GiB.
    :param gpu: the number of GPUs, True for one, or part of the GPU's name, such as 'L4'.
    :param gpu_memory_gb: minimum memory of each GPU in GB.
    :param max_price: maximum price in US dollars per hour; at AWS and Azure also the limit of a
        spot price.
    :param tags: tags for everything that is created, in addition to FogROS2's own.
    :param regions: further regions to try, in this order, if one has no capacity.
    :param user: the image's login user.
    :param ssh_from: networks (CIDR) that may reach the SSH port; None for this robot's public
        address only.
    :param fleet: public SSH keys of other robots, which from the networks of ``ssh_from`` may have
        container machines on this one (``ContainerInstance(on=SSHInstance(...))``).
    """

    #: FogROS2's keys of :meth:`info` that are options.
    _shown: ClassVar[Mapping[str, str]] = {}
    #: The key of the cloud's own id, and its part of the machine's id.
    _shown_id: ClassVar[Mapping[str, int]] = {}

    def __init__(
        self, *, spot: Optional[Bool] = None,
        arch: Optional[SomeSubstitutionsType] = None,
        min_cpu: Optional[Value] = None,
        min_memory_gb: Optional[Value] = None,
        gpu: Optional[Union[Value, bool]] = None,
        gpu_memory_gb: Optional[Value] = None,
        max_price: Optional[Union[Value, Decimal]] = None,
        tags: Optional[Mapping[str, SomeSubstitutionsType]] = None,
        regions: Optional[Sequence[SomeSubstitutionsType]] = None,
        user: Optional[SomeSubstitutionsType] = None,
        ssh_from: Optional[Sequence[SomeSubstitutionsType]] = None,
        fleet: Optional[Sequence[SomeSubstitutionsType]] = None,
        options: Optional[Mapping[str, Any]] = None, **common: Any,
    ) -> None:
        shared = options_of(VmInstance.__init__, locals())
        super().__init__(options={**(options or {}), **shared}, **common)

    def info(self, flush_to_disk: bool = False) -> dict[str, Any]:
        """Return what is known about the machine, with FogROS2's keys."""
        known = super().info(flush_to_disk)
        known.update((key, self._option(name)) for key, name in self._shown.items())
        known.update((key, self._running.machine.id.split('/')[part] if self._running else None)
                     for key, part in self._shown_id.items())
        return known


class AWSCloudInstance(VmInstance):
    """
    An EC2 instance, created for the launch.

    Defaults: the region of the user's AWS configuration, an image that ``ros2 fog`` has baked with
    what the launch needs or else Ubuntu 24.04, and the type t3.medium, or the cheapest type that
    meets the requirements.

    ``ami_image``, ``ec2_instance_type`` and ``subnet`` may depend on the region: a mapping such as
    ``{'us-west-1': 'ami-1', 'eu-west-1': 'ami-2'}`` has a value for each region, and the launch
    uses the value of the region that it chooses.

    :param ami_image: id of an image.
    :param region: such as 'eu-central-1'; 'nearest' for the region with the fastest response.
    :param ec2_instance_type: such as 't3.medium'; 'cheapest' for the cheapest type that meets
        the requirements.
    :param disk_size: GB; default 30.
    :param cpu_type: manufacturer of the processor: intel, amd, aws.
    :param iam_instance_profile: name or ARN of the profile with the instance's own AWS rights.
    :param subnet: subnet id; None for one of the default VPC.
    :param instance_types: further types to try, in this order, if there is no capacity for one.
    """

    provider = 'aws'
    _shown = {'ec2_region': 'region', 'ec2_instance_type': 'ec2_instance_type',
              'disk_size': 'disk_size', 'aws_ami_image': 'ami_image'}
    _shown_id = {'ec2_instance_id': -1}

    def __init__(
        self, ami_image: Optional[ByRegion] = None,
        region: Optional[SomeSubstitutionsType] = None,
        ec2_instance_type: Optional[ByRegion] = None,
        disk_size: Optional[Value] = None, *,
        cpu_type: Optional[SomeSubstitutionsType] = None,
        iam_instance_profile: Optional[SomeSubstitutionsType] = None,
        subnet: Optional[ByRegion] = None,
        instance_types: Optional[Sequence[SomeSubstitutionsType]] = None,
        **common: Any,
    ) -> None:
        super().__init__(options=options_of(AWSCloudInstance.__init__, locals()), **common)


class GCPCloudInstance(VmInstance):
    """
    A Compute Engine instance, created for the launch.

    Defaults: the project of the user's credentials, the region us-central1, an image that
    ``ros2 fog`` has baked with what the launch needs or else Ubuntu 24.04, and the type e2-medium.

    :param project_id: id of the project.
    :param ami_image: ``projects/P/global/images/NAME`` or ``.../images/family/NAME``, or the name
        of an image of the project.
    :param zone: such as 'us-central1-a'; None for any zone of the region with capacity.
    :param machine_type: such as 'e2-medium'; 'cheapest' for the cheapest type that meets the
        requirements.
    :param disk_size: GB; default 30.
    :param region: such as 'europe-west3'; 'nearest' for the region with the fastest response.
    :param accelerators: GPUs to attach to an N1 type, such as 'nvidia-tesla-t4:2'.
    :param service_account: email address of the account with the machine's own rights. With the
        right to delete the instance, the machine deletes itself when the robot is gone.
    :param network: name of the VPC network.
    :param machine_types: further types to try, in this order, if there is no capacity for one.
    """

    provider = 'gcp'
    _shown = {'compute_instance_type': 'machine_type', 'disk_size': 'disk_size'}
    _shown_id = {'compute_instance_id': -2}

    def __init__(
        self, project_id: Optional[SomeSubstitutionsType] = None,
        ami_image: Optional[SomeSubstitutionsType] = None,
        zone: Optional[SomeSubstitutionsType] = None,
        machine_type: Optional[SomeSubstitutionsType] = None,
        disk_size: Optional[Value] = None, *,
        region: Optional[SomeSubstitutionsType] = None,
        accelerators: Optional[SomeSubstitutionsType] = None,
        service_account: Optional[SomeSubstitutionsType] = None,
        network: Optional[SomeSubstitutionsType] = None,
        machine_types: Optional[Sequence[SomeSubstitutionsType]] = None,
        **common: Any,
    ) -> None:
        super().__init__(options=options_of(GCPCloudInstance.__init__, locals()), **common)

    def info(self, flush_to_disk: bool = False) -> dict[str, Any]:
        """Return what is known about the machine, with FogROS2's keys."""
        return {'compute_region': self._option('zone') or self._option('region'),
                **super().info(flush_to_disk)}


class KubeInstance(CloudInstance):
    """
    A pod of a Kubernetes cluster, created for the launch in the context's namespace.

    :param container_image: needs Python 3.10 or newer and ``sh``; ROS 2 in it saves time.
    :param zone: preferred zone of the pod.
    :param mcpu: CPU request and limit in thousandths of a CPU; 0 for none.
    :param mb: memory request and limit in MiB; 0 for none.
    :param namespace: None for the context's own.
    :param context: context of the kubeconfig; None for the current one.
    :param gpus: number of devices of the kind ``gpu_resource``.
    :param gpu_resource: such as 'nvidia.com/gpu'.
    :param node_selector: labels that the cluster's node must have.
    :param tolerations: as in a pod's specification.
    :param runtime_class: such as 'nvidia'.
    :param image_pull_secrets: names of secrets in the namespace.
    :param service_account: the pod's service account; its token is not mounted.
    :param expose: how the VPN reaches the pod: 'load_balancer', 'node_port', 'pod_dials_robot',
        'pod_ip'; 'auto' tries them in this order.
    :param robot_host: address at which pods reach the robot, if they have to dial it.
    :param user: login user, created if the image has none of this name.
    :param env: variables of every login; ``environment`` is for the nodes only.
    :param annotations: annotations of the Service, for example for a cloud's load balancer.
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
        super().__init__(options=options_of(KubeInstance.__init__, locals()), **common)

    def info(self, flush_to_disk: bool = False) -> dict[str, Any]:
        """Return what is known about the machine, with FogROS2's keys."""
        machine = self._running.machine if self._running else None
        return {
            **super().info(flush_to_disk),
            'compute_region': self._option('zone'),
            'compute_instance_type':
                f'{self._option("mcpu") or 0}mx{self._option("mb") or 0}Mb',
            'compute_instance_id': machine.id if machine else None,
        }


class AzureCloudInstance(VmInstance):
    """
    A virtual machine of Azure, created for the launch in a resource group of its own.

    Defaults: the region of ``AZURE_DEFAULTS_LOCATION`` or else eastus, an image that ``ros2 fog``
    has baked with what the launch needs or else Ubuntu 24.04, and the size Standard_B2als_v2, or
    the cheapest size that meets the requirements.

    The keywords of FogROS2's pull request 109 have other names: ``zone`` is ``region``,
    ``machine_type`` is ``vm_size``, ``ami_image`` is ``image``.

    :param resource_group: your own group: a machine joins its virtual network, if it has one in
        the region. FogROS2 creates and deletes nothing in it.
    :param ami_image: the same as ``image``.
    :param zone: the same as ``region``.
    :param machine_type: the same as ``vm_size``.
    :param disk_size: GB; default and minimum 30.
    :param region: such as 'westeurope'; 'nearest' for the region with the fastest response.
    :param vm_size: such as 'Standard_B2als_v2'; 'cheapest' for the cheapest size that meets the
        requirements.
    :param image: 'publisher:offer:sku:version' of the Marketplace, or an image's resource id.
    :param cpu_type: manufacturer of the processor: intel, amd, arm.
    :param vm_sizes: further sizes to try, in this order, if there is no capacity for one.
    """

    provider = 'azure'
    _shown = {'compute_region': 'region', 'compute_instance_type': 'vm_size',
              'disk_size': 'disk_size'}
    _shown_id = {'compute_instance_id': 1}

    def __init__(
        self, resource_group: Optional[SomeSubstitutionsType] = None,
        ami_image: Optional[ByRegion] = None,
        zone: Optional[SomeSubstitutionsType] = None,
        machine_type: Optional[ByRegion] = None,
        disk_size: Optional[Value] = None, *,
        region: Optional[SomeSubstitutionsType] = None,
        vm_size: Optional[ByRegion] = None,
        image: Optional[ByRegion] = None,
        cpu_type: Optional[SomeSubstitutionsType] = None,
        vm_sizes: Optional[Sequence[SomeSubstitutionsType]] = None,
        **common: Any,
    ) -> None:
        options = options_of(AzureCloudInstance.__init__, locals())
        for other, name in (('zone', 'region'), ('machine_type', 'vm_size'),
                            ('ami_image', 'image')):
            value = options.pop(other, None)
            if value is not None:
                if options.get(name) is not None:
                    raise ConfigurationError(f'{other}= and {name}= are the same option',
                                             f'leave {other}= out')
                options[name] = value
        super().__init__(options=options, **common)
