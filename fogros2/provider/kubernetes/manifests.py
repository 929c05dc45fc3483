# SPDX-License-Identifier: Apache-2.0
"""The manifests of a machine: a Job, its pod, a Service; pure."""

from __future__ import annotations

from collections.abc import Mapping
import hashlib
import json
import math
from typing import Any

from fogros2.model import CreateRequest, MachineSpec
from fogros2.provider.kubernetes import boot, names
from fogros2.provider.kubernetes.options import Options

#: Seconds after which the cluster removes a machine that has ended, with all that is its.
TTL = 60
#: Seconds for which a pod waits for its launch, on top of what pulling the image takes.
BOOT = 600.0
#: Seconds for which a pod answers the question whether UDP gets through.
LISTEN = 180.0
#: Port at which images of web applications serve HTTP.
APPLICATION_PORT = 8080
#: What a server of files may use, of the kinds of which the machine's own container has a limit.
_APPLICATION_LIMITS = {'cpu': '100m', 'memory': '128Mi'}


def job(spec: MachineSpec, request: CreateRequest, options: Options) -> dict[str, Any]:
    """
    Return the Job of a machine, which owns whatever else is made for it.

    Its deadline is the machine's lifetime, and its time to live takes pods and services along,
    whatever became of the robot.
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
        'labels': names.labels(spec.name, request.tags),
        # an autoscaler that tidies up doesn't move a robot's nodes for it
        'annotations': {'cluster-autoscaler.kubernetes.io/safe-to-evict': 'false'}}


def pod(spec: MachineSpec, request: CreateRequest, options: Options) -> dict[str, Any]:
    """Return the pod as the Job will ask for it, to find out beforehand whether it may."""
    return {
        'apiVersion': 'v1', 'kind': 'Pod',
        'metadata': {'generateName': f'{names.job_name(spec.name)}-', **metadata(spec, request)},
        'spec': pod_spec(spec, request, options)}


def pod_spec(spec: MachineSpec, request: CreateRequest, options: Options) -> dict[str, Any]:
    """Return what the pod runs, with no right beyond NET_ADMIN and no token of the cluster's."""
    port = 0 if options.expose in ('pod_dials_robot', 'pod_ip') else request.vpn_port
    container: dict[str, Any] = {
        'name': names.CONTAINER, 'image': image_for(options, request.dependencies),
        'imagePullPolicy': 'IfNotPresent',
        'command': boot.arguments(
            options.user, max(BOOT, spec.robot_timeout), port, word(request.token), LISTEN,
            alive=bool(request.application)),
        'env': [{'name': name, 'value': value} for name, value in options.env.items()],
        'securityContext': {
            # an image may have another user; an interface takes root with NET_ADMIN
            'runAsUser': 0, 'privileged': False, 'capabilities': {'add': ['NET_ADMIN']}},
    }
    if port:
        container['ports'] = [
            {'name': 'vpn', 'containerPort': request.vpn_port, 'protocol': 'UDP'}]
    if resources := _resources(options):
        container['resources'] = {'limits': resources, 'requests': resources}
    found: dict[str, Any] = {
        'restartPolicy': 'Never', 'automountServiceAccountToken': False,
        'enableServiceLinks': False, 'hostname': names.job_name(spec.name)[len('fogros2-'):],
        'terminationGracePeriodSeconds': boot.GRACE, 'containers': [container]}
    if request.application:
        found['containers'].append(_application(request.application, resources))
    if options.node_selector:
        found['nodeSelector'] = dict(options.node_selector)
    if options.tolerations:
        found['tolerations'] = [dict(each) for each in options.tolerations]
    if options.runtime_class:
        found['runtimeClassName'] = options.runtime_class
    if options.image_pull_secrets:
        found['imagePullSecrets'] = [{'name': name} for name in options.image_pull_secrets]
    if options.service_account:
        found['serviceAccountName'] = options.service_account
    if options.zone:
        found['affinity'] = _preferring(options.zone)
    return found


def _application(image: str, beside: Mapping[str, str]) -> dict[str, Any]:
    """
    Return the container of a web application.

    Its probe asks the machine's container, so that it ends with that one, and the pod with both.

    :param beside: limits of the machine's container.
    """
    found: dict[str, Any] = {
        'name': names.APPLICATION, 'image': image, 'imagePullPolicy': 'IfNotPresent',
        'ports': [{'name': 'application', 'containerPort': APPLICATION_PORT}],
        'securityContext': {
            # Lichtblick's server is a file with this one capability: without, it doesn't start
            'privileged': False, 'allowPrivilegeEscalation': False,
            'capabilities': {'drop': ['ALL'], 'add': ['NET_BIND_SERVICE']}},
        'livenessProbe': {'tcpSocket': {'port': boot.ALIVE_PORT}, 'periodSeconds': 5}}
    limits = {kind: value for kind, value in _APPLICATION_LIMITS.items() if kind in beside}
    if limits:
        found['resources'] = {'limits': limits, 'requests': limits}
    return found


def image_for(options: Options, dependencies: str) -> str:
    """Return the pod's image; ``{dependencies}`` in its name stands for what a launch needs."""
    return options.container_image.replace('{dependencies}', dependencies or 'latest')


def _resources(options: Options) -> dict[str, str]:
    found = {}
    if options.mcpu:
        found['cpu'] = f'{options.mcpu}m'
    if options.mb:
        found['memory'] = f'{options.mb}Mi'
    if options.gpus:
        found[options.gpu_resource] = str(options.gpus)
    return found


def _preferring(zone: str) -> dict[str, Any]:
    """Return the wish for a zone: one that the cluster doesn't have keeps nothing from running."""
    return {'nodeAffinity': {'preferredDuringSchedulingIgnoredDuringExecution': [{
        'weight': 100, 'preference': {'matchExpressions': [{
            'key': 'topology.kubernetes.io/zone', 'operator': 'In', 'values': [zone]}]}}]}}


def service(
    kind: str, spec: MachineSpec, request: CreateRequest, options: Options, uid: str,
) -> dict[str, Any]:
    """
    Return the Service that leads UDP to the machine's VPN; a TCP one would be another's.

    :param kind: 'LoadBalancer' or 'NodePort'.
    :param uid: of the Job, which owns it.
    """
    name = names.job_name(spec.name)
    return {
        'apiVersion': 'v1', 'kind': 'Service',
        'metadata': {
            'name': name, 'labels': names.labels(spec.name, request.tags),
            'annotations': dict(options.annotations),
            'ownerReferences': [{
                'apiVersion': 'batch/v1', 'kind': 'Job', 'name': name, 'uid': uid,
                'controller': True, 'blockOwnerDeletion': True}]},
        'spec': {
            'type': kind, 'selector': {names.MACHINE: name},
            'ports': [{'name': 'vpn', 'protocol': 'UDP', 'port': request.vpn_port,
                       'targetPort': request.vpn_port}]}}


def word(token: str) -> str:
    """
    Return what the question whether UDP gets through begins with.

    The token itself stays where it is needed.
    """
    return hashlib.sha256(f'fogros2 udp {token}'.encode()).hexdigest()[:32]


def exposure_patch(values: Mapping[str, str]) -> dict[str, Any]:
    """Return the change of a Job that writes annotations down."""
    return {'metadata': {'annotations': dict(values)}}
