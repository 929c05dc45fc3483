# SPDX-License-Identifier: Apache-2.0
"""Credentials in the robot's environment reach no machine, whatever copies that environment."""

from __future__ import annotations

from collections.abc import Iterator
import os
from typing import Any

import pytest

pytest.importorskip('launch.actions', reason='launch is not installed')
from launch import LaunchContext
from launch.actions import ExecuteProcess
import launch.logging

from fogros2 import ContainerInstance
from fogros2.describe import variables
from fogros2.model import MachineSpec
from fogros2.runtime import node_spec

SECRETS = {'AWS_SECRET_ACCESS_KEY': 'aws', 'GITHUB_TOKEN': 'hub', 'OPENAI_API_KEY': 'ai'}


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Return the warnings; the environment has credentials."""
    for name, value in SECRETS.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(variables, '_reported', set())
    lines: list[str] = []
    monkeypatch.setattr(launch.logging.get_logger('fogros2'), 'warning', lines.append)
    yield lines


def sent(**arguments: Any) -> dict[str, Any]:
    """Return the variables that a process gets on its machine."""
    context, base = LaunchContext(), dict(os.environ)
    action = ExecuteProcess(cmd=['true'], **arguments)
    action.prepare(context)
    return dict(node_spec.from_action(
        action, context, base, MachineSpec('planner', 'container'), 'abcdef').environment)


def most() -> dict[str, str]:
    """Return a copy of the environment without a tenth of its variables."""
    keys = [key for key in os.environ if key not in SECRETS]
    return {key: os.environ[key] for key in (*SECRETS, *keys[len(keys) // 10:])}


def test_copy_of_the_environment_leaves_credentials_here(said: list[str]) -> None:
    for copied in (dict(os.environ), most()):
        assert sent(env={**copied, 'SPEED': '3'}) == {'SPEED': '3'}
        assert sent(additional_env={**copied, 'SPEED': '3'}) == {'SPEED': '3'}
    assert len(said) == 1 and all(name in said[0] for name in SECRETS)
    assert not any(value in said[0].split() for value in SECRETS.values())


def test_changed_variable_of_a_copy_travels(said: list[str]) -> None:
    assert sent(env={**os.environ, 'GITHUB_TOKEN': 'of the machine'}) == {
        'GITHUB_TOKEN': 'of the machine'}


def test_dds_settings_of_a_copy_stay_here(said: list[str]) -> None:
    for name in ('FASTRTPS_DEFAULT_PROFILES_FILE', 'ROS_STATIC_PEERS', 'ROS_LOCALHOST_ONLY',
                 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_DISCOVERY_SERVER', 'CYCLONEDDS_URI',
                 'FASTDDS_BUILTIN_TRANSPORTS', 'ZENOH_SESSION_CONFIG_URI',
                 'ZENOH_CONFIG_OVERRIDE', 'RMW_IMPLEMENTATION'):
        assert sent(env={**os.environ, name: 'of the robot'}) == {}, name


def test_listed_variables_travel(said: list[str]) -> None:
    listed = {name: os.environ[name] for name in ('GITHUB_TOKEN', 'HOME')}
    assert sent(env=listed) == listed == sent(additional_env=listed)
    token = {'GITHUB_TOKEN': 'hub'}
    assert sent(env=dict(os.environ), additional_env=token) == token
    assert len(said) == 1 and 'GITHUB_TOKEN' not in said[0]


def test_machine_gets_no_copy_of_the_environment(said: list[str]) -> None:
    machine = ContainerInstance(name='m', environment={**os.environ, 'SPEED': '3'})
    assert machine.spec(LaunchContext()).environment == {'SPEED': '3'}
    assert all(name in said[0] for name in SECRETS)
