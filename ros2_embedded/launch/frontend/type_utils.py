# SPDX-License-Identifier: Apache-2.0
"""The elements of launch files, whatever the format, and types as they name them."""
from __future__ import annotations

from typing import Any, List

from ..utilities.type_utils import is_typing_list


class Entity:
    """An element with a type's name, attributes and children; it notes what was read."""

    def __init__(self, element: Any, type_name: str, parent: Entity | None = None) -> None:
        self._element = element
        self.type_name = type_name
        self.parent = parent
        #: Where the file has it, if its parser says so.
        self.line: int | None = None

    @property
    def children(self) -> list[Entity]:
        raise NotImplementedError()

    def get_attr(
        self, name: str, *, data_type: Any = str, optional: bool = False,
        can_be_str: bool = True
    ) -> Any:
        """
        Return an attribute.

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


_TYPES = {
    'str': str, 'bool': bool, 'float': float, 'int': int, 'list_of_str': List[str],
    'list_of_bool': List[bool], 'list_of_float': List[float], 'list_of_int': List[int],
    'yaml': None,
}


def check_is_list_entity(data_type: Any) -> bool:
    """Say whether it is ``List[Entity]``, or of a class derived from that."""
    kind = data_type.__args__[0] if is_typing_list(data_type) else None
    return isinstance(kind, type) and issubclass(kind, Entity)


def get_data_type_from_identifier(type_identifier: str) -> Any:
    if type_identifier not in _TYPES:
        raise ValueError(f"Got invalid type identifier '{type_identifier}'")
    return _TYPES[type_identifier]
