# SPDX-License-Identifier: Apache-2.0
"""A report of a bug has no output of nodes and no secret in the forms that programs write."""

from __future__ import annotations

from collections.abc import Iterator
import importlib.util
import logging
from pathlib import Path

import launch.logging
import pytest

from fogros2.store import Store
from ros2fog_cli.api import bugreport, doctor


@pytest.fixture
def log(tmp_path: Path) -> Iterator[Path]:
    """Return a folder of logs that launch's own loggers write; it becomes the latest."""
    before = launch.logging.launch_config.log_dir
    folder = tmp_path / 'log'
    (folder / 'latest').mkdir(parents=True)
    launch.logging.reset()
    launch.logging.launch_config.log_dir = str(folder / 'latest')
    yield folder
    launch.logging.reset()
    launch.logging.launch_config.log_dir = before


def test_output_of_nodes_is_in_no_report(log: Path) -> None:
    launch.logging.get_logger('fogros2').info('a: create 2.00 s')
    node, errors = launch.logging.get_output_loggers('camera-1', 'log')
    node.info('[camera-1] the door opens with 4711')
    errors.error('[camera-1] twice')
    launch.logging.get_logger('fogros2').warning('a: slow\nit goes on')
    logging.shutdown()
    said = (log / 'latest/launch.log').read_text()
    assert '4711' in said and 'twice' in said
    found = '\n'.join(bugreport.last_lines(log / 'latest/launch.log'))
    assert '4711' not in found and 'twice' not in found
    assert 'create 2.00 s' in found and 'it goes on' in found


@pytest.mark.parametrize('text', [
    'https://me:p@ss/hunter2@index/simple', 'https://store/c?sv=1&sig=hunter2%2Bab%3D',
    '<Security><Authentication><Password>hunter2</Password></Authentication></Security>',
    'pwd=hunter2', 'DB_PASS: hunter2', 'run --passphrase hunter2', 'run --api-key "hunter2"',
    'clone with ghp_hunter2hunter2hunter2hunter2hunter2h', 'hf_hunter2HunterHunterHunter',
    'Authorization: Basic hunter2', 'authorization=Digest username="a", response="hunter2"',
    'sent Bearer hunter2', 'curl -u me:hunter2 x', 'sshpass -p hunter2 ssh x', 'apikey: hunter2',
    'PrivateKey = hunter2', 'AccountKey=hunter2;', 'https://x?key=hunter2',
    "{'token': b'hunter2'}", 'Set-Cookie: session=hunter2', 'npm_hunter2hunter2hunter2',
    'SG.hunter2hunter2.hunter2hunter2',
    'glpat-hunter2HunterHunterHunter', 'AIzaSyhunter2HunterHunterHunterHunter',
    'eyJhbGciOiJIUzI1NiJ9.hunter2eyJzdWIi.hunter2', 'ASIA0000000HUNTER2AK hunter'])
def test_secrets_that_programs_write_are_hidden(text: str) -> None:
    environment = {'ROS_EXTRA': text}
    said = bugreport.report([], Store(), environment, Path('/nonexistent'))
    assert 'ROS_EXTRA=' in said and 'hunter2' not in said and bugreport.HIDDEN in said


@pytest.mark.parametrize('name', ['MYSQL_PWD', 'SSHPASS', 'WIFI_PSK', 'DB_PASS'])
def test_value_of_secret_variable_is_hidden_anywhere(name: str) -> None:
    said = bugreport.report([], Store(), {name: 'hunter2-of-me', 'ROS_B': 'a hunter2-of-me'},
                            Path('/nonexistent'))
    assert 'hunter2' not in said


@pytest.mark.skipif(not any(map(importlib.util.find_spec, ('tomllib', 'tomli'))),
                    reason='needs Python 3.11 or tomli')
def test_values_of_env_in_defaults_are_not_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv('XDG_CONFIG_HOME', str(tmp_path))
    for name in ('COLCON_PREFIX_PATH', 'AMENT_PREFIX_PATH'):
        monkeypatch.setenv(name, '')
    (tmp_path / 'fogros2').mkdir()
    (tmp_path / 'fogros2/fogros2.toml').write_text(
        "[kubernetes]\nmb = 512\nenv = {WANDB_LOGIN = 'hunter2'}\n")
    check = doctor.machine_defaults()
    assert check.verdict == 'ok', check
    said = bugreport.report([check], Store(), {}, Path('/nonexistent'))
    assert 'hunter2' not in said
    assert "kubernetes.mb=512, kubernetes.env=['WANDB_LOGIN']" in said


def test_what_a_report_needs_is_shown() -> None:
    said = bugreport.report([], Store(), {
        'PWD': '/ws/of/mine', 'ROS_A': '/ws/of/mine/x', 'ROS_B': 'http://10.0.0.7:80/a?b=c',
        'ROS_C': 'udp://lo', 'ROS_D': 'passing 5, design: one'}, Path('/nonexistent'))
    for shown in ('ROS_A=/ws/of/mine/x', 'ROS_B=http://10.0.0.7:80/a?b=c', 'ROS_C=udp://lo',
                  'ROS_D=passing 5, design: one'):
        assert shown in said
