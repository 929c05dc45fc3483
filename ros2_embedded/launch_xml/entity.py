# SPDX-License-Identifier: Apache-2.0
"""An XML element as an entity."""
from __future__ import annotations

from typing import Any, cast, List, Optional, Set
import xml.etree.ElementTree as ET

from launch.frontend import Entity as BaseEntity
from launch.frontend.type_utils import check_is_list_entity
from launch.utilities.type_utils import get_typed_value


class Entity(BaseEntity):
    """
    An XML element.

    An attribute ``x`` beside ``x-sep`` is a list, separated by that.
    """

    def __init__(
        self, xml_element: ET.Element, *, parent: Optional[Entity] = None
    ) -> None:
        self.__xml_element = xml_element
        self.__parent = parent
        self.__read_attributes: Set[str] = set()
        self.__read_children: Set[str] = set()

    @property
    def type_name(self) -> str:
        return self.__xml_element.tag

    @property
    def parent(self) -> Optional[Entity]:
        return self.__parent

    @property
    def children(self) -> List[BaseEntity]:
        self.__read_children = {element.tag for element in self.__xml_element}
        return [Entity(element, parent=self) for element in self.__xml_element]

    def assert_entity_completely_parsed(self) -> None:
        tags = {element.tag for element in self.__xml_element} - self.__read_children
        if tags:
            raise ValueError(f'Unexpected nested tag(s) found in `{self.type_name}`: {tags}')
        attributes = set(self.__xml_element.attrib) - self.__read_attributes
        if attributes:
            raise ValueError(
                f'Unexpected attribute(s) found in `{self.type_name}`: {attributes}')

    def get_attr(
        self, name: str, *, data_type: Any = str, optional: bool = False,
        can_be_str: bool = True
    ) -> Any:
        found: Any = None
        if check_is_list_entity(data_type):
            elements = [element for element in self.__xml_element if element.tag == name]
            if elements:
                self.__read_children.add(name)
                return [Entity(element, parent=self) for element in elements]
        elif name in self.__xml_element.attrib:
            self.__read_attributes.add(name)
            found = self.__xml_element.attrib[name]
            separator = f'{name}-sep'
            if separator in self.__xml_element.attrib:
                self.__read_attributes.add(separator)
                found = found.split(self.__xml_element.attrib[separator])
        if found is None:
            if optional:
                return None
            raise AttributeError(
                f"Attribute '{name}' of type '{data_type}' not found in Entity "
                f"'{self.type_name}'")
        try:
            return get_typed_value(cast(str, found), data_type, can_be_str=can_be_str)
        except ValueError as exc:
            raise TypeError(
                f"Attribute '{name}' of Entity '{self.type_name}' expected to be of type "
                f"'{data_type}'.'{found}' can not be converted to one of those types") from exc
