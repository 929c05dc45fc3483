# SPDX-License-Identifier: Apache-2.0
"""A YAML mapping or sequence as an entity."""
from __future__ import annotations

from typing import Any, List

from launch.frontend import Entity as BaseEntity
from launch.frontend.type_utils import check_is_list_entity
from launch.utilities.ros_yaml import Plain, typed
from launch.utilities.type_utils import is_instance_of


def _typed(value: Any) -> Any:
    return typed(value) if isinstance(value, Plain) else value


class Entity(BaseEntity):
    """A mapping of attributes, its children under 'children'; or a sequence of children."""

    def __init__(self, element: Any, type_name: str, parent: BaseEntity | None = None) -> None:
        super().__init__(element, type_name, parent)
        self.__read_keys: set[str] = set()
        self.__children_called = False

    @property
    def children(self) -> list[BaseEntity]:
        self.__children_called = True
        children = self._element
        if not isinstance(children, (dict, list)):
            raise TypeError(
                f'Expected a dict or list, got {type(children)}:\n---\n{children}\n---')
        if isinstance(children, dict):
            if 'children' not in children:
                raise ValueError(
                    f'Expected entity `{self.type_name}` to have children entities.'
                    'That can be a list of subentities or a dictionary with a `children` '
                    'list element')
            self.__read_keys.add('children')
            children = children['children']
        entities: list[BaseEntity] = []
        for child in children:
            line = getattr(child, 'line', self.line)
            if not isinstance(child, dict) or len(child) != 1:
                error = RuntimeError(
                    'Subentities must be a dictionary with only one key, '
                    'which is the entity type')
                vars(error)['line'] = line
                raise error
            [(type_name, element)] = child.items()
            entities.append(Entity(element, type_name, self))
            entities[-1].line = line
        return entities

    def assert_entity_completely_parsed(self) -> None:
        if isinstance(self._element, list):
            if not self.__children_called:
                raise ValueError(
                    f'Unexpected nested entity(ies) found in `{self.type_name}`: '
                    f'{self._element}')
        elif isinstance(self._element, dict):
            unread = set(self._element) - self.__read_keys
            if unread:
                raise ValueError(
                    f'Unexpected key(s) found in `{self.type_name}`: {unread}')

    def get_attr(
        self, name: str, *, data_type: Any = str, optional: bool = False,
        can_be_str: bool = True
    ) -> Any:
        if not isinstance(self._element, dict) or name not in self._element:
            if optional:
                return None
            raise AttributeError(
                f"Can not find attribute '{name}' in Entity '{self.type_name}'")
        self.__read_keys.add(name)
        value = self._element[name]
        if data_type not in (str, List[str]):
            value = [_typed(item) for item in value] if isinstance(value, list) else _typed(value)
        if check_is_list_entity(data_type):
            if isinstance(value, list) and value and isinstance(value[0], dict):
                return [Entity(child, name, self) for child in value]
            raise TypeError(
                f"Attribute '{name}' of Entity '{self.type_name}' expected to be a list of "
                'dictionaries.')
        if not is_instance_of(value, data_type, can_be_str=can_be_str):
            raise TypeError(
                f"Attribute '{name}' of Entity '{self.type_name}' expected to be of type "
                f"'{data_type}', got '{type(value)}'")
        return value
