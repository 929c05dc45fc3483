# SPDX-License-Identifier: Apache-2.0
"""What nodes are made of."""
from __future__ import annotations

from typing import Any, List, Sequence

from embedded_default.lacking import lacking
from launch import Action, Condition, SomeSubstitutionsType
from launch.frontend import Entity, Parser
from launch.substitutions import normalized_default
from launch.utilities import normalize_to_list_of_substitutions

from .._parsing import parse_nested_parameters, parse_remappings
from ..parameter_descriptions import ParameterFile as ParameterFile
from ..parameter_descriptions import ParameterValue as ParameterValue
from ..utilities import normalize_parameters, normalize_remap_rules

__getattr__ = lacking(__name__, 'ComposableLifecycleNode Parameter')


class _Described(Action):
    """What launch files say of a composable node as they do of actions."""

    _texts = {'package': 'pkg', 'plugin': 'plugin', 'name': 'name', 'namespace': 'namespace?'}


class ComposableNode:
    """
    A node for a container to load.

    :param plugin: the node's class.
    :param extra_arguments: for the container, such as ``use_intra_process_comms``.
    """

    def __init__(
        self, *, package: SomeSubstitutionsType, plugin: SomeSubstitutionsType,
        name: SomeSubstitutionsType | None = None, namespace: SomeSubstitutionsType | None = None,
        parameters: Sequence[Any] | None = None, remappings: Any = None,
        extra_arguments: Sequence[Any] | None = None, condition: Condition | None = None
    ) -> None:
        self.package = normalize_to_list_of_substitutions(package)
        self.node_plugin = normalize_to_list_of_substitutions(plugin)
        self.node_name = normalized_default(name)
        self.node_namespace = normalized_default(namespace)
        self.parameters = None if parameters is None else normalize_parameters(parameters)
        self.remappings = list(normalize_remap_rules(remappings)) if remappings else None
        self.extra_arguments = normalize_parameters(extra_arguments) if extra_arguments else None
        self.__condition = condition

    @classmethod
    def parse(cls, parser: Parser, entity: Entity) -> tuple[type[ComposableNode], dict[str, Any]]:
        _, kwargs = _Described.parse(entity, parser)
        parameters = entity.get_attr('param', data_type=List[Entity], optional=True)
        if parameters is not None:
            kwargs['parameters'] = parse_nested_parameters(parameters, parser)
        kwargs['remappings'] = parse_remappings(entity, parser)
        extra = entity.get_attr('extra_arg', data_type=List[Entity], optional=True) or ()
        kwargs['extra_arguments'] = [
            {tuple(parser.parse_substitution(argument.get_attr('name'))):
             parser.parse_substitution(argument.get_attr('value'))} for argument in extra]
        for argument in extra:
            argument.assert_entity_completely_parsed()
        entity.assert_entity_completely_parsed()
        return cls, kwargs

    def condition(self) -> Condition | None:
        return self.__condition
