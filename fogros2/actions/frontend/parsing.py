# SPDX-License-Identifier: Apache-2.0
"""Parse the elements of a launch file into FogROS2's actions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Optional

from launch import Action
from launch.actions import GroupAction
from launch.frontend import Entity, Parser

from fogros2.actions.cloud_group import CloudGroup
from fogros2.actions.fog_machine import FogMachine
from fogros2.actions.frontend.actions import FogROSLaunch, separate
from fogros2.actions.frontend.entity import (
    attribute,
    children,
    complete,
    CONDITIONS,
    Parsed,
    value,
)
from fogros2.actions.nodes import CloudNode, ComposableNodeContainer, LifecycleNode, Node
from fogros2.describe import features, keywords
from fogros2.describe.kinds import Keyword
from fogros2.errors import ConfigurationError, did_you_mean, naming
from fogros2.launch_internals.parsers import scoped

#: Attributes and elements of nodes that launch_ros reads.
_NODE = (
    'additional_env', 'args', 'autostart', 'composable_node', 'cwd', 'emulate_tty', 'env', 'exec',
    'exec_name', 'launch-prefix', 'name', 'namespace', 'on_exit', 'output', 'output_format',
    'param', 'pkg', 'remap', 'respawn', 'respawn_delay', 'respawn_max_retries', 'ros_args',
    'shell', 'sigkill_timeout', 'sigterm_timeout')
_GROUP = ('forwarding', 'keep', 'scoped')


def fog_machine(entity: Entity, parser: Parser) -> Parsed:
    """Read ``<fog_machine name="planner" provider="aws" region="nearest"/>``."""
    _, kwargs = Action.parse(entity, parser)
    provider = attribute(entity, parser, 'provider')
    if not provider:
        raise ConfigurationError('a fog_machine needs a provider',
                                 did_you_mean('', keywords.providers()))
    if isinstance(provider, str):
        parameters = dict(keywords.keywords(keywords.machine_class(provider)))
    else:
        # the provider is resolved when the action is executed: accept the keywords of all
        parameters = {name: keyword for cls in keywords.machine_classes()
                      for name, keyword in keywords.keywords(cls).items()}
    name = attribute(entity, parser, 'name')
    with naming(name if isinstance(name, str) else ''):
        given = _given(entity, parser, parameters)
    items = features.machine_lists()
    given.update(_items(entity, parser, items))
    what = f"a fog_machine of the provider '{provider}'" if isinstance(provider, str) else ''
    complete(entity, (*parameters, 'provider', *items, *CONDITIONS), what)
    if 'name' not in given:
        raise ConfigurationError('a fog_machine needs a name', 'its nodes say machine="that name"')
    return FogMachine, {**kwargs, 'provider': provider, 'given': given}


def _given(
    entity: Entity, parser: Parser, parameters: Mapping[str, Keyword],
) -> dict[str, Any]:
    """Return the values of the keywords that an element has."""
    contents = {name: value(entity, parser, keyword) for name, keyword in parameters.items()}
    return {name: content for name, content in contents.items() if content is not None}


def _items(entity: Entity, parser: Parser, names: Iterable[str]) -> dict[str, list[Any]]:
    """Return the items of features' lists by keyword, from child elements with these names."""
    return separate(
        parser.parse_action(child) for name in names for child in children(entity, name))[1]


def cloud_node(entity: Entity, parser: Parser) -> Parsed:
    """Read ``<cloud_node machine="planner" pkg="demo" exec="talker">``, like ``<node>``."""
    return node(entity, parser, CloudNode)


def node(entity: Entity, parser: Parser, cls: type[Node]) -> Parsed:
    """Read an element of ``cls`` as launch_ros does, with the keywords of a machine."""
    _, kwargs = cls.parse(entity, parser)
    kwargs['machine'] = _machine(entity, parser)
    parameters = features.keywords('node_options')
    kwargs.update(_given(entity, parser, parameters))
    items = features.node_lists().values()
    kwargs.update(_items(entity, parser, items))
    complete(entity, ('machine', *items, *parameters, *_NODE, *CONDITIONS))
    return cls, kwargs


#: Elements that may have a machine inside ``<fogros_launch>``.
_WITH_MACHINE = {'node': Node, 'node_container': ComposableNodeContainer,
                 'lifecycle_node': LifecycleNode}


def _node_with_machine(entity: Entity, parser: Parser) -> Optional[Action]:
    cls = _WITH_MACHINE.get(entity.type_name)
    if cls is None or entity.get_attr('machine', data_type=None, optional=True) is None:
        return None
    _, kwargs = node(entity, parser, cls)
    return cls(**kwargs)


def cloud_group(entity: Entity, parser: Parser) -> Parsed:
    """Read ``<cloud_group machine="planner">``, like ``<group>``."""
    _, kwargs = GroupAction.parse(entity, parser)
    kwargs['machine'] = _machine(entity, parser)
    kwargs['actions'], lists = separate(kwargs['actions'])
    kwargs.update(lists)
    complete(entity, ('machine', *features.node_lists().values(), *_GROUP, *CONDITIONS))
    return CloudGroup, kwargs


def _machine(entity: Entity, parser: Parser) -> Any:
    machine = attribute(entity, parser, 'machine')
    if not machine:
        raise ConfigurationError(f'a {entity.type_name} needs a machine',
                                 'machine="planner", as <fog_machine name="planner" .../> says')
    return machine


def fogros_launch(entity: Entity, parser: Parser) -> Parsed:
    """Read ``<fogros_launch robot_nodes="after_cloud" dds="fastdds">`` with its content."""
    _, kwargs = Action.parse(entity, parser)
    kwargs.update(_given(entity, parser, {
        name: Keyword(name, 'text') for name in ('robot_nodes', 'dds')}))
    below = scoped(parser, _node_with_machine)
    kwargs['actions'], lists = separate(map(below.parse_action, entity.children))
    kwargs.update(lists)
    complete(entity, ('robot_nodes', 'dds', *CONDITIONS))
    return FogROSLaunch, kwargs
