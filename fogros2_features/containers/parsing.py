# SPDX-License-Identifier: Apache-2.0
"""Read the element ``<docker_container>`` of a ``<fog_machine>``."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

from fogros2.actions.frontend.actions import Item
from fogros2.actions.frontend.entity import complete, value
from fogros2.describe import kinds, values
from fogros2.errors import ConfigurationError
from fogros2_features.containers import Containers, docker_lines
from fogros2_features.containers.commands import described, parse

if TYPE_CHECKING:
    from launch import LaunchContext
    from launch.frontend import Entity, Parser

    from fogros2.actions.frontend.entity import Parsed


class Line(values.Converted):
    """The keywords of a container, which become its command line once they are resolved."""

    @staticmethod
    def convert(value: Any, /) -> Any:
        """Return the command line."""
        return Containers.item(**value)


class DockerContainer(Item):
    """A container of the ``<fog_machine>`` around the element."""

    def execute(self, context: LaunchContext) -> None:
        """Refuse an element elsewhere."""
        raise ConfigurationError('a docker_container runs on a machine',
                                 'write it inside a fog_machine')


def docker_container(entity: Entity, parser: Parser) -> Parsed:
    """Read ``<docker_container cmd="docker run redis"/>``, or ``image=`` and its keywords."""
    parameters = {'cmd': kinds.Keyword('cmd', 'text'), **kinds.parameters_of(described)}
    contents = {name: value(entity, parser, keyword, docker_lines.unfold if name == 'cmd' else str)
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
    return DockerContainer, {'keyword': Containers.machine_list[0],
                             'item': Line(arguments) if line is None else line}
