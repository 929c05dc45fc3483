# SPDX-License-Identifier: Apache-2.0
"""Describe a machine's Job, its pod and its Services; pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import hashlib
import json
import math
from typing import Any

from fogros2.model import CreateRequest, MachineSpec
from fogros2.provider.kubernetes import boot, claims, names
from fogros2.provider.kubernetes.options import Options

#: Seconds after which the cluster deletes a machine that has ended, with all that it owns.
TTL = 60
#: Seconds for which a pod waits for its launch, after its image was pulled.
BOOT = 600.0
#: Port on which images of web applications serve HTTP.
APPLICATION_PORT = 8080
#: Limits of the application, a file server, if the machine's container has limits of that kind.
_APPLICATION_LIMITS = {'cpu': '100m', 'memory': '128Mi'}
#: Name of a pod's volume at /dev/shm.
_SHM = 'fogros2-shm'
#: A mesh adds no container, which would outlive the machine; Istio's label, before an annotation.
_NO_MESH = {'sidecar.istio.io/inject': 'false'}


def job(spec: MachineSpec, request: CreateRequest, options: Options) -> dict[str, Any]:
    """
    Return the Job of a machine, which owns all its other objects.

    Its deadline is the machine's lifetime. After its time to live, the cluster deletes it with its
    pods and Services, even without the robot.
    """
    own = metadata(spec, request)
    return {
        'apiVersion': 'batch/v1', 'kind': 'Job',
        'metadata': {
            'name': names.job_name(spec.name), 'labels': own['labels'],
            'annotations': {
                names.ATTEMPT: request.token, names.LOGIN: options.user,
                names.TAGS: json.dumps(dict(request.tags), sort_keys=True),
                names.VPN_PORT: str(request.vpn_port), names.EXPOSE: options.expose,
                names.ROBOT_HOST: options.robot_host, **own['annotations']}},
        'spec': {
            'backoffLimit': 0, 'completions': 1, 'parallelism': 1,
            'activeDeadlineSeconds': max(1, math.ceil(spec.lifetime)),
            'ttlSecondsAfterFinished': TTL,
            'template': {'metadata': own, 'spec': pod_spec(spec, request, options)}}}


def metadata(spec: MachineSpec, request: CreateRequest) -> dict[str, Any]:
    """Return the labels and annotations of a pod."""
    return {
        'labels': {**names.labels(spec.name, request.tags), **_NO_MESH},
        # An autoscaler must not move the pod to free its node: the Cluster Autoscaler, Karpenter.
        'annotations': {'cluster-autoscaler.kubernetes.io/safe-to-evict': 'false',
                        'karpenter.sh/do-not-disrupt': 'true',
                        'linkerd.io/inject': 'disabled', **_NO_MESH}}


def pod(spec: MachineSpec, request: CreateRequest, options: Options) -> dict[str, Any]:
    """Return the pod that the Job will create, for a dry run of its admission."""
    return {
        'apiVersion': 'v1', 'kind': 'Pod',
        'metadata': {'generateName': f'{names.job_name(spec.name)}-', **metadata(spec, request)},
        'spec': pod_spec(spec, request, options)}


def pod_spec(spec: MachineSpec, request: CreateRequest, options: Options) -> dict[str, Any]:
    """Return the pod's specification, without rights but NET_ADMIN, and without API token."""
    port = 0 if options.expose in ('pod_dials_robot', 'pod_ip') else request.vpn_port
    container: dict[str, Any] = {
        'name': names.CONTAINER, 'image': image_for(options, request.dependencies),
        'imagePullPolicy': 'IfNotPresent',
        'command': boot.arguments(
            options.user, max(BOOT, spec.robot_timeout), port, word(request.token),
            alive=bool(request.application)),
        'env': [{'name': name, 'value': value} for name, value in options.env.items()],
        'securityContext': {
            # Images may set another user; a VPN interface needs root with NET_ADMIN.
            'runAsUser': 0, 'privileged': False, 'capabilities': {'add': ['NET_ADMIN']}},
    }
    if port:
        container['ports'] = [
            {'name': 'vpn', 'containerPort': request.vpn_port, 'protocol': 'UDP'}]
    if resources := _resources(options):
        container['resources'] = {'limits': resources, 'requests': resources}
    manifest: dict[str, Any] = {
        'restartPolicy': 'Never', 'automountServiceAccountToken': False,
        'enableServiceLinks': False, 'hostname': names.job_name(spec.name)[len('fogros2-'):],
        'terminationGracePeriodSeconds': boot.GRACE, 'nodeSelector': options.node_labels,
        'containers': [container]}
    manifest['volumes'], container['volumeMounts'] = claims.mounts(request.with_volumes)
    # runtimes give 64 MB, which end nodes by SIGBUS; what is used counts to the pod's memory
    manifest['volumes'].append({'name': _SHM, 'emptyDir': {'medium': 'Memory'}})
    container['volumeMounts'].append({'name': _SHM, 'mountPath': '/dev/shm'})  # noqa: S108
    if request.application:
        manifest['containers'].append(_application(request.application, resources))
    if options.tolerations:
        manifest['tolerations'] = [dict(each) for each in options.tolerations]
    if options.runtime_class:
        manifest['runtimeClassName'] = options.runtime_class
    if options.image_pull_secrets:
        manifest['imagePullSecrets'] = [{'name': name} for name in options.image_pull_secrets]
    if options.service_account:
        manifest['serviceAccountName'] = options.service_account
    if options.zone:
        manifest['affinity'] = _preferring(options.zone)
    return manifest


def _application(image: str, beside: Mapping[str, str]) -> dict[str, Any]:
    """
    Return the container of a web application.

    Its liveness probe connects to the machine's container, so both containers end together.

    :param beside: limits of the machine's container.
    """
    container: dict[str, Any] = {
        'name': names.APPLICATION, 'image': image, 'imagePullPolicy': 'IfNotPresent',
        'ports': [{'name': 'application', 'containerPort': APPLICATION_PORT}],
        'securityContext': {
            # The file of Lichtblick's server has this capability, and does not start without it.
            'privileged': False, 'allowPrivilegeEscalation': False,
            'capabilities': {'drop': ['ALL'], 'add': ['NET_BIND_SERVICE']}},
        'livenessProbe': {'tcpSocket': {'port': boot.ALIVE_PORT}, 'periodSeconds': 5}}
    limits = {kind: value for kind, value in _APPLICATION_LIMITS.items() if kind in beside}
    if limits:
        container['resources'] = {'limits': limits, 'requests': limits}
    return container


def image_for(options: Options, dependencies: str) -> str:
    """Return the pod's image; replace ``{dependencies}`` by the hash of a launch's needs."""
    return options.container_image.replace('{dependencies}', dependencies or 'latest')


def _resources(options: Options) -> dict[str, str]:
    limits = {}
    if options.mcpu:
        limits['cpu'] = f'{options.mcpu}m'
    if options.mb:
        limits['memory'] = f'{options.mb}Mi'
    if options.gpus:
        limits[options.gpu_resource] = str(options.gpus)
    return limits


def _preferring(zone: str) -> dict[str, Any]:
    """Return the preference of a zone; the pod also runs in a cluster without that zone."""
    return {'nodeAffinity': {'preferredDuringSchedulingIgnoredDuringExecution': [{
        'weight': 100, 'preference': {'matchExpressions': [{
            'key': 'topology.kubernetes.io/zone', 'operator': 'In', 'values': [zone]}]}}]}}


def port_service(
    kind: str, where: names.MachineId, port: int, sources: Sequence[str],
) -> dict[str, Any]:
    """
    Return the Service of a machine's TCP port, which the machine's Job owns.

    It keeps the clients' addresses (``externalTrafficPolicy: Local``), because the server in the
    pod checks them; a load balancer refuses other clients before.

    :param kind: 'LoadBalancer' or 'NodePort'.
    """
    manifest = service(
        kind, names.port_service(where, port), where, 'TCP', port,
        labels={**names.MANAGED, names.MACHINE: where.job}, annotations={})
    manifest['spec']['externalTrafficPolicy'] = 'Local'
    if kind == 'LoadBalancer':
        manifest['spec']['loadBalancerSourceRanges'] = list(sources)
    return manifest


def service(
    kind: str, name: str, where: names.MachineId, protocol: str, port: int, *,
    labels: Mapping[str, str], annotations: Mapping[str, str],
) -> dict[str, Any]:
    """
    Return a Service for one port of a machine, which the machine's Job owns.

    :param kind: 'LoadBalancer' or 'NodePort'.
    """
    return {
        'apiVersion': 'v1', 'kind': 'Service',
        'metadata': {
            'name': name, 'labels': dict(labels), 'annotations': dict(annotations),
            'ownerReferences': [{
                'apiVersion': 'batch/v1', 'kind': 'Job', 'name': where.job, 'uid': where.uid,
                'controller': True, 'blockOwnerDeletion': True}]},
        'spec': {
            'type': kind, 'selector': {names.MACHINE: where.job},
            'ports': [{'name': protocol.lower(), 'protocol': protocol, 'port': port,
                       'targetPort': port}]}}


def word(token: str) -> str:
    """Return the first word of probes for UDP: a hash, because the token is secret."""
    return hashlib.sha256(f'fogros2 udp {token}'.encode()).hexdigest()[:32]
