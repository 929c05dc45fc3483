# SPDX-License-Identifier: Apache-2.0
"""Events and answers of the agent: what passes the check, and what an error says."""

from __future__ import annotations

import json
import os
import typing

import pytest

from fogros2 import events
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


def test_events_and_fields_of_a_newer_agent_are_ignored():
    assert events.event({'event': 'unheard of', 'seq': 3}) is None
    assert events.event({'event': 'ending', 'reason': 'x', 'new': [{}]}) is not None
