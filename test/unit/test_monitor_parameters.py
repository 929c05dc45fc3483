# SPDX-License-Identifier: Apache-2.0
"""Parameters of nodes as viewers see and set them, with services of a fake."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import threading
from typing import Any

import pytest

pytest.importorskip('foxglove', reason='the extra "monitor" is not installed')
pytest.importorskip('rclpy', reason='rclpy is not installed')
from foxglove import Parameter
from rcl_interfaces.msg import ListParametersResult, ParameterValue, SetParametersResult
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters

from fogros2.waiting import wait_until
from fogros2_monitor import parameters
from fogros2_monitor.parameters import converted, Parameters, shown
from fogros2_monitor.services import CallError

DOUBLE = ParameterValue(type=3, double_value=0.5)


@pytest.mark.parametrize(('value', 'ros', 'back'), [
    (True, {'type': 1, 'bool_value': True}, True),
    (7, {'type': 2, 'integer_value': 7}, 7),
    (7, {'type': 3, 'double_value': 7.0}, 7.0),
    (-0.5, {'type': 3, 'double_value': -0.5}, -0.5),
    ('ä', {'type': 4, 'string_value': 'ä'}, 'ä'),
    (b'\0\xff', {'type': 5, 'byte_array_value': [b'\0', b'\xff']}, b'\0\xff'),
    ([True, False], {'type': 6, 'bool_array_value': [True, False]}, [True, False]),
    ([1, 2], {'type': 7, 'integer_array_value': [1, 2]}, [1, 2]),
    ([1, 2.5], {'type': 8, 'double_array_value': [1.0, 2.5]}, [1.0, 2.5]),
    (['a', ''], {'type': 9, 'string_array_value': ['a', '']}, ['a', '']),
    ([], {'type': 9, 'string_array_value': []}, []),
])
def test_value_becomes_one_of_the_parameter_and_back(value, ros, back):
    made = converted(value, ParameterValue(type=ros['type']))
    assert made == ParameterValue(**ros)
    seen = shown('/a.b', made)
    assert seen is not None and (seen.name, seen.get_value()) == ('/a.b', back)


@pytest.mark.parametrize(('kind', 'value'), [
    (0, 1), (99, 1), (1, 1), (1, 'true'), (2, True), (2, 1.0), (2, '1'), (2, None), (3, True),
    (3, '1.0'), (3, [1.0]), (4, 1), (4, b'a'), (4, {'a': 1}), (5, 'YQ=='), (5, [1]), (6, True),
    (6, [1]), (7, [1, 1.5]), (7, [True]), (8, ['1']), (8, {}), (9, 'ab'), (9, ['a', 1]),
    (9, [['a']]), (4, 'x' * (parameters.LONGEST + 1)), (7, [1] * (parameters.LONGEST + 1))],
    ids=lambda value: repr(value)[:20])
def test_value_of_another_type_is_refused(kind, value):
    with pytest.raises(ValueError, match='it '):
        converted(value, ParameterValue(type=kind))


def test_parameter_without_a_value_is_not_shown():
    assert shown('/a.b', ParameterValue()) is None
    assert shown('/a.b', ParameterValue(type=77)) is None


class Nodes:
    """Services of nodes with parameters; a node without a dictionary does not answer."""

    def __init__(self) -> None:
        self.values: dict[str, dict[str, ParameterValue]] = {}
        self.calls: list[str] = []
        self.ended = threading.Event()

    def call(self, name: str, cls: Any, request: Any, timeout: float) -> Any:
        self.calls.append(name)
        node, _, verb = name.rpartition('/')
        if node not in self.values:
            self.ended.wait(60)
            raise CallError(f'{name} is gone')
        known = self.values[node]
        if cls is ListParameters:
            return cls.Response(result=ListParametersResult(names=[*known]))
        if cls is GetParameters:
            return cls.Response(values=[known[each] for each in request.names])
        assert cls is SetParameters
        results = [SetParametersResult(successful=each.name != 'fixed', reason='it is \x1bfixed')
                   for each in request.parameters]
        known.update({each.name: each.value for each, result in zip(request.parameters, results)
                      if result.successful})
        return cls.Response(results=results)


class Bench:
    def __init__(self) -> None:
        self.nodes = Nodes()
        self.published: list[tuple[str, Any]] = []
        self.reports: list[str] = []
        self.parameters = Parameters(
            self.nodes, lambda name: '.hidden' not in name,  # type: ignore[arg-type]
            lambda changes: self.published.extend(
                (each.name, each.get_value()) for each in changes), self.reports.append)

    def until(self, probe: Callable[[], Any]) -> None:
        wait_until(lambda: probe() or None, timeout=30, what='parameters')

    def see(self, *names: str) -> dict[str, Any]:
        return {each.name: each.get_value() for each in self.parameters.get(names)}


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setattr(parameters, 'FIRST', 30.0)
    made = Bench()
    made.nodes.values['/arm'] = {'speed': DOUBLE, 'hidden': DOUBLE}
    yield made
    made.nodes.ended.set()
    made.parameters.close()


def test_first_viewer_waits_for_the_values(bench):
    bench.parameters.look({'/arm'})
    assert bench.see() == {'/arm.speed': 0.5}
    assert bench.see('/arm.speed', '/arm.x', '/x', '') == {'/arm.speed': 0.5}
    assert bench.published == [('/arm.speed', 0.5)]


def test_node_is_read_again_after_a_change_until_its_end(bench):
    bench.parameters.look({'/arm'})
    bench.see()
    bench.nodes.values['/arm']['speed'] = ParameterValue(type=3, double_value=1.5)
    count = len(bench.nodes.calls)
    bench.parameters.look({'/arm'})
    assert len(bench.nodes.calls) == count
    for name in ('/arm', '/nobody'):
        bench.parameters.changed(name)
    bench.parameters.look({'/arm'})
    bench.until(lambda: bench.published[1:] == [('/arm.speed', 1.5)])
    bench.parameters.look(set())
    assert bench.see() == {}


def test_viewer_who_asks_again_gets_newer_values(bench, monkeypatch):
    bench.parameters.look({'/arm'})
    bench.see()
    # of a node that started again before anybody noticed
    bench.nodes.values['/arm'] = {'speed': ParameterValue(type=4, string_value='fast')}
    monkeypatch.setattr(parameters, 'FRESH', 0.0)

    def newer() -> bool:
        bench.parameters.look({'/arm'})
        return bench.see() == {'/arm.speed': 'fast'}

    bench.until(newer)


def test_silent_node_keeps_nobody_waiting(bench, monkeypatch):
    monkeypatch.setattr(parameters, 'FIRST', 0.2)
    bench.parameters.look({'/arm', '/silent'})
    bench.until(lambda: bench.see() == {'/arm.speed': 0.5})
    monkeypatch.setattr(parameters, 'SETTING', 60.0)
    assert bench.parameters.set([Parameter('/arm.speed', value=2.5)])[0].get_value() == 2.5
    # the second does not wait for its node, while the first one's is silent
    del bench.nodes.values['/arm']
    monkeypatch.setattr(parameters, 'SETTING', 0.2)
    for _ in range(2):
        assert bench.parameters.set([Parameter('/arm.speed', value=4.0)])[0].get_value() == 2.5
        monkeypatch.setattr(parameters, 'SETTING', 60.0)


def test_nothing_wrong_reaches_a_node(bench, monkeypatch):
    bench.nodes.values['/arm']['fixed'] = DOUBLE
    bench.parameters.look({'/arm'})
    bench.see()
    bench.nodes.calls.clear()
    for name, value in (('/arm.x', 1.0), ('/arm.hidden', 1.0), ('/a b.speed', 1.0), ('', 1.0),
                        ('/arm.speed', 'fast'), ('/arm.speed', None)):
        bench.parameters.set([Parameter(name, value=value)])
    bench.parameters.set([Parameter('/arm.speed', value=1.0)] * (parameters.SETS + 1))
    monkeypatch.setattr(parameters, 'PENDING', 0)
    bench.parameters.set([Parameter('/arm.speed', value=1.0)])
    monkeypatch.undo()
    assert bench.nodes.calls == [] and len(bench.reports) == 8
    assert bench.parameters.set([]) == []
    bench.parameters.set([Parameter('/arm.fixed', value=1.0)])
    bench.until(lambda: '/arm.fixed is not set' in bench.reports[-1])
    assert bench.see('/arm.fixed') == {'/arm.fixed': 0.5}


@pytest.mark.parametrize(('limit', 'most'), [('MOST', 3), ('BYTES', 100)])
def test_viewers_see_a_limited_number_of_parameters(bench, monkeypatch, limit, most):
    monkeypatch.setattr(parameters, limit, most)
    bench.nodes.values['/big'] = {
        f'p{number}': ParameterValue(type=4, string_value='x' * 50) for number in range(4)}
    bench.parameters.look({'/arm', '/big'})
    assert bench.see() == {'/arm.speed': 0.5}
    assert bench.reports == ['the parameters of /big are too many to show']
