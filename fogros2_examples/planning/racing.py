# SPDX-License-Identifier: Apache-2.0
"""Request motions from the worker process."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
import json
import os
import subprocess
from typing import Any, Optional

from fogros2.python_module import RUN_MODULE
from fogros2_examples.meshes import Floats
from fogros2_examples.planning import worker
from fogros2_examples.planning.scene import Scene


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


class Racer:
    """
    Plan in one scene at a time, in a worker process.

    :param workers: number of parallel searches; 0: one per core.
    :param planners: names of OMPL's planners, which the searches use in turn.
    """

    def __init__(self, workers: int = 0, planners: Sequence[str] = ('RRTConnect',)) -> None:
        self.workers = workers or cores()
        self.planners = list(planners)
        self._scene: Optional[Scene] = None
        self._process = self._start()

    @staticmethod
    def _start() -> subprocess.Popen[str]:
        return subprocess.Popen([*RUN_MODULE, worker.__name__], stdin=subprocess.PIPE,
                                stdout=subprocess.PIPE, text=True)

    def enter(self, scene: Scene) -> None:
        """
        Plan in this scene from now on.

        :raises RuntimeError: the worker has ended; the next call starts a new one.
        """
        self._scene = None
        self._ask({'scene': worker.encoded(scene)})
        self._scene = scene

    def plan(self, start: Floats, goal: Floats, *, seconds: float,
             seed: int = 1) -> dict[str, Any]:
        """
        Return the fields of ``search.Outcome``; the first motion found wins.

        :param seconds: time-out.
        :param seed: seed of the first search, increased by one for each further search.
        :raises RuntimeError: the worker has ended; the next call starts a new one.
        """
        return self._ask({
            'start': start.tolist(), 'goal': goal.tolist(), 'seconds': seconds,
            'seeds': [seed + number for number in range(self.workers)],
            'planners': self.planners})

    def close(self) -> None:
        """Stop the worker."""
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(OSError):  # the worker may have ended before it read a question
            self._process.stdin.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()

    def _ask(self, question: dict[str, Any]) -> dict[str, Any]:
        if self._process.poll() is not None:
            self.close()
            self._process = self._start()
            if self._scene is not None:
                self.enter(self._scene)
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps(question) + '\n')
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        except OSError as error:
            raise RuntimeError(f'the search has ended: {error}') from error
        if not line:
            raise RuntimeError(f'the search has ended with status {self._process.wait()}')
        answer: dict[str, Any] = json.loads(line)
        return answer
