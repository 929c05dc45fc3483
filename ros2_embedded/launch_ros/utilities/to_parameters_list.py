# SPDX-License-Identifier: Apache-2.0
"""Evaluated parameters as rclpy's, for nodes that get them through a service."""
from __future__ import annotations

import pathlib
from typing import Any, Dict, Iterator, List, Optional, Tuple, TYPE_CHECKING

from launch.launch_context import LaunchContext

from ..parameters_type import EvaluatedParameters
from .evaluate_parameters import evaluate_parameter_dict
from .normalize_parameters import normalize_parameter_dict

if TYPE_CHECKING:
    import rclpy.parameter


def _nodes_of(content: Dict[str, Any], names: Tuple[str, ...] = ()) -> Iterator[Tuple[str, Any]]:
    for key, value in content.items():
        if key == 'ros__parameters':
            yield '/'.join(names), value
        elif isinstance(value, dict):
            yield from _nodes_of(value, (*names, key.strip('/')))


def _read(path: pathlib.Path, node: str) -> Dict[str, Any]:
    import yaml
    content = yaml.safe_load(path.read_text()) or {}
    nodes = dict(_nodes_of(content))
    if not nodes:
        return dict(content)
    return {**nodes.get('**', {}), **nodes.get(node, {})}


def to_parameters_list(
    context: LaunchContext, node_name: str, namespace: Optional[str],
    evaluated_parameters: EvaluatedParameters
) -> List[rclpy.parameter.Parameter]:
    """
    Return the node's parameters; of files, what stands there for all nodes or this one.

    :raises RuntimeError: for values that can't be parameters.
    """
    from rclpy.parameter import Parameter
    node = '/'.join(part.strip('/') for part in (namespace or '', node_name) if part.strip('/'))
    parameters = []
    for given in evaluated_parameters:
        if isinstance(given, pathlib.Path):
            values: Any = evaluate_parameter_dict(
                context, normalize_parameter_dict(_read(given, node)))
        else:
            values = given
        if not isinstance(values, dict):
            raise RuntimeError(f'invalid evaluated parameters {values!r}')
        for name, value in values.items():
            kind = next((kind for kind in Parameter.Type if kind.check(value)), None)
            if kind is None:
                raise RuntimeError(f'invalid parameter value {value!r}')
            parameters.append(Parameter(name, kind, value))
    return parameters
