# SPDX-License-Identifier: Apache-2.0
"""What a live view shows of a launch: its steps by the journal, and a machine as text."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
import re
import subprocess
import sys
import threading
from types import SimpleNamespace
from typing import Any, cast

import pytest
from ros2cli.cli import main

from fogros2 import events, journal
from fogros2.journal import Journal, Step
from fogros2.report import (
    Event,
    Progress,
    silent,
    step,
    StepDone,
    StepFailed,
    StepStarted,
)
from rigs import recorded_agent
from ros2fog_cli.api import screen
from ros2fog_cli.api.follower import node_name, rates
from ros2fog_cli.api.machines import Entry
from ros2fog_cli.api.reach import Link
from ros2fog_cli.api.shown import as_json, machine_json, phase, Shown, ShownLaunch


def read(folder: Path) -> list[Step]:
    return journal.read(folder).steps


def test_journal_forwards_and_stores_events(tmp_path: Path) -> None:
    heard: list[Event] = []
    times = iter([100.0, 101.0, 102.0, 103.0, 103.1, 104.0])
    folder = tmp_path / 'launch'
    keep = Journal(heard.append, folder, clock=lambda: next(times))
    folder.mkdir()
    assert read(folder) == []
    keep(StepStarted('', 'VPN'))
    keep(StepStarted('a', 'workspace'))
    keep(StepDone('', 'VPN', 2.0, 'up'))
    keep(Progress('a', 'workspace', 10, 100))
    keep(Progress('a', 'workspace', 20, 100))  # too soon after the other
    keep(StepFailed('a', 'workspace', 3.0, 'no room'))
    assert len(heard) == 6
    assert read(folder) == [
        Step('', 'VPN', 100.0, 'done', 2.0, 'up'),
        Step('a', 'workspace', 101.0, 'failed', 3.0, 'no room', 10, 100)]
    assert (folder / journal.FILE).stat().st_mode & 0o777 == 0o600


def test_journal_without_a_folder_stops_nothing(tmp_path: Path) -> None:
    folder = tmp_path / 'launch'
    folder.mkdir()
    keep = Journal(silent, folder)
    with step(keep, 'a', 'machine'):
        pass
    (folder / journal.FILE).unlink()
    folder.rmdir()  # as at the end of a launch
    with pytest.raises(ValueError, match='why'), step(keep, 'a', 'delete'):
        raise ValueError('why')
    keep(StepStarted('a', 'not kept'))
    assert not folder.exists()


def test_journal_accepts_events_of_several_threads(tmp_path: Path) -> None:
    keep = Journal(silent, tmp_path)

    def many(name: str) -> None:
        for _ in range(50):
            with step(keep, name, 'machine'):
                pass

    threads = [threading.Thread(target=many, args=(name,)) for name in 'abcd']
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [s.state for s in read(tmp_path)] == ['done'] * 200


@pytest.mark.parametrize('line', [
    '', 'x', '[]', '{}', '{"time": 1, "machine": "a", "step": "s", "event": "done"}',
    '{"time": "x", "machine": "a", "step": "s", "event": "started"}',
    '{"time": 1, "machine": "a", "step": "s", "event": "progress", "done": 1, "total": 2}',
    '{"time": 1, "machine": "a", "st', '[' * 100_000])
def test_damaged_line_of_a_journal_is_skipped(line: str) -> None:
    good = '{"time": 1, "machine": "a", "step": "s", "event": "started"}'
    assert journal.Contents([line, good, line]).steps in (
        [Step('a', 's', 1.0)], [Step('a', 's', 1.0, done=1, total=2)])


def test_watched_journal_is_parsed_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    launch, parsed, loads = ShownLaunch(), [], json.loads
    monkeypatch.setattr(journal.json, 'loads', lambda line: parsed.append(line) or loads(line))
    event = {'time': 1, 'event': 'started', 'machine': 'a', 'step': 's'}

    def write(text: str) -> None:
        with open(tmp_path / journal.FILE, 'a') as file:
            file.write(text)
        launch.read(tmp_path)

    progress = json.dumps({**event, 'event': 'progress', 'done': 1, 'total': 2}) + '\n'
    write(json.dumps(event) + '\n' + 5000 * progress + progress[:9])
    assert len(parsed) == 5001
    write(progress[9:])
    assert len(parsed) == 5002
    assert launch.contents.steps == [Step('a', 's', 1.0, done=1, total=2)]


def test_steps_that_repeat_for_weeks_stay_few() -> None:
    def line(kind: str, step: str, time: int) -> str:
        return json.dumps({'time': time, 'event': kind, 'machine': 'a', 'step': step,
                           'seconds': 1.0, 'detail': ''})

    steps = journal.Contents([
        line('started', 'boot', 0), line('done', 'boot', 1), line('started', 'image', 2),
        *(line(kind, 'repair', time) for time in range(9000) for kind in ('started', 'done')),
        *(line('failed', 'ticket', time) for time in range(9000))]).steps
    assert len(steps) <= journal.MOST + 1
    assert [step.step for step in steps[:3]] == ['boot', 'image', 'repair']
    assert [(step.step, step.begin) for step in steps[-2:]] == [
        ('repair', 8999.0), ('ticket', 8998.0)]


def test_step_that_only_failed_has_its_begin() -> None:
    line = ('{"time": 10, "machine": "a", "step": "left there", "event": "failed", '
            '"seconds": 2, "detail": "silent"}')
    assert journal.Contents([line]).steps == [
        Step('a', 'left there', 8.0, 'failed', 2.0, 'silent')]


@pytest.mark.parametrize(('steps', 'expected'), [
    ([], 'coming'),
    ([('machine', 'done'), ('agent', 'running')], 'coming'),
    ([('machine', 'failed'), ('undo', 'done')], 'ending'),
    ([('agent', 'done')], 'running'),
    ([('agent', 'done'), ('Python modules', 'failed')], 'running'),
    ([('agent', 'done'), ('delete', 'running')], 'ending'),
    ([('agent', 'done'), ('let go', 'done')], 'ending'),
    # a replacement, and the next offer of a cloud
    ([('machine', 'done'), ('agent', 'done'), ('delete', 'done'), ('machine', 'running')],
     'coming'),
    ([('machine', 'done'), ('agent', 'done'), ('delete', 'done'), ('machine', 'done'),
      ('agent', 'done')], 'running'),
    ([('machine', 'failed'), ('delete', 'done'), ('machine', 'done'), ('agent', 'done')],
     'running'),
    ([('machine', 'failed'), ('delete', 'done'), ('machine', 'failed')], 'ending'),
])
def test_phase_follows_from_the_steps(steps: list[tuple[str, str]], expected: str) -> None:
    assert phase(tuple(Step('a', name, 1.0, state) for name, state in steps)) == expected


def test_failure_that_is_not_fatal_ends_no_machine(tmp_path: Path) -> None:
    keep = Journal(silent, tmp_path)
    keep(StepDone('a', 'machine', 1.0, ''))
    keep(StepFailed('a', 'DDS filter', 0.0, 'no control groups', fatal=False))
    assert phase(tuple(read(tmp_path))) == 'coming'
    keep(StepDone('a', 'agent', 1.0, ''))
    assert phase(tuple(read(tmp_path))) == 'running'


@pytest.mark.parametrize(('words', 'expected'), [
    (['/usr/bin/python3', '/opt/ros/lib/p/talker', '--ros-args', '-r', '__node:=speaker'],
     'speaker'),
    (['/usr/bin/python3', '/opt/ros/lib/p/talker.py', '-x'], 'talker'),
    (['/opt/ros/lib/p/listener', '--ros-args', '-p', 'a:=/b'], 'listener'),
    (['sleep', '1'], ''), ([], '')])
def test_node_name_is_read_from_a_command_line(words: list[str], expected: str) -> None:
    assert node_name(words) == expected


def test_status_of_an_agent_is_shown() -> None:
    nodes = [{'id': 'a/b', 'name': 'b', 'state': 'exited', 'pid': None, 'returncode': -9,
              'restarts': 1}]
    answer = recorded_agent.answer('status', since=5.5, rss_kb=16, nodes=nodes)
    follower = SimpleNamespace(
        agent=events.answer('status', answer), vpn=None, problems={}, last=0)
    state = machine_json('a', Shown(Entry('a', 'memory'), cast(Any, follower)))
    assert state['agent'] == {'since': 5.5, 'rss': 16000, 'heartbeat_age': None}
    assert state['nodes'] == [{'name': 'b', 'state': 'exited', 'pid': 0, 'returncode': -9,
                               'restarts': 1, 'error': ''}]
    shown = screen.frame(machine(agent=state['agent'], nodes=state['nodes']), [], 1100.0)
    assert any('heartbeat -' in line for line in shown)


def test_rates_follow_from_two_counts() -> None:
    first = Link('198.18.0.2', 'fog1', received=1000.0, sent=50.0)
    before = {**rates(None, first, 10.0), **dataclasses.asdict(first)}
    assert (before['receiving'], before['sending']) == (None, None)
    second = dataclasses.replace(first, received=3000.0, sent=10.0)
    assert rates(before, second, 12.0) == {'at': 12.0, 'receiving': 1000.0, 'sending': None}
    assert rates(before, second, 10.1)['at'] == 10.0


def machine(**changes: Any) -> dict[str, Any]:
    return {
        'name': 'planner', 'provider': 'aws', 'id': 'i-1', 'state': 'running',
        'phase': 'running', 'launch': 'abc123', 'launch_pid': 7, 'launch_alive': True,
        'created': 1000.0, 'expires': 4600.0, 'ended': None, 'address': '198.51.100.7',
        'place': 'eu-central-1', 'kind': 'g4dn.xlarge', 'cost_per_hour': 3.6,
        'on_exit': 'delete', 'deleting': False, 'trouble': '', 'problems': [],
        'replicas': [],
        'log': 0, 'agent': {'since': 1010.0, 'rss': 14_000_000, 'heartbeat_age': 1.0},
        'clock': {'text': "70.0 ms ahead of the robot's"},
        'vpn': {'address': '198.18.0.2', 'interface': 'fogabc', 'received': 5e6, 'sent': 1e3,
                'latency': 20.5, 'receiving': 2e5, 'sending': None, 'handshake': 1090},
        'steps': [{'step': 'machine', 'state': 'done', 'seconds': 12.3, 'begin': 1000.0,
                   'detail': 'there', 'done': 0, 'total': 0},
                  {'step': 'workspace', 'state': 'running', 'seconds': None, 'begin': 1095.0,
                   'detail': '', 'done': 5_000_000, 'total': 10_000_000}],
        'nodes': [{'name': 'slam-1', 'state': 'running', 'pid': 12, 'returncode': -9,
                   'restarts': 2, 'error': None}], **changes}


def test_machine_is_drawn_on_a_screen() -> None:
    lines = [{'node': 'slam-1', 'text': f'line {n}'} for n in range(1, 100)]
    shown = screen.frame(machine(), lines, 1100.0, columns=90, rows=20)
    text = '\n'.join(shown)
    assert len(shown) == 20
    assert shown[0] == 'planner (aws i-1)  running  100 s  $0.1000 so far'
    assert 'handshake 10 s ago, round trip 20.50 ms' in text
    assert "70.0 ms ahead of the robot's" in text
    assert 'received 5.0 MB (200.0 kB/s), sent 1.0 kB' in text
    assert re.search(r'^workspace +running +5\.0 +5\.0 MB of 10\.0 MB$', text, re.MULTILINE)
    assert re.search(r'^slam-1 +running +12 +-9 +2$', text, re.MULTILINE)
    assert '58 min left' in text and shown[-1] == '[slam-1] line 99'
    assert [len(line) <= 30 for line in screen.frame(machine(), lines, 1100.0, columns=30,
                                                     rows=9)] == [True] * 9
    gone = machine(phase='gone', vpn=None, agent=None, steps=[], nodes=[], ended=1050.0,
                   launch_alive=False, cost_per_hour=None)
    assert screen.frame(gone, [], 1100.0)[0] == 'planner (aws i-1)  gone  50 s'


def test_topics_across_the_vpn_are_drawn() -> None:
    shown = '\n'.join(screen.frame(machine(
        streams=[{'topic': '/camera', 'transport': 'h264', 'source': '', 'target': 'planner',
                  'rate': 29.96, 'bandwidth': 81_000.0, 'share': 3.2e6, 'latency': 0.0123},
                 {'topic': '/map', 'transport': 'h264', 'source': 'one', 'target': 'two',
                  'rate': None, 'bandwidth': None}],
        topics=[{'topic': '/odom', 'from': ['planner', 'one'], 'to': [''], 'rate': None,
                 'bandwidth': None}]), [], 1100.0, rows=40))
    assert re.search(r'^/camera \(h264\) +robot +planner +30\.0 +81\.0 kB/s +3\.2 Mbit/s +12 ms$',
                     shown, re.MULTILINE)
    assert re.search(r'^/odom +planner, one +robot +- +- +- +-$', shown, re.MULTILINE)
    assert '/map' not in shown


def test_topics_option_needs_watch() -> None:
    assert 'is for --watch' in str(main(argv=['fog', 'status', 'planner', '--topics']))


def test_output_of_a_node_has_no_escape_sequences() -> None:
    bad = '\x1b]0;owned\x07\x1b[2J\x9b31mred\r\n'
    lines = [{'node': f'n{bad}', 'text': f'before {bad}after'}]
    shown = screen.frame(machine(problems=[bad], nodes=[
        {**machine()['nodes'][0], 'name': bad}]), lines, 1100.0, rows=40)
    assert 'owned' in '\n'.join(shown)
    for line in [*shown, screen.summary(machine(problems=[bad]))]:
        assert line.isprintable(), line


def test_summary_has_the_rarely_changing_parts() -> None:
    assert screen.summary(machine(phase='coming')) == (
        'planner: coming up; workspace running; slam-1 running, 2 restarts')


def test_watch_refuses_an_invalid_name() -> None:
    assert 'no name for a machine' in str(main(argv=['fog', 'status', '../up', '--watch']))


def test_running_step_of_an_ended_launch_is_done() -> None:
    running = Step('a', 'delete', 1.0)
    assert as_json(running)['state'] == 'running'
    assert as_json(running, ended=True)['state'] == 'done'
    json.dumps(as_json(running))


def test_watch_ends_with_the_reader_of_its_lines(tmp_path: Path) -> None:
    # as behind `| head -n 1`
    program = tmp_path / 'program.py'
    program.write_text('import sys\nfrom ros2cli.cli import main\n'
                       'sys.exit(main(argv=sys.argv[1:]))\n')
    words = f'{sys.executable} {program} fog status a --watch --json'
    done = subprocess.run(['sh', '-c', f'{words} | head -n 1'], capture_output=True, text=True,
                          timeout=30)
    assert json.loads(done.stdout) == {'version': 1, 'machine': None} and done.stderr == ''
