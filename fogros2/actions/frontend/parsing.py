# SPDX-License-Identifier: Apache-2.0
"""Parse the elements of a launch file into FogROS2's actions."""

from __future__ import annotations

from typing import Any, Optional, TYPE_CHECKING

from launch import Action
from launch.actions import GroupAction

from fogros2.actions.cloud_group import CloudGroup
from fogros2.actions.fog_machine import FogMachine
from fogros2.actions.frontend.actions import FogROSLaunch, instead_of, StreamTopicEverywhere
from fogros2.actions.frontend.entity import (
    attribute,
    children,
    complete,
    CONDITIONS,
    text,
    value,
)
from fogros2.actions.nodes import CloudNode, ComposableNodeContainer, LifecycleNode, Node
from fogros2.actions.replicated import Replicated
from fogros2.describe import features, keywords, kinds, values
from fogros2.errors import ConfigurationError, did_you_mean
from fogros2.host import docker_lines
from fogros2.host.containers import described, parse
from fogros2.image_transport.streams import StreamTopic
from fogros2.launch_internals.parsers import scoped

if TYPE_CHECKING:
    from launch.frontend import Entity, Parser

    from fogros2.actions.frontend.entity import Parsed

#: Attributes and elements of nodes that launch_ros reads.
_NODE = (
    'additional_env', 'args', 'autostart', 'composable_node', 'cwd', 'emulate_tty', 'env', 'exec',
    'exec_name', 'launch-prefix', 'name', 'namespace', 'on_exit', 'output', 'output_format',
    'param', 'pkg', 'remap', 'respawn', 'respawn_delay', 'respawn_max_retries', 'ros_args',
    'shell', 'sigkill_timeout', 'sigterm_timeout')
_GROUP = ('forwarding', 'keep', 'scoped')
_STREAM = ('topic', 'transport', 'direction', 'source')


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
        parameters = {name: keyword for each in keywords.providers() if _loads(each)
                      for name, keyword in keywords.keywords(keywords.machine_class(each)).items()}
    contents = {name: value(entity, parser, keyword) for name, keyword in parameters.items()}
    containers = [_container(child, parser) for child in children(entity, 'docker_container')]
    what = f"a fog_machine of the provider '{provider}'" if isinstance(provider, str) else ''
    complete(entity, (*parameters, 'provider', 'docker_container', *CONDITIONS), what)
    if contents['name'] is None:
        raise ConfigurationError('a fog_machine needs a name', 'its nodes say machine="that name"')
    kwargs.update(provider=provider, containers=containers, given={
        name: content for name, content in contents.items() if content is not None})
    return FogMachine, kwargs


def _container(entity: Entity, parser: Parser) -> dict[str, Any]:
    """Read ``<docker_container cmd="docker run redis"/>``, or ``image=`` and its keywords."""
    parameters = {'cmd': kinds.Keyword('cmd', 'text'), **kinds.parameters_of(described)}
    contents = {name: value(entity, parser, keyword, docker_lines.joined if name == 'cmd' else str)
                for name, keyword in parameters.items()}
    complete(entity, parameters)
    arguments = {name: values.items(content) if parameters[name].kind == 'list' else content
                 for name, content in contents.items() if content is not None}
    line = arguments.get('cmd')
    if (line is None) == ('image' not in arguments) or (line is not None and len(arguments) > 1):
        raise ConfigurationError('a docker_container takes a cmd, or an image and what it needs',
                                 'cmd="docker run --net=host IMAGE", or image="IMAGE"')
    if isinstance(line, str):
        parse(line)
    return arguments


def _loads(provider: str) -> bool:
    """Return whether a provider's class can be loaded."""
    try:
        keywords.machine_class(provider)
    except ConfigurationError:
        return False
    return True


def cloud_node(entity: Entity, parser: Parser) -> Parsed:
    """Read ``<cloud_node machine="planner" pkg="demo" exec="talker">``, like ``<node>``."""
    return node(entity, parser, CloudNode)


def node(entity: Entity, parser: Parser, cls: type[Node]) -> Parsed:
    """Read an element of ``cls`` as launch_ros does, with the keywords of a machine."""
    _, kwargs = cls.parse(entity, parser)
    kwargs['machine'] = _machine(entity, parser)
    parameters = {'image': kinds.Keyword('image', 'text'),
                  'image_options': kinds.Keyword('image_options', 'list'),
                  **features.keywords('node_options')}
    contents = {name: value(entity, parser, keyword) for name, keyword in parameters.items()}
    kwargs.update({name: values.items(content) if name == 'image_options' else content
                   for name, content in contents.items() if content is not None})
    streams = [stream_topic(child, parser)[1] for child in children(entity, 'stream_topic')]
    _, kwargs['stream_topics'] = instead_of(StreamTopicEverywhere(**each) for each in streams)
    complete(entity, ('machine', 'stream_topic', *parameters, *_NODE, *CONDITIONS))
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
    kwargs['actions'], kwargs['stream_topics'] = instead_of(kwargs['actions'])
    complete(entity, ('machine', 'stream_topic', *_GROUP, *CONDITIONS))
    return CloudGroup, kwargs


def replicated(entity: Entity, parser: Parser) -> Parsed:
    """Read ``<replicated machines="a, b" services="/plan" topics="/in:/out">``."""
    _, kwargs = Action.parse(entity, parser)
    parameters: dict[str, kinds.Kind] = {
        'machines': 'list', 'services': 'list', 'topics': 'list', 'hedge_after': 'scalar',
        'deadline': 'scalar'}
    for name, kind in parameters.items():
        content = value(entity, parser, kinds.Keyword(name, kind))
        if content is not None:
            kwargs[name] = content
    kwargs.setdefault('machines', [])
    kwargs['actions'], kwargs['stream_topics'] = instead_of(
        parser.parse_action(child) for child in entity.children)
    complete(entity, (*parameters, 'stream_topic', *CONDITIONS))
    return Replicated, kwargs


def _machine(entity: Entity, parser: Parser) -> Any:
    machine = attribute(entity, parser, 'machine')
    if not machine:
        raise ConfigurationError(f'a {entity.type_name} needs a machine',
                                 'machine="planner", as <fog_machine name="planner" .../> says')
    return machine


def stream_topic(entity: Entity, parser: Parser) -> Parsed:
    """Read ``<stream_topic topic="/camera" transport="h264"><param name= value=/>``."""
    _, kwargs = Action.parse(entity, parser)
    topic: Any = attribute(entity, parser, 'topic')
    if not topic:
        raise ConfigurationError('a stream_topic needs a topic', 'topic="/camera"')
    parameters: dict[str, Any] = {}
    for child in children(entity, 'param'):
        name = attribute(child, parser, 'name')
        content = value(child, parser, kinds.Keyword('value', 'scalar'))
        complete(child, ('name', 'value'))
        if not name or not isinstance(name, str) or content is None or name in _STREAM:
            raise ConfigurationError('a param of a stream_topic takes a name, written out, and a '
                                     'value', '<param name="bitrate" value="2000000"/>')
        parameters[name] = content
    attributes: dict[str, Any] = {
        name: attribute(entity, parser, name) for name in _STREAM if name != 'topic'}
    complete(entity, ('param', *_STREAM, *CONDITIONS))
    kwargs['entry'] = StreamTopic(
        topic, **{name: content for name, content in attributes.items() if content is not None},
        **parameters)
    return StreamTopicEverywhere, kwargs


def fogros_launch(entity: Entity, parser: Parser) -> Parsed:
    """Read ``<fogros_launch robot_nodes="after_cloud" dds="fastdds">`` with its content."""
    _, kwargs = Action.parse(entity, parser)
    for name in ('robot_nodes', 'dds'):
        value = entity.get_attr(name, optional=True)
        if value is not None:
            kwargs[name] = text(parser, value)
    below = scoped(parser, _node_with_machine)
    kwargs['actions'], kwargs['stream_topics'] = instead_of(
        below.parse_action(child) for child in entity.children)
    complete(entity, ('robot_nodes', 'dds', *CONDITIONS))
    return FogROSLaunch, kwargs
