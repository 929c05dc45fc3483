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


@pytest.mark.parametrize('node', [Destroyed(), Silent()])
def test_ending_launch_and_silence_count_as_no_consent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, node: Any,
) -> None:
    monkeypatch.setattr('launch_ros.ros_adapters.get_ros_node', lambda context: node)
    monkeypatch.setattr(checkpoints, 'ANSWER', 0.5)
    session: Any = SimpleNamespace(
        spec=MachineSpec('planner', 'container'), own=Options(checkpoint=str(tmp_path / 'map')),
        nodes=lambda: [NodeSpec(f'planner/{number}', name=f'n{number}', package='demo')
                       for number in range(100)])

    async def ask() -> Optional[bool]:
        context = LaunchContext()
        context._set_asyncio_loop(asyncio.get_running_loop())
        kept = Checkpoints(session, context, tmp_path, '', None, in_thread=asyncio.to_thread,
                           logger=logging.getLogger())
        return await kept.ask()

    begin = time.monotonic()
    assert loops.run(ask()) is False
    assert time.monotonic() - begin < 25.0  # the nodes have their time together
