# SPDX-License-Identifier: Apache-2.0
"""A node for a container to load."""
from __future__ import annotations

from typing import Any, Dict, Iterable, List, Optional, Tuple, Type

from launch.action import Action
from launch.condition import Condition
from launch.frontend import Entity, Parser
from launch.some_substitutions_type import SomeSubstitutionsType
from launch.substitution import Substitution
from launch.utilities import normalize_to_list_of_substitutions

from ..parameters_type import Parameters, SomeParameters
from ..remap_rule_type import RemapRule, SomeRemapRules
from ..utilities import normalize_parameters, normalize_remap_rules


def _normalized(text: Optional[SomeSubstitutionsType]) -> Optional[List[Substitution]]:
    return None if text is None else normalize_to_list_of_substitutions(text)


class ComposableNode:
    """
    A node for a container to load.

    :param plugin: the node's class.
    :param extra_arguments: for the container, such as ``use_intra_process_comms``.
    """

    def __init__(
        self, *, package: SomeSubstitutionsType, plugin: SomeSubstitutionsType,
        name: Optional[SomeSubstitutionsType] = None,
        namespace: Optional[SomeSubstitutionsType] = None,
        parameters: Optional[SomeParameters] = None,
        remappings: Optional[SomeRemapRules] = None,
        extra_arguments: Optional[SomeParameters] = None,
        condition: Optional[Condition] = None
    ) -> None:
        self.__package = normalize_to_list_of_substitutions(package)
        self.__node_plugin = normalize_to_list_of_substitutions(plugin)
        self.__node_name = _normalized(name)
        self.__node_namespace = _normalized(namespace)
        self.__parameters = None if parameters is None else normalize_parameters(parameters)
        self.__remappings = list(normalize_remap_rules(remappings)) if remappings else None
        self.__extra_arguments = (
            normalize_parameters(extra_arguments) if extra_arguments else None)
        self.__condition = condition

    @classmethod
    def parse(
        cls, parser: Parser, entity: Entity
    ) -> Tuple[Type[ComposableNode], Dict[str, Any]]:
        """Return this class and the keyword arguments that a frontend's entity gives."""
        from ..actions import Node
        from ..actions.node import parse_remappings
        _, kwargs = Action.parse(entity, parser)
        for name, attribute in (('package', 'pkg'), ('plugin', 'plugin'), ('name', 'name')):
            kwargs[name] = parser.parse_substitution(entity.get_attr(attribute))
        namespace = entity.get_attr('namespace', optional=True)
        if namespace is not None:
            kwargs['namespace'] = parser.parse_substitution(namespace)
        parameters = entity.get_attr('param', data_type=List[Entity], optional=True)
        if parameters is not None:
            kwargs['parameters'] = Node.parse_nested_parameters(parameters, parser)
        remappings = parse_remappings(entity, parser)
        if remappings is not None:
            kwargs['remappings'] = remappings
        extra = entity.get_attr('extra_arg', data_type=List[Entity], optional=True)
        if extra is not None:
            kwargs['extra_arguments'] = [
                {tuple(parser.parse_substitution(argument.get_attr('name'))):
                 parser.parse_substitution(argument.get_attr('value'))} for argument in extra]
            for argument in extra:
                argument.assert_entity_completely_parsed()
        entity.assert_entity_completely_parsed()
        return cls, kwargs

    @property
    def package(self) -> List[Substitution]:
        """The package's name."""
        return self.__package

    @property
    def node_plugin(self) -> List[Substitution]:
        """The node's class."""
        return self.__node_plugin

    @property
    def node_name(self) -> Optional[List[Substitution]]:
        """The node's name, if given."""
        return self.__node_name

    @property
    def node_namespace(self) -> Optional[List[Substitution]]:
        """The node's namespace, if given."""
        return self.__node_namespace

    @property
    def parameters(self) -> Optional[Parameters]:
        """The node's parameters, if given."""
        return self.__parameters

    @property
    def remappings(self) -> Optional[Iterable[RemapRule]]:
        """The node's remappings, if given."""
        return self.__remappings

    @property
    def extra_arguments(self) -> Optional[Parameters]:
        """The arguments for the container, if given."""
        return self.__extra_arguments

    def condition(self) -> Optional[Condition]:
        """Return the condition, if any."""
        return self.__condition
