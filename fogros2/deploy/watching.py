# SPDX-License-Identifier: Apache-2.0
"""Check that a silent machine still exists, and update how the robot reaches it."""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import threading
from types import TracebackType
from typing import Optional

from fogros2.agent_client import AgentClient, Heartbeat
from fogros2.deploy.job import Job
from fogros2.errors import FogError, MachineNotFound
from fogros2.model import Machine, MachineState
from fogros2.report import StepFailed

#: Seconds without a heartbeat before the provider is asked, and the poll interval after that.
SILENCE, INTERVAL = 5.0, 5.0

_ENDED = {
    MachineState.DELETED: 'it was deleted', MachineState.STOPPING: 'it is being ended',
    MachineState.STOPPED: 'it was stopped'}


class Watch:
    """
    Ask the provider about a machine without heartbeat, until the machine is known to be gone.

    A machine that exists but is out of reach is not reported. An unknown exception is a defect of
    FogROS2 or of a plugin: it ends the watch and is reported at once, and ``close`` raises it, so
    that the nodes continue until then.

    :param gone: called with the reason, once, from the watch's thread.
    :param found: called with the provider's report of a machine that runs.
    """

    def __init__(
        self, job: Job, agent: AgentClient, heartbeat: Heartbeat, *,
        gone: Callable[[str], None], found: Callable[[Machine], None],
    ) -> None:
        self._job = job
        self._agent = agent
        self._heartbeat = heartbeat
        self._gone = gone
        self._found = found
        self._done = threading.Event()
        self._fault: Optional[BaseException] = None
        threading.Thread(target=self._run, name='fog-watch', daemon=True).start()

    def close(self) -> None:
        """
        Stop watching; ignore the answer to a pending question.

        :raises BaseException: the exception that ended the watch, once.
        """
        self._done.set()
        fault, self._fault = self._fault, None
        if fault is not None:
            raise fault

    def _run(self) -> None:
        with contextlib.ExitStack() as end:
            end.push(self._ended)
            self._watch()

    def _ended(
        self, kind: Optional[type[BaseException]], error: Optional[BaseException],
        traceback: Optional[TracebackType],
    ) -> bool:
        """Keep the exception that ended the watch for ``close``, and report it."""
        if error is not None:
            self._fault = error
            self._job.launch.report(StepFailed(
                self._job.name, 'watch', 0.0, 'nobody looks any more whether the machine still '
                f'exists: {type(error).__name__}: {error}', fatal=False))
        return True

    def _watch(self) -> None:
        pause = 1.0
        while not self._done.wait(pause):
            pause = 1.0
            age = self._heartbeat.age
            if age is not None and age > SILENCE:
                reason, deleted = self._ask()
                # while the agent sends, the machine exists, whatever the provider reports
                if reason and self._agent.silent_for > SILENCE and not self._done.is_set():
                    self._job.gone, self._job.deleted = True, deleted
                    self._gone(reason)
                    return
                pause = INTERVAL

    def _ask(self) -> tuple[str, bool]:
        """Return why the machine ended ('' if it runs or is unknown), and if it is deleted."""
        job = self._job
        try:
            machine = job.provider.describe(job.machine_id)
        except MachineNotFound as error:
            return str(error.args[0]), True
        except FogError:
            return '', False  # perhaps the robot has no network: retried
        if machine.state is MachineState.RUNNING and not self._done.is_set():
            self._found(machine)
        return _ENDED.get(machine.state, ''), machine.state is MachineState.DELETED
