# SPDX-License-Identifier: Apache-2.0
"""Actions that set something for all nodes that follow, in their scope."""
from __future__ import annotations

import os
from typing import Any, List

from launch import Action, Substitution
from launch.action import ParsedAction
from launch.frontend import Entity, expose_action, Parser
from launch.launch_context import LaunchContext
from launch.some_substitutions_type import SomeSubstitutionsType
from launch.substitutions import SubstitutionFailure
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions

from ..parameters_type import ParameterName, ParameterValue, SomeParameterValue
from ..ros_adapters import get_ros_node
from ..utilities import make_namespace_absolute, prefix_namespace
from ..utilities.evaluate_parameters import evaluate_parameter_dict
from ..utilities.namespace_utils import check_namespace
from ..utilities.normalize_parameters import normalize_parameter_dict


@expose_action('push_ros_namespace')
@expose_action('push-ros-namespace')
class PushROSNamespace(Action):
    """
    Puts a namespace below the present one, or if absolute in its place.

    :raises SubstitutionFailure: when executed, if that gives no valid namespace.
    """

    def __init__(self, namespace: SomeSubstitutionsType, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.__namespace = normalize_to_list_of_substitutions(namespace)

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['namespace'] = parser.parse_substitution(entity.get_attr('namespace'))
        return cls, kwargs

    @property
    def namespace(self) -> List[Substitution]:
        """The namespace as it was given."""
        return self.__namespace

    def execute(self, context: LaunchContext) -> None:
        pushed = perform_substitutions(context, self.namespace)
        previous = context.launch_configurations.get('ros_namespace')
        namespace = make_namespace_absolute(prefix_namespace(previous, pushed) or '')
        try:
            check_namespace(namespace)
        except Exception as exc:  # noqa: BLE001 - rclpy has none in common but this.
            raise SubstitutionFailure(
                'The resulting namespace is invalid: '
                f"[previous_namespace='{previous}', pushed_namespace='{pushed}']") from exc
        context.launch_configurations['ros_namespace'] = namespace


def _append(context: LaunchContext, name: str, *items: Any) -> None:
    # In place, as in ROS 2: a list that was there before a scope keeps what is added in it.
    context.launch_configurations.setdefault(name, []).extend(items)


@expose_action('set_parameter')
class SetParameter(Action):
    """Sets a parameter of all nodes that follow."""

    def __init__(
        self, name: SomeSubstitutionsType, value: SomeParameterValue, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        self.__param_dict = normalize_parameter_dict(
            {tuple(normalize_to_list_of_substitutions(name)): value})

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['name'] = parser.parse_substitution(entity.get_attr('name'))
        kwargs['value'] = parser.parse_substitution(entity.get_attr('value'))
        return cls, kwargs

    @property
    def name(self) -> ParameterName:
        """The parameter's name."""
        return next(iter(self.__param_dict))

    @property
    def value(self) -> ParameterValue:
        """The parameter's value."""
        return next(iter(self.__param_dict.values()))

    def execute(self, context: LaunchContext) -> None:
        values = evaluate_parameter_dict(context, self.__param_dict)
        _append(context, 'global_params', *values.items())


@expose_action('set_parameters_from_file')
class SetParametersFromFile(Action):
    """Gives all nodes that follow a file of parameters."""

    def __init__(self, filename: SomeSubstitutionsType, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._input_file = normalize_to_list_of_substitutions(filename)

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['filename'] = parser.parse_substitution(entity.get_attr('filename'))
        return cls, kwargs

    def execute(self, context: LaunchContext) -> None:
        _append(context, 'global_params', perform_substitutions(context, self._input_file))


@expose_action('set_remap')
class SetRemap(Action):
    """Remaps a name in all nodes that follow."""

    def __init__(
        self, src: SomeSubstitutionsType, dst: SomeSubstitutionsType, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        self.__src = normalize_to_list_of_substitutions(src)
        self.__dst = normalize_to_list_of_substitutions(dst)

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['src'] = parser.parse_substitution(entity.get_attr('from'))
        kwargs['dst'] = parser.parse_substitution(entity.get_attr('to'))
        return cls, kwargs

    @property
    def src(self) -> List[Substitution]:
        """The name."""
        return self.__src

    @property
    def dst(self) -> List[Substitution]:
        """What it becomes."""
        return self.__dst

    def execute(self, context: LaunchContext) -> None:
        _append(context, 'ros_remaps', (
            perform_substitutions(context, self.__src),
            perform_substitutions(context, self.__dst)))


@expose_action('set_ros_log_dir')
class SetROSLogDir(Action):
    """Sets where nodes that follow log to, below the present directory unless absolute."""

    def __init__(self, new_log_dir: SomeSubstitutionsType, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.__log_dir = normalize_to_list_of_substitutions(new_log_dir)

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['new_log_dir'] = parser.parse_substitution(entity.get_attr('new_log_dir'))
        return cls, kwargs

    @property
    def log_dir(self) -> List[Substitution]:
        """The directory as it was given."""
        return self.__log_dir

    def execute(self, context: LaunchContext) -> None:
        from launch.logging import _base_directory
        os.environ['ROS_LOG_DIR'] = os.path.join(
            _base_directory(), perform_substitutions(context, self.log_dir))


@expose_action('set_use_sim_time')
class SetUseSimTime(Action):
    """Sets ``use_sim_time`` of the launch's own node, which :class:`ROSTimer` counts by."""

    def __init__(self, value: bool, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.__value = value

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['value'] = parser.parse_substitution(entity.get_attr('value'))
        return cls, kwargs

    @property
    def value(self) -> bool:
        """The value."""
        return self.__value

    def execute(self, context: LaunchContext) -> None:
        from rclpy.parameter import Parameter
        node = get_ros_node(context)
        node.set_parameters([Parameter('use_sim_time', Parameter.Type.BOOL, self.value)])
        if not node.get_parameter('use_sim_time').get_parameter_value().bool_value:
            raise RuntimeError('Failed to set use_sim_time parameter')
