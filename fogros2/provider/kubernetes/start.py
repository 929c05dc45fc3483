# SPDX-License-Identifier: Apache-2.0
"""Wait for a pod to run, by one watch; decide whether a problem is final."""

from __future__ import annotations

from collections.abc import Mapping
import threading
import time
from typing import Any, Optional

from fogros2.errors import DeadlineExceeded, ProviderError
from fogros2.kubernetes_client import Api, existing, items, path, selector
from fogros2.model import MachineState
from fogros2.provider.kubernetes import hints, names, pods
from fogros2.provider.kubernetes.names import MachineId
from fogros2.provider.kubernetes.pods import Trouble

#: Seconds to wait for the end of a problem that may be temporary: a node that is being freed, a
#: registry that does not answer at first.
TIMEOUT = 15.0
#: Seconds to wait for a node or a disk, whose coming no event may report.
SCHEDULING = 60.0
#: Seconds after which the events are read, if there is no pod or the pod does not start.
QUIET = 5.0


class Start:
    """
    Wait for the pod of a new Job.

    :param name: the machine's name, for messages.
    """

    def __init__(
        self, api: Api, where: MachineId, job: Mapping[str, Any], *, name: str,
        cancel: threading.Event,
    ) -> None:
        self._api = api
        self._where = where
        self._job = job
        self._name = name
        self._pod: Optional[dict[str, Any]] = None
        self._trouble: Optional[Trouble] = None
        self._event_trouble: Optional[Trouble] = None
        self._since = 0.0
        self._scales_up = False
        self._next_events = time.monotonic() + QUIET
        self._cancel = cancel

    def wait(self, timeout: float) -> dict[str, Any]:
        """
        Return the pod as soon as its container runs.

        :raises ProviderError: the pod cannot run; with the event's text.
        :raises DeadlineExceeded: the pod did not run in time.
        """
        try:
            with hints.explained('to let the pods be watched', self._where.namespace):
                return self._api.follow(
                    path('pods', self._where.namespace), self._look, tick=self._tick,
                    again=self._again, timeout=timeout, cancel=self._cancel,
                    what=f"the pod of '{self._name}' to run",
                    labelSelector=selector({names.MACHINE: self._where.job}))
        except DeadlineExceeded as error:
            if self._trouble is None:
                raise
            raise self._error(self._trouble) from error

    def _look(self, event: str, pod: dict[str, Any]) -> Optional[dict[str, Any]]:
        if pods.pod_of(self._job, [pod]) is None:
            return None  # the pod of an earlier Job with the name
        if event == 'DELETED' or pods.state_of(self._job, pod) is MachineState.STOPPING:
            raise ProviderError(
                f"'{self._name}' ended while it was coming up: {pods.end_of(self._job, pod)}",
                'is its image one with Python 3 and sh, and nobody deletes it?')
        if pods.is_running(pod):
            return pod
        self._pod = pod
        self._note(pods.trouble_of(pod))
        return None

    def _note(self, trouble: Optional[Trouble]) -> None:
        if trouble is not None and trouble.final:
            raise self._error(trouble)
        if trouble is None or self._trouble is None \
                or trouble.unscheduled != self._trouble.unscheduled:
            self._since = time.monotonic()
        elif trouble.less_than(self._trouble):
            return
        self._trouble = trouble

    def _error(self, trouble: Trouble) -> ProviderError:
        return ProviderError(f"the pod of '{self._name}' does not run: {trouble.what}",
                             trouble.hint)

    def _again(self) -> None:
        """Check that the Job still exists, after a watch was lost."""
        if existing(self._api, path('jobs', self._where.namespace, self._where.job),
                    self._cancel) is None:
            raise ProviderError(f"'{self._name}' was deleted while it was coming up")

    def _tick(self) -> None:
        now = time.monotonic()
        over = self._lasting(now) is not None and not self._scales_up
        if over or now >= self._next_events and (
                self._trouble is None or now - self._since >= TIMEOUT):
            # Polled rarely, because a watch would report the events of all pods.
            self._next_events = now + 4 * QUIET
            self._events()
        trouble = self._lasting(now)
        if trouble is not None and not self._scales_up:
            raise self._error(trouble)

    def _lasting(self, now: float) -> Optional[Trouble]:
        """Return the problem if it has had its time to end."""
        trouble = self._trouble
        if trouble is None:
            return None
        return trouble if now - self._since >= (
            SCHEDULING if trouble.unscheduled else TIMEOUT) else None

    def _events(self) -> None:
        if self._pod is None:
            self._again()
        meta = (self._pod or self._job)['metadata']
        events = items(self._api.request(
            'GET', path('events', self._where.namespace),
            fieldSelector=f"involvedObject.uid={meta['uid']}", cancel=self._cancel))
        self._scales_up = pods.scales_up(events)
        trouble = pods.trouble_in(events)
        if self._trouble in (None, self._event_trouble) or (trouble is not None and trouble.final):
            self._note(trouble)
        self._event_trouble = trouble
