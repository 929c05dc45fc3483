# SPDX-License-Identifier: Apache-2.0
"""
A TCP port of a machine for others than the robot: a Service of its own, beside the VPN's.

It keeps the callers' addresses (``externalTrafficPolicy: Local``), as what listens in the pod
looks at them; a load balancer turns away those that aren't allowed before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import contextlib
import threading
from typing import Any, Optional

from fogros2.errors import DeadlineExceeded, ProviderError
from fogros2.kubernetes_client import Api, ApiError, path
from fogros2.model import Machine
from fogros2.provider.kubernetes import exposure, hints, names, ways
from fogros2.provider.kubernetes.names import MachineId

#: Seconds in which a load balancer has to be there.
LOAD_BALANCER = 180.0


def service(
    kind: str, where: MachineId, port: int, sources: Sequence[str],
    annotations: Mapping[str, str] = {},
) -> dict[str, Any]:
    """
    Return the Service that leads a TCP port to a machine; its Job owns it.

    :param kind: 'LoadBalancer' or 'NodePort'.
    """
    spec: dict[str, Any] = {
        'type': kind, 'selector': {names.MACHINE: where.job}, 'externalTrafficPolicy': 'Local',
        'ports': [{'name': 'tcp', 'protocol': 'TCP', 'port': port, 'targetPort': port}]}
    if kind == 'LoadBalancer':
        spec['loadBalancerSourceRanges'] = list(sources)
    return {
        'apiVersion': 'v1', 'kind': 'Service',
        'metadata': {
            'name': called(where, port), 'annotations': dict(annotations),
            'labels': {**names.MANAGED, names.MACHINE: where.job},
            'ownerReferences': [{
                'apiVersion': 'batch/v1', 'kind': 'Job', 'name': where.job, 'uid': where.uid,
                'controller': True, 'blockOwnerDeletion': True}]},
        'spec': spec}


def called(where: MachineId, port: int) -> str:
    """Return the name of the Service that leads to a port of a machine."""
    return f'{where.job}-{port}'


def publish(
    api: Api, where: MachineId, machine: Machine, pod: Mapping[str, Any], port: int,
    sources: Sequence[str], cancel: Optional[threading.Event],
) -> tuple[str, int]:
    """
    Let networks reach a TCP port of a pod, they alone; return where they do.

    :raises ProviderError: the cluster allows no Service, or no load balancer comes.
    """
    close(api, where, port)
    kind = 'LoadBalancer' if ways.maker(api, cancel) else 'NodePort'
    target = path('services', where.namespace)
    try:
        made = api.request(
            'POST', target, service(kind, where, port, sources), cancel=cancel)
        if kind == 'LoadBalancer':
            hosts: list[str] = api.follow(
                target, lambda event, found: exposure.ingress(found) or None,
                timeout=LOAD_BALANCER, cancel=cancel, what='a load balancer',
                fieldSelector=f'metadata.name={called(where, port)}')
            return hosts[0], port
    except ApiError as error:
        raise ProviderError(
            f"the cluster refused a Service for port {port} of '{machine.name}': {error.args[0]}",
            hints.of_refusal(str(error.args[0]), where.namespace)) from error
    except DeadlineExceeded as error:
        raise ProviderError(
            f"no load balancer came for port {port} of '{machine.name}' in "
            f'{LOAD_BALANCER:.0f} s', 'leave monitor_allow= out there') from error
    addresses = [str(pod['status'].get('hostIP') or '')]
    with contextlib.suppress(ApiError):
        # the address that the pod tells is the node's inner one
        addresses = exposure.node_addresses(api.request(
            'GET', path('nodes', '', str(pod['spec'].get('nodeName') or '')),
            cancel=cancel)) or addresses
    return addresses[0], exposure.node_port(made)


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
