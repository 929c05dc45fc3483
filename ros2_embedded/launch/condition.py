# SPDX-License-Identifier: Apache-2.0
"""Base of all conditions."""
from __future__ import annotations

from typing import Callable, Optional, TYPE_CHECKING

if TYPE_CHECKING:
    from .launch_context import LaunchContext


class Condition:
    """Decides, when an action is visited, whether it executes."""

    def __init__(self, *, predicate: Optional[Callable[[LaunchContext], bool]] = None) -> None:
        self._predicate = predicate

    def describe(self) -> str:
        """Return a description for humans."""
        return repr(self)

    def evaluate(self, context: LaunchContext) -> bool:
        """Return what the predicate says; without one, False."""
        return False if self._predicate is None else self._predicate(context)
