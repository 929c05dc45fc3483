# SPDX-License-Identifier: Apache-2.0
"""Base of all that a launch description consists of."""
from __future__ import annotations

import asyncio
from typing import Any, Iterable, List, Optional, Tuple, TYPE_CHECKING

if TYPE_CHECKING:
    from .launch_context import LaunchContext


class LaunchDescriptionEntity:
    """Something that launch visits, with other entities below it."""

    def describe(self) -> str:
        """Return a description for humans."""
        raise NotImplementedError()

    def describe_sub_entities(self) -> List[LaunchDescriptionEntity]:
        """Return the entities that a visit yields in any case."""
        return []

    def describe_conditional_sub_entities(
        self
    ) -> List[Tuple[str, Iterable[LaunchDescriptionEntity]]]:
        """Return, with its condition in words, what a visit or an event may yield."""
        return []

    def visit(self, context: LaunchContext) -> Optional[List[LaunchDescriptionEntity]]:
        """Do the entity's work; return what is to be visited next, in order."""
        return None

    def get_asyncio_future(self) -> Optional[asyncio.Future[Any]]:
        """Return what launch waits for before it is idle."""
        return None
