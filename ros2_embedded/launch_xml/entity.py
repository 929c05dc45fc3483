# SPDX-License-Identifier: Apache-2.0
"""An XML element as an entity."""
from __future__ import annotations

from typing import Any
import xml.etree.ElementTree as ET

from launch.frontend import Entity as BaseEntity
from launch.frontend.type_utils import check_is_list_entity
from launch.utilities.type_utils import get_typed_value


class Entity(BaseEntity):
    """
    An XML element.

    An attribute ``x`` beside ``x-sep`` is a list, separated by that.
    """

    def __init__(self, element: ET.Element, parent: BaseEntity | None = None) -> None:
        super().__init__(element, element.tag, parent)
        self.__read_attributes: set[str] = set()
        self.__read_children: set[str] = set()

    @property
    def children(self) -> list[BaseEntity]:
        self.__read_children = {element.tag for element in self._element}
        return [Entity(element, self) for element in self._element]

    def assert_entity_completely_parsed(self) -> None:
        tags = {element.tag for element in self._element} - self.__read_children
        if tags:
            raise ValueError(f'Unexpected nested tag(s) found in `{self.type_name}`: {tags}')
        attributes = set(self._element.attrib) - self.__read_attributes
        if attributes:
            raise ValueError(
                f'Unexpected attribute(s) found in `{self.type_name}`: {attributes}')

    def get_attr(
        self, name: str, *, data_type: Any = str, optional: bool = False,
        can_be_str: bool = True
    ) -> Any:
        found: Any = None
        if check_is_list_entity(data_type):
            elements = [element for element in self._element if element.tag == name]
            if elements:
                self.__read_children.add(name)
                return [Entity(element, self) for element in elements]
        elif name in self._element.attrib:
            self.__read_attributes.add(name)
            found = self._element.attrib[name]
            separator = f'{name}-sep'
            if separator in self._element.attrib:
                self.__read_attributes.add(separator)
                found = found.split(self._element.attrib[separator])
        if found is None:
            if optional:
                return None
            raise AttributeError(
                f"Attribute '{name}' of type '{data_type}' not found in Entity "
                f"'{self.type_name}'")
        try:
            return get_typed_value(found, data_type, can_be_str=can_be_str)
        except ValueError as exc:
            raise TypeError(
                f"Attribute '{name}' of Entity '{self.type_name}' expected to be of type "
                f"'{data_type}'.'{found}' can not be converted to one of those types") from exc
