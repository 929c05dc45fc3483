# SPDX-License-Identifier: Apache-2.0
"""Create the Service of a machine's VPN, find out whether UDP gets through; open TCP ports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import contextlib
import threading
import time
from typing import Any, Optional
from urllib.parse import urlsplit

from fogros2.errors import DeadlineExceeded, NameTaken, ProviderError, VpnError
from fogros2.kubernetes_client import Api, ApiError, existing, path, Unreachable
from fogros2.model import CreateRequest, Machine, MachineSpec
from fogros2.provider.kubernetes import exposure, hints, manifests, names
from fogros2.provider.kubernetes.exposure import Exposure
from fogros2.provider.kubernetes.names import MachineId
from fogros2.provider.kubernetes.options import Options
from fogros2.vpn import addresses
from fogros2.waiting import wait_until

#: Time-out of the deletion of an earlier Job's Service, in seconds.
TAKEN = 20.0


def make(
    api: Api, spec: MachineSpec, request: CreateRequest, options: Options,
    job: Mapping[str, Any], cancel: Optional[threading.Event] = None,
) -> None:
    """
    Create the Service for ``options.expose``, which the Job owns.

    With 'auto', the cluster may refuse it.

    :raises ProviderError: the cluster refused.
    """
    kind = _service_kind(api, options.expose, cancel)
    if not kind:
        return
    where = MachineId.of(job, api.context)
    body = manifests.service(
        kind, where.job, where, 'UDP', request.vpn_port,
        labels=names.labels(spec.name, request.tags), annotations=options.annotations)
    target = path('services', where.namespace)

    def attempt() -> Optional[dict[str, Any]]:
        try:
            return api.request('POST', target, body, cancel=cancel)
        except ApiError as error:
            if error.reason != 'AlreadyExists':
                raise
        service = existing(api, f'{target}/{where.job}', cancel)
        # It belongs to an earlier attempt, or to an earlier Job with the name, with which the
        # cluster will delete it soon.
        return service if service is not None and owned(service, where.uid) else None

    try:
        wait_until(attempt, timeout=TAKEN, cancel=cancel, interval=0.2,
                   what=f"the Service of an earlier '{spec.name}' to be gone")
    except ApiError as error:
        if options.expose != 'auto':
            raise hints.refused(error, f"the Service of '{spec.name}'", where.namespace) from error
    except DeadlineExceeded as error:
        if options.expose != 'auto':
            raise NameTaken(
                f"namespace '{where.namespace}' has a Service '{where.job}' that is not the "
                "machine's", 'give the machine another name=, or: kubectl delete service '
                f'-n {where.namespace} {where.job}') from error


def owned(thing: Mapping[str, Any], uid: str) -> bool:
    """Return whether the Job with a uid owns an object that is not being deleted."""
    meta = thing['metadata']
    return not meta.get('deletionTimestamp') and any(
        owner.get('uid') == uid for owner in meta.get('ownerReferences') or ())


def _service_kind(api: Api, expose: str, cancel: Optional[threading.Event]) -> str:
    if expose == 'auto':
        return 'LoadBalancer' if maker(api, cancel) else 'NodePort'
    return {'load_balancer': 'LoadBalancer', 'node_port': 'NodePort'}.get(expose, '')


#: What makes load balancers, by API server.
_makers: dict[str, str] = {}


def maker(api: Api, cancel: Optional[threading.Event] = None) -> str:
    """Return what makes load balancers in a cluster, see ``exposure.load_balancers``."""
    if (name := _makers.get(api.server)) is not None:
        return name
    name = exposure.load_balancers(api.server)
    if not name:
        groups = api.request('GET', '/apis', cancel=cancel).get('groups') or ()
        name = exposure.load_balancers(api.server, [str(each['name']) for each in groups])
    _makers[api.server] = name
    return name


def load_balancer(
    api: Api, namespace: str, service: str, timeout: float, cancel: Optional[threading.Event],
) -> list[str]:
    """
    Wait for a Service's load balancer, and return its addresses and host names.

    :raises DeadlineExceeded: it was not ready after ``timeout`` seconds.
    """
    return api.follow(
        path('services', namespace), lambda event, body: exposure.ingress(body) or None,
        timeout=timeout, cancel=cancel, what='a load balancer',
        fieldSelector=f'metadata.name={service}')


def node_hosts(
    api: Api, pod: Mapping[str, Any], cancel: Optional[threading.Event],
) -> list[str]:
    """Return the addresses of a pod's node, external ones first."""
    hosts: list[str] = []
    name = str(pod['spec'].get('nodeName') or '')
    # Most robots may not read nodes; then the address in the pod's status remains.
    with contextlib.suppress(ApiError, Unreachable):
        hosts = exposure.node_addresses(api.request(
            'GET', path('nodes', '', name), timeout=2.0, cancel=cancel))
    return list(dict.fromkeys([*hosts, str(pod['status'].get('hostIP') or '')]))


def known(job: Mapping[str, Any]) -> Optional[Exposure]:
    """Return the exposure that was found before, None if there is none yet."""
    return Exposure.parse(names.annotation(job, names.EXPOSURE))


def robot_host(api: Api, job: Mapping[str, Any]) -> str:
    """Return the address at which a pod reaches this robot, '' if there is no route."""
    server = urlsplit(api.server)
    with contextlib.suppress(VpnError):
        return names.annotation(job, names.ROBOT_HOST) or addresses.own_address(
            (server.hostname or '', server.port or 443))
    return ''


def find(
    api: Api, where: MachineId, job: Mapping[str, Any], pod: Mapping[str, Any], *,
    timeout: float, cancel: threading.Event,
) -> Exposure:
    """
    Return how UDP reaches a running pod.

    :raises ProviderError: the requested exposure does not work.
    """
    expose = names.annotation(job, names.EXPOSE)
    if expose == 'pod_ip':
        return Exposure('pod_ip', str(pod['status']['podIP']), 0, 'as asked')
    if expose == 'pod_dials_robot':
        return Exposure('pod_dials_robot', '', 0, 'as asked')
    search = _Search(api, where, job, pod, cancel)
    with hints.explained(f"reading the Service of '{where.job}'", where.namespace):
        return search.run(expose, timeout)


class _Search:
    """Try the exposures in their order, each with a time-out; collect the failures."""

    def __init__(
        self, api: Api, where: MachineId, job: Mapping[str, Any], pod: Mapping[str, Any],
        cancel: threading.Event,
    ) -> None:
        self._api = api
        self._where = where
        self._path = path('services', where.namespace, where.job)
        self._pod = pod
        self._cancel = cancel
        self._port = int(names.annotation(job, names.VPN_PORT) or 0)
        self._word = manifests.word(names.annotation(job, names.ATTEMPT))
        self._failed: list[str] = []

    def run(self, expose: str, timeout: float) -> Exposure:
        """Return the first exposure that works."""
        deadline = time.monotonic() + timeout
        service = self._service()
        if service is not None and service['spec']['type'] == 'LoadBalancer':
            limit = exposure.LOAD_BALANCER_ALONE if expose != 'auto' else min(
                exposure.timeout(maker(self._api, self._cancel)), timeout * 0.8)
            if (result := self._load_balancer(limit)) is not None:
                return result
        if service is not None and expose in ('auto', 'node_port'):
            remaining = max(1.0, min(exposure.NODE_PORT, deadline - time.monotonic()))
            if (result := self._node_port(service, remaining)) is not None:
                return result
        reason = '; '.join(self._failed)
        if expose == 'auto':
            if service is not None:
                # The cloud would bill its load balancer for the machine's life.
                with contextlib.suppress(ApiError, Unreachable):
                    self._api.request('DELETE', self._path, cancel=self._cancel)
            return Exposure('pod_dials_robot', '', 0, reason)
        raise ProviderError(
            f"no UDP gets to the pod of '{self._where.job}' by expose='{expose}': {reason}",
            "let UDP through on the way there, or take expose='pod_dials_robot'")

    def _service(self) -> Optional[dict[str, Any]]:
        """Return the Service, None if there is none."""
        service = existing(self._api, self._path, self._cancel)
        if service is None:
            self._failed.append('the cluster allows no Service')
        elif not owned(service, self._where.uid):
            self._failed.append("the Service of that name is not the machine's")
            return None
        return service

    def _load_balancer(self, timeout: float) -> Optional[Exposure]:
        begin = time.monotonic()
        try:
            hosts = load_balancer(
                self._api, self._where.namespace, self._where.job, timeout, self._cancel)
        except DeadlineExceeded:
            self._failed.append(f'no load balancer came in {timeout:.0f} s')
            return None
        while (remaining := timeout - (time.monotonic() - begin)) > 0:
            # A host name may be unknown for minutes, so resolve it each time.
            answer = exposure.first_to_answer(
                [(host, self._port) for host in hosts], self._word, timeout=min(5.0, remaining),
                cancel=self._cancel)
            if answer is not None:
                return Exposure('load_balancer', answer[0], self._port, f'{hosts[0]} answers')
            self._cancel.wait(0.1)
        self._failed.append(f'the load balancer {hosts[0]} lets no UDP through')
        return None

    def _node_port(self, service: Mapping[str, Any], timeout: float) -> Optional[Exposure]:
        port = exposure.node_port(service)
        if not port:
            self._failed.append('the Service has no port on the nodes')
            return None
        hosts = node_hosts(self._api, self._pod, self._cancel)
        answer = exposure.first_to_answer(
            [(host, port) for host in hosts], self._word, timeout=timeout, cancel=self._cancel)
        if answer is None:
            self._failed.append(f"port {port} of the node ({', '.join(hosts)}) answers nothing in "
                                f'{timeout:.0f} s')
            return None
        why = '; '.join([*self._failed, f'the node {answer[0]} answers'])
        return Exposure('node_port', answer[0], port, why)


def open_port(
    api: Api, where: MachineId, machine: Machine, pod: Mapping[str, Any], port: int,
    sources: Sequence[str], cancel: Optional[threading.Event],
) -> tuple[str, int]:
    """
    Open a TCP port of a pod for some networks; return host and port for their computers.

    :raises ProviderError: the cluster allows no Service, or makes no load balancer.
    """
    close_port(api, where, port)
    what = f"port {port} of '{machine.name}'"
    service = manifests.port_service(_service_kind(api, 'auto', cancel), where, port, sources)
    try:
        with hints.explained(f'a Service for {what}', where.namespace):
            made = api.request('POST', path('services', where.namespace), service, cancel=cancel)
            if service['spec']['type'] == 'LoadBalancer':
                return load_balancer(api, where.namespace, service['metadata']['name'],
                                     exposure.LOAD_BALANCER, cancel)[0], port
    except DeadlineExceeded as error:
        raise ProviderError(
            f'the cluster created no load balancer for {what} in {exposure.LOAD_BALANCER:.0f} s',
            'let no other networks in on this cluster') from error
    return node_hosts(api, pod, cancel)[0], exposure.node_port(made)


def close_port(api: Api, where: MachineId, port: int) -> None:
    """Remove the Service of a port; idempotent."""
    name = names.port_service(where, port)
    try:
        api.request('DELETE', path('services', where.namespace, name))
    except ApiError as error:
        if error.status != 404:
            raise ProviderError(
                f"port {port} of '{where.job}' can't be closed: {error.args[0]}",
                hints.of_refusal(str(error.args[0]), where.namespace)
                or f'kubectl delete service -n {where.namespace} {name}') from error
