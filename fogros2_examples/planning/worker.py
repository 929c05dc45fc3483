# SPDX-License-Identifier: Apache-2.0
"""
Run searches in parallel processes, one per core, and return the first result; a program.

It reads JSON lines. It answers ``{"scene": ...}`` (of ``encoded``) when the scene is ready, and
``{"start", "goal", "seconds", "seeds", "planners"}`` with the best outcome. Threads would not
help: OMPL calls Python at each step for a collision check, and only one thread at a time runs
Python. The program forks a process for each search, because OMPL accepts a seed once per process;
the child has the scene already. Nothing else runs in this program that a fork would break.
"""

from __future__ import annotations

from collections.abc import Mapping
import contextlib
import dataclasses
import json
import os
import select
import signal
import sys
from typing import Any, Optional, TYPE_CHECKING

import numpy

from fogros2_examples.meshes import Mesh
from fogros2_examples.planning.scene import Scene

if TYPE_CHECKING:
    from fogros2_examples.planning.search import Outcome, Space


def encoded(scene: Scene) -> dict[str, Any]:
    """Return a scene as JSON values."""
    def plain(value: Any) -> Any:
        if isinstance(value, Mesh):
            return {'vertices': value.vertices.tolist(), 'triangles': value.triangles.tolist()}
        return value if isinstance(value, str) else value.tolist()

    return {field.name: plain(getattr(scene, field.name)) for field in dataclasses.fields(scene)}


def decoded(given: Mapping[str, Any]) -> Scene:
    """Return the scene of ``encoded``'s values."""
    def mesh(value: Mapping[str, Any]) -> Mesh:
        return Mesh(numpy.array(value['vertices'], float).reshape(-1, 3),
                    numpy.array(value['triangles'], numpy.int32).reshape(-1, 3))

    low, high, start, goal = (
        numpy.array(given[name], float) for name in ('low', 'high', 'start', 'goal'))
    return Scene(given['name'], mesh(given['body']), mesh(given['walls']), mesh(given['shell']),
                 low, high, start, goal)


def race(space: Space, request: Mapping[str, Any]) -> Outcome:
    """
    Run a search per seed; return the first motion found, or a reason if none was found.

    :raises SystemExit: the caller is gone; all searches were killed.
    :param request: ``start``, ``goal``, ``seconds``, ``seeds`` and ``planners``; the searches use
        the planners in turn.
    """
    from fogros2_examples.planning.search import Outcome

    start, goal = numpy.array(request['start'], float), numpy.array(request['goal'], float)
    pipes: dict[int, int] = {}
    for number, seed in enumerate(request['seeds']):
        planner = request['planners'][number % len(request['planners'])]
        read, write = os.pipe()
        child = os.fork()
        if not child:
            _search(space, write, start, goal, request['seconds'], seed, planner)
        os.close(write)
        pipes[read] = child
    texts = dict.fromkeys(pipes, b'')
    best: Optional[Outcome] = None
    try:
        while pipes and (best is None or best.end == 'time'):
            ready = select.select([*pipes, sys.stdin.fileno()], [], [])[0]
            if sys.stdin.fileno() in ready:
                # The caller sends nothing before the answer: its end of the pipe is closed.
                raise SystemExit
            for read in ready:
                data = os.read(read, 1 << 16)
                texts[read] += data
                if data:
                    continue
                os.close(read)
                _, status = os.waitpid(pipes.pop(read), 0)
                if not texts[read]:
                    raise RuntimeError(f'a search ended with status {status} and no answer')
                outcome = Outcome(**json.loads(texts[read]))
                if best is None or outcome.end != 'time':
                    best = outcome
    finally:
        for read, child in pipes.items():
            os.close(read)
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
    if best is None:
        raise RuntimeError('no seed, no search')
    return best


def _search(space: Space, write: int, start: Any, goal: Any, seconds: float, seed: int,
            planner: str) -> None:
    """Search in a child process, and exit it."""
    outcome = space.search(start, goal, seconds=seconds, seed=seed, planner=planner)
    with os.fdopen(write, 'w') as out:
        json.dump(dataclasses.asdict(outcome), out)
    # The bindings would print a page about objects that they did not free.
    os._exit(0)


def main() -> None:
    """Answer questions until standard input ends."""
    from fogros2_examples.planning.search import Space

    # Ctrl-C in a terminal reaches all processes; the caller closes this one's standard input.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    space: Optional[Space] = None
    with contextlib.suppress(BrokenPipeError, SystemExit):
        for line in sys.stdin:
            request = json.loads(line)
            if 'scene' in request:
                space = Space(decoded(request['scene']))
                print(json.dumps({'ready': True}), flush=True)
                continue
            if space is None:
                raise RuntimeError('asked for a motion before there was a scene')
            print(json.dumps(dataclasses.asdict(race(space, request))), flush=True)
    os._exit(0)


if __name__ == '__main__':
    main()
