# SPDX-License-Identifier: Apache-2.0
"""Volumes of pods: a PersistentVolumeClaim for each, which no Job owns."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import contextlib
import threading
from typing import Any, Optional

from fogros2.errors import NameTaken
from fogros2.kubernetes_client import Api, ApiError, items, path, selector
from fogros2.provider.kubernetes import names
from fogros2.provider.kubernetes.hints import explained

#: The label of a claim, whose value is the volume's name.
VOLUME = 'fogros2-volume'


def claim_name(name: str) -> str:
    """Return the name of a volume's claim; the API server refuses a second one."""
    return f'{VOLUME}-{name}'


def claim(name: str, size_gb: int) -> dict[str, Any]:
    """Return a claim, with the cluster's usual storage class."""
    return {
        'apiVersion': 'v1', 'kind': 'PersistentVolumeClaim',
        'metadata': {'name': claim_name(name), 'labels': {**names.MANAGED, VOLUME: name}},
        'spec': {'accessModes': ['ReadWriteOnce'],
                 'resources': {'requests': {'storage': f'{size_gb}Gi'}}}}


def users(api: Api, namespace: str, cancel: Optional[threading.Event] = None) -> dict[str, str]:
    """Return the Job of the first pod that has not ended, by the claims that pods mount."""
    answer = api.request('GET', path('pods', namespace), labelSelector=selector(names.MANAGED),
                         cancel=cancel)
    latest_first = sorted(items(answer), reverse=True, key=lambda pod: (
        pod['metadata']['creationTimestamp'], pod['metadata']['uid']))
    return {volume['persistentVolumeClaim']['claimName']: pod['metadata']['labels'].get(
                names.MACHINE, pod['metadata']['name'])
            for pod in latest_first if pod['status'].get('phase') not in ('Succeeded', 'Failed')
            for volume in pod['spec'].get('volumes') or () if 'persistentVolumeClaim' in volume}


def make(
    api: Api, namespace: str, job: str, volumes: Mapping[str, tuple[str, int]],
    cancel: Optional[threading.Event],
) -> None:
    """
    Make the claims of a machine that do not exist yet.

    :raises NameTaken: another machine uses one.
    """
    taken = users(api, namespace, cancel) if volumes else {}
    for name in volumes:
        check_free(name, taken, (job,))
    for name, (_, size_gb) in volumes.items():
        with explained(f"the volume '{name}'", namespace):
            try:
                api.request('POST', path('persistentvolumeclaims', namespace),
                            claim(name, size_gb), cancel=cancel)
            except ApiError as error:
                if error.reason != 'AlreadyExists':
                    raise


def check_free(name: str, taken: Mapping[str, str], own: Iterable[str] = ()) -> None:
    """
    Check that no other machine uses a volume.

    :raises NameTaken: one does.
    """
    user = taken.get(claim_name(name), '')
    if user and user not in own:
        machine = user.removeprefix('fogros2-')
        raise NameTaken(f"the machine '{machine}' has the volume '{name}'",
                        f'end its launch, or: ros2 fog delete {machine}')


def mounts(volumes: Mapping[str, tuple[str, int]]) -> tuple[list[Any], list[Any]]:
    """Return the volumes of a pod, and the mounts of its container."""
    return ([{'name': name, 'persistentVolumeClaim': {'claimName': claim_name(name)}}
             for name in volumes],
            [{'name': name, 'mountPath': where} for name, (where, _) in volumes.items()])


def size_of(entry: Mapping[str, Any]) -> Optional[int]:
    """Return the size of a claim in GB, None if it has another form than FogROS2's."""
    with contextlib.suppress(ValueError):
        return int(str(entry['spec']['resources']['requests']['storage']).removesuffix('Gi'))
    return None
