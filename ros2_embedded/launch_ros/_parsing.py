# SPDX-License-Identifier: Apache-2.0
"""Parameters and remappings of nodes in launch files."""
from __future__ import annotations

from typing import Any, List

from launch.actions._simple import parse_pairs
from launch.frontend import Entity, Parser
from launch.frontend.type_utils import get_data_type_from_identifier

from .parameter_descriptions import ParameterFile, ParameterValue


def parse_nested_parameters(params: list[Entity], parser: Parser) -> list[Any]:
    """Return ``parameters`` from ``<param name= value=/>`` and ``<param from=/>``."""
    def read_named(elements: list[Entity]) -> dict[Any, Any]:
        values: dict[Any, Any] = {}
        for element in elements:
            name = tuple(parser.parse_substitution(element.get_attr('name')))
            identifier = element.get_attr('type', data_type=None, optional=True)
            kind = None if identifier is None else (
                get_data_type_from_identifier(identifier))
            value = element.get_attr('value', data_type=kind, optional=True)
            nested = element.get_attr('param', data_type=List[Entity], optional=True)
            element.assert_entity_completely_parsed()
            if nested:
                for other, given in (('value', value), ('type', kind)):
                    if given is not None:
                        raise RuntimeError(
                            f'nested parameters and {other} attributes are mutually '
                            'exclusive')
                values[name] = read_named(nested)
            elif value is not None:
                values[name] = ParameterValue(
                    parser.parse_if_substitutions(value), value_type=kind)
            else:
                raise RuntimeError('either a value attribute or nested params are needed')
        return values

    parameters: list[Any] = []
    for param in params:
        file = param.get_attr('from', optional=True)
        allow_substs = param.get_attr('allow_substs', data_type=bool, optional=True)
        name = param.get_attr('name', optional=True)
        if file is not None and name is not None:
            raise RuntimeError('name and from attributes are mutually exclusive')
        if file is not None:
            param.assert_entity_completely_parsed()
            parameters.append(ParameterFile(
                parser.parse_substitution(file), allow_substs=bool(allow_substs)))
        elif name is not None:
            if allow_substs is not None:
                raise RuntimeError(
                    "'allow_substs' can only be used together with 'from' attribute")
            parameters.append(read_named([param]))
        else:
            raise ValueError('param Entity should have name or from attribute')
    return parameters


def parse_remappings(entity: Entity, parser: Parser) -> list[Any] | None:
    """Return ``remappings`` from ``<remap from= to=/>`` elements, if there are any."""
    pairs = parse_pairs(entity, parser, 'remap', 'from', 'to')
    return None if pairs is None else list(pairs.items())
