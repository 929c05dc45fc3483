# SPDX-License-Identifier: Apache-2.0
"""What a launch does when a node that it is for has ended."""

from __future__ import annotations

from typing import Optional

from launch import LaunchContext
from launch.actions import Shutdown
from launch.events.process import ProcessExited


def ended(event: ProcessExited, context: LaunchContext) -> Optional[Shutdown]:
    """
    End the launch; for a node's ``on_exit``. Shutdown alone would forget how the node ended.

    :raises RuntimeError: the node failed; the launch's exit status is then 1.
    """
    if context.is_shutdown:
        return None
    if event.returncode:
        raise RuntimeError(f'{event.process_name} ended with exit status {event.returncode}')
    return Shutdown(reason=f'{event.process_name} is done')
