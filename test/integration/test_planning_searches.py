# SPDX-License-Identifier: Apache-2.0
"""Motion planning: searches in processes of their own, and motions held against the scene."""

from __future__ import annotations

import math
import os
from pathlib import Path
import signal
import threading

import numpy
import pytest

pytest.importorskip('fcl', reason='python-fcl is in the extra applications')
pytest.importorskip('ompl.base', reason='ompl is in the extra applications')

from fogros2.waiting import wait_until
from fogros2_examples.planning.picture import between
from fogros2_examples.planning.racing import Racer
from fogros2_examples.planning.scene import MADE, pose
from rigs.planning_room import box_room


def depth(first, second):
    """Return by how much two boxes overlap at least, m; 0 where they don't."""
    def axes(corners):
        return [(corners[i] - corners[0]) / numpy.linalg.norm(corners[i] - corners[0])
                for i in (1, 2, 4)]

    least = math.inf
    a, b = axes(first), axes(second)
    for axis in [*a, *b, *(numpy.cross(x, y) for x in a for y in b)]:
        length = numpy.linalg.norm(axis)
        if length < 1e-6:
            continue
        p, q = first @ axis / length, second @ axis / length
        least = min(least, p.max() - q.min(), q.max() - p.min())
    return max(0.0, least)


def boxes(mesh):
    return [mesh.vertices[i:i + 8] for i in range(0, len(mesh.vertices), 8)]


@pytest.mark.parametrize('name', sorted(MADE))
def test_motion_touches_nothing(name):
    # the boxes that the meshes are made of are held against each other without FCL
    scene = MADE[name]()
    racer = Racer(workers=2)
    try:
        racer.enter(scene)
        outcome = racer.plan(scene.start, scene.goal, seconds=60, seed=3)
    finally:
        racer.close()
    assert outcome['end'] == 'found'
    path = numpy.array(outcome['path'])
    assert path[0] == pytest.approx(scene.start, abs=1e-6)
    assert path[-1][:3] == pytest.approx(scene.goal[:3], abs=1e-6)
    assert abs(path[-1][3:] @ scene.goal[3:]) == pytest.approx(1)
    assert outcome['length'] >= numpy.linalg.norm(scene.goal[:3] - scene.start[:3])
    around = [(part, part.min(axis=0), part.max(axis=0))
              for part in boxes(scene.walls) + boxes(scene.shell)]
    for at in between(path, 0.05):
        body = scene.at(at)
        low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
        for part, under, over in around:
            if (low < over).all() and (high > under).all():
                # OMPL looks at poses some centimetres apart
                assert all(depth(piece, part) < 0.02 for piece in boxes(body)), at


@pytest.fixture(scope='module')
def racer():
    racer = Racer(workers=2, planners=['RRTConnect', 'KPIECE1'])
    yield racer
    racer.close()


def test_each_failure_to_plan_has_its_own_end(racer):
    racer.enter(box_room(wall=True))
    start, goal = pose(0.5, 0.5, 0.5), pose(3.5, 0.5, 0.5)
    outcome = racer.plan(start, goal, seconds=0.5)
    assert outcome['end'] == 'time' and outcome['path'] == []
    assert 0.5 <= outcome['seconds'] < 30
    assert racer.plan(pose(2, 0.5, 0.5), goal, seconds=60)['end'] == 'start'
    assert racer.plan(start, pose(3.5, 0.5, 9), seconds=60)['end'] == 'goal'
    # and it goes on
    racer.enter(box_room(wall=False))
    assert racer.plan(start, goal, seconds=120)['end'] == 'found'


def test_same_seed_finds_the_same_path():
    one = Racer(workers=1)
    try:
        scene = box_room(wall=False)
        one.enter(scene)
        found = [one.plan(scene.start, scene.goal, seconds=120, seed=5) for _ in range(2)]
    finally:
        one.close()
    assert found[0]['path'] == found[1]['path'] and found[0]['checks'] == found[1]['checks']


def test_dead_search_is_reported_and_replaced():
    racer, scene = Racer(workers=1), box_room(wall=False)
    try:
        racer.enter(scene)
        os.kill(racer._process.pid, signal.SIGSTOP)
        threading.Timer(0.3, racer._process.kill).start()
        with pytest.raises(RuntimeError, match='has ended'):
            racer.plan(scene.start, scene.goal, seconds=120)
        assert racer.plan(scene.start, scene.goal, seconds=120)['end'] == 'found'
    finally:
        racer.close()


def test_searches_end_with_the_process_that_asked():
    racer, scene = Racer(workers=2), box_room(wall=True)
    racer.enter(scene)
    worker = racer._process.pid
    asking = threading.Thread(target=lambda: pytest.raises(
        RuntimeError, racer.plan, scene.start, scene.goal, seconds=60), daemon=True)
    asking.start()
    children = Path(f'/proc/{worker}/task/{worker}/children')
    searches = wait_until(lambda: len(found := children.read_text().split()) == 2 and found,
                          timeout=60.0, what='the searches')
    racer._process.stdin.close()
    asking.join(60)
    racer.close()
    assert not asking.is_alive()
    assert not [pid for pid in searches if Path('/proc', pid).exists()]
