# SPDX-License-Identifier: Apache-2.0
"""Ending a machine: its Job, which takes pod and Service along, and waiting until all are gone."""

from __future__ import annotations

from collections.abc import Mapping
import contextlib
import time
from typing import Any, Optional

from fogros2 import kubernetes_client
from fogros2.errors import ProviderError
from fogros2.kubernetes_client import Api, ApiError, items, path, selector
from fogros2.provider.kubernetes import boot, names, pods
from fogros2.provider.kubernetes.names import MachineId

#: Seconds that a pod is given when the robot ends it: its nodes have ended before.
GRACE = 1
#: Seconds in which everything of a machine has to be gone.
GONE = 120.0
#: Seconds after which a pod is looked for that the Job has made at the last moment.
AGAIN = 1.5


def end(api: Api, where: MachineId) -> None:
    """
    Delete a machine's Job; return when it, its pod and its Service are gone; idempotent.

    :raises ApiError: the cluster refuses.
    :raises DeadlineExceeded: something stays.
    """
    target = path('jobs', where.namespace, where.job)
    try:
        answer = api.request('DELETE', target, {
            'kind': 'DeleteOptions', 'apiVersion': 'v1', 'propagationPolicy': 'Foreground',
            'preconditions': {'uid': where.uid}}, doubt=kubernetes_client.DOUBT)
    except ApiError as error:
        # gone, or gone and another of the name in its place
        if error.status in (404, 409):
            return
        raise
    _end_pods(api, where)
    looked = time.monotonic()

    def gone() -> Optional[bool]:
        try:
            now = api.request('GET', target)
        except ApiError as error:
            if error.status == 404:
                return True
            raise
        return True if now['metadata']['uid'] != where.uid else None

    def late() -> None:
        nonlocal looked
        if time.monotonic() - looked > AGAIN:
            _end_pods(api, where)
            looked = time.monotonic()

    api.follow(
        path('jobs', where.namespace),
        lambda event, job: True if event == 'DELETED' else None, again=gone, tick=late,
        timeout=GONE, what=f"'{where.job}' to be deleted",
        fieldSelector=f'metadata.name={where.job}',
        resourceVersion=(answer.get('metadata') or {}).get('resourceVersion'))


def _end_pods(api: Api, where: MachineId) -> None:
    """
    End the pods of a Job that is being deleted, quicker than the cluster would.

    Not those of another Job that has the name by now: clusters label pods with their Job's uid.
    """
    target = path('pods', where.namespace)
    labels = selector({names.MACHINE: where.job, names.JOB_UID: where.uid})

    def delete(grace: int) -> list[dict[str, Any]]:
        # without a say the pod has the time that it gets when the cluster takes it away
        return list(items(api.request('DELETE', target, {
            'kind': 'DeleteOptions', 'apiVersion': 'v1', 'gracePeriodSeconds': grace},
            labelSelector=labels)))

    found = delete(GRACE)
    left = {str(pod['metadata']['uid']) for pod in found if not pods.has_ended(pod)}

    def look(event: str, pod: dict[str, Any]) -> Optional[bool]:
        if event == 'DELETED' or pods.has_ended(pod):
            left.discard(str(pod['metadata']['uid']))
        return None if left else True

    def again() -> Optional[bool]:
        now = items(api.request('GET', target, labelSelector=labels))
        left.intersection_update(
            str(pod['metadata']['uid']) for pod in now if not pods.has_ended(pod))
        return None if left else True

    if left:
        for pod in found:
            _tell(api, pod)
        api.follow(target, look, again=again, timeout=GONE, labelSelector=labels,
                   what=f"the pod of '{where.job}' to end")
    if found:
        # nothing runs in it any more; the node would take seconds to tidy up first
        delete(0)


def _tell(api: Api, pod: Mapping[str, Any]) -> None:
    """Have a pod end itself: it may be in the time it was given to move its nodes."""
    meta = pod['metadata']
    # where it doesn't hear us, the node ends it
    with contextlib.suppress(ProviderError):
        api.execute(path('pods', str(meta['namespace']), str(meta['name']), 'exec'),
                    names.CONTAINER, boot.END_COMMAND, timeout=2.0)
