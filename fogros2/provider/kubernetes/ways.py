# SPDX-License-Identifier: Apache-2.0
"""Making the Service that a machine's VPN is reached by, and finding out whether it works."""

from __future__ import annotations

from collections.abc import Mapping
import contextlib
import threading
import time
from typing import Any, Optional

from fogros2.errors import DeadlineExceeded, NameTaken, ProviderError
from fogros2.kubernetes_client import Api, ApiError, path, Unreachable
from fogros2.model import CreateRequest, MachineSpec
from fogros2.provider.kubernetes import exposure, hints, manifests, names
from fogros2.provider.kubernetes.exposure import Exposure
from fogros2.provider.kubernetes.names import MachineId
from fogros2.provider.kubernetes.options import Options
from fogros2.waiting import wait_until

#: Seconds in which a cluster takes away what belonged to a Job that is gone.
TAKEN = 20.0


def make(
    api: Api, namespace: str, spec: MachineSpec, request: CreateRequest, options: Options,
    job: Mapping[str, Any],
) -> Optional[dict[str, Any]]:
    """
    Make the Service that ``options.expose`` takes and return it; the Job owns it.

    Where the way is ours to choose, a cluster that allows no Service is no obstacle.

    :raises ProviderError: the cluster refused.
    """
    kind = _service_kind(api, options.expose, request.cancel)
    if not kind:
        return None
    uid = str(job['metadata']['uid'])
    body = manifests.service(kind, spec, request, options, uid)
    target = path('services', namespace)

    def attempt() -> Optional[dict[str, Any]]:
        try:
            return api.request('POST', target, body, cancel=request.cancel)
        except ApiError as error:
            if error.reason != 'AlreadyExists':
                raise
        there = _read(api, f"{target}/{body['metadata']['name']}", request.cancel)
        # an earlier attempt's, or of a Job that had the name before: the cluster takes that one
        # away with its Job, but not at once
        return there if there is not None and owned(there, uid) else None

    try:
        return wait_until(attempt, timeout=TAKEN, cancel=request.cancel, interval=0.2,
                          what=f"the Service of an earlier '{spec.name}' to be gone")
    except ApiError as error:
        if options.expose == 'auto':
            return None
        raise ProviderError(
            f"the cluster refused the Service of '{spec.name}': {error.args[0]}",
            hints.of_refusal(str(error.args[0]), namespace)) from error
    except DeadlineExceeded as error:
        if options.expose == 'auto':
            return None
        raise NameTaken(
            f"namespace '{namespace}' has a Service '{body['metadata']['name']}' that is not "
            f"the machine's", 'give the machine another name=, or: kubectl delete service '
            f"-n {namespace} {body['metadata']['name']}") from error


def owned(thing: Mapping[str, Any], uid: str) -> bool:
    """Return whether an object belongs to the Job that has a uid, and stays."""
    meta = thing['metadata']
    return not meta.get('deletionTimestamp') and any(
        owner.get('uid') == uid for owner in meta.get('ownerReferences') or ())


def _read(
    api: Api, target: str, cancel: Optional[threading.Event],
) -> Optional[dict[str, Any]]:
    """Return an object, None if there is none."""
    try:
        return api.request('GET', target, cancel=cancel)
    except ApiError as error:
        if error.status != 404:
            raise
        return None


def _service_kind(api: Api, expose: str, cancel: Optional[threading.Event]) -> str:
    if expose == 'auto':
        return 'LoadBalancer' if maker(api, cancel) else 'NodePort'
    return {'load_balancer': 'LoadBalancer', 'node_port': 'NodePort'}.get(expose, '')


#: Who makes load balancers, by API server.
_makers: dict[str, str] = {}


def maker(api: Api, cancel: Optional[threading.Event] = None) -> str:
    """Return who makes load balancers in a cluster, '' if nobody is known to; asked once."""
    if (known := _makers.get(api.server)) is not None:
        return known
    found = exposure.load_balancers(api.server)
    if not found:
        groups = api.request('GET', '/apis', cancel=cancel).get('groups') or ()
        found = exposure.load_balancers(api.server, [str(each['name']) for each in groups])
    _makers[api.server] = found
    return found


def known(job: Mapping[str, Any]) -> Optional[Exposure]:
    """Return the way that was found before, None if none has been yet."""
    return Exposure.parse(names.annotation(job, names.EXPOSURE))


def robot_host(api: Api, job: Mapping[str, Any]) -> str:
    """Return the address at which a pod reaches this robot."""
    return names.annotation(job, names.ROBOT_HOST) or exposure.own_address(api.server)


def find(
    api: Api, where: MachineId, job: Mapping[str, Any], pod: Mapping[str, Any], *,
    service: Optional[Mapping[str, Any]], timeout: float, cancel: threading.Event,
) -> Exposure:
    """
    Return the way that UDP takes to a pod that runs.

    :param service: what ``make`` returned, None where that isn't known any more.

    :raises ProviderError: the one that was asked for doesn't work.
    """
    asked = names.annotation(job, names.EXPOSE)
    if asked == 'pod_ip':
        return Exposure('pod_ip', str(pod['status']['podIP']), 0, 'as asked')
    if asked == 'pod_dials_robot':
        return Exposure('pod_dials_robot', '', 0, 'as asked')
    search = _Search(api, where, job, pod, cancel)
    try:
        return search.run(asked, service or search.service(), timeout)
    except ApiError as error:
        raise ProviderError(
            f"the Service of '{where.job}' can't be read: {error.args[0]}",
            hints.of_refusal(str(error.args[0]), where.namespace)) from error


class _Search:
    """The ways in their order, each with its deadline; what didn't work says why the next."""

    def __init__(
        self, api: Api, where: MachineId, job: Mapping[str, Any], pod: Mapping[str, Any],
        cancel: threading.Event,
    ) -> None:
        self._api = api
        self._where = where
        self._pod = pod
        self._cancel = cancel
        self._port = int(names.annotation(job, names.VPN_PORT) or 0)
        self._word = manifests.word(names.annotation(job, names.ATTEMPT))
        self._path = path('services', where.namespace, where.job)
        self._failed: list[str] = []

    def run(
        self, asked: str, service: Optional[Mapping[str, Any]], timeout: float,
    ) -> Exposure:
        """Try them."""
        deadline = time.monotonic() + timeout
        if service is not None and service['spec']['type'] == 'LoadBalancer':
            patience = min(exposure.patience(maker(self._api, self._cancel)), timeout * 0.8)
            if (found := self._load_balancer(patience)) is not None:
                return found
        if service is not None and asked in ('auto', 'node_port'):
            left = max(1.0, min(exposure.NODE_PORT, deadline - time.monotonic()))
            if (found := self._node_port(service, left)) is not None:
                return found
        reason = '; '.join(self._failed)
        if asked == 'auto':
            return Exposure('pod_dials_robot', '', 0, reason)
        raise ProviderError(
            f"no UDP gets to the pod of '{self._where.job}' by expose='{asked}': {reason}",
            "let UDP through on the way there, or take expose='pod_dials_robot'")

    def service(self) -> Optional[dict[str, Any]]:
        """Return the Service, None if there is none."""
        found = _read(self._api, self._path, self._cancel)
        if found is None:
            self._failed.append('the cluster allows no Service')
        elif not owned(found, self._where.uid):
            self._failed.append("the Service of that name is not the machine's")
            return None
        return found

    def _load_balancer(self, patience: float) -> Optional[Exposure]:
        begin = time.monotonic()
        try:
            hosts: list[str] = self._api.follow(
                path('services', self._where.namespace),
                lambda event, service: exposure.ingress(service) or None,
                timeout=patience, cancel=self._cancel, what='a load balancer',
                fieldSelector=f'metadata.name={self._where.job}')
        except DeadlineExceeded:
            self._failed.append(f'no load balancer came in {patience:.0f} s')
            return None
        while (left := patience - (time.monotonic() - begin)) > 0:
            # a name may be unknown for minutes: looked up anew each time
            answer = exposure.first_to_answer(
                [(host, self._port) for host in hosts], self._word, timeout=min(5.0, left),
                cancel=self._cancel)
            if answer is not None:
                return Exposure('load_balancer', answer[0], self._port, f'{hosts[0]} answers')
            self._cancel.wait(0.1)
        self._failed.append(f'the load balancer {hosts[0]} lets no UDP through')
        return None

    def _node_port(self, service: Mapping[str, Any], patience: float) -> Optional[Exposure]:
        port = exposure.node_port(service)
        if not port:
            self._failed.append('the Service has no port on the nodes')
            return None
        hosts = [str(self._pod['status'].get('hostIP') or '')]
        answer = exposure.first_to_answer(
            [(hosts[0], port)], self._word, timeout=min(1.0, patience), cancel=self._cancel)
        if answer is None:
            # the address that the pod tells is the node's inner one
            hosts = list(dict.fromkeys([*self._node(), *hosts]))
            answer = exposure.first_to_answer(
                [(host, port) for host in hosts], self._word, timeout=patience,
                cancel=self._cancel)
        if answer is None:
            self._failed.append(f"port {port} of the node ({', '.join(hosts)}) answers nothing in "
                                f'{patience:.0f} s')
            return None
        why = '; '.join([*self._failed, f'the node {answer[0]} answers'])
        return Exposure('node_port', answer[0], port, why)

    def _node(self) -> list[str]:
        """Return the addresses of the pod's node; its own is known where nodes can't be read."""
        name = str(self._pod['spec'].get('nodeName') or '')
        with contextlib.suppress(ApiError, Unreachable):
            # most robots may not, which isn't worth the wait for another answer
            return exposure.node_addresses(self._api.request(
                'GET', path('nodes', '', name), patience=2.0, cancel=self._cancel))
        return []
