# SPDX-License-Identifier: Apache-2.0
"""Checkpoints of a machine, on launch's event loop."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Optional

from launch import LaunchContext
import pytest
from rclpy.exceptions import InvalidHandle

from fogros2.model import MachineSpec, NodeSpec
from fogros2_features.replacement.checkpoints import Checkpoints
from fogros2_features.replacement.options import Options
from rigs import loops


class Destroyed:
    """The ROS node of a launch that has ended."""

    def create_client(self, *_: object) -> None:
        raise InvalidHandle('destruction was requested')


def test_ending_launch_counts_as_no_consent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    monkeypatch.setattr('launch_ros.ros_adapters.get_ros_node', lambda context: Destroyed())
    session: Any = SimpleNamespace(
        spec=MachineSpec('planner', 'container'), own=Options(checkpoint=str(tmp_path / 'map')),
        nodes=lambda: [NodeSpec('planner/talker', name='talker', package='demo')])

    async def ask() -> Optional[bool]:
        context = LaunchContext()
        context._set_asyncio_loop(asyncio.get_running_loop())
        kept = Checkpoints(session, context, tmp_path, '', None, in_thread=asyncio.to_thread,
                           logger=logging.getLogger())
        return await kept.ask()

    assert loops.run(ask()) is False
