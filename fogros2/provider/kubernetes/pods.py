# SPDX-License-Identifier: Apache-2.0
"""What a Job and its pod tell of a machine; pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
import datetime
import re
from typing import Any, Optional

from fogros2.model import MachineState
from fogros2.provider.kubernetes import hints, names

#: What a container waits for that it will wait for in vain.
_HOPELESS = ('InvalidImageName', 'ErrImageNeverPull', 'CreateContainerConfigError',
             'CreateContainerError', 'RunContainerError', 'ErrInvalidImageName')
_PULL = ('ErrImagePull', 'ImagePullBackOff', 'RegistryUnavailable', 'ImageInspectError')
#: Answers of a registry that another try won't change.
_FINAL = re.compile(r'not ?found|manifest unknown|unauthorized|denied|forbidden|no match for '
                    r'platform|no matching manifest|does not exist|invalid reference', re.I)


@dataclasses.dataclass(frozen=True)
class Trouble:
    """
    Why a pod doesn't run.

    :param final: waiting won't help.
    """

    what: str
    hint: str = ''
    final: bool = False

    def less_than(self, before: Trouble) -> bool:
        """Return whether this says less than what was said before: only that it goes on."""
        return self.what.startswith('ImagePullBackOff') and before.what.startswith('ErrImagePull')


def timestamp(text: str) -> float:
    """Return a time of the API's in seconds since the epoch."""
    return datetime.datetime.fromisoformat(text.replace('Z', '+00:00')).timestamp()


def pod_of(job: Mapping[str, Any], pods: Iterable[Mapping[str, Any]]) -> Optional[dict[str, Any]]:
    """Return the first pod of a Job: a later one is another computer, with nothing of ours."""
    uid = job['metadata']['uid']
    own = [dict(pod) for pod in pods
           if any(owner.get('uid') == uid
                  for owner in pod['metadata'].get('ownerReferences') or ())]
    return min(own, key=lambda pod: str(pod['metadata'].get('creationTimestamp')), default=None)


def state_of(job: Mapping[str, Any], pod: Optional[Mapping[str, Any]]) -> MachineState:
    """Return where a machine is in its life."""
    if job['metadata'].get('deletionTimestamp') or any(
            condition['type'] in ('Complete', 'Failed') and condition['status'] == 'True'
            for condition in (job.get('status') or {}).get('conditions') or ()):
        return MachineState.STOPPING
    if pod is None:
        # a Job that ran before has lost its pod to an eviction
        lost = (job.get('status') or {}).get('active') == 0 and \
            (job.get('status') or {}).get('failed')
        return MachineState.STOPPING if lost else MachineState.PENDING
    phase = (pod.get('status') or {}).get('phase')
    if pod['metadata'].get('deletionTimestamp') or phase in ('Succeeded', 'Failed') \
            or _machine_has(pod, 'terminated'):
        return MachineState.STOPPING
    return MachineState.RUNNING if is_running(pod) else MachineState.PENDING


def is_running(pod: Mapping[str, Any]) -> bool:
    """Return whether the machine of a pod runs; the application beside it may come later."""
    return (pod.get('status') or {}).get('phase') in ('Pending', 'Running') \
        and _machine_has(pod, 'running')


def has_ended(pod: Mapping[str, Any]) -> bool:
    """Return whether nothing of a pod runs any more, or has yet."""
    phase = (pod.get('status') or {}).get('phase')
    # the application, which nobody needs then, may run for a moment longer
    return not _machine_has(pod, 'running') and (
        phase in ('Pending', 'Succeeded', 'Failed') or _machine_has(pod, 'terminated'))


def _machine_has(pod: Mapping[str, Any], state: str) -> bool:
    return any(state in (each.get('state') or {}) for each in _machine(pod))


def _machine(pod: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the statuses of a pod's containers without that of the application."""
    return [each for each in (pod.get('status') or {}).get('containerStatuses') or ()
            if each.get('name') != names.APPLICATION]


def end_of(job: Mapping[str, Any], pod: Optional[Mapping[str, Any]]) -> str:
    """Return why a machine has ended, in the cluster's words."""
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
            said = f", {ended['message'].strip()}" if ended.get('message') else ''
            return f"its container ended: {ended.get('reason') or 'exit'} " \
                   f"(exit status {ended.get('exitCode')}{said})"
    return 'its pod is being deleted' if pod['metadata'].get('deletionTimestamp') \
        else 'its pod has ended'


def trouble_of(
    pod: Mapping[str, Any], *, gpu_resource: str = 'nvidia.com/gpu',
) -> Optional[Trouble]:
    """Return what keeps a pod from running, None if nothing does but time."""
    status = pod.get('status') or {}
    for condition in status.get('conditions') or ():
        if condition['type'] == 'PodScheduled' and condition['status'] == 'False':
            message = str(condition.get('message') or condition.get('reason') or '')
            return Trouble(f'FailedScheduling: {message}',
                           hints.of_scheduling(message, gpu_resource))
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
    Return what events of a Job or pod tell that the pod itself doesn't.

    :param events: those about the Job and its pod, in any order.
    """
    for event in events:
        reason, message = str(event.get('reason', '')), str(event.get('message', ''))
        if reason == 'NotTriggerScaleUp':
            return Trouble(f'{reason}: {message}', 'the autoscaler has no node that would fit',
                           final=True)
        if reason == 'FailedCreate':
            namespace = str(event['metadata'].get('namespace', ''))
            return Trouble(f'FailedCreate: {message}', hints.of_refusal(message, namespace),
                           final='quota' not in message)
        if reason in ('FailedCreatePodSandBox', 'FailedMount'):
            return Trouble(f'{reason}: {message}', 'the node can not begin the pod')
    return None


def scales_up(events: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether the cluster is getting another node for the pod."""
    return any(event.get('reason') == 'TriggeredScaleUp' for event in events)
