# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog wait``, ``bugreport``, ``ssh-config`` and ``--version``."""

from __future__ import annotations

import dataclasses
import io
import json
import os
from pathlib import Path
import subprocess
import sys
import threading
from typing import Any
import xml.etree.ElementTree as ElementTree

import pytest
from ros2cli.cli import main

from fogros2 import process, waiting
from fogros2.model import Endpoint, Machine, MachineSpec, MachineState
from fogros2.provider import TAG_NAME, TAG_ROBOT
from fogros2.store import process_start, Record, robot_name, Store, this_process
from fogros2_testing.fakes import MemoryProvider
from fogros2_testing.plugins import instead
from ros2fog_cli.api import awaiting, bugreport, output, reach, ssh_settings
from ros2fog_cli.api.doctor import Check

ROOT = Path(__file__).parents[2]
#: Texts that no report may have, by how they get to this computer.
PLANTED = {
    'AWS_SECRET_ACCESS_KEY': 'wJalrXUtnFEMI/K7MDENG/bPxRfiCYEXAMPLEKEY',
    'FOGROS2_GCP_API_KEY': 'AIzaSyplantedplantedplantedplanted01234',
    'MY_PASSWORD': 'correct-horse-battery',
    'key': '-----BEGIN OPENSSH PRIVATE KEY-----\nb3BlbnNzaC1rZXktdjEAAAAABG5vbm\nmVzaXRpb24K\n',
    'vpn': 'yAnz5TF+lXXJte14tji3zlMNq+hd2rYUIgJBgB3fBmk=',
    'door': '8f434346648f6b96df89dda901c5176b10a6d83961dd3c1ac88b59b2dc327aa4',
    'node': 'the node says: open sesame',
    'of a machine': 'variable-of-a-node',
}


@pytest.fixture(autouse=True)
def memory(monkeypatch: pytest.MonkeyPatch) -> None:
    MemoryProvider.machines = {}
    instead(monkeypatch, 'fogros2.provider', {'memory': MemoryProvider})


def run(*words: str) -> Any:
    return main(argv=['fog', *words])


def machine(name: str, **changes: Any) -> Machine:
    made = Machine(f'id-{name}', name, 'memory', MachineState.RUNNING,
                   endpoint=Endpoint('ssh', '198.51.100.7', 2200, 'fog', 'ssh-ed25519 AAAA'),
                   tags={TAG_NAME: name, TAG_ROBOT: robot_name()})
    made = dataclasses.replace(made, **changes)
    MemoryProvider.machines[made.id] = made
    return made


def record(name: str, *, alive: bool = True, **changes: Any) -> Record:
    found = Record(name, 'memory', MachineSpec(name, 'memory'), machine_id=f'id-{name}',
                   launch='abc123', pid=os.getpid() if alive else 1,
                   pid_start=process_start(os.getpid()) or 0)
    return Store().save(dataclasses.replace(found, **changes))


def steps(*lines: tuple[str, str, str]) -> None:
    """Write a journal of the launch: machine, step and event."""
    path = Store().launch_folder('abc123') / 'steps.jsonl'
    path.write_text(''.join(json.dumps({
        'time': 1.0, 'machine': name, 'step': step, 'event': event, 'seconds': 1.0, 'detail': ''})
        + '\n' for name, step, event in lines))


def test_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert run('--version') == 0
    version = ElementTree.parse(ROOT / 'package.xml').findtext('version')
    assert capsys.readouterr().out == f'fogros2 {version}\n'


# -- wait -----------------------------------------------------------------------------------------


def test_wait_ends_when_the_machine_is_up() -> None:
    status: list[Any] = []
    waits = threading.Thread(target=lambda: status.append(run('wait', 'a', '--timeout', '20')))
    waits.start()
    record('a')
    steps(('a', 'create', 'done'), ('b', 'agent', 'done'))
    waiting.wait_until(lambda: "waiting for 'a'" in waiting.everything(), timeout=60.0,
                       what='the wait')
    assert status == []
    steps(('a', 'create', 'done'), ('a', 'agent', 'done'))
    waits.join(60.0)
    assert status == [0]


def test_wait_fails_when_the_launch_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = threading.Event()
    monkeypatch.setattr(
        awaiting.journal, 'read', lambda folder: seen.set() or awaiting.journal.Contents())
    record('a')
    status: list[Any] = []
    waits = threading.Thread(target=lambda: status.append(run('wait', 'a', '--timeout', '20')))
    waits.start()
    assert seen.wait(60.0)
    Store().delete('a')
    waits.join(60.0)
    assert "the launch of 'a' ended before it was up" in status[0]


def test_wait_goes_on_while_a_launch_replaces_the_machine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks: list[str] = []
    recorded = awaiting.machines.recorded

    def look(store: Store, name: str) -> dict[str, Record]:
        looks.append(name)
        if len(looks) == 2:
            store.delete('a')
        elif len(looks) == 3:
            steps(('a', 'delete', 'done'), ('a', 'machine', 'done'), ('a', 'agent', 'done'))
            record('a')
        return recorded(store, name)

    monkeypatch.setattr(awaiting.machines, 'recorded', look)
    record('a')
    steps(('a', 'machine', 'failed'))
    (Store().launch_folder('abc123') / 'process.json').write_text(
        json.dumps(this_process()))
    assert run('wait', 'a', '--timeout', '20') == 0 and len(looks) == 3


def test_wait_fails_after_its_time() -> None:
    assert "timed out after 0 s waiting for 'a'" in run('wait', 'a', '--timeout', '0')
    machine('a')
    assert 'ros2 fog delete a' in run('wait', 'a', '--gone', '--timeout', '0')


def test_wait_for_the_end_asks_the_provider() -> None:
    assert run('wait', 'a', '--gone', '--timeout', '0') == 0
    machine('a', tags={TAG_NAME: 'a', TAG_ROBOT: 'another-1'})
    assert run('wait', 'a', '--gone', '--timeout', '0') == 0
    record('a', alive=False)
    assert 'the end of' in run('wait', 'a', '--gone', '--timeout', '0')


# -- bugreport ------------------------------------------------------------------------------------


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return ROS 2's folder of logs on a computer that is full of secrets."""
    for name in ('AWS_SECRET_ACCESS_KEY', 'FOGROS2_GCP_API_KEY', 'MY_PASSWORD'):
        monkeypatch.setenv(name, PLANTED[name])
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    record('a', spec=MachineSpec('a', 'memory', options={'key': PLANTED['key']},
                                 environment={'NODE_SETTING': PLANTED['of a machine']}))
    for name, text in (('id_ed25519', 'key'), ('vpn.key', 'vpn'), ('door.key', 'door')):
        (Store().machine('a') / name).write_text(PLANTED[text])
    steps(('a', 'create', 'done'))
    log = tmp_path / 'log'
    (log / 'latest').mkdir(parents=True)
    (log / 'latest' / 'launch.log').write_text('\n'.join([
        '1700000000.1000000 [INFO] [launch]: All log files are below here',
        '1700000000.2000000 [INFO] [fogros2]: a: create 2.00 s',
        f"1700000000.3100000 [INFO] [talker-1]: {PLANTED['node']}",
        'password is next',
        f"1700000000.3200000 [WARNING] [fogros2]: {PLANTED['vpn']} {PLANTED['door']}",
        'it goes on',
        f"1700000000.3400000 [ERROR] [fogros2]: {PLANTED['MY_PASSWORD']} {PLANTED['key']}",
        f"1700000000.3500000 [ERROR] [fogros2]: secret_key='{PLANTED['AWS_SECRET_ACCESS_KEY']}'",
        f'1700000000.3600000 [INFO] [fogros2]: file {Path.home()}/ws/install/a/b/c/setup.py']))
    return log


def test_bugreport_has_what_it_needs_and_no_secret(planted: Path) -> None:
    text = bugreport.report([Check('state folder', 'ok', f'{Path.home()}/x')], Store(),
                            os.environ, planted)
    assert [name for name, secret in PLANTED.items()
            if any(part in text for part in secret.split('\n') if part)] == []
    assert 'password is next' not in text
    for line in ('[ok] state folder: ~/x', 'ROS_DOMAIN_ID=7', 'a: create done 1.00 s',
                 'a: memory, on_exit=delete, bootstrap=auto, its launch runs',
                 '[INFO] [fogros2]: a: create 2.00 s', 'FOGROS2_GCP_API_KEY=[hidden]',
                 '[INFO] [fogros2]: file ~/ws/install/a/b/c/setup.py', 'it goes on',
                 f'Python {sys.version.split()[0]}'):
        assert line in text, text


def test_bugreport_is_printed_without_a_log(capsys: pytest.CaptureFixture[str]) -> None:
    assert run('bugreport') == 0
    said = capsys.readouterr()
    assert '## Checks' in said.out and '## Last launch' in said.out
    assert 'read it before you send it' in said.err


# -- ssh-config -----------------------------------------------------------------------------------


@pytest.mark.skipif(process.which('ssh') is None, reason='OpenSSH is not installed')
def test_ssh_reads_the_settings_of_a_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv('FOGROS2_STATE_HOME', str(tmp_path / 'a 100% new folder'))
    monkeypatch.setenv('HOME', str(tmp_path))
    key = str(tmp_path / 'a key%h')
    machine('a')
    record('a', endpoint=Endpoint('ssh', '203.0.113.1', 22, 'ubuntu', 'ssh-ed25519 AAAA', key))
    assert run('ssh-config', 'a') == 0
    line = capsys.readouterr().out.splitlines()[-1]
    config = tmp_path / 'config'
    config.write_text(f'{line}\nHost b\n    Port 7\n')

    def settings(name: str) -> dict[str, str]:
        said = subprocess.run(['ssh', '-F', config, '-G', name], capture_output=True, text=True,
                              check=True).stdout
        return dict(row.partition(' ')[::2] for row in said.splitlines())

    found = settings('a')
    # where the provider says, as whom and with what the record says
    assert (found['hostname'], found['port'], found['user']) == ('198.51.100.7', '2200', 'ubuntu')
    assert found['identityfile'].replace('%%', '%') == key and found['identitiesonly'] == 'yes'
    assert found['hostkeyalias'] == 'fogros2-a' and found['stricthostkeychecking'] in (
        'yes', 'true')
    assert (Store().machine('a') / 'known_hosts').read_text() == 'fogros2-a ssh-ed25519 AAAA\n'
    assert settings('b')['port'] == '7'
    # the settings end with the machine
    Store().delete('a')
    assert settings('a')['hostname'] == 'a'


def test_machine_that_ends_meanwhile_leaves_no_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    def settings(name: str, *others: object) -> str:
        Store().delete(name)
        return 'Host a\n'

    monkeypatch.setattr(ssh_settings, 'settings', settings)
    machine('a')
    record('a', endpoint=Endpoint('ssh', '203.0.113.1', 22, 'ubuntu', 'ssh-ed25519 AAAA'))
    assert run('ssh-config', 'a') == 1
    assert Store().machines() == []


def test_line_for_ssh_is_shown_until_it_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv('HOME', str(tmp_path))
    assert run('ssh-config') == 0
    line = capsys.readouterr().out.splitlines()[-1]
    assert line == ssh_settings.include(Store())
    (tmp_path / '.ssh').mkdir()
    (tmp_path / '.ssh/config').write_text(f'  {line}\n')
    assert run('ssh-config') == 0
    assert capsys.readouterr().out == ''


@pytest.mark.parametrize('changes', [
    {'host': '198.51.100.7\n    ProxyCommand id'}, {'user': 'fog\n    PermitLocalCommand yes'},
    {'user': 'fog evil'}, {'host_key': 'ssh-ed25519 AAAA\n* ssh-ed25519 BBBB'}])
def test_machine_adds_no_settings_of_its_own(
    changes: dict[str, Any], capsys: pytest.CaptureFixture[str],
) -> None:
    machine('a', endpoint=dataclasses.replace(
        Endpoint('ssh', '198.51.100.7', 22, 'fog', 'ssh-ed25519 AAAA'), **changes))
    record('a')
    assert run('ssh-config', 'a') == 1
    assert 'that ssh would misread' in capsys.readouterr().err
    assert not (Store().machine('a') / 'ssh_config').exists()
    assert not (Store().machine('a') / 'known_hosts').exists()


def test_machine_without_ssh_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    machine('pod', endpoint=Endpoint('kubernetes', 'pod'))
    record('pod')
    assert run('ssh-config', 'pod') == 1
    assert "'pod' has no SSH server that this computer reaches (ros2 fog connect pod)" \
        in capsys.readouterr().err
    assert run('ssh-config') == 0
    assert run('ssh-config', 'nobody') == 1


# -- output that can not be written ---------------------------------------------------------------

def test_output_that_is_lost_is_one_line(tmp_path: Path) -> None:
    env = {**os.environ, 'HOME': str(tmp_path)}

    def fog(stdout: Any, *words: str) -> tuple[int, str]:
        done = subprocess.run(['ros2', 'fog', *words], stdout=stdout, stderr=subprocess.PIPE,
                              text=True, env=env, timeout=60)
        return done.returncode, done.stderr

    with open('/dev/full', 'w') as full:
        assert fog(full, '--version') == (1, "can't write the output: No space left on device\n")
    end, pipe = os.pipe()
    os.close(end)
    try:
        assert fog(pipe, 'list', '--json') == (1, '')
    finally:
        os.close(pipe)
    # without standard streams, as a service may start it
    done = subprocess.run(['sh', '-c', 'exec ros2 fog --version <&- >&- 2>&-'], env=env,
                          timeout=60)
    assert done.returncode == 0


def test_character_that_the_terminal_lacks_ends_no_verb(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = io.BytesIO()
    monkeypatch.setattr('sys.stdout', io.TextIOWrapper(shown, 'latin-1'))
    with output.cleaned():
        print('[planner] ✓ fähig', flush=True)
    assert shown.getvalue() == b'[planner] \\u2713 f\xe4hig\n'


def test_round_trip_is_read_from_a_translated_ping(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / 'ping').write_text(
        '#!/bin/sh\n[ "$LC_ALL" = C ] && word=time || word=Zeit\n'
        'for each in 0.9 0.412 0.3; do echo "64 bytes from $8: icmp_seq=1 $word=$each ms"; done\n')
    (tmp_path / 'ping').chmod(0o755)
    monkeypatch.setitem(process._ENVIRONMENT, 'PATH', f'{tmp_path}:/usr/bin:/bin')
    monkeypatch.setitem(process._ENVIRONMENT, 'LC_ALL', 'de_DE.UTF-8')
    assert reach.ping('198.51.100.7') == 0.412
