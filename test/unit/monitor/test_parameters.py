# SPDX-License-Identifier: Apache-2.0
"""Parameters of nodes as viewers see and set them, with services of a fake."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip('foxglove', reason='the extra "monitor" is not installed')
pytest.importorskip('rclpy', reason='rclpy is not installed')
from foxglove import Parameter
from rcl_interfaces.msg import ListParametersResult, ParameterValue, SetParametersResult
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters

from fogros2_monitor import parameters
from fogros2_monitor.parameters import converted, Parameters, shown

DOUBLE = ParameterValue(type=3, double_value=0.5)


def native(value: ParameterValue) -> Any:
    one, = shown({'/a.b': value})
    assert one.name == '/a.b'
    return one.get_value()


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
    made = converted(Parameter('/a.b.c', value=value), ParameterValue(type=ros['type']))
    assert (made.name, made.value) == ('b.c', ParameterValue(**ros))
    assert native(made.value) == back


@pytest.mark.parametrize(('kind', 'value'), [
    (0, 1), (0, None), (99, 1), (1, 1), (1, 'true'), (2, 1.0), (2, '1'), (2, None), (3, True),
    (3, '1.0'), (3, [1.0]), (4, 1), (4, b'a'), (4, {'a': 1}), (5, 'YQ=='), (5, [1]), (6, True),
    (6, [1]), (7, [1, 1.5]), (8, ['1']), (8, {}), (9, 'ab'), (9, ['a', 1]), (9, [['a']])])
def test_value_of_another_type_is_refused(kind, value):
    with pytest.raises(ValueError):
        converted(Parameter('/a.b', value=value), ParameterValue(type=kind))


def test_parameter_without_a_value_is_not_shown():
    assert shown({'/a.b': ParameterValue(), '/a.c': ParameterValue(type=77)}) == []


class Nodes:
    """Services of nodes with parameters; a node without a dictionary does not answer."""

    def __init__(self) -> None:
        self.values = {'/arm': {'speed': DOUBLE, 'hidden': DOUBLE, 'fixed': DOUBLE}}
        self.calls: list[str] = []

    def call(self, requests: dict[str, tuple[Any, Any]], timeout: float) -> dict[str, Any]:
        self.calls += requests
        return {name: self._answer(self.values[name.rpartition('/')[0]], *request)
                for name, request in requests.items() if name.rpartition('/')[0] in self.values}

    def _answer(self, known: dict[str, ParameterValue], cls: Any, request: Any) -> Any:
        if cls is ListParameters:
            return cls.Response(result=ListParametersResult(names=[*known]))
        if cls is GetParameters:
            return cls.Response(values=[known.get(each, ParameterValue())
                                        for each in request.names])
        assert cls is SetParameters
        results = [SetParametersResult(successful=each.name != 'fixed', reason='it is fixed')
                   for each in request.parameters]
        known.update({each.name: each.value for each, result in zip(request.parameters, results)
                      if result.successful})
        return cls.Response(results=results)


class Bench:
    def __init__(self) -> None:
        self.nodes = Nodes()
        self.reports: list[str] = []
        self.parameters = Parameters(
            self.nodes, lambda name: '.hidden' not in name,  # type: ignore[arg-type]
            self.reports.append)

    def get(self, *names: str) -> dict[str, Any]:
        values = self.parameters.get(names, {'/arm', '/silent'})
        return {each.name: each.get_value() for each in shown(values)}

    def set(self, **values: Any) -> None:
        self.parameters.set([Parameter(f'/arm.{name}', value=value)
                             for name, value in values.items()], {'/arm', '/silent'})


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_viewer_gets_what_it_names_or_everything(bench):
    assert bench.get() == {'/arm.speed': 0.5, '/arm.fixed': 0.5}
    bench.nodes.calls.clear()
    assert bench.get('/arm.speed', '/arm.x', '/x.y', '/arm.hidden', '', '.') == {'/arm.speed': 0.5}
    assert bench.nodes.calls == ['/arm/get_parameters'] and bench.reports == []


def test_viewer_sets_parameters(bench):
    bench.set(speed=2, fixed=1)
    assert bench.get() == {'/arm.speed': 2.0, '/arm.fixed': 0.5}
    assert bench.reports == ['/arm.fixed is not set: it is fixed']


def test_nothing_wrong_reaches_a_node(bench):
    bench.set(speed='fast', hidden=1.0, x=1.0)
    for name in ('/a b.speed', '', '/silent.speed', '/arm/set_parameters.speed'):
        bench.parameters.set([Parameter(name, value=1.0)], {'/arm', '/silent'})
    assert not [name for name in bench.nodes.calls if not name.endswith('/get_parameters')]
    assert [report.count('is unknown, or of another type') for report in bench.reports] == [
        3, 1, 1, 1, 1]


def test_node_that_does_not_answer_is_reported(bench):
    values = bench.nodes.values['/arm']

    def call(requests: dict[str, Any], timeout: float) -> dict[str, Any]:
        return {} if '/arm/set_parameters' in requests else type(bench.nodes).call(
            bench.nodes, requests, timeout)

    bench.nodes.call = call
    bench.set(speed=1.0)
    assert bench.reports == ['/arm did not answer'] and values['speed'] == DOUBLE


def test_viewer_gets_and_sets_a_limited_number(bench, monkeypatch):
    monkeypatch.setattr(parameters, 'MOST', 2)
    bench.nodes.values['/arm'] = dict.fromkeys('abc', DOUBLE)
    assert len(bench.get()) == 2
    bench.set(a=1.0, b=1.0, c=1.0)
    assert bench.nodes.values['/arm']['c'] == DOUBLE
    assert bench.reports == ['only 2 of 3 parameters are shown or set'] * 2
