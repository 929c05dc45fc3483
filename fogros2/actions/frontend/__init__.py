# SPDX-License-Identifier: Apache-2.0
"""
Add machines, cloud nodes, cloud groups and streams to launch files of XML and YAML.

launch imports this module for every such file (``launch.frontend.launch_extension``), so each
function imports its parser only when needed. doc/launch_xml_yaml.md describes all elements.
"""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

from launch.frontend import expose_action

if TYPE_CHECKING:
    from launch.frontend import Entity, Parser

    #: The class of an action, and its constructor's keywords.
    Parsed = tuple[type[Any], dict[str, Any]]


@expose_action('fog_machine')
def _fog_machine(entity: Entity, parser: Parser) -> Parsed:
    from fogros2.actions.frontend import parsing
    return parsing.fog_machine(entity, parser)


@expose_action('cloud_node')
def _cloud_node(entity: Entity, parser: Parser) -> Parsed:
    from fogros2.actions.frontend import parsing
    return parsing.cloud_node(entity, parser)


@expose_action('cloud_group')
def _cloud_group(entity: Entity, parser: Parser) -> Parsed:
    from fogros2.actions.frontend import parsing
    return parsing.cloud_group(entity, parser)


@expose_action('stream_topic')
def _stream_topic(entity: Entity, parser: Parser) -> Parsed:
    from fogros2.actions.frontend import parsing
    return parsing.stream_topic(entity, parser)


@expose_action('fogros_launch')
def _fogros_launch(entity: Entity, parser: Parser) -> Parsed:
    from fogros2.actions.frontend import parsing
    return parsing.fogros_launch(entity, parser)
