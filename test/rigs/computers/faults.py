# SPDX-License-Identifier: Apache-2.0
"""Errors that a test orders: which one a request gets."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Optional


def due(faults: list[Any], fits: Callable[[Any], bool]) -> Optional[Any]:
    """
    Return the first fault that fits a request, None for none.

    :param faults: have ``times``: how often, 0 for always; one that is over is removed.
    """
    for fault in faults:
        if fits(fault):
            fault.times -= 1
            if fault.times == 0:
                faults.remove(fault)
            return fault
    return None
