# SPDX-License-Identifier: Apache-2.0
"""Delete a machine's Job, which owns pod and Service, and wait until all are deleted."""

from __future__ import annotations

import time
from typing import Any, Optional

from fogros2 import kubernetes_client
from fogros2.kubernetes_client import Api, ApiError, existing, items, path, selector
from fogros2.provider.kubernetes import names, pods
from fogros2.provider.kubernetes.names import MachineId

#: Grace period of a pod that the robot deletes, in seconds: its nodes have ended before.
GRACE = 1
#: Time-out of a pod's end, in seconds.
POD = 120.0
#: Time-out of the deletion, in seconds: clouds need minutes to delete a load balancer.
GONE = 300.0
#: Seconds after which to look for a pod that the Job created at the last moment.
AGAIN = 1.5


def end(api: Api, where: MachineId) -> None:
    """
    Delete a machine's Job; return when Job, pod and Service are deleted; idempotent.

    :raises ApiError: the cluster refused.
    :raises DeadlineExceeded: something was not deleted in time.
    """
    target = path('jobs', where.namespace, where.job)
    try:
        answer = api.request('DELETE', target, {
            'kind': 'DeleteOptions', 'apiVersion': 'v1', 'propagationPolicy': 'Foreground',
            'preconditions': {'uid': where.uid}}, doubt=kubernetes_client.DOUBT)
    except ApiError as error:
        # The Job does not exist, or another Job has its name.
        if error.status in (404, 409):
            return
        raise
    _end_pods(api, where)
    looked = time.monotonic()

    def gone() -> Optional[bool]:
        now = existing(api, target)
        return True if now is None or now['metadata']['uid'] != where.uid else None

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
    End the pods of a Job that is being deleted, faster than the cluster does.

    The label with the Job's uid excludes the pods of a later Job with the same name.
    """
    target = path('pods', where.namespace)
    labels = selector({names.MACHINE: where.job, names.JOB_UID: where.uid})

    def delete(grace: int) -> list[dict[str, Any]]:
        # By default, a pod gets the time to move its nodes.
        return list(items(api.request('DELETE', target, {
            'kind': 'DeleteOptions', 'apiVersion': 'v1', 'gracePeriodSeconds': grace},
            labelSelector=labels)))

    pod_list = delete(GRACE)
    uids = {str(pod['metadata']['uid']) for pod in pod_list if not pods.has_ended(pod)}

    def look(event: str, pod: dict[str, Any]) -> Optional[bool]:
        if event == 'DELETED' or pods.has_ended(pod):
            uids.discard(str(pod['metadata']['uid']))
        return None if uids else True

    def again() -> Optional[bool]:
        now = items(api.request('GET', target, labelSelector=labels))
        uids.intersection_update(
            str(pod['metadata']['uid']) for pod in now if not pods.has_ended(pod))
        return None if uids else True

    if uids:
        api.follow(target, look, again=again, timeout=POD, labelSelector=labels,
                   what=f"the pod of '{where.job}' to end")
    if pod_list:
        # Nothing runs in the pods; the node would need seconds to clean up.
        delete(0)
