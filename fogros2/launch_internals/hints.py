# SPDX-License-Identifier: Apache-2.0
"""
Say which action or element takes a machine, where a launch file gives one to launch's own.

launch's errors name only the unexpected keyword or attribute. launch has no extension point for
either: the constructor that all actions call, and the table of elements, are replaced.
"""

from __future__ import annotations

import functools
from typing import Any

from launch import Action
from launch.frontend import Entity, expose, Parser

from fogros2.errors import ConfigurationError

#: Elements and classes of launch_ros that FogROS2 has with a machine.
_NODES = {'node': 'Node', 'node_container': 'ComposableNodeContainer',
          'lifecycle_node': 'LifecycleNode'}


@functools.cache
def of_actions() -> None:
    """Refuse ``machine=`` of launch's actions by name, from now on."""
    before = Action.__init__

    @functools.wraps(before)
    def construct(self: Action, *args: Any, **kwargs: Any) -> None:
        if 'machine' in kwargs:
            names = [cls.__name__ for cls in type(self).__mro__]
            ours = [name for name in names if name in _NODES.values()]
            raise ConfigurationError(
                f'{names[0]} of {type(self).__module__} takes no machine',
                f'use the {ours[0]} of fogros2: from fogros2 import {ours[0]}' if ours else
                'put it into a group: fogros2.CloudGroup(machine, [actions])')
        before(self, *args, **kwargs)

    Action.__init__ = construct  # type: ignore[method-assign]


@functools.cache
def of_elements() -> None:
    """Refuse ``machine=`` of launch's elements by name, from now on."""
    import launch_ros.actions  # noqa: F401 - exposes the elements

    for name in (*_NODES, 'executable', 'group', 'include', 'load_composable_node'):
        if name in expose.action_parse_methods:
            _replace(name, expose.action_parse_methods[name])


def _replace(name: str, before: Any) -> None:
    @functools.wraps(before)
    def parse(entity: Entity, parser: Parser) -> Any:
        if entity.get_attr('machine', data_type=None, optional=True) is None:
            return before(entity, parser)
        if name in _NODES:
            instead = ', or write cloud_node instead of node' if name == 'node' else ''
            raise ConfigurationError(f'{name} takes a machine only below fogros_launch',
                                     f'put fogros_launch around it{instead}')
        raise ConfigurationError(
            f'{name} takes no machine', 'write cloud_group instead of group'
            if name == 'group' else 'put it into a cloud_group with the machine')

    vars(parse)['__wrapped__'] = vars(before).get('__wrapped__', before)
    expose.action_parse_methods[name] = parse
