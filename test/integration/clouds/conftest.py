# SPDX-License-Identifier: Apache-2.0
"""A robot beside a cloud in a box: launches there know of the cloud's API alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import metadata
import os
from pathlib import Path
import shutil
from typing import Any
import uuid

import pytest

from fogros2.model import Machine, MachineSpec
from fogros2.provider import TAG_ON_EXIT
from fogros2.provider.vm.provider import VmProvider
from fogros2.waiting import wait_until
from fogros2_testing import request_for
from rigs.clouds import Cloud, CLOUDS, Robot
from rigs.computers.network import ROBOT
from rigs.launched import launching

HERE = Path(__file__).parent

#: What is tried on ROS 2 as well as on the embedded default: what its launch and nodes have a part
#: in. All else is the cloud's and the box's, the same on either, and takes minutes.
ON_BOTH = (
    'test_talker_from_nothing_to_nothing', 'test_machines_of_two_places_hear_each_other',
    'test_fogros2s_talker_aws_on_a_simulated_ubuntu_22_04',
    'test_fogros2s_talker_auto_aws_with_one_line_changed',
    'test_fogros2s_talker_gcp_runs_byte_for_byte')


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave to the embedded default what is the same there, unless it is asked for by name."""
    embedded = any(found.name == 'ros2-embedded' for found in metadata.distributions())
    named = any('clouds' in word for word in config.args)
    if embedded or named or config.option.keyword:
        return
    left = [item for item in items if item.path.parent == HERE
            and getattr(item, 'originalname', item.name) not in ON_BOTH]
    items[:] = [item for item in items if item not in left]
    config.hook.pytest_deselected(items=left)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test in each cloud; a module names ``CLOUDS`` if its tests are special to some."""
    named = {name.strip() for mark in metafunc.definition.iter_markers('parametrize')
             for name in str(mark.args[0]).split(',')}
    if 'cloud' in metafunc.fixturenames and 'cloud' not in named:
        names = getattr(metafunc.module, 'CLOUDS', tuple(CLOUDS))
        metafunc.parametrize('cloud', names, indirect=True, scope='session')


@pytest.fixture(scope='session')
def cloud(request: pytest.FixtureRequest) -> Cloud:
    """Return the cloud that a test is for."""
    return CLOUDS[request.param]()


@pytest.fixture(scope='session')
def box(cloud: Cloud, engine: str) -> Iterator[Any]:
    """Open a box for all tests of a cloud."""
    if shutil.which('ros2') is None:
        pytest.skip('needs ros2 on PATH')
    if os.geteuid() != 0:
        pytest.skip("needs root itself: sudo, the way into the robot's network, takes no Ctrl-C")
    for module in cloud.needs:
        pytest.importorskip(module, reason=f'needs {module}')
    with cloud.open() as box:
        yield box


@pytest.fixture
def robot(cloud: Cloud, box: Any, tmp_path: Path) -> Iterator[Robot]:
    """Yield a robot; when the test ends, nothing that somebody would pay for is left."""
    box.slow()
    box.forget_calls()
    box.set_boot_delay(0.0)
    cloud.reset(box)
    with launching() as start:
        yield Robot(cloud, box, tmp_path, start)
    alive, kept = box.alive(), cloud.left(box)
    cloud.clear(box)
    assert not alive, f'left running: {alive}'
    assert not kept, f'left at {cloud.name}: {kept}'


@pytest.fixture
def provider(
    cloud: Cloud, box: Any, robot: Robot, loopback_only: None, monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> VmProvider:
    """Return the provider, in this process; the robot's address is that of the robot."""
    for name, value in cloud.variables(box, tmp_path, here=True).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv('FOGROS2_ROBOT_ADDRESS', ROBOT)
    return cloud.provider()


@pytest.fixture
def make(cloud: Cloud, box: Any, provider: VmProvider) -> Callable[..., Machine]:
    """Return what makes a machine, and waits until its SSH server answers."""
    def made(name: str, on_exit: str = 'delete', **options: Any) -> Machine:
        spec = MachineSpec(name, cloud.name, options, on_exit=on_exit)
        machine = provider.reachable(provider.create(
            spec, request_for(spec, **{TAG_ON_EXIT: on_exit})), name=name, timeout=30.0)
        wait_until(lambda: all(i.ready > 0 for i in box.alive()), timeout=60, what='SSH servers')
        return machine
    return made


@pytest.fixture
def name() -> str:
    """Return a name that no other machine has."""
    return f'fogt-{uuid.uuid4().hex[:6]}'
