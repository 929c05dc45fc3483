# SPDX-License-Identifier: Apache-2.0
"""The agent's parts by value: the log and its rotation, the watchdog's arithmetic, settings."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from fogros2 import agent
from fogros2.agent import boot_clock, checked, CONFIG, Log, Refused, Watchdog
from fogros2.agent_client import agent_source


def event(text: str) -> bytes:
    return agent.dump({'event': 'output', 'text': text})[1:]


def read(log: Log, seq: int = 1) -> list[dict]:
    """Return all events from ``seq`` on, over the generations."""
    found, at = log.locate(seq)
    lines = found.read(at)
    data = b''
    index = log.files.index(found)
    while True:
        data += lines
        at += len(lines)
        lines = log.files[index].read(at)
        if not lines:
            index, at = index + 1, 0
            if index == len(log.files):
                return [json.loads(line) for line in data.splitlines()]
            lines = log.files[index].read(0)


def test_events_are_numbered_and_found_by_their_number(tmp_path):
    log = Log(str(tmp_path), 1 << 20)
    for number in range(500):
        log.append([event('x' * (number * 7 % 300))])
    for seq in (1, 2, 3, 77, 250, 499, 500):
        file, offset = log.locate(seq)
        assert json.loads(file.read(offset).splitlines()[0])['seq'] == seq
    file, offset = log.locate(501)
    assert file.read(offset) == b''
    assert [e['seq'] for e in read(log, 490)] == list(range(490, 501))


def test_the_log_is_private(tmp_path):
    Log(str(tmp_path), 1 << 20)
    assert (tmp_path / 'events.jsonl').stat().st_mode & 0o777 == 0o600


def test_rotation_keeps_two_generations_and_the_numbers_go_on(tmp_path):
    log = Log(str(tmp_path), 4096)
    for number in range(300):
        log.append([event(str(number)), event('second')])
        assert sum(p.stat().st_size for p in tmp_path.iterdir()) <= 2 * 4096
    assert log.next == 601 and log.first > 1
    assert [e['seq'] for e in read(log)] == list(range(log.first, 601))


def test_a_log_goes_on_after_a_restart_of_its_agent(tmp_path):
    log = Log(str(tmp_path), 4096)
    for number in range(100):
        log.append([event(str(number))])
    again = Log(str(tmp_path), 4096)
    assert (again.first, again.next) == (log.first, log.next)
    again.append([event('more')])
    assert read(again)[-1]['seq'] == log.next


def test_right_after_a_rotation_a_restart_still_knows_the_number(tmp_path):
    log = Log(str(tmp_path), 4096)
    for number in range(100):
        log.append([event(str(number))])
    log._rotate(log.next)
    again = Log(str(tmp_path), 4096)
    assert again.next == log.next and again.first == log.first


def test_a_torn_line_is_cut(tmp_path):
    log = Log(str(tmp_path), 1 << 20)
    log.append([event('whole')])
    with open(tmp_path / 'events.jsonl', 'ab') as stream:
        stream.write(b'{"seq":2,"time":1,"ev')
    again = Log(str(tmp_path), 1 << 20)
    assert again.next == 2
    again.append([event('next')])
    assert [e['text'] for e in read(again)] == ['whole', 'next']


def test_a_log_that_something_else_was_written_to_does_not_stop_the_agent(tmp_path):
    (tmp_path / 'events.jsonl').write_bytes(os.urandom(5000) + b'\n')
    log = Log(str(tmp_path), 1 << 20)
    log.append([event('here')])
    file, offset = log.locate(1)
    assert b'"here"' in file.read(offset)


def test_a_link_in_the_place_of_the_log_is_not_followed(tmp_path):
    (tmp_path / 'target').write_text('precious')
    (tmp_path / 'events.jsonl').symlink_to(tmp_path / 'target')
    with pytest.raises(OSError):
        Log(str(tmp_path), 1 << 20)
    assert (tmp_path / 'target').read_text() == 'precious'


def test_long_lines_are_read_whole(tmp_path):
    log = Log(str(tmp_path), 1 << 26)
    log.append([event('x' * (3 << 20)), event('y')])
    file, offset = log.locate(1)
    first = file.read(offset)
    assert json.loads(first.splitlines()[0])['text'] == 'x' * (3 << 20)
    assert log.locate(2)[0].seq_at(log.locate(2)[1]) == 2


def test_a_full_disk_loses_events_and_nothing_else(tmp_path, capsys):
    log = Log(str(tmp_path), 1 << 20)
    os.close(log.files[0].fd)
    log.files[0].fd = os.open('/dev/full', os.O_RDWR)
    log.append([event('lost')])
    log.append([event('lost too')])
    assert capsys.readouterr().err.count('events are being lost') == 1
    assert log.next == 3


def config(**more):
    return {**{key: default for key, (_, default) in CONFIG.items()},
            'lifetime': 1000.0, 'robot_timeout': 10.0, 'boot_timeout': 100.0, **more}


def test_without_a_launch_the_machine_ends_after_boot_timeout():
    dog = Watchdog(config(), 5.0)
    assert dog.due(104.9) is None
    assert dog.due(105.0) == 'no launch came'


def test_a_launch_that_configures_gets_the_time_to_install():
    dog = Watchdog(config(), 0.0)
    dog.configured(90.0, heartbeat=False)
    assert dog.due(189.0) is None
    assert dog.due(190.0) == 'no launch came'


def test_from_the_heartbeats_configuration_on_the_robot_timeout_counts():
    dog = Watchdog(config(), 0.0)
    dog.configured(50.0, heartbeat=True)
    assert dog.due(59.9) is None
    assert dog.due(60.0) == 'robot gone'
    dog.beat(59.0)
    assert dog.due(68.9) is None
    assert dog.due(69.0) == 'robot gone'
    assert dog.due(500.0) == 'robot gone'


def test_the_lifetime_ends_a_machine_whatever_beats_and_begins_anew_with_a_launch():
    dog = Watchdog(config(), 0.0)
    dog.configured(0.0, heartbeat=True)
    for second in range(0, 1000, 5):
        dog.beat(float(second))
        assert dog.due(float(second)) is None
    dog.beat(1000.0)
    assert dog.due(1000.0) == 'lifetime'
    dog.configured(1000.0, heartbeat=True)
    assert dog.due(1000.0) is None
    dog.disarm()
    assert dog.due(1999.9) is None
    assert dog.due(2000.0) == 'lifetime'


def test_a_late_heartbeat_does_not_rearm_what_was_disarmed():
    dog = Watchdog(config(), 0.0)
    dog.configured(0.0, heartbeat=True)
    dog.disarm()
    dog.beat(1.0)
    assert dog.beat_at is None
    assert dog.deadlines() == [(1000.0, 'lifetime')]


def test_a_launch_without_heartbeat_does_not_bring_back_the_wait_for_one():
    dog = Watchdog(config(), 0.0)
    dog.configured(0.0, heartbeat=True)
    dog.configured(5.0, heartbeat=False)
    assert dog.due(10.0) == 'robot gone'


def test_the_clock_counts_sleep():
    assert abs(boot_clock() - float(open('/proc/uptime').read().split()[0])) < 5.0


@pytest.mark.parametrize('settings', [
    {'lifetime': 0}, {'lifetime': float('nan')}, {'lifetime': float('inf')}, {'lifetime': True},
    {'lifetime': '8'}, {'on_exit': 'burn'}, {'end_command': 'shutdown'}, {'end_command': [3]},
    {'environment': {'A': 3}}, {'environment': {'': 'x'}}, {'environment': {'A': 'x\0'}},
    {'heartbeat': {'bind': '10.0.0.1', 'peer': '10.0.0.2', 'port': 0}},
    {'heartbeat': {'bind': '10.0.0.1', 'peer': '10.0.0.2', 'port': '7'}},
    {'heartbeat': {'bind': 'name', 'peer': '10.0.0.2', 'port': 7}},
    {'heartbeat': [1]}, {'machine': 7}, {'log_bytes': -1},
])
def test_settings_that_make_no_sense_are_refused(settings):
    with pytest.raises(Refused):
        checked(settings)


def test_settings_of_a_newer_robot_are_ignored():
    assert checked({'new': 1, 'id': 3, 'machine': 'x', 'heartbeat': None}) == {
        'machine': 'x', 'heartbeat': None}


def test_words_are_quoted_as_a_shell_reads_them():
    words = ['plain', "it's", '$HOME `x` "y"', '', 'a\nb']
    line = 'printf "%s\\0" ' + ' '.join(agent.quoted(word) for word in words)
    output = subprocess.run(['sh', '-c', line], capture_output=True, check=True).stdout
    assert output.decode().split('\0')[:-1] == words


def test_a_tree_is_removed_and_links_are_not_followed(tmp_path):
    outside = tmp_path / 'outside'
    outside.mkdir()
    (outside / 'file').write_text('stays')
    tree = tmp_path / 'tree'
    (tree / 'folder').mkdir(parents=True)
    (tree / 'folder' / 'file').write_text('')
    (tree / 'link').symlink_to(outside)
    (tree / 'loose').symlink_to('/nowhere')
    agent.remove_tree(str(tree))
    assert not tree.exists() and (outside / 'file').exists()


def test_it_needs_the_standard_library_alone():
    code = ('import sys; sys.path.insert(0, sys.argv[1]); import agent; '
            'extra = {m.split(".")[0] for m in sys.modules} - set(sys.stdlib_module_names); '
            'print(sorted(extra - {"agent", "__main__"}))')
    done = subprocess.run(
        [sys.executable, '-IS', '-c', code, str(agent_source().parent)],
        capture_output=True, text=True, check=True)
    assert done.stdout.strip() == '[]'


def test_a_wrong_command_line_shows_the_right_one():
    done = subprocess.run([sys.executable, str(agent_source()), 'fly'], capture_output=True)
    assert done.returncode == 2 and done.stderr.startswith(b'usage: ')
