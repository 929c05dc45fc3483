# SPDX-License-Identifier: Apache-2.0
"""One element of a launch file, whatever its format."""
from __future__ import annotations

from typing import Any, List, Optional


class Entity:
    """An element with a type's name, attributes and children."""

    @property
    def type_name(self) -> str:
        """The element's name."""
        raise NotImplementedError()

    @property
    def parent(self) -> Optional[Entity]:
        """The element that this one stands in."""
        raise NotImplementedError()

    @property
    def children(self) -> List[Entity]:
        """The elements in this one; all count as read."""
        raise NotImplementedError()

    def get_attr(
        self, name: str, *, data_type: Any = str, optional: bool = False,
        can_be_str: bool = True
    ) -> Any:
        """
        Return an attribute; it counts as read.

        :param data_type: a scalar type, a list of it, ``List[Entity]``, or None for any.
        :param can_be_str: whether a text will do where the type is another.
        :raises AttributeError: if it isn't there and not optional.
        :raises TypeError: if it isn't of the type.
        """
        raise NotImplementedError()

    def assert_entity_completely_parsed(self) -> None:
        """
        Refuse what nobody read.

        :raises ValueError: naming the attributes or elements.
        """
        raise NotImplementedError()
