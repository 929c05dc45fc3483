# SPDX-License-Identifier: Apache-2.0
"""Actions that set something for all nodes that follow, in their scope."""
from __future__ import annotations

import os
from typing import Any

from launch import Action, SomeSubstitutionsType
from launch.frontend import expose_action
from launch.launch_context import LaunchContext
from launch.logging import _get_logging_directory
from launch.substitutions import SubstitutionFailure
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions

from ..utilities.names import check_namespace, make_namespace_absolute, prefix_namespace
from ..utilities.parameters import evaluate_parameter_dict, normalize_parameter_dict

__all__ = [
    'PushROSNamespace', 'SetParameter', 'SetParametersFromFile', 'SetRemap', 'SetROSLogDir']


@expose_action('push_ros_namespace')
@expose_action('push-ros-namespace')
class PushROSNamespace(Action):
    """
    Puts a namespace below the present one, or if absolute in its place.

    :raises SubstitutionFailure: when executed, if that gives no valid namespace.
    """

    _texts = {'namespace': 'namespace'}

    def __init__(self, namespace: SomeSubstitutionsType, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.namespace = normalize_to_list_of_substitutions(namespace)

    def execute(self, context: LaunchContext) -> None:
        pushed = perform_substitutions(context, self.namespace)
        previous = context.launch_configurations.get('ros_namespace')
        namespace = make_namespace_absolute(prefix_namespace(previous, pushed) or '')
        try:
            check_namespace(namespace)
        except Exception as exc:  # rclpy's errors have no other base
            raise SubstitutionFailure(
                'The resulting namespace is invalid: '
                f"[previous_namespace='{previous}', pushed_namespace='{pushed}']") from exc
        context.launch_configurations['ros_namespace'] = namespace


def _append(context: LaunchContext, name: str, *items: Any) -> None:
    # In place, as in ROS 2: a list that was there before a scope keeps what is added in it.
    context.launch_configurations.setdefault(name, []).extend(items)


@expose_action('set_parameter')
class SetParameter(Action):

    _texts = {'name': 'name', 'value': 'value'}

    def __init__(self, name: SomeSubstitutionsType, value: Any, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.__param_dict = normalize_parameter_dict(
            {tuple(normalize_to_list_of_substitutions(name)): value})

    def execute(self, context: LaunchContext) -> None:
        values = evaluate_parameter_dict(context, self.__param_dict)
        _append(context, 'global_params', *values.items())


@expose_action('set_parameters_from_file')
class SetParametersFromFile(Action):

    _texts = {'filename': 'filename'}

    def __init__(self, filename: SomeSubstitutionsType, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._input_file = normalize_to_list_of_substitutions(filename)

    def execute(self, context: LaunchContext) -> None:
        _append(context, 'global_params', perform_substitutions(context, self._input_file))


@expose_action('set_remap')
class SetRemap(Action):

    _texts = {'src': 'from', 'dst': 'to'}

    def __init__(
        self, src: SomeSubstitutionsType, dst: SomeSubstitutionsType, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        self.src = normalize_to_list_of_substitutions(src)
        self.dst = normalize_to_list_of_substitutions(dst)

    def execute(self, context: LaunchContext) -> None:
        _append(context, 'ros_remaps', (
            perform_substitutions(context, self.src), perform_substitutions(context, self.dst)))


@expose_action('set_ros_log_dir')
class SetROSLogDir(Action):
    """Sets where nodes that follow log to, below the present directory unless absolute."""

    _texts = {'new_log_dir': 'new_log_dir'}

    def __init__(self, new_log_dir: SomeSubstitutionsType, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.log_dir = normalize_to_list_of_substitutions(new_log_dir)

    def execute(self, context: LaunchContext) -> None:
        os.environ['ROS_LOG_DIR'] = os.path.join(
            _get_logging_directory(), perform_substitutions(context, self.log_dir))
