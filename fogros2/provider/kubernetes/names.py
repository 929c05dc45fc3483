# SPDX-License-Identifier: Apache-2.0
"""What a machine is called in a cluster, and how its tags are kept there; pure."""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
import json
import re
from typing import Any

from fogros2.errors import MachineNotFound

#: On everything of ours.
MANAGED = {'app.kubernetes.io/managed-by': 'fogros2'}
#: Label that leads from a machine to its pods and services.
MACHINE = 'fogros2-machine'
#: Label that the cluster gives each pod of a Job: its uid.
JOB_UID = 'controller-uid'
#: Annotations of the Job.
ATTEMPT = 'fogros2-token'
TAGS = 'fogros2-tags'
#: How the VPN gets to the pod, written down once it is known.
EXPOSURE = 'fogros2-exposure'
VPN_PORT = 'fogros2-vpn-port'
LOGIN = 'fogros2-login'
#: What the launch file said of the way, and of the robot's address for pods that dial it.
EXPOSE = 'fogros2-expose'
ROBOT_HOST = 'fogros2-robot-host'
#: The container of a pod that is the machine, and the web application beside it.
CONTAINER = 'machine'
APPLICATION = 'application'

_LABEL_VALUE = re.compile(r'([A-Za-z0-9]([A-Za-z0-9._-]{0,61}[A-Za-z0-9])?)?')


@dataclasses.dataclass(frozen=True)
class MachineId:
    """
    Where a machine is: its Job, told from others of the same name by its uid.

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
    def parse(cls, text: str) -> MachineId:
        """
        Return what an id names.

        :raises MachineNotFound: it is none of ours.
        """
        match = re.fullmatch(r'([a-z0-9-]+)/(fogros2-[a-z0-9-]+)/([0-9a-f-]+)@(.*)', text)
        if not match:
            raise MachineNotFound(f"'{text}' is no Kubernetes machine")
        return cls(*match.groups())


def job_name(machine: str) -> str:
    """Return the name of a machine's Job; one per namespace, so the API server keeps watch."""
    # a label takes 63, and the Job's pod adds six
    return f'fogros2-{machine.lower()}'[:57].rstrip('-')


def labels(machine: str, tags: Mapping[str, str]) -> dict[str, str]:
    """Return the labels of everything of a machine: the tags that can be labels, and ours."""
    fit = {key: value for key, value in tags.items() if _LABEL_VALUE.fullmatch(value)}
    return {**fit, **MANAGED, MACHINE: job_name(machine)}


def wanted(tags: Mapping[str, str]) -> dict[str, str]:
    """Return the labels to look for; a value that can't be a label is compared afterwards."""
    return {**MANAGED,
            **{key: value for key, value in tags.items() if _LABEL_VALUE.fullmatch(value)}}


def tags_of(job: Mapping[str, Any]) -> dict[str, str]:
    """Return the tags that a Job was made with."""
    try:
        found = json.loads(annotation(job, TAGS) or '{}')
    except ValueError:
        return {}
    return {str(key): str(value) for key, value in found.items()} \
        if isinstance(found, dict) else {}


def annotation(thing: Mapping[str, Any], name: str) -> str:
    """Return an annotation of an object, '' if it has none of that name."""
    return str((thing['metadata'].get('annotations') or {}).get(name, ''))


def endpoint_host(namespace: str, pod: str, context: str) -> str:
    """Return what an endpoint of kind 'kubernetes' has for a host."""
    return f'{namespace}/{pod}@{context}'
