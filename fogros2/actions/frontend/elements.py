# SPDX-License-Identifier: Apache-2.0
"""
Add machines, cloud nodes and cloud groups to launch files of XML and YAML.

launch imports this module for every such file (``launch.frontend.launch_extension``), so the
parsers are imported only when needed. doc/launch_xml_yaml.md describes all elements.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from launch.frontend import expose_action

from fogros2.launch_internals import hints

if TYPE_CHECKING:
    from launch.frontend import Entity, Parser

    from fogros2.actions.frontend.entity import Parsed


def expose(name: str, module: str) -> None:
    """Let launch read an element by the function of this name in a module."""
    def parse(entity: Entity, parser: Parser) -> Parsed:
        parsed: Parsed = getattr(importlib.import_module(module), name)(entity, parser)
        return parsed

    expose_action(name)(parse)


hints.of_elements()
for _name in ('fog_machine', 'cloud_node', 'cloud_group', 'fogros_launch'):
    expose(_name, 'fogros2.actions.frontend.parsing')
