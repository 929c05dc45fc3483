# SPDX-License-Identifier: Apache-2.0
"""
Run machines as pods: a Job for each, which owns the pod and its Service, and ends both in time.

``options`` parses what a launch file asks for, ``names`` has names, ids and tags. ``boot`` is the
first process of a pod, ``hints`` explains refusals. ``claims`` has the volumes, ``manifests``
describes Job, pod and Service. ``pods`` reads the state of Jobs and pods, ``start`` waits for a
pod. ``exposure`` and ``ways`` find how UDP reaches the pod, and open TCP ports, ``ending`` deletes
everything. ``image`` builds images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import contextlib
import threading
import time
from typing import Any, ClassVar, Optional

from fogros2 import kubernetes_client, untrusted
from fogros2.errors import (
    FogError,
    MachineNotFound,
    NameTaken,
    PrerequisiteError,
)
from fogros2.kubernetes_client import (
    Api,
    ApiError,
    existing,
    items,
    path,
    selector,
    Unreachable,
)
from fogros2.model import CreateRequest, Endpoint, Machine, MachineSpec, MachineState, Volume
from fogros2.provider import Attached, Capabilities, made_without, Provider, TAG_ON_EXIT
from fogros2.provider.kubernetes import (
    boot,
    claims,
    ending,
    hints,
    manifests,
    names,
    pods,
    ways,
)
from fogros2.provider.kubernetes.exposure import Exposure
from fogros2.provider.kubernetes.hints import explained, refused
from fogros2.provider.kubernetes.names import MachineId
from fogros2.provider.kubernetes.options import Options
from fogros2.provider.kubernetes.start import Start

_REVIEW = '/apis/authorization.k8s.io/v1/selfsubjectrulesreviews'
#: Time-out of an API server that does not answer at the start, in seconds.
_FIRST = 5.0
#: Label of every node.
_ARCHITECTURE = 'kubernetes.io/arch'
#: Seconds for which rights and admissions are not checked again.
_SURE = 30.0


class KubernetesProvider(Provider):
    """Pods of the cluster that the kubeconfig names."""

    name: ClassVar[str] = 'kubernetes'
    #: A pod has only the rights that WireGuard needs.
    capabilities: ClassVar[Capabilities] = Capabilities(
        shell_kind='kubernetes', containers=False, keeps_volumes=True,
        application_port=manifests.APPLICATION_PORT,
        preemption_notice=boot.NOTICE_COMMAND)
    poll_interval: ClassVar[float] = 1.0

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._asking = threading.Lock()
        #: When the cluster last agreed: that this user has all rights, or to a pod.
        self._agreed: dict[object, float] = {}
        #: Contexts and namespaces in launch files and records; '' for the current ones.
        self._places: set[tuple[str, str]] = set()
        self._lifetimes: dict[str, float] = {}
        #: Jobs that this process created, which saves requests.
        self._made: dict[str, dict[str, Any]] = {}
        #: Uid of the first pod; a later pod of the same Job is not the machine.
        self._pods: dict[str, str] = {}

    @classmethod
    def configured(cls) -> bool:
        """Return whether there is a kubeconfig, or this pod may use the API."""
        return kubernetes_client.configured()

    def answers(self) -> str:
        """Return the API server's version and the used namespace."""
        api = kubernetes_client.connect()
        version = api.request('GET', '/version', timeout=_FIRST)
        return f"{api.server} answers, {version.get('gitVersion')}, namespace '{api.namespace}'"

    def check(self, spec: MachineSpec) -> None:
        """Check the options, and this user's rights in the cluster."""
        options = Options.parse(spec.options)
        api, namespace = self._place(options)
        self._lifetimes[names.job_name(spec.name)] = spec.lifetime
        self._once((api.context, namespace), lambda: self._check_rights(api, namespace))

    def _once(self, what: object, ask: Callable[[], object]) -> None:
        """Ask the cluster, once for all machines of a launch; ``ask`` raises if it refuses."""
        with self._asking:
            if time.monotonic() - self._agreed.get(what, -_SURE) >= _SURE:
                ask()
                self._agreed[what] = time.monotonic()

    def _check_rights(self, api: Api, namespace: str) -> None:
        review = api.request('POST', _REVIEW, {'spec': {'namespace': namespace}}, timeout=_FIRST)
        status = review.get('status') or {}
        lacking = hints.missing_rights(status.get('resourceRules') or ())
        # If the authorizer cannot list all rules, the requests themselves show what lacks.
        if lacking and not status.get('incomplete'):
            raise PrerequisiteError(
                f"this user may not {', '.join(lacking)} in namespace '{namespace}' of "
                f'{api.server}', 'packaging/kubernetes/role.yaml has all that a robot needs')

    def architecture(self, spec: MachineSpec) -> str:
        """Return the architecture in ``node_selector``, or of all nodes with its labels."""
        options = Options.parse(spec.options)
        api, _ = self._place(options)
        architectures = {options.node_selector.get(_ARCHITECTURE, '')}
        if architectures == {''}:
            # Most users may not list nodes.
            with contextlib.suppress(ApiError):
                nodes = items(api.request(
                    'GET', path('nodes'), labelSelector=selector(options.node_labels),
                    timeout=_FIRST, cancel=self.cancel))
                architectures = {str((node['metadata'].get('labels') or {}).get(_ARCHITECTURE, ''))
                                 for node in nodes}
        (arch,) = architectures if len(architectures) == 1 else ('',)
        return {'amd64': 'x86_64', 'arm64': 'aarch64'}.get(arch, '')

    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        """Check the pod's admission by a dry run, then create the Job and its Service."""
        options = Options.parse(spec.options)
        api, namespace = self._place(options)
        claims.make(api, namespace, names.job_name(spec.name), request.with_volumes, self.cancel)
        existing = None
        try:
            # Pods of one kind differ only by their names.
            self._once(
                f'{api.context} {namespace} {request.dependencies} {options} '
                f'{request.with_volumes}',
                lambda: api.request(
                    'POST', path('pods', namespace), manifests.pod(spec, request, options),
                    dryRun='All', cancel=self.cancel))
        except ApiError as error:
            # The first attempt with this token may have used the quota.
            existing = self._existing(api, namespace, spec, request)
            if existing is None:
                raise refused(error, f"the pod of '{spec.name}'", namespace) from error
        except FogError as error:
            error.refused = True  # a dry run creates nothing
            raise
        job = existing or self._make_job(api, namespace, spec, request, options)
        machine_id = str(MachineId.of(job, api.context))
        try:
            ways.make(api, spec, request, options, job, self.cancel)
        except BaseException as error:
            self.destroy(machine_id)
            if isinstance(error, FogError):
                error.refused = True
            raise
        self._made[machine_id] = job
        return machine_id

    def _make_job(
        self, api: Api, namespace: str, spec: MachineSpec, request: CreateRequest,
        options: Options,
    ) -> dict[str, Any]:
        try:
            return api.request('POST', path('jobs', namespace),
                               manifests.job(spec, request, options), cancel=self.cancel)
        except Unreachable as error:
            error.refused = False
            raise
        except ApiError as error:
            if error.reason != 'AlreadyExists':
                failure = refused(error, f"the Job of '{spec.name}'", namespace)
                failure.refused = error.status < 500
                raise failure from error
            existing = self._existing(api, namespace, spec, request)
            if existing is None:
                raise NameTaken(
                    f"namespace '{namespace}' has a machine '{spec.name}' already",
                    f'give the machine another name=, or: ros2 fog delete {spec.name}') from error
            return existing

    def _existing(
        self, api: Api, namespace: str, spec: MachineSpec, request: CreateRequest,
    ) -> Optional[dict[str, Any]]:
        """Return the Job that an earlier attempt with this token created."""
        with contextlib.suppress(ApiError):
            job = api.request('GET', path('jobs', namespace, names.job_name(spec.name)),
                              cancel=self.cancel)
            if names.annotation(job, names.ATTEMPT) == request.token:
                return job
        return None

    def reachable(
        self, machine_id: str, *, name: str, timeout: float, known: Optional[Machine] = None,
    ) -> Machine:
        """Wait until the pod runs, then find how UDP reaches it."""
        where = MachineId.parse(machine_id)
        api = kubernetes_client.connect(where.context)
        cancel = self.cancel or threading.Event()
        begin = time.monotonic()
        job = self._made.get(machine_id) or self._job(api, where)
        pod = Start(api, where, job, name=name, cancel=cancel).wait(timeout)
        self._pods[machine_id] = str(pod['metadata']['uid'])
        change = self._again(api, machine_id, job)
        exposure = ways.known(job)
        if exposure is None:
            exposure = ways.find(
                api, where, job, pod, cancel=cancel,
                timeout=max(1.0, timeout - (time.monotonic() - begin)))
            change['metadata'] = {'annotations': {names.EXPOSURE: str(exposure)}}
        if change and names.tags_of(job).get(TAG_ON_EXIT) == 'keep':
            # Later launches read it.
            with explained(f"the Job of '{name}'", where.namespace):
                api.request(
                    'PATCH', path('jobs', where.namespace, where.job), change, cancel=cancel)
        return self._machine(api, where, job, pod, exposure)

    def _again(self, api: Api, machine_id: str, job: Mapping[str, Any]) -> dict[str, Any]:
        """Return the change that gives a kept machine another lifetime."""
        lifetime = self._lifetimes.get(str(job['metadata']['name']))
        begun = (job.get('status') or {}).get('startTime')
        if machine_id in self._made or lifetime is None or not begun:
            return {}
        # by the clock of the cluster: that of this computer may be wrong
        age = max(0.0, api.clock.now() - pods.timestamp(str(begun)))
        return {'spec': {'activeDeadlineSeconds': int(age + lifetime) + 1}}

    def describe(self, machine_id: str) -> Machine:
        """Return the state of a machine, from the cluster."""
        where = MachineId.parse(machine_id)
        api = kubernetes_client.connect(where.context)
        job = self._job(api, where)
        pod = pods.pod_of(job, self._pods_of(api, where))
        uid = self._pods.get(machine_id)
        if uid and (pod is None or pod['metadata']['uid'] != uid):
            raise MachineNotFound(f"the pod of '{where.job}' is gone")
        return self._machine(api, where, job, pod)

    def find(self, tags: Mapping[str, str]) -> Iterator[Machine]:
        """Yield the Jobs with all of ``tags``, in all namespaces if the user may list them."""
        contexts = {'', *(context for context, _ in self._places.copy())}
        seen: set[str] = set()
        for context in sorted(contexts):
            if context == '' and not kubernetes_client.configured():
                continue
            api = kubernetes_client.connect(context)
            labels = selector(names.wanted(tags))
            for namespace, jobs in self._entries(api, 'jobs', labels):
                wanted = [job for job in jobs if tags.items() <= names.tags_of(job).items()]
                pod_list = items(self._ask(api, 'pods', namespace, labels)) if wanted else ()
                for job in wanted:
                    where = MachineId.of(job, api.context)
                    if where.uid not in seen:
                        seen.add(where.uid)
                        yield self._machine(api, where, job, pods.pod_of(job, pod_list))

    def search_for(self, specs: Iterable[MachineSpec]) -> None:
        """Let ``find`` search the namespaces of these specs."""
        with self._lock:
            self._places.update((str(spec.options.get('context') or ''),
                                 str(spec.options.get('namespace') or '')) for spec in specs)

    def _entries(
        self, api: Api, kind: str, labels: str,
    ) -> Iterator[tuple[str, list[dict[str, Any]]]]:
        try:
            yield '', list(items(self._ask(api, kind, '', labels)))
            return
        except ApiError as error:
            if error.status != 403:
                raise
        named = {space or api.namespace for context, space in self._places.copy()
                 if context == api.context or not context and api is kubernetes_client.connect()}
        for namespace in sorted({api.namespace, *named}):
            try:
                entries = list(items(self._ask(api, kind, namespace, labels)))
            except ApiError as error:
                # the role may be in the named namespaces alone
                if error.status == 403 and named and namespace not in named:
                    continue
                raise refused(error, f'listing {kind}', namespace) from error
            yield namespace, entries

    def _ask(self, api: Api, kind: str, namespace: str, labels: str) -> dict[str, Any]:
        return api.request('GET', path(kind, namespace), labelSelector=labels, timeout=_FIRST)

    def destroy(self, machine_id: str) -> None:
        """Delete the Job; return when Job, pod and Service are deleted."""
        where = MachineId.parse(machine_id)
        api = kubernetes_client.connect(where.context)
        self._made.pop(machine_id, None)
        self._pods.pop(machine_id, None)
        with explained(f"deleting '{where.job}'", where.namespace):
            ending.end(api, where)

    def open_port(
        self, machine: Machine, port: int, sources: Sequence[str],
    ) -> tuple[str, int]:
        """Make a Service for a TCP port, or remove it."""
        where = MachineId.parse(machine.id)
        api = kubernetes_client.connect(where.context)
        if not sources:
            ways.close_port(api, where, port)
            return machine.vpn_host, port
        pod = pods.pod_of(self._job(api, where), self._pods_of(api, where))
        if pod is None:
            raise MachineNotFound(f"the pod of '{where.job}' is gone")
        return ways.open_port(api, where, machine, pod, port, sources, self.cancel)

    def volumes(self, hosts: Sequence[str] = ()) -> Iterator[Volume]:
        """Yield the claims in all namespaces if the user may list them."""
        api = kubernetes_client.connect()
        for namespace, entries in self._entries(
                api, 'persistentvolumeclaims', f'{selector(names.MANAGED)},{claims.VOLUME}'):
            taken = claims.users(api, namespace) if entries else {}
            for entry in entries:
                meta = entry['metadata']
                yield Volume(
                    f'{self.name}:{api.context}/{meta["namespace"]}/{meta["name"]}',
                    str(meta['labels'][claims.VOLUME]), self.name,
                    f'{api.context}/{meta["namespace"]}'.lstrip('/'), claims.size_of(entry),
                    taken.get(str(meta['name']), '').removeprefix('fogros2-'))

    def attach(self, machine_id: str, name: str, size_gb: int) -> Attached:
        """Return nothing: the kubelet has mounted the volume."""
        where = MachineId.parse(machine_id)
        taken = claims.users(kubernetes_client.connect(where.context), where.namespace,
                             self.cancel)
        claims.check_free(name, taken, (where.job,))  # two launches may have made pods at once
        if claims.claim_name(name) not in taken:
            raise made_without(where.job.removeprefix('fogros2-'), name)
        return Attached()

    def detach(self, machine_id: str, name: str) -> None:
        """Do nothing: the machine's end frees the volume."""

    def delete_volume(self, volume_id: str) -> None:
        """Delete a claim, which by its storage class deletes the disk."""
        context, namespace, name = volume_id.removeprefix(f'{self.name}:').rsplit('/', 2)
        api = kubernetes_client.connect(context)
        with explained(f"deleting '{name}'", namespace):
            claims.check_free(name.removeprefix(claims.claim_name('')),
                              claims.users(api, namespace))
            try:
                api.request('DELETE', path('persistentvolumeclaims', namespace, name))
            except ApiError as error:
                if error.status != 404:
                    raise

    # -- shared by the methods above ------------------------------------------------------------

    def _place(self, options: Options) -> tuple[Api, str]:
        api = kubernetes_client.connect(options.context)
        namespace = options.namespace or api.namespace
        with self._lock:
            self._places.add((options.context, namespace))
        return api, namespace

    def _job(self, api: Api, where: MachineId) -> dict[str, Any]:
        with explained(f"reading '{where.job}'", where.namespace):
            job = existing(api, path('jobs', where.namespace, where.job))
        if job is None or job['metadata']['uid'] != where.uid:
            raise MachineNotFound(f"'{where.job}' does not exist any more")
        return job

    def _pods_of(self, api: Api, where: MachineId) -> list[dict[str, Any]]:
        with explained('listing pods', where.namespace):
            return list(items(self._ask(
                api, 'pods', where.namespace, selector({names.MACHINE: where.job}))))

    def _machine(
        self, api: Api, where: MachineId, job: Mapping[str, Any],
        pod: Optional[Mapping[str, Any]], exposure: Optional[Exposure] = None,
    ) -> Machine:
        exposure = exposure or ways.known(job)
        state = pods.state_of(job, pod)
        tags = names.tags_of(job)
        status = (pod or {}).get('status') or {}
        endpoint = None
        user = names.annotation(job, names.LOGIN)
        if pod is not None and state is MachineState.RUNNING and untrusted.NAME.fullmatch(user):
            endpoint = Endpoint(
                'kubernetes', names.endpoint_host(
                    where.namespace, str(pod['metadata']['name']), where.context),
                0, user)
        address = str(status.get('podIP') or '')
        return Machine(
            id=str(where), name=tags.get('fogros2-name', where.job), provider=self.name,
            state=state, created=pods.timestamp(str(job['metadata']['creationTimestamp'])),
            endpoint=endpoint, vpn_host=address if exposure is None else exposure.host,
            vpn_port=0 if exposure is None else exposure.port,
            robot_host=ways.robot_host(api, job),
            private_network=f'kubernetes {api.server}', private_ip=address,
            region=f'{where.context}/{where.namespace}'.lstrip('/'), kind=kind_of(job),
            image=str(container_of(job)['image']),
            tags=tags, end_command=boot.END_COMMAND,
            note='' if exposure is None else exposure.words())


def container_of(job: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the first container of a machine's pod, from its Job."""
    container: Mapping[str, Any] = job['spec']['template']['spec']['containers'][0]
    return container


def kind_of(job: Mapping[str, Any]) -> str:
    """Describe a machine in a few words: its resource limits and its image."""
    container = container_of(job)
    limits = (container.get('resources') or {}).get('limits') or {}
    words = [f'{value} {name}' for name, value in sorted(limits.items())]
    return ', '.join([*words, str(container['image']).rpartition('/')[2]])
