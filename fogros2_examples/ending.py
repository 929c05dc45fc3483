# SPDX-License-Identifier: Apache-2.0
"""End a launch when a node has exited."""

from __future__ import annotations

from typing import Optional

from launch import LaunchContext
from launch.actions import Shutdown
from launch.events.process import ProcessExited


def ended(event: ProcessExited, context: LaunchContext) -> Optional[Shutdown]:
    """
    Shut the launch down; for a node's ``on_exit``. Shutdown alone would lose the exit status.

    :raises RuntimeError: the node failed, so the launch's exit status is 1.
    """
    if context.is_shutdown:
        return None
    if event.returncode:
        raise RuntimeError(f'{event.process_name} ended with exit status {event.returncode}')
    return Shutdown(reason=f'{event.process_name} is done')
