# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of a machine, on launch's event loop."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path
import time
from types import SimpleNamespace
from typing import Any, Optional

from launch import LaunchContext
import pytest
from rclpy.exceptions import InvalidHandle
from rclpy.task import Future
from rclpy.validate_full_topic_name import validate_full_topic_name

from fogros2.errors import ShellError
from fogros2.model import MachineSpec, NodeSpec
from fogros2_features.replacement import checkpoints
from fogros2_features.replacement.checkpoints import Checkpoints
from fogros2_features.replacement.options import Options
from rigs import loops


class Destroyed:
    """The ROS node of a launch that has ended."""

    def create_client(self, *_: object) -> None:
        raise InvalidHandle('destruction was requested')


class Silent:
    """A ROS node all of whose services are there and never answer."""

    def create_client(self, *_: object) -> Any:
        return SimpleNamespace(service_is_ready=lambda: True, call_async=lambda request: Future())


class Strict:
    """A ROS node without other nodes' services, which takes names as rclpy does."""

    def create_client(self, _: object, name: str) -> Any:
        if '{' in name:
            raise ValueError('unknown substitution')
        validate_full_topic_name(name, is_service=True)
        return SimpleNamespace(service_is_ready=lambda: False)


def asked(tmp_path: Path, nodes: list[NodeSpec]) -> Optional[bool]:
    """Return what nodes with a checkpoint answer."""
    session: Any = SimpleNamespace(
        spec=MachineSpec('planner', 'container'), own=Options(checkpoint=str(tmp_path / 'map')),
        nodes=lambda: nodes)

    async def ask() -> Optional[bool]:
        context = LaunchContext()
        context._set_asyncio_loop(asyncio.get_running_loop())
        kept = Checkpoints(session, context, tmp_path, '', None, in_thread=asyncio.to_thread,
                           logger=logging.getLogger())
        await kept.ask()
        return await kept.ask()

    return loops.run(ask())


def test_program_without_a_ros_name_offers_no_service(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    node = Strict()
    monkeypatch.setattr('launch_ros.ros_adapters.get_ros_node', lambda context: node)
    assert asked(tmp_path, [
        NodeSpec('1', name='python3-1'), NodeSpec('2', name='a', executable='slam_node.py'),
        NodeSpec('3', name='ubuntu:24.04'), NodeSpec('4', name='{x}'), NodeSpec('5', name='ok'),
        NodeSpec('6', name='a' * 300)]) is None


def test_nodes_without_a_copy_of_their_folder_are_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture,
) -> None:
    session: Any = SimpleNamespace(
        spec=MachineSpec('planner', 'container'), own=Options(checkpoint='/nowhere/map'))

    async def move() -> None:
        context = LaunchContext()
        context._set_asyncio_loop(asyncio.get_running_loop())
        kept = Checkpoints(session, context, tmp_path, '', None, in_thread=asyncio.to_thread,
                           logger=logging.getLogger())
        await kept.restore(kept.robot)
        machine: Any = None
        await kept.restore(machine)

    loops.run(move())
    assert [each.getMessage() for each in caplog.records if each.levelname == 'WARNING'] == [
        'planner: /nowhere/map is not restored: the launch has no copy of it '
        '(do the nodes write there, and not to a folder of a container?)']


def test_each_folder_that_is_not_copied_is_reported_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture,
) -> None:
    class Folder:
        def __init__(self, folder: str, *, bad: bool) -> None:
            self.folder, self.bad = folder, bad

        def save(self, shell: object, *, still: bool) -> bool:
            if self.bad:
                raise ShellError('it can not be read')
            return True

    session: Any = SimpleNamespace(spec=MachineSpec('planner', 'container'), own=Options())

    async def save() -> None:
        context = LaunchContext()
        kept = Checkpoints(session, context, tmp_path, '', None, in_thread=asyncio.to_thread,
                           logger=logging.getLogger())
        folders = [Folder('~/a', bad=True), Folder('~/b', bad=True), Folder('~/c', bad=False)]
        kept._folders.update({folder.folder: folder for folder in folders})  # type: ignore
        shell: Any = None
        for bad in (True, True, False, True):
            folders[1].bad = bad
            await kept.save(shell, still=False)

    loops.run(save())
    assert [each.getMessage()[9:12] for each in caplog.records if each.levelname == 'WARNING'] == [
        '~/a', '~/b', '~/b']


@pytest.mark.parametrize('node', [Destroyed(), Silent()])
def test_ending_launch_and_silence_count_as_no_consent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, node: Any,
) -> None:
    monkeypatch.setattr('launch_ros.ros_adapters.get_ros_node', lambda context: node)
    monkeypatch.setattr(checkpoints, 'ANSWER', 0.5)
    begin = time.monotonic()
    assert asked(tmp_path, [NodeSpec(f'planner/{number}', name=f'n{number}', package='demo')
                            for number in range(100)]) is False
    assert time.monotonic() - begin < 25.0  # the nodes have their time together
