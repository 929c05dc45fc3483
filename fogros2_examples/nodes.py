# SPDX-License-Identifier: Apache-2.0
"""Run a node of the examples until a signal or its result."""

from __future__ import annotations

from collections.abc import Callable
import time
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from fogros2_examples.files import BadInput

#: Keeps the last message for late subscribers.
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def run(name: str, make: Callable[[], Any], turn: Callable[[Any], Any] = rclpy.spin) -> None:
    """
    Create a node and run it until a signal; exit at once on an invalid parameter or file.

    :param turn: runs the node; may return its exit status, or raise SystemExit.
    """
    rclpy.init()
    try:
        raise SystemExit(turn(make()))
    except (BadInput, OSError) as error:
        raise SystemExit(f'{name}: {error}') from error
    except (KeyboardInterrupt, ExternalShutdownException):
        pass  # rclpy's signal handler shuts rclpy down in its own thread; do not do it twice
    except RuntimeError:  # RCLError: the signal came before a message was published
        if rclpy.ok():
            raise
    except SystemExit:
        rclpy.try_shutdown()
        raise


def until(node: Node, true: Callable[[], bool], wait: float) -> bool:
    """Handle a node's messages until ``true()`` is true; return False after ``wait`` seconds."""
    deadline = time.monotonic() + wait
    while not true():
        if time.monotonic() > deadline:
            return False
        rclpy.spin_once(node, timeout_sec=0.1)
    return True
