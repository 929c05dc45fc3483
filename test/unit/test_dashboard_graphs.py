# SPDX-License-Identifier: Apache-2.0
"""The programs beside launches: begun, told, believed with care, ended."""

from __future__ import annotations

import base64
from collections.abc import Iterator
import json
from pathlib import Path
import sys
import time
from typing import Any

import pytest

from fogros2.model import MachineSpec
from fogros2.store import Record, Store, this_process
from fogros2.waiting import wait_until
from ros2fog_cli.api import graphs
from ros2fog_cli.api.graphs import Graphs

#: Tells what it was told, and its variables.
PROGRAM = """
import json, os, sys
print('what a library prints')
print('[1]\\n"text"\\n{"picture": "/camera"}')
print(json.dumps({'picture': '/camera', 'number': 7, 'data': %r}))
print(json.dumps({'picture': '/odd', 'note': 'bayer'}), flush=True)
for line in sys.stdin:
    machines = json.loads(line)['machines']
    print(json.dumps({'streams': [{'topic': '/camera', 'note': ''}, {'topic': '/odd', 'note': ''}],
                      'topics': [machines, os.environ['ROS_DOMAIN_ID']]}), flush=True)
""" % base64.b64encode(b'jpeg').decode()


@pytest.fixture
def several() -> Iterator[Graphs]:
    made = Graphs(Store(), pictures=True)
    yield made
    made.close()


def launched(launch: str = 'abc123', **changes: Any) -> Record:
    folder = Store().launch_folder(launch)
    (folder / 'rmw').write_text('rmw_cyclonedds_cpp')
    (folder / 'domain').write_text('42')
    return Record('a', 'memory', MachineSpec('a', 'memory'), launch=launch,
                  **{**this_process(), **changes})


def instead(monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    monkeypatch.delenv('RMW_IMPLEMENTATION', raising=False)
    monkeypatch.setattr('fogros2_monitor.GRAPH', (sys.executable, '-c', program))


def test_output_of_a_graph_program_is_collected(
    several: Graphs, monkeypatch: pytest.MonkeyPatch,
) -> None:
    instead(monkeypatch, PROGRAM)
    record = launched()
    # a machine that is not looked at, and one of another launch
    for name, launch in (('b', 'abc123'), ('c', 'def456')):
        Store().save(Record(name, 'memory', MachineSpec(name, 'memory'), launch=launch))

    def told() -> Any:
        state = several.update([(record, ('talker',))])
        return state if state['topics'] else None

    state = wait_until(told, timeout=60.0, what='its word')
    assert state['topics'] == [{'a': ['talker'], 'b': []}, '42'] and state['graph_trouble'] == []
    camera, odd = state['streams']
    assert (camera['id'], camera['picture'], odd['note']) == ('abc123 /camera', 7, 'bayer')
    assert several.picture('abc123 /camera') == b'jpeg'
    assert several.picture('abc123 /odd') is None and several.picture('other /camera') is None
    assert several.picture('') is None
    (graph,) = several._graphs.values()
    # nobody looks any more, or the launch is over
    assert several.update([])['streams'] == []
    assert not graph.alive and several.picture('abc123 /camera') is None


def test_failed_graph_program_is_reported_and_restarted(
    several: Graphs, monkeypatch: pytest.MonkeyPatch,
) -> None:
    instead(monkeypatch, 'import sys; sys.exit("no module named rclpy")')
    record = launched()

    def trouble() -> Any:
        return several.update([(record, ())])['graph_trouble'] or None

    assert wait_until(trouble, timeout=60.0, what='its failure') == [
        'topics are not looked at: no module named rclpy']
    instead(monkeypatch, PROGRAM)
    assert trouble() and not several._graphs
    monkeypatch.setattr(graphs, 'AGAIN', 0.0)
    assert not trouble() and several._graphs


def test_no_graph_program_for_another_middleware(
    several: Graphs, monkeypatch: pytest.MonkeyPatch,
) -> None:
    instead(monkeypatch, PROGRAM)
    monkeypatch.setenv('RMW_IMPLEMENTATION', 'rmw_other_cpp')
    (why,) = several.update([(launched(), ())])['graph_trouble']
    assert 'this terminal rmw_other_cpp' in why
    monkeypatch.delenv('RMW_IMPLEMENTATION')
    over = launched('def456', pid=0)
    assert several.update([(over, ())]) == {'streams': [], 'topics': [], 'graph_trouble': []}
    assert not several._graphs


def test_graph_program_that_hangs_is_killed(several: Graphs, monkeypatch: pytest.MonkeyPatch,
                                        tmp_path: Path) -> None:
    begun = tmp_path / 'begun'
    instead(monkeypatch, f'import time; open({str(begun)!r}, "w"); time.sleep(600)')
    monkeypatch.setattr(graphs, 'TIMEOUT', 0.2)
    several.update([(launched(), ())])
    wait_until(begun.exists, timeout=60.0, what='its begin')
    (graph,) = several._graphs.values()
    begin = time.monotonic()
    several.close()
    assert time.monotonic() - begin < 60 and not graph.alive
    json.dumps(several.update([]))
