# SPDX-License-Identifier: Apache-2.0
"""Calls services of nodes that may not be there yet, in a thread."""
from __future__ import annotations

import logging
import threading
from typing import Any, Optional

from launch.launch_context import LaunchContext


def call_service(
    client: Any, request: Any, context: LaunchContext, logger: logging.Logger
) -> Optional[Any]:
    """
    Wait for the service and return its response; None when the launch shuts down meanwhile.

    Blocks: call it in an executor's thread.
    """
    while not client.wait_for_service(timeout_sec=1.0):
        if context.is_shutdown:
            logger.warning(
                f"Abandoning wait for the '{client.srv_name}' service, due to shutdown.")
            return None
    answered = threading.Event()
    future = client.call_async(request)
    future.add_done_callback(lambda _: answered.set())
    while not answered.wait(1.0):
        if context.is_shutdown:
            logger.warning(
                f"Abandoning wait for the '{client.srv_name}' service response, "
                'due to shutdown.')
            future.cancel()
            return None
    if future.exception() is not None:
        raise future.exception()
    return future.result()
