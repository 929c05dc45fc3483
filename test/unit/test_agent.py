# SPDX-License-Identifier: Apache-2.0
"""The agent's parts by value: the journal and its rotation, the watchdog, settings."""

from __future__ import annotations

import errno
import json
import os
import selectors
import socket
from types import SimpleNamespace

import pytest

from fogros2.agent import journal
from fogros2.agent.journal import Journal
from fogros2.agent.loop import boot_clock, Loop
from fogros2.agent.protocol import checked, CONFIG, Refused
from fogros2.agent.server import Agent
from fogros2.agent.watchdog import Heartbeats, Watchdog

HEARTBEAT = {'bind': '10.0.0.1', 'peer': '10.0.0.2', 'port': 7, 'key': 'ab' * 16}


def event(text: str) -> dict:
    return {'event': 'output', 'text': text}


def read(log: Journal, seq: int = 1) -> list[dict]:
    """Return all events from ``seq`` on, over the generations."""
    found, position = [], log.find(seq)
    while True:
        data, position = log.read(position)
        if not data:
            return found
        found += [json.loads(line) for line in data.splitlines()]


def test_event_is_found_by_its_number(tmp_path):
    log = Journal(str(tmp_path), 1 << 20)
    for number in range(500):
        log.append(event('x' * (number * 7 % 300)))
    for seq in (1, 2, 3, 77, 250, 499, 500):
        assert [e['seq'] for e in read(log, seq)] == list(range(seq, 501))
    assert log.read(log.find(501))[0] == b''


@pytest.mark.parametrize('size', [journal.BLOCK - 100, 3 * journal.BLOCK])
def test_event_is_found_beyond_a_block(tmp_path, size):
    log = Journal(str(tmp_path), 1 << 24)
    for extra in range(0, 40, 8):
        log.append(event('x' * (size + extra)))
        log.append(event('short'))
    for seq in range(1, 11):
        data, _ = log.read(log.find(seq))
        assert json.loads(data.splitlines()[0])['seq'] == seq


def test_lost_event_is_searched_from_the_oldest(tmp_path):
    log = Journal(str(tmp_path), 1 << 20)
    log.append(event('here'))
    log.next = 5  # a full disk has lost the events between
    log.append(event('later'))
    assert [e['seq'] for e in read(log, 3)] == [1, 5]


def test_rotation_keeps_two_generations_and_the_numbers(tmp_path):
    log = Journal(str(tmp_path), 4096)
    for number in range(300):
        log.append(event(str(number)))
        assert sum(p.stat().st_size for p in tmp_path.iterdir()) <= 2 * 4096
    assert log.next == 301 and log.first > 1
    assert [e['seq'] for e in read(log)] == list(range(log.first, 301))


def test_restarted_agent_continues_the_journal(tmp_path):
    log = Journal(str(tmp_path), 4096)
    for number in range(100):
        log.append(event(str(number)))
    again = Journal(str(tmp_path), 4096)
    assert (again.first, again.next) == (log.first, log.next)
    again.append(event('more'))
    assert read(again)[-1]['seq'] == log.next
    again.rotate(again.next)
    later = Journal(str(tmp_path), 4096)
    assert (later.first, later.next) == (again.first, again.next)


def test_torn_line_is_cut(tmp_path):
    log = Journal(str(tmp_path), 1 << 20)
    log.append(event('whole'))
    with open(tmp_path / 'events.jsonl', 'ab') as stream:
        stream.write(b'{"seq":2,"time":1,"ev')
    again = Journal(str(tmp_path), 1 << 20)
    assert again.next == 2
    again.append(event('next'))
    assert [e['text'] for e in read(again)] == ['whole', 'next']


def test_damaged_journal_does_not_stop_the_agent(tmp_path):
    (tmp_path / 'events.jsonl').write_bytes(os.urandom(5000) + b'\n')
    log = Journal(str(tmp_path), 1 << 20)
    log.append(event('here'))
    assert b'"here"' in log.read(log.find(1))[0]


def test_symbolic_link_as_journal_is_not_followed(tmp_path):
    (tmp_path / 'target').write_text('precious')
    (tmp_path / 'events.jsonl').symlink_to(tmp_path / 'target')
    with pytest.raises(OSError):
        Journal(str(tmp_path), 1 << 20)
    assert (tmp_path / 'target').read_text() == 'precious'


def test_long_lines_are_read_whole(tmp_path):
    log = Journal(str(tmp_path), 1 << 26)
    log.append(event('x' * (3 << 20)))
    log.append(event('y'))
    assert [len(e['text']) for e in read(log)] == [3 << 20, 1]
    assert [e['seq'] for e in read(log, 2)] == [2]


def test_full_disk_loses_only_events(tmp_path, capsys):
    log = Journal(str(tmp_path), 1 << 20)
    os.close(log.files[0].fd)
    log.files[0].fd = os.open('/dev/full', os.O_RDWR)
    log.append(event('lost'))
    log.append(event('lost too'))
    assert capsys.readouterr().err.count('events are being lost') == 1
    assert log.next == 3


def test_small_disk_gets_a_small_journal(tmp_path, monkeypatch):
    monkeypatch.setattr(os, 'statvfs', lambda path: SimpleNamespace(f_blocks=8, f_frsize=4096))
    log = Journal(str(tmp_path), 1 << 20)
    for number in range(300):
        log.append(event(str(number)))
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 2 * 4096


@pytest.mark.parametrize('room', [3000, 6000])
def test_full_disk_keeps_the_newest_events(tmp_path, monkeypatch, room):
    """Which something else has filled up, to less than the journal's two generations."""
    write = os.write

    def full(fd, data):
        taken = sum(path.stat().st_size for path in tmp_path.iterdir())
        if taken >= room:
            raise OSError(errno.ENOSPC, 'No space left on device')
        return write(fd, data[:room - taken])

    monkeypatch.setattr(os, 'write', full)
    log = Journal(str(tmp_path), 4096)
    live = 0
    for number in range(1000):
        position = log.find(log.next)
        log.append(event(str(number)))
        live += bool(log.read(position)[0])
    assert read(log)[-1]['seq'] == log.next - 1 == 1000
    # a follower misses few
    assert live > 950


def test_large_event_is_kept_on_a_full_disk(tmp_path, monkeypatch):
    write = os.write

    def full(fd, data):
        if sum(path.stat().st_size for path in tmp_path.iterdir()) + len(data) > 3000:
            raise OSError(errno.ENOSPC, 'No space left on device')
        return write(fd, data)

    monkeypatch.setattr(os, 'write', full)
    log = Journal(str(tmp_path), 4096)
    for size in (2500, 2500, 2500, 10):
        log.append(event('x' * size))
    assert read(log)[-1]['seq'] == 4


def config(**more):
    return {**{key: default for key, (_, default) in CONFIG.items()},
            'lifetime': 1000.0, 'robot_timeout': 10.0, 'boot_timeout': 100.0, **more}


def test_machine_without_launch_ends_after_boot_timeout():
    dog = Watchdog(config(), 5.0)
    assert dog.due(104.9) is None
    assert dog.due(105.0) == 'no launch came'
    dog.configured(90.0, heartbeat=False)
    assert dog.due(189.0) is None
    assert dog.due(190.0) == 'no launch came'


def test_robot_timeout_begins_with_the_heartbeat_configuration():
    dog = Watchdog(config(), 0.0)
    dog.configured(50.0, heartbeat=True)
    assert dog.due(59.9) is None
    assert dog.due(60.0) == 'robot gone'
    dog.beat(1, 59.0)
    assert dog.due(68.9) is None
    assert dog.due(69.0) == 'robot gone'
    assert dog.due(500.0) == 'robot gone'


def test_lifetime_ends_machine_despite_heartbeats():
    dog = Watchdog(config(), 0.0)
    dog.configured(0.0, heartbeat=True)
    for second in range(0, 1000, 5):
        dog.beat(second, float(second))
        assert dog.due(float(second)) is None
    dog.beat(1001, 1000.0)
    assert dog.due(1000.0) == 'lifetime'
    dog.configured(1000.0, heartbeat=True)
    assert dog.due(1000.0) is None
    dog.disarm()
    assert dog.due(1999.9) is None
    assert dog.due(2000.0) == 'lifetime'


@pytest.mark.parametrize(('settings', 'seconds', 'reasons'), [
    ({'heartbeat': HEARTBEAT}, 300.0, []),  # robot_timeout is 10 s
    ({}, 300.0, []),  # boot_timeout is 100 s
    ({'heartbeat': HEARTBEAT}, 2000.0, ['lifetime'])])
def test_suspended_machine_waits_anew_for_its_launch(tmp_path, settings, seconds, reasons):
    agent = Agent(config(directory=str(tmp_path), **settings))
    emitted, suspended = [], 0.0
    agent.emit = emitted.append
    agent.loop.clock = lambda: boot_clock() + suspended
    agent._restart_watchdog()
    agent._watch()
    suspended = seconds
    agent._watch()
    assert [e['reason'] for e in emitted] == reasons


def test_late_heartbeat_does_not_rearm_the_watchdog():
    dog = Watchdog(config(), 0.0)
    dog.configured(0.0, heartbeat=True)
    dog.disarm()
    dog.beat(1, 1.0)
    assert dog.beat_at is None
    assert dog.deadlines() == [(1000.0, 'lifetime')]


def test_heartbeat_behind_a_release_is_dropped(free_udp_port):
    loop, settings = Loop(), config(heartbeat={
        **HEARTBEAT, 'bind': '127.0.0.1', 'port': free_udp_port})
    beats = Heartbeats(loop, settings, Watchdog(settings, 0.0), lambda: None)
    beats.open()
    robot, machine = socket.socketpair()
    with robot, machine, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        def release(mask):
            settings['heartbeat'] = None
            beats.open()

        loop.select(machine, selectors.EVENT_READ, release)
        robot.send(b'release')
        other.sendto(b'beat', ('127.0.0.1', free_udp_port))
        loop.turn(loop.clock())
        assert beats.socket is None


def test_configuring_without_heartbeat_keeps_the_deadline():
    dog = Watchdog(config(), 0.0)
    dog.configured(0.0, heartbeat=True)
    dog.configured(5.0, heartbeat=False)
    assert dog.due(10.0) == 'robot gone'


def test_restarted_agent_continues_the_deadlines():
    dog, again = Watchdog(config(), 5.0), Watchdog(config(), 60.0)
    dog.configured(50.0, heartbeat=True)
    dog.beat(7, 52.0)
    again.resume(json.loads(json.dumps(dog.state)), 60.0)
    assert again.deadlines() == dog.deadlines() == [(62.0, 'robot gone'), (1050.0, 'lifetime')]
    assert again.number == 7


def test_deadline_of_a_clock_before_a_reboot_counts_as_now():
    dog = Watchdog(config(), 3.0)
    dog.resume([7, 90000.0, None, 90000.0], 3.0)
    assert dog.deadlines() == [(13.0, 'robot gone'), (1003.0, 'lifetime')]


@pytest.mark.parametrize('state', [
    7, [], [1, 2.0, 3.0], [1, None, None, None], ['x', 1.0, None, None], [1, 'x', None, None],
    [float('inf'), 1.0, None, None]])
def test_damaged_state_of_a_watchdog_is_refused(state):
    with pytest.raises((OverflowError, TypeError, ValueError)):
        Watchdog(config(), 3.0).resume(state, 3.0)


@pytest.mark.parametrize('settings', [
    {'lifetime': 0}, {'lifetime': float('nan')}, {'lifetime': float('inf')}, {'lifetime': True},
    {'lifetime': '8'}, {'on_exit': 'burn'}, {'end_command': 'shutdown'}, {'end_command': [3]},
    {'environment': {'A': 3}}, {'environment': {'': 'x'}}, {'environment': {'A': 'x\0'}},
    {'heartbeat': {**HEARTBEAT, 'port': 0}}, {'heartbeat': {**HEARTBEAT, 'port': '7'}},
    {'heartbeat': {**HEARTBEAT, 'port': 5.5}},
    {'heartbeat': {**HEARTBEAT, 'bind': 'name'}}, {'heartbeat': {**HEARTBEAT, 'key': 'ab' * 15}},
    {'heartbeat': {**HEARTBEAT, 'key': None}}, {'heartbeat': {**HEARTBEAT, 'key': 'secret'}},
    {'heartbeat': [1]}, {'machine': 7}, {'log_bytes': -1},
])
def test_invalid_settings_are_refused(settings):
    with pytest.raises(Refused):
        checked(settings)


def test_settings_of_a_newer_robot_are_ignored():
    assert checked({'new': 1, 'id': 3, 'machine': 'x', 'heartbeat': HEARTBEAT}) == {
        'machine': 'x', 'heartbeat': HEARTBEAT}


def test_end_of_the_machine_is_tried_until_it_ends(tmp_path, monkeypatch):
    """Such as by a cloud's API that does not answer at first: else it runs and costs on."""
    agent = Agent({'directory': str(tmp_path / 'agent'), 'end_command': ['end-me']})
    ran, later = [], []
    monkeypatch.setattr(agent.processes, 'spawn', lambda argv, then, **_: (
        ran.append(argv), then(1)))
    monkeypatch.setattr(agent.loop, 'at', lambda seconds, call: later.append((seconds, call)))
    monkeypatch.setattr(agent, 'emit', lambda event: None)
    agent._end_machine()
    for _ in range(3):
        (seconds, again), = later
        later.clear()
        assert seconds <= 60.0
        again()
    assert ran == 4 * [['end-me']]


@pytest.mark.parametrize(('adopted', 'action'), [
    (False, 'end the machine'), (True, 'stop the nodes')])
def test_machine_whose_first_launch_died_is_not_kept(tmp_path, monkeypatch, adopted, action):
    """It may not even be complete; one that a later launch took over is."""
    agent = Agent({'directory': str(tmp_path / 'agent'), 'on_exit': 'keep', 'boot_timeout': 60.0,
                   'end_command': ['end-me']})
    agent.adopted, events = adopted, []
    monkeypatch.setattr(agent, 'emit', events.append)
    monkeypatch.setattr(agent.nodes, 'stop_all', lambda then: None)
    agent._watch()
    assert events == []
    agent.watchdog.boot_from -= 61.0
    agent._watch()
    assert events == [{'event': 'watchdog', 'reason': 'no launch came', 'action': action}]
    assert agent.ending != adopted
