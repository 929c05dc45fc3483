# SPDX-License-Identifier: Apache-2.0
"""Whether a machine that says nothing any more still exists: its provider knows."""

from __future__ import annotations

from collections.abc import Callable
import threading

from fogros2.agent_client import AgentClient, Heartbeat
from fogros2.deploy.job import Job
from fogros2.errors import FogError, MachineNotFound
from fogros2.model import MachineState

#: Seconds without an answer, by agent and heartbeat alike, after which the provider is asked, and
#: between two questions.
SILENCE, INTERVAL = 5.0, 5.0

_ENDED = {
    MachineState.DELETED: 'it was deleted', MachineState.STOPPING: 'it is being ended',
    MachineState.STOPPED: 'it was stopped'}


class Watch:
    """
    Asks the provider about a machine from which nothing comes, until it is known to be gone.

    A machine that is merely out of reach exists still: nothing is told of it.

    :param gone: is called with the reason, once, from the watch's own thread.
    """

    def __init__(
        self, job: Job, agent: AgentClient, heartbeat: Heartbeat, gone: Callable[[str], None],
    ) -> None:
        self._job = job
        self._agent = agent
        self._heartbeat = heartbeat
        self._gone = gone
        self._done = threading.Event()
        threading.Thread(target=self._run, name='fog-watch', daemon=True).start()

    def close(self) -> None:
        """Stop watching; a question under way is answered to nobody."""
        self._done.set()

    def _run(self) -> None:
        pause = 1.0
        while not self._done.wait(pause):
            pause = 1.0
            if self._silent():
                reason = self._ask()
                if reason and not self._done.is_set():
                    self._gone(reason)
                    return
                pause = INTERVAL

    def _silent(self) -> bool:
        age = self._heartbeat.age
        return age is not None and age > SILENCE and self._agent.silent_for > SILENCE

    def _ask(self) -> str:
        """Return why the machine is no more, '' while it exists or nobody knows."""
        job = self._job
        try:
            machine = job.provider.describe(job.machine_id)
        except MachineNotFound as error:
            job.gone = job.deleted = True
            return str(error.args[0])
        except FogError:
            return ''  # no network here, maybe: asked again
        job.gone = machine.state in _ENDED
        job.deleted = machine.state is MachineState.DELETED
        return _ENDED.get(machine.state, '')
