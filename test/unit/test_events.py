# SPDX-License-Identifier: Apache-2.0
"""Events and answers of the agent: what passes the check, and what an error says."""

from __future__ import annotations

import json
import os
import typing

import pytest

from fogros2 import events, untrusted
from fogros2.agent import server
from rigs import recorded_agent


def test_events_of_an_agent_are_valid():
    recorded = recorded_agent.events()
    assert [events.event(event) for event in recorded] == recorded
    kinds = {typing.get_args(typing.get_type_hints(kind)['event'])[0]
             for kind in typing.get_args(events.AgentEvent)}
    # those that were not recorded
    assert {event['event'] for event in recorded} == kinds - {'watched', 'restarted'}


@pytest.mark.parametrize(('command', 'answer'), recorded_agent.answers())
def test_answers_of_an_agent_are_valid(command, answer):
    assert events.answer(command, answer) == answer


def test_agent_names_its_launch_before_it_serves(tmp_path):
    server.Agent({'machine': 'planner', 'launch': 'first', 'directory': str(tmp_path)}).open()
    assert json.loads((tmp_path / 'config.json').read_text())['launch'] == 'first'
    assert (tmp_path / 'agent.pid').read_text() == f'{os.getpid()}\n'


@pytest.mark.parametrize('name', ['config.json', 'watchdog.json'])
def test_file_that_is_too_deep_does_not_stop_the_agent(tmp_path, name):
    settings = {'machine': 'planner', 'launch': 'first', 'directory': str(tmp_path)}
    (tmp_path / 'config.json').write_text(json.dumps(settings))
    (tmp_path / name).write_text('[' * 100_000)
    server.Agent(settings).open()


@pytest.mark.parametrize('value', [0, -1, 2 ** 53])
def test_number_in_range_is_valid(value):
    assert events.event({'event': 'end_failed', 'returncode': value})


@pytest.mark.parametrize(('value', 'text'), [
    (2 ** 53 + 1, 'a number out of range'), (float('nan'), 'a number out of range'),
    (float('-inf'), 'a number out of range'), (1.5, 'float'), (True, 'bool'), (None, 'NoneType')])
def test_invalid_number_is_named(value, text):
    with pytest.raises(untrusted.InvalidMessage) as caught:
        events.event({'event': 'end_failed', 'returncode': value})
    assert str(caught.value) == f"field 'returncode': expected int, got {text}"


def test_field_inside_a_list_is_named():
    status = recorded_agent.answer('status')
    status['nodes'] = [{**status['nodes'][0], 'restarts': 'x'}]
    with pytest.raises(untrusted.InvalidMessage, match="field 'nodes.restarts': expected int"):
        events.answer('status', status)
    status['nodes'] = 7
    with pytest.raises(untrusted.InvalidMessage, match="field 'nodes': expected list, got int"):
        events.answer('status', status)


def test_missing_field_is_named():
    with pytest.raises(untrusted.InvalidMessage, match="field 'hint' is missing"):
        events.event({'event': 'refused', 'node': 'n', 'name': 'n', 'error': 'x'})


def test_events_and_fields_of_a_newer_agent_are_ignored():
    assert events.event({'event': 'unheard of', 'seq': 3}) is None
    assert events.event({'event': 'ending', 'reason': 'x', 'new': [{}]}) is not None
