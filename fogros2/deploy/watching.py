# SPDX-License-Identifier: Apache-2.0
"""Whether a machine from which nothing comes still exists, and how it is reached by now."""

from __future__ import annotations

from collections.abc import Callable
import threading

from fogros2.agent_client import AgentClient, Heartbeat
from fogros2.deploy.job import Job
from fogros2.errors import FogError, MachineNotFound
from fogros2.model import Machine, MachineState

#: Seconds without an answer after which the provider is asked, and between two questions.
SILENCE, INTERVAL = 5.0, 5.0

_ENDED = {
    MachineState.DELETED: 'it was deleted', MachineState.STOPPING: 'it is being ended',
    MachineState.STOPPED: 'it was stopped'}


class Watch:
    """
    Asks the provider about a machine whose heartbeat stays away, until it is known to be gone.

    A machine that is merely out of reach exists still: nothing is told of it.

    :param gone: is called with the reason, once, from the watch's own thread.
    :param found: is called with what the provider tells of one that exists.
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
        threading.Thread(target=self._run, name='fog-watch', daemon=True).start()

    def close(self) -> None:
        """Stop watching; a question under way is answered to nobody."""
        self._done.set()

    def _run(self) -> None:
        pause = 1.0
        while not self._done.wait(pause):
            pause = 1.0
            age = self._heartbeat.age
            if age is not None and age > SILENCE:
                reason, deleted = self._ask()
                # an agent that speaks is there, whatever its provider says
                if reason and self._agent.silent_for > SILENCE and not self._done.is_set():
                    self._job.gone, self._job.deleted = True, deleted
                    self._gone(reason)
                    return
                pause = INTERVAL

    def _ask(self) -> tuple[str, bool]:
        """Return why the machine runs no more ('': it does, or nobody knows), and if it's gone."""
        job = self._job
        try:
            machine = job.provider.describe(job.machine_id)
        except MachineNotFound as error:
            return str(error.args[0]), True
        except FogError:
            return '', False  # no network here, maybe: asked again
        if machine.state is MachineState.RUNNING and not self._done.is_set():
            self._found(machine)
        return _ENDED.get(machine.state, ''), machine.state is MachineState.DELETED
