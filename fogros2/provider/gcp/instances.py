# SPDX-License-Identifier: Apache-2.0
"""Requests and reports of Compute Engine instances, converted without any call."""

from __future__ import annotations

import base64
from collections.abc import Mapping
import math
import re
from typing import Any

from fogros2.model import MachineSpec, MachineState
from fogros2.provider import TAG_ON_EXIT
from fogros2.provider.gcp.options import Options
from fogros2.provider.machine_types import MachineType
from fogros2.provider.vm.cloud import Order, own_name, Place, TAG_DISK, Vm, when
from fogros2.provider.vm.labels import LabelRules

RULES = LabelRules()
_TAG_IMAGE = 'fogros2-image'
STATES = {
    'RUNNING': MachineState.RUNNING,
    **dict.fromkeys(('STOPPING', 'PENDING_STOP', 'SUSPENDING', 'DEPROVISIONING'),
                    MachineState.STOPPING),
    **dict.fromkeys(('TERMINATED', 'STOPPED', 'SUSPENDED'), MachineState.STOPPED),
}
#: GB of GPUs, which the API does not tell.
_GPU_GB = {'nvidia-tesla-t4': 16, 'nvidia-l4': 24, 'nvidia-tesla-v100': 16,
           'nvidia-tesla-a100': 40, 'nvidia-a100-80gb': 80, 'nvidia-h100-80gb': 80}
#: Google's limits of ``maxRunDuration`` in seconds.
_SHORTEST, _LONGEST = 30, 120 * 86400


def label_filter(tags: Mapping[str, str]) -> str:
    """Return the filter for FogROS2's resources with all of ``tags``."""
    return ' '.join(['(labels.fogros2-attempt:*)', *(
        f'(labels.{key} = "{value}")' for key, value in RULES.encode(tags).items())])


def disk_type(kind: str) -> str:
    """Return the type of disks for a type of machines."""
    # types since the fourth generation take no other disks
    new = re.match(r'[a-z]+(\d+)', kind)
    return 'hyperdisk-balanced' if new and int(new[1]) >= 4 else 'pd-balanced'


def insertion(
    place: Place, order: Order, image: Mapping[str, Any], subnet: str, tags: Mapping[str, str],
) -> dict[str, Any]:
    """
    Return the body of instances.insert for one place.

    :param image: entry of ``prepare``: path, size of the disk in GB, whether there are GPUs.
    :param subnet: URL of the subnetwork; '' for the one of an automatic network.
    """
    options: Options = order.options
    zone, name = f'zones/{place.zone}', own_name(order.attempt)
    disk = max(options.disk_size, image['size'])
    labels = RULES.encode({
        **{key: value for key, value in tags.items() if key != 'Name'},  # no key of a label
        TAG_DISK: str(disk), _TAG_IMAGE: image['path']})
    return {
        'name': name,
        'description': f'FogROS2 machine {order.spec.name}',
        'machineType': f'{zone}/machineTypes/{place.kind}',
        'labels': labels,
        'tags': {'items': [name]},
        'metadata': {'items': [
            {'key': 'user-data', 'value': base64.b64encode(order.user_data).decode()},
            {'key': 'user-data-encoding', 'value': 'base64'},
            # the SSH keys of the project's users do not log in here
            {'key': 'block-project-ssh-keys', 'value': 'TRUE'}]},
        'disks': [{'boot': True, 'autoDelete': True, 'initializeParams': {
            'sourceImage': image['path'], 'diskSizeGb': str(disk), 'labels': labels,
            'diskType': f'{zone}/diskTypes/{disk_type(place.kind)}'}}],
        'networkInterfaces': [{
            'network': f'global/networks/{options.network}',
            **({'subnetwork': subnet} if subnet else {}),
            'accessConfigs': [{'name': 'External NAT', 'type': 'ONE_TO_ONE_NAT'}]}],
        'scheduling': scheduling(
            order.spec, options, fixed=image['gpus'] or is_fixed(place.kind)),
        'guestAccelerators': [
            {**gpu, 'acceleratorType': f'{zone}/acceleratorTypes/{gpu["acceleratorType"]}'}
            for gpu in options.gpus()],
        'serviceAccounts': [{
            'email': options.service_account,
            'scopes': ['https://www.googleapis.com/auth/cloud-platform'],
        }] if options.service_account else [],
    }


def is_fixed(kind: str) -> bool:
    """Return whether Google migrates no instance of a type, with or without GPUs."""
    return re.fullmatch(r'h\d.*|.*-metal', kind) is not None


def scheduling(spec: MachineSpec, options: Options, *, fixed: bool) -> dict[str, Any]:
    """
    Return how Google places an instance, and when it ends it.

    :param fixed: whether Google cannot migrate the instance, because of its type or GPUs.
    """
    return {
        'automaticRestart': False,
        'onHostMaintenance': 'TERMINATE' if options.spot or fixed else 'MIGRATE',
        'provisioningModel': 'SPOT' if options.spot else 'STANDARD',
        **limit(spec, spot=options.spot, action='STOP' if spec.on_exit == 'stop' else 'DELETE')}


def limit(spec: MachineSpec, *, spot: bool, action: str) -> dict[str, Any]:
    """
    Return when Google ends an instance: at its lifetime, and when it preempts a spot instance.

    A machine that is kept has no such end: another launch may use it for longer, and Google
    changes the time of stopped instances only.

    :param action: STOP or DELETE.
    """
    words: dict[str, Any] = {}
    if spec.on_exit != 'keep':
        seconds = min(max(math.ceil(spec.lifetime), _SHORTEST), _LONGEST)
        words['maxRunDuration'] = {'seconds': str(seconds)}
    if spot or spec.on_exit != 'keep':
        words['instanceTerminationAction'] = action
    return words


def path_of(vm: str) -> str:
    """Return the path of an instance below ``projects/``."""
    project, zone, name = vm.split('/')
    return f'{project}/zones/{zone}/instances/{name}'


def vm_of(project: str, instance: Mapping[str, Any]) -> Vm:
    """Convert an instance as the API reports it."""
    tags = RULES.decode(instance.get('labels') or {})
    zone = _last(instance['zone'])
    state = STATES.get(instance['status'], MachineState.PENDING)
    words = instance.get('scheduling', {})
    if state is MachineState.STOPPED and tags.get(TAG_ON_EXIT) == 'delete' \
            and words.get('instanceTerminationAction') == 'DELETE':
        # it ended itself, and ros2 fog gc deletes it; meanwhile Google bills its disk
        state = MachineState.DELETED
    nic = (instance.get('networkInterfaces') or [{}])[0]
    public = [access.get('natIP') for access in nic.get('accessConfigs') or ()]
    return Vm(
        f'{project}/{zone}/{instance["name"]}', zone[:-2], state, tags,
        kind=_last(instance.get('machineType', '')),
        spot=words.get('provisioningModel') == 'SPOT',
        address=next(filter(None, public), None) or nic.get('networkIP', ''),
        private_network=f'gcp:{project}/{_last(nic.get("network", ""))}',
        private_ip=nic.get('networkIP', ''), created=when(instance.get('creationTimestamp')),
        stopped=when(instance.get('lastStopTimestamp')) if state is MachineState.STOPPED else None,
        image=tags.get(_TAG_IMAGE, ''), reason=instance.get('statusMessage', ''))


def machine_type(entry: Mapping[str, Any]) -> MachineType:
    """Convert an entry of machineTypes."""
    vcpus, gpus = int(entry['guestCpus']), (entry.get('accelerators') or [{}])[0]
    gpu = str(gpus.get('guestAcceleratorType', ''))
    arch = {'ARM64': 'arm64'}.get(entry.get('architecture', ''), 'x86_64')
    one = arch == 'arm64' or vcpus == 1  # arm64 has one thread on each core
    return MachineType(
        entry['name'], vcpus, vcpus if one else vcpus // 2, entry['memoryMb'] / 1024, arch,
        gpus=int(gpus.get('guestAcceleratorCount', 0)),
        gpu=gpu.replace('-', ' ').upper(),
        gpu_memory_gb=round(_GPU_GB.get(gpu, 0) / 1.024 ** 3, 1), spot=True)


def _last(url: str) -> str:
    return url.rpartition('/')[2]
