# SPDX-License-Identifier: Apache-2.0
"""
Open a TCP port of a machine for other computers than the robot, by a separate Service.

The Service keeps the clients' addresses (``externalTrafficPolicy: Local``), because the server in
the pod checks them; a load balancer refuses other clients before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import threading
from typing import Any, Optional

from fogros2.errors import DeadlineExceeded, ProviderError
from fogros2.kubernetes_client import Api, ApiError, path
from fogros2.model import Machine
from fogros2.provider.kubernetes import exposure, hints, manifests, names, ways
from fogros2.provider.kubernetes.names import MachineId

#: Time-out of a load balancer's creation, in seconds.
LOAD_BALANCER = 180.0


def service(
    kind: str, where: MachineId, port: int, sources: Sequence[str],
    annotations: Mapping[str, str] = {},
) -> dict[str, Any]:
    """
    Return the Service of a machine's TCP port, which the machine's Job owns.

    :param kind: 'LoadBalancer' or 'NodePort'.
    """
    found = manifests.owned_service(
        called(where, port), kind, where.job, where.uid, 'TCP', port,
        labels={**names.MANAGED, names.MACHINE: where.job}, annotations=annotations)
    found['spec']['externalTrafficPolicy'] = 'Local'
    if kind == 'LoadBalancer':
        found['spec']['loadBalancerSourceRanges'] = list(sources)
    return found


def called(where: MachineId, port: int) -> str:
    """Return the name of the Service of a machine's port."""
    return f'{where.job}-{port}'


def open_port(
    api: Api, where: MachineId, machine: Machine, pod: Mapping[str, Any], port: int,
    sources: Sequence[str], cancel: Optional[threading.Event],
) -> tuple[str, int]:
    """
    Open a TCP port of a pod for some networks; return host and port for their computers.

    :raises ProviderError: the cluster allows no Service, or makes no load balancer.
    """
    close(api, where, port)
    kind = 'LoadBalancer' if ways.maker(api, cancel) else 'NodePort'
    target = path('services', where.namespace)
    try:
        made = api.request(
            'POST', target, service(kind, where, port, sources), cancel=cancel)
        if kind == 'LoadBalancer':
            return ways.load_balancer(
                api, where.namespace, called(where, port), LOAD_BALANCER, cancel)[0], port
    except ApiError as error:
        raise hints.refused(
            error, f"a Service for port {port} of '{machine.name}'", where.namespace) from error
    except DeadlineExceeded as error:
        raise ProviderError(
            f"the cluster created no load balancer for port {port} of '{machine.name}' in "
            f'{LOAD_BALANCER:.0f} s', 'leave monitor_allow= out on this cluster') from error
    return ways.node_hosts(api, pod, cancel)[0], exposure.node_port(made)


def close(api: Api, where: MachineId, port: int) -> None:
    """Remove the Service of a port; idempotent."""
    try:
        api.request('DELETE', f"{path('services', where.namespace)}/{called(where, port)}")
    except ApiError as error:
        if error.status != 404:
            raise ProviderError(
                f"port {port} of '{where.job}' can't be closed: {error.args[0]}",
                hints.of_refusal(str(error.args[0]), where.namespace)
                or f'kubectl delete service -n {where.namespace} {called(where, port)}') from error
