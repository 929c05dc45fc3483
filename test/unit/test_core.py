# SPDX-License-Identifier: Apache-2.0
"""Tests of the small modules below everything: errors, waiting, report, plugins, process."""

from importlib import metadata
import json
import os
import sys
import threading
import time
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from fogros2 import errors, model, plugin_system, process, report
from fogros2.errors import Cancelled
from fogros2.model import Command, NodeSpec, Result
from fogros2.waiting import cancellable, wait_until
from fogros2_testing.plugins import install


def test_error_has_message_and_hint():
    assert str(errors.FogError('x failed', 'do y')) == 'x failed (do y)'
    assert str(errors.FogError('x failed')) == 'x failed'


def test_failed_command_shows_its_last_error_lines():
    result = Result(3, 'out', '\n'.join(['one', 'two', 'three', 'four']))
    error = errors.CommandError(Command(('tool',), what='make it'), result, 'planner')
    assert str(error) == (
        'make it failed on planner with exit status 3: two / three / four')


def test_wait_returns_the_result_of_the_probe():
    answers = iter([None, False, 7])
    assert wait_until(lambda: next(answers), timeout=60, what='x', interval=0.001) == 7


def test_wait_ends_at_its_deadline():
    begin = time.monotonic()
    with pytest.raises(errors.DeadlineExceeded, match=r'0\.05 s waiting for godot \(go home\)'):
        wait_until(lambda: None, timeout=0.05, what='godot', hint='go home')
    assert time.monotonic() - begin < 5


def test_wait_ends_when_cancelled():
    cancel = threading.Event()
    threading.Timer(0.05, cancel.set).start()
    with pytest.raises(errors.Cancelled):
        wait_until(lambda: None, timeout=60, what='x', cancel=cancel)


def test_step_is_reported_with_detail_and_failure():
    events = []
    with report.step(events.append, 'm', 's') as detail:
        detail.append('fine')
    with pytest.raises(ZeroDivisionError):
        with report.step(events.append, 'm', 't'):
            raise ZeroDivisionError('division by zero')
    kinds = [type(event) for event in events]
    assert kinds == [report.StepStarted, report.StepDone, report.StepStarted, report.StepFailed]
    assert events[1].detail == 'fine'
    assert events[3].reason == 'division by zero'


def test_unknown_plugin_is_refused_with_a_suggestion():
    with pytest.raises(errors.ConfigurationError, match="did you mean 'container'"):
        plugin_system.load('fogros2.provider', 'conteiner')


@pytest.mark.parametrize(('program', 'message', 'hint'), [
    ('import fogros2.transport', 'fogros2.transport', 'install a version of fogt_shelf'),
    ('import fogt_missing', 'No module named .fogt_missing', 'pip install --upgrade fogt_shelf'),
    ('1 / 0', 'of fogt_shelf 0 .* ZeroDivisionError: division by zero', 'import fogt_shelf'),
    ('def', 'SyntaxError: .*fogt_shelf.py, line 1', 'import fogt_shelf')])
def test_defective_plugin_is_named(tmp_path, monkeypatch, program, message, hint):
    install(tmp_path, 'fogros2.feature', 'shelf', program, 'Shelf')
    monkeypatch.syspath_prepend(tmp_path)
    (found,) = metadata.distributions(path=[str(tmp_path)])
    monkeypatch.setattr(
        plugin_system, '_entry_points', lambda group: {p.name: p for p in found.entry_points})
    with pytest.raises(errors.PrerequisiteError, match=message) as caught:
        plugin_system.load('fogros2.feature', 'shelf')
    assert hint in caught.value.hint and 'install FogROS2' not in caught.value.hint


def test_verb_of_a_former_version_in_a_workspace_has_a_remedy(monkeypatch):
    error = ImportError("No module named 'fogros2.former'", name='fogros2.former')
    point = SimpleNamespace(load=Mock(side_effect=error), dist=SimpleNamespace(name='fogros2'))
    monkeypatch.setattr(plugin_system, '_entry_points', lambda group: {'former': point})
    with pytest.raises(errors.PrerequisiteError) as caught:
        plugin_system.load('fogros2.verb', 'former')
    assert 'delete build/fogros2 and install/fogros2 before' in caught.value.hint


def test_first_of_two_plugins_with_one_name_wins(monkeypatch):
    points = [metadata.EntryPoint('budget', f'{name}:A', 'fogros2.feature')
              for name in ('first', 'second')]
    monkeypatch.setattr(plugin_system, '_all', lambda: metadata.EntryPoints(points))
    assert plugin_system._entry_points.__wrapped__('fogros2.feature')['budget'] == points[0]


def test_json_of_the_model_is_plain():
    node = NodeSpec('1', 'talker-1', 'p', 'e', arguments=('a', ({'share': 'p'}, '/x')))
    data = json.loads(model.to_json(node))
    assert data['arguments'] == ['a', [{'share': 'p'}, '/x']]
    with pytest.raises(TypeError):
        model.to_json({'x': object()})


def run(*words, **arguments):
    return process.run(Command(words), **{'timeout': 20, **arguments})


def test_command_returns_its_output_and_status():
    result = run('sh', '-c', 'cat; echo err >&2; exit 3', check=False)
    assert (result.returncode, result.stdout, result.stderr) == (3, '', 'err\n')
    result = process.run(Command(('cat',), input=b'x' * 200_000), timeout=20)
    assert len(result.stdout) == 200_000


def test_lines_arrive_while_the_command_runs():
    lines = []
    cancel = threading.Event()

    def take(line):
        lines.append(line)
        cancel.set()

    with pytest.raises(errors.Cancelled):
        run('sh', '-c', 'echo one; exec tail -f /dev/null', on_output=take, cancel=cancel)
    assert lines == ['one']


def test_timed_out_command_ends_with_its_children(tmp_path):
    script = f'tail -f /dev/null & echo $! > {tmp_path}/pid; wait'
    with pytest.raises(errors.DeadlineExceeded):
        run('sh', '-c', script, timeout=2.0)
    child = int((tmp_path / 'pid').read_text())
    wait_until(lambda: not alive(child), timeout=60, what='the child to go')


def alive(pid):
    try:
        with open(f'/proc/{pid}/stat') as stat:
            return stat.read().rpartition(')')[2].split()[0] != 'Z'
    except OSError:
        return False


def test_interrupt_does_not_reach_a_command():
    result = run('sh', '-c', 'ps -o pgid= -p $$ 2>/dev/null || cut -d" " -f5 /proc/$$/stat')
    assert int(result.stdout) != os.getpgid(0)


def test_missing_program_is_named():
    with pytest.raises(errors.PrerequisiteError, match='no-such-tool not found'):
        run('no-such-tool')
    with pytest.raises(errors.PrerequisiteError, match='sudo apt-get install iproute2'):
        process.require(['no-such-tool', sys.executable], package_of={'no-such-tool': 'iproute2'})


def test_command_finds_programs_in_an_empty_environment(monkeypatch):
    for name in list(os.environ):
        monkeypatch.delenv(name)
    assert run('sh', '-c', 'ls / >/dev/null; echo fine').stdout == 'fine\n'


def test_late_result_of_an_abandoned_call_is_passed_on():
    """Such as a connection, which somebody has to close."""
    answered, cancel, late = threading.Event(), threading.Event(), []

    def call():
        cancel.set()
        answered.wait(60)
        return 'a connection'

    with pytest.raises(Cancelled):
        cancellable(call, cancel, what='connecting', grace=lambda: 0.0, late=late.append)
    assert late == []
    answered.set()
    wait_until(lambda: late or None, timeout=60, what='the result')
    assert late == ['a connection']


def test_wait_without_time_looks_once():
    assert wait_until(lambda: 5, timeout=0.0, what='the number') == 5
