# SPDX-License-Identifier: Apache-2.0
"""Explain a cluster's refusals, with remedies; pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
import contextlib
import re
from typing import Any

from fogros2.errors import ProviderError
from fogros2.kubernetes_client import ApiError

#: API group, resource, verbs.
Right = tuple[str, str, tuple[str, ...]]
#: The rights that a robot needs, as in packaging/kubernetes/role.yaml.
RIGHTS: tuple[Right, ...] = (
    ('batch', 'jobs', ('create', 'get', 'list', 'watch', 'patch', 'delete')),
    ('', 'pods', ('create', 'get', 'list', 'watch', 'deletecollection')),
    ('', 'pods/exec', ('create', 'get')),
    ('', 'events', ('list',)),
    ('', 'services', ('create', 'get', 'watch')),
)

_FORBIDDEN = re.compile(
    r'User "(?P<user>[^"]*)" cannot (?P<verb>\w+) resource "(?P<resource>[^"]*)"'
    r' in API group "(?P<group>[^"]*)"(?: in the namespace "(?P<namespace>[^"]*)")?')

#: Remedies for refusals, by patterns of their messages.
_REMEDIES = {
    'violates PodSecurity':
        'a VPN takes NET_ADMIN, which the namespace forbids: kubectl label namespace '
        '{namespace} pod-security.kubernetes.io/enforce=privileged --overwrite',
    '(?i)pod ?security ?policy':
        'a VPN takes NET_ADMIN: let the service account use a PodSecurityPolicy whose '
        'allowedCapabilities has it',
    'admission webhook':
        'a policy of the cluster refuses the pod, which asks for NET_ADMIN and user 0, '
        "and is not privileged: have it allowed in namespace '{namespace}'",
    'security context constraint':
        'a VPN takes NET_ADMIN: grant the service account a security context constraint '
        'that allows it',
    'exceeded quota':
        "ask for less (mcpu=, mb=, gpus=), end other machines of namespace '{namespace}',"
        ' or have its quota raised',
    'failed quota|must specify':
        "the quota of namespace '{namespace}' wants mcpu= and mb= to be given",
    r'LimitRange|(minimum|maximum) \S+ usage per':
        "the limits of namespace '{namespace}' allow other mcpu= and mb= alone",
    'namespaces? "[^"]*" not found': 'kubectl create namespace {namespace}',
    'serviceaccount.*not found': 'check service_account=',
    'RuntimeClass.*not found':
        'check runtime_class=; `kubectl get runtimeclass` lists what there is',
    'is being terminated': "namespace '{namespace}' is being deleted: take another one",
}


def of_refusal(message: str, namespace: str) -> str:
    """
    Return the remedy for a refusal by the API server or by an admission plugin.

    >>> of_refusal('pods "x" is forbidden: violates PodSecurity "baseline:latest"', 'robots')[:21]
    'a VPN takes NET_ADMIN'
    """
    if match := _FORBIDDEN.search(message):
        resource = match['resource'] + (f".{match['group']}" if match['group'] else '')
        where = f"namespace '{match['namespace']}'" if match['namespace'] else 'whole cluster'
        return (f"let '{match['user']}' {match['verb']} {resource} in the {where}: "
                'packaging/kubernetes/role.yaml has all that a robot needs')
    return next((remedy.format(namespace=namespace) for pattern, remedy in _REMEDIES.items()
                 if re.search(pattern, message, re.DOTALL)), '')


def refused(error: ApiError, what: str, namespace: str) -> ProviderError:
    """
    Return the error for a refusal by the API server, with the remedy.

    :param what: completes 'the cluster refused ...'.
    """
    message = str(error.args[0])
    return ProviderError(f'the cluster refused {what}: {message}',
                         error.hint or of_refusal(message, namespace))


@contextlib.contextmanager
def explained(what: str, namespace: str) -> Iterator[None]:
    """Raise a refusal in the block as the error of :func:`refused`."""
    try:
        yield
    except ApiError as error:
        raise refused(error, what, namespace) from error


def missing_rights(rules: Iterable[Mapping[str, Any]]) -> list[str]:
    """
    Return the rights that a robot needs and a user lacks, such as 'create pods/exec'.

    :param rules: ``resourceRules`` of the answer to a SelfSubjectRulesReview.
    """
    allowed = [rule for rule in rules if not rule.get('resourceNames')]

    def may(group: str, resource: str, verb: str) -> bool:
        kind, _, part = resource.partition('/')
        fit = {resource, '*', *([f'*/{part}'] if part else [])}
        return any(
            {'*', verb} & set(rule.get('verbs') or ())
            and {'*', group} & set(rule.get('apiGroups') or ())
            and fit & set(rule.get('resources') or ())
            for rule in allowed)

    return [f'{verb} {resource}{f".{group}" if group else ""}'
            for group, resource, verbs in RIGHTS for verb in verbs
            if not may(group, resource, verb)]


def of_scheduling(message: str) -> str:
    """Return the remedy for a pod that fits no node."""
    hints = []
    if gpu := re.search(r'Insufficient (\S+/\w+)', message):
        hints.append(f'no node has enough free {gpu[1]}: is its device plugin installed, '
                     'or another gpu_resource= right?')
    if re.search(r'Insufficient (cpu|memory|pods|ephemeral)', message):
        hints.append('ask for less (mcpu=, mb=), or add a node')
    if re.search(r"didn't match (Pod's )?node (affinity|selector)|node selector", message):
        hints.append('no node carries the labels of node_selector=')
    if 'taint' in message:
        hints.append('nodes carry taints: name them in tolerations=')
    if 'on Fargate' in message:
        hints.append('Fargate refuses NET_ADMIN: use a namespace= without a Fargate profile')
    return '; '.join(hints) or '`kubectl describe nodes` shows what they have'


def of_image(reason: str, message: str, image: str) -> str:
    """Return the remedy for an image that cannot be pulled, or a container that cannot start."""
    text = message.lower()
    if reason == 'InvalidImageName':
        return f"container_image='{image}' is no image's name"
    if re.search('429 too many|toomanyrequests', text):
        return ('the registry limits pulls without a login: name a secret in image_pull_secrets=, '
                'or an image of another registry in container_image=')
    if re.search(r'unauthorized|authorization|denied|forbidden|credentials|401|403', text):
        return ('the registry wants a login, or has no such image: check container_image=, and '
                'name the secret in image_pull_secrets=')
    if re.search(r'no match for platform|exec format|no matching manifest', text):
        return ("the image isn't made for the nodes' architecture: build it for theirs, or "
                'choose nodes with node_selector=')
    if re.search(r'not ?found|manifest unknown|does not exist|no such', text):
        return 'check container_image=, its tag and its registry'
    if reason in ('ErrImagePull', 'ImagePullBackOff'):
        return 'can the nodes reach the registry?'
    if reason == 'CreateContainerConfigError':
        return 'the image or the options ask for what the namespace does not have'
    return '`kubectl describe pod` shows more'
