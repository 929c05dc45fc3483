# SPDX-License-Identifier: Apache-2.0
"""
``ros2 fog`` beside the launch of the tutorial's container machine, and after it was killed.

The tutorial works word for word, on the embedded default and on ROS 2. The name of the machine is
another one, as tests share the computer.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import io
import json
import os
from pathlib import Path
import secrets
import signal
import subprocess
import sys
from typing import Any

import pytest
from ros2cli.cli import main

from fogros2.store import Store
from fogros2.waiting import wait_until
from rigs.launched import Launched, launching, ros2, WITH_SIGINT
from rigs.tutorial import activated, FILE, Tutorial


def fog(*words: str, check: bool = True) -> subprocess.CompletedProcess[str]:
    """Run a verb in this process, which has loaded it all; return what a shell would see."""
    with contextlib.redirect_stdout(io.StringIO()) as out, \
            contextlib.redirect_stderr(io.StringIO()) as errors:
        status = main(argv=['fog', *words])
        if isinstance(status, str):  # as sys.exit takes it
            print(status, file=sys.stderr)
    done = subprocess.CompletedProcess(
        words, int(bool(status)), out.getvalue(), errors.getvalue())
    assert not check or done.returncode == 0, done.stdout + done.stderr
    return done


@pytest.fixture
def tutorial(tmp_path: Path) -> Tutorial:
    return Tutorial(f'cli-{secrets.token_hex(2)}', tmp_path)


@pytest.fixture
def environment(tutorial: Tutorial, tmp_path: Path) -> dict[str, str]:
    """Return the variables of a terminal of the tutorial."""
    return activated(tutorial.commands[1], tmp_path)


@pytest.fixture
def launch(
    nothing_left: None, engine: str, tutorial: Tutorial, environment: dict[str, str],
) -> Iterator[Launched]:
    with launching() as start:
        launch = start(*tutorial.words(f'ros2 launch ./{FILE}')[1:], environment=environment)
        launch.wait_for(f'I heard: [Hello World from {tutorial.name} ')
        yield launch


def commands_of_the_tutorial_work(tutorial: Tutorial, environment: dict[str, str]) -> None:
    """Run each in a process of its own."""
    for verb, expected in (
            ('list', [tutorial.name]), ('status .*', ['running', 'round trip', 'talker']),
            ('logs .*', ['process started', 'Publishing']), ('connect .*', [tutorial.name])):
        done = ros2(*tutorial.words(f'ros2 fog {verb}'), environment=environment)
        # what a node says on stderr comes on stderr
        text = done.stdout + done.stderr
        assert done.returncode == 0 and all(words in text for words in expected), done


def logs_follow(name: str, children: list[subprocess.Popen[bytes]], folder: Path) -> None:
    """Check that ``logs -f`` ends with Ctrl-C, and with its reader."""
    log = folder / 'follow.log'
    with log.open('wb') as output:
        follower = subprocess.Popen([*WITH_SIGINT, 'ros2', 'fog', 'logs', name, '-f'],
                                    stdout=output, stderr=subprocess.STDOUT)
    children.append(follower)
    wait_until(lambda: log.read_text().count('Publishing') >= 3, timeout=60.0, what='three lines')
    assert follower.poll() is None
    follower.send_signal(signal.SIGINT)
    assert follower.wait(60) in (0, signal.SIGINT, -signal.SIGINT)
    # a reader that has seen enough ends it as well, without a traceback
    enough = subprocess.run(['sh', '-c', f'ros2 fog logs {name} -f 2>&1 | head -n 2'],
                            capture_output=True, text=True, timeout=60)
    assert len(enough.stdout.splitlines()) == 2 and enough.stderr == ''


def another_terminal_joins(name: str) -> None:
    exports = fog('env', name).stdout
    listener = f'{sys.executable} -c "from fogros2_examples.listener import main; main()"'
    heard = subprocess.run(
        ['sh', '-c', f'{exports}\nexec {listener} --ros-args -p count:=2'], text=True,
        capture_output=True, timeout=60,
        env={name: value for name, value in os.environ.items() if name != 'ROS_DOMAIN_ID'})
    assert heard.returncode == 0, heard.stderr
    assert f'Hello World from {name}' in heard.stdout + heard.stderr


def test_verbs_work_beside_a_launch_and_clean_up_after_its_death(
    launch: Launched, tutorial: Tutorial, environment: dict[str, str],
    children: list[subprocess.Popen[bytes]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    name = tutorial.name
    commands_of_the_tutorial_work(tutorial, environment)

    def listed() -> dict[str, Any]:
        (entry,) = [e for e in json.loads(fog('list', '--json').stdout)['machines']
                    if e['name'] == name]
        return entry

    entry = listed()
    assert entry['state'] == 'running' and entry['launch_alive'] and entry['address']
    assert 28000 < entry['time_left'] <= 28800

    status = json.loads(fog('status', name, '--json').stdout)
    assert status['problems'] == []
    assert 0 < status['vpn']['latency'] < 5000 and status['vpn']['received'] > 0
    assert status['vpn']['handshake_age'] < 180
    (node,) = status['agent']['nodes']
    assert node['name'].startswith('talker') and node['state'] == 'running'
    assert status['agent']['rss_kb'] < 30000

    nobody = fog('logs', name, '--node', 'talkr-1', check=False)
    assert nobody.returncode == 1 and 'Publishing' not in nobody.stdout + nobody.stderr
    assert f"'{name}' has no node 'talkr-1' (did you mean 'talker-1'?)" in nobody.stderr
    unwatched = fog('monitor', name, '--no-browser', check=False)
    assert unwatched.returncode == 1
    assert f"'{name}' has no Foxglove bridge (launch_foxglove=True" in unwatched.stderr

    logs_follow(name, children, tmp_path)
    another_terminal_joins(name)
    assert fog('wait', name, '--timeout', '30').returncode == 0
    written = fog('ssh-config', name).stdout
    assert str(Store().machine(name) / 'ssh_config') in written
    config = tmp_path / 'config'
    config.write_text(written.splitlines()[-1] + '\n')
    assert subprocess.run(['ssh', '-F', config, '-o', 'BatchMode=yes', name, 'hostname'],
                          capture_output=True, text=True, timeout=30).stdout.strip() == name

    # which becomes ssh
    assert ros2('fog', 'connect', name, '--', 'sh', '-c', 'hostname; exit 7').returncode == 7
    assert ros2('fog', 'connect', name, '--user', 'root', '--', 'true').returncode != 0

    refused = fog('delete', name, '--yes', check=False)
    assert refused.returncode == 1 and '--force' in refused.stderr
    assert launch.child.poll() is None

    # the provider's tags are enough to end the machine; gc clears the robot's side
    launch.kill()
    entry = listed()
    assert entry['launch_alive'] is False and 'launch gone' in entry['state']
    would = json.loads(fog('gc', '--dry-run', '--json').stdout)['cleared']
    assert [w['reason'] for w in would if w['name'] == name] == ['its launch is gone']
    here = os.environ['FOGROS2_STATE_HOME']
    monkeypatch.setenv('FOGROS2_STATE_HOME', str(tmp_path / 'lost'))
    assert '(orphan)' in [line for line in fog('list').stdout.splitlines() if name in line][0]
    assert f'deleted {name}' in fog('delete', name, '--yes').stdout
    monkeypatch.setenv('FOGROS2_STATE_HOME', here)
    assert f'leftovers of {name}' in fog(*tutorial.words('ros2 fog gc')[1:]).stdout
    assert fog('wait', name, '--gone', '--timeout', '60').returncode == 0
    assert name not in fog('gc').stdout + fog('list').stdout
    assert not Store().machine(name).exists()
