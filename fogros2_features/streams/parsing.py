# SPDX-License-Identifier: Apache-2.0
"""Read the element ``<stream_topic>``."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

from launch import Action

from fogros2.actions.frontend.actions import Item
from fogros2.actions.frontend.entity import attribute, children, complete, CONDITIONS, value
from fogros2.describe import kinds
from fogros2.errors import ConfigurationError
from fogros2_features.streams.entries import StreamTopic

if TYPE_CHECKING:
    from launch.frontend import Entity, Parser

    from fogros2.actions.frontend.entity import Parsed

#: The attributes; all else are parameters of the transport.
_STREAM = ('topic', 'transport', 'direction', 'source')


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
    kwargs['item'] = StreamTopic(
        topic, **{name: content for name, content in attributes.items() if content is not None},
        **parameters)
    return Item, {'keyword': 'stream_topics', **kwargs}
