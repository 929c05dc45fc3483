# SPDX-License-Identifier: Apache-2.0
"""Evaluated parameters as rclpy's, for nodes that get them through a service."""
from __future__ import annotations

import pathlib
from typing import Any, Iterator

from launch.launch_context import LaunchContext

from ..parameters_type import EvaluatedParameters
from .evaluate_parameters import evaluate_parameter_dict
from .normalize_parameters import normalize_parameter_dict


def _nodes_of(content: dict[str, Any], names: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    for key, value in content.items():
        if key == 'ros__parameters':
            yield '/'.join(names), value
        elif isinstance(value, dict):
            yield from _nodes_of(value, (*names, key.strip('/')))


def _read(path: pathlib.Path, node: str) -> dict[str, Any]:
    import yaml
    content = yaml.safe_load(path.read_text()) or {}
    nodes = dict(_nodes_of(content))
    if not nodes:
        return dict(content)
    return {**nodes.get('**', {}), **nodes.get(node, {})}


def to_parameters_list(
    context: LaunchContext, node_name: str, namespace: str | None,
    evaluated_parameters: EvaluatedParameters
) -> list[Any]:
    """
    Return the node's parameters; of files, what stands there for all nodes or this one.

    :raises RuntimeError: for values that can't be parameters.
    """
    from rclpy.parameter import Parameter
    node = '/'.join(part.strip('/') for part in (namespace or '', node_name) if part.strip('/'))
    parameters = []
    for given in evaluated_parameters:
        values = given if isinstance(given, dict) else evaluate_parameter_dict(
            context, normalize_parameter_dict(_read(given, node)))
        for name, value in values.items():
            kind = next((kind for kind in Parameter.Type if kind.check(value)), None)
            if kind is None:
                raise RuntimeError(f'invalid parameter value {value!r}')
            parameters.append(Parameter(name, kind, value))
    return parameters
