# SPDX-License-Identifier: Apache-2.0
"""Names, labels and annotations of a machine's objects in a cluster; pure."""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
import re
from typing import Any

from fogros2 import untrusted
from fogros2.errors import MachineNotFound

#: Label of all our objects.
MANAGED = {'app.kubernetes.io/managed-by': 'fogros2'}
#: Label with the name of the Job, on its pods and Services.
MACHINE = 'fogros2-machine'
#: Label with the uid of the Job, which the cluster sets on its pods.
JOB_UID = 'controller-uid'
#: Annotations of the Job.
ATTEMPT = 'fogros2-token'
TAGS = 'fogros2-tags'
#: How the VPN reaches the pod, once it is known.
EXPOSURE = 'fogros2-exposure'
VPN_PORT = 'fogros2-vpn-port'
LOGIN = 'fogros2-login'
#: Options of the launch file: how the VPN reaches the pod, and the robot's address for pods.
EXPOSE = 'fogros2-expose'
ROBOT_HOST = 'fogros2-robot-host'
#: Names of a pod's containers: the machine, and the web application.
CONTAINER = 'machine'
APPLICATION = 'application'

_LABEL_VALUE = re.compile(r'([A-Za-z0-9]([A-Za-z0-9._-]{0,61}[A-Za-z0-9])?)?')


@dataclasses.dataclass(frozen=True)
class MachineId:
    """
    The id of a machine: its Job; the uid distinguishes it from other Jobs with the same name.

    >>> MachineId.parse('robots/fogros2-talker/1b2c@arn:aws:eks:eu-north-1:1:cluster/x').context
    'arn:aws:eks:eu-north-1:1:cluster/x'
    """

    namespace: str
    job: str
    uid: str
    context: str = ''

    def __str__(self) -> str:
        return f'{self.namespace}/{self.job}/{self.uid}@{self.context}'

    @classmethod
    def of(cls, job: Mapping[str, Any], context: str) -> MachineId:
        """Return the id of the machine of a Job."""
        meta = job['metadata']
        return cls(str(meta['namespace']), str(meta['name']), str(meta['uid']), context)

    @classmethod
    def parse(cls, text: str) -> MachineId:
        """
        Parse an id.

        :raises MachineNotFound: it is no id of this provider.
        """
        match = re.fullmatch(r'([a-z0-9-]+)/(fogros2-[a-z0-9-]+)/([0-9a-f-]+)@(.*)', text)
        if not match:
            raise MachineNotFound(f"'{text}' is no Kubernetes machine")
        return cls(*match.groups())


def job_name(machine: str) -> str:
    """Return the name of a machine's Job; the API server refuses a second Job of that name."""
    # A label has up to 63 characters, and the name of the Job's pod has six more.
    return f'fogros2-{machine.lower()}'[:57].rstrip('-')


def port_service(where: MachineId, port: int) -> str:
    """Return the name of the Service of a machine's TCP port."""
    return f'{where.job}-{port}'


def labels(machine: str, tags: Mapping[str, str]) -> dict[str, str]:
    """Return the labels of a machine's objects: our own, and the tags that can be labels."""
    return {**wanted(tags), MACHINE: job_name(machine)}


def wanted(tags: Mapping[str, str]) -> dict[str, str]:
    """Return the labels to search for; tags that cannot be labels are compared afterwards."""
    fit = {key: value for key, value in tags.items() if _LABEL_VALUE.fullmatch(value)}
    return {**fit, **MANAGED}


def tags_of(job: Mapping[str, Any]) -> dict[str, str]:
    """Return the tags of a Job."""
    try:
        tags: dict[str, str] = untrusted.parsed(annotation(job, TAGS) or '{}', dict[str, str])
    except untrusted.InvalidMessage:
        return {}
    return tags


def annotation(thing: Mapping[str, Any], name: str) -> str:
    """Return an annotation of an object, '' if the object does not have it."""
    return str((thing['metadata'].get('annotations') or {}).get(name, ''))


def endpoint_host(namespace: str, pod: str, context: str) -> str:
    """Return the host of an endpoint of kind 'kubernetes'."""
    return f'{namespace}/{pod}@{context}'
