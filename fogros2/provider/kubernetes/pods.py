# SPDX-License-Identifier: Apache-2.0
"""Read the state of a machine from its Job, its pod and their events; pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
import datetime
import re
from typing import Any, Optional

from fogros2.model import MachineState
from fogros2.provider.kubernetes import hints, names

#: Reasons of a waiting container that will never run.
_HOPELESS = ('InvalidImageName', 'ErrImageNeverPull', 'CreateContainerConfigError',
             'CreateContainerError', 'RunContainerError', 'ErrInvalidImageName')
_PULL = ('ErrImagePull', 'ImagePullBackOff', 'RegistryUnavailable', 'ImageInspectError')
#: Answers of a registry that a retry will not change.
_FINAL = re.compile(r'not ?found|manifest unknown|unauthorized|denied|forbidden|no match for '
                    r'platform|no matching manifest|does not exist|invalid reference', re.I)
#: The API server's decisions about a pod. Any other failure to create one (a server that restarts,
#: a webhook that does not answer) ends, and the cluster tries again.
_REFUSED = re.compile(r'\b(forbidden|invalid|denied)\b')
#: Reasons of events: the Cluster Autoscaler and Karpenter add a node for the pod.
_SCALES_UP = ('TriggeredScaleUp', 'Nominated')
#: The node cannot begin the pod, and has begun it.
_HELD_UP = ('FailedCreatePodSandBox', 'FailedMount')
_BEGUN = ('Pulling', 'Pulled', 'Created')


@dataclasses.dataclass(frozen=True)
class Trouble:
    """
    Why a pod does not run.

    :param final: whether waiting cannot help.
    """

    what: str
    hint: str = ''
    final: bool = False

    def less_than(self, before: Trouble) -> bool:
        """Return whether this only repeats an earlier problem, with less detail."""
        return self.what.startswith('ImagePullBackOff') and before.what.startswith('ErrImagePull')

    @property
    def unscheduled(self) -> bool:
        """Whether no node takes the pod: one may be coming, or the disk of a claim."""
        return self.what.startswith('FailedScheduling')


def timestamp(text: str) -> float:
    """Return a time of the API in seconds since the epoch."""
    return datetime.datetime.fromisoformat(text.replace('Z', '+00:00')).timestamp()


def pod_of(job: Mapping[str, Any], pods: Iterable[Mapping[str, Any]]) -> Optional[dict[str, Any]]:
    """Return the first pod of a Job: a later pod has none of the machine's state."""
    uid = job['metadata']['uid']
    own = [dict(pod) for pod in pods
           if any(owner.get('uid') == uid
                  for owner in pod['metadata'].get('ownerReferences') or ())]
    return min(own, key=lambda pod: str(pod['metadata'].get('creationTimestamp')), default=None)


def state_of(job: Mapping[str, Any], pod: Optional[Mapping[str, Any]]) -> MachineState:
    """Return the state of a machine."""
    if job['metadata'].get('deletionTimestamp') or any(
            condition['type'] in ('Complete', 'Failed') and condition['status'] == 'True'
            for condition in (job.get('status') or {}).get('conditions') or ()):
        return MachineState.STOPPING
    if pod is None:
        # The pod of a Job that ran before was evicted.
        lost = (job.get('status') or {}).get('active') == 0 and \
            (job.get('status') or {}).get('failed')
        return MachineState.STOPPING if lost else MachineState.PENDING
    phase = (pod.get('status') or {}).get('phase')
    if pod['metadata'].get('deletionTimestamp') or phase in ('Succeeded', 'Failed') \
            or _machine_has(pod, 'terminated'):
        return MachineState.STOPPING
    return MachineState.RUNNING if is_running(pod) else MachineState.PENDING


def is_running(pod: Mapping[str, Any]) -> bool:
    """Return whether the machine's container runs; the application may start later."""
    return (pod.get('status') or {}).get('phase') in ('Pending', 'Running') \
        and _machine_has(pod, 'running')


def has_ended(pod: Mapping[str, Any]) -> bool:
    """Return whether the machine's container does not run, or has ended."""
    phase = (pod.get('status') or {}).get('phase')
    # The application may run a little longer.
    return not _machine_has(pod, 'running') and (
        phase in ('Pending', 'Succeeded', 'Failed') or _machine_has(pod, 'terminated'))


def _machine_has(pod: Mapping[str, Any], state: str) -> bool:
    return any(state in (each.get('state') or {}) for each in _machine(pod))


def _machine(pod: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the status of the machine's container; others are the application's or a mesh's."""
    return [each for each in (pod.get('status') or {}).get('containerStatuses') or ()
            if each.get('name') == names.CONTAINER]


def end_of(job: Mapping[str, Any], pod: Optional[Mapping[str, Any]]) -> str:
    """Return why a machine has ended, as the cluster reports it."""
    for condition in (job.get('status') or {}).get('conditions') or ():
        if condition['type'] == 'Failed' and condition['status'] == 'True' \
                and condition.get('reason') == 'DeadlineExceeded':
            return 'its lifetime is over'
    if pod is None:
        return 'its pod is gone'
    status = pod.get('status') or {}
    if status.get('reason') or status.get('message'):
        return ': '.join(str(status[key]) for key in ('reason', 'message') if status.get(key))
    for each in _machine(pod):
        ended = (each.get('state') or {}).get('terminated')
        if ended:
            message = f", {ended['message'].strip()}" if ended.get('message') else ''
            return f"its container ended: {ended.get('reason') or 'exit'} " \
                   f"(exit status {ended.get('exitCode')}{message})"
    return 'its pod is being deleted' if pod['metadata'].get('deletionTimestamp') \
        else 'its pod has ended'


def trouble_of(pod: Mapping[str, Any]) -> Optional[Trouble]:
    """Return why a pod does not run, None if it is starting normally."""
    status = pod.get('status') or {}
    for condition in status.get('conditions') or ():
        if condition['type'] == 'PodScheduled' and condition['status'] == 'False':
            message = str(condition.get('message') or condition.get('reason') or '')
            return Trouble(f'FailedScheduling: {message}', hints.of_scheduling(message))
    for each in _machine(pod):
        waiting = (each.get('state') or {}).get('waiting') or {}
        reason, message = str(waiting.get('reason', '')), str(waiting.get('message', ''))
        if reason in (*_HOPELESS, *_PULL):
            final = reason in _HOPELESS or bool(_FINAL.search(message))
            return Trouble(f'{reason}: {message}' if message else reason,
                           hints.of_image(reason, message, str(each.get('image', ''))), final)
    return None


def trouble_in(events: Sequence[Mapping[str, Any]]) -> Optional[Trouble]:
    """
    Return a problem that only the events of a Job or pod show.

    :param events: events of the Job and its pod, in any order.
    """
    begun = max((_last(event) for event in events if event.get('reason') in _BEGUN), default=-1.0)
    for event in sorted(events, key=_last, reverse=True):
        reason, message = str(event.get('reason', '')), str(event.get('message', ''))
        if reason == 'NotTriggerScaleUp' and not scales_up(events):
            return Trouble(f'{reason}: {message}', 'the autoscaler has no node that would fit',
                           final=True)
        if reason == 'FailedCreate':
            namespace = str(event['metadata'].get('namespace', ''))
            return Trouble(f'FailedCreate: {message}', hints.of_refusal(message, namespace),
                           final='quota' not in message and bool(_REFUSED.search(message)))
        if reason in _HELD_UP and _last(event) > begun:
            return Trouble(f'{reason}: {message}', 'the node can not begin the pod')
    return None


def scales_up(events: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether the cluster is adding a node for the pod."""
    return any(event.get('reason') in _SCALES_UP for event in events)


def _last(event: Mapping[str, Any]) -> float:
    """Return when an event was last seen, in seconds since the epoch; 0 if it has no time."""
    time = event.get('lastTimestamp') or event.get('eventTime') \
        or event['metadata'].get('creationTimestamp')
    return timestamp(str(time)) if time else 0.0
