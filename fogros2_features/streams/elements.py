# SPDX-License-Identifier: Apache-2.0
"""
Add the element ``<stream_topic>`` to launch files of XML and YAML.

launch imports this module for every such file (``launch.frontend.launch_extension``), so the
parser is imported only when needed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from launch.frontend import expose_action

if TYPE_CHECKING:
    from launch.frontend import Entity, Parser

    from fogros2.actions.frontend.entity import Parsed


@expose_action('stream_topic')
def _parse(entity: Entity, parser: Parser) -> Parsed:
    from fogros2_features.streams import parsing
    return parsing.stream_topic(entity, parser)
