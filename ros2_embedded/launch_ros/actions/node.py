# SPDX-License-Identifier: Apache-2.0
"""The action that executes a ROS node."""
from __future__ import annotations

import atexit
import os
import pathlib
from tempfile import NamedTemporaryFile
from typing import Any, Iterable, List, Sequence

from launch import LaunchDescriptionEntity, SomeSubstitutionsType
from launch._base import ParsedAction
from launch.actions import ExecuteProcess
from launch.frontend import Entity, expose_action, Parser
from launch.launch_context import LaunchContext
import launch.logging
from launch.substitutions import LocalSubstitution
from launch.utilities import ensure_argument_type, perform_substitutions
from launch.utilities import normalize_to_list_of_substitutions as normalize
from launch.utilities.ros_yaml import dump

from .._parsing import parse_nested_parameters, parse_remappings
from ..substitutions import ExecutableInPackage
from ..utilities import names
from ..utilities.parameters import as_argument, evaluate_parameters, normalize_parameters


@expose_action('node')
class Node(ExecuteProcess):
    """
    Executes a node.

    :param executable: a file name in the package, or without a package a path.
    :param exec_name: the process's name in the launch.
    :param parameters: files and dictionaries; later ones win.
    :param remappings: pairs of names.
    :param ros_arguments: what goes behind ``--ros-args``.
    :param arguments: what goes to the executable itself.
    """

    _texts = {**ExecuteProcess._texts, 'executable': 'exec', 'package': 'pkg?',
              'exec_name': 'exec_name?', 'namespace': 'namespace?'}
    UNSPECIFIED_NODE_NAME = '<node_name_unspecified>'
    UNSPECIFIED_NODE_NAMESPACE = '<node_namespace_unspecified>'
    parse_nested_parameters = staticmethod(parse_nested_parameters)

    def __init__(
        self, *, executable: SomeSubstitutionsType, package: SomeSubstitutionsType | None = None,
        name: SomeSubstitutionsType | None = None, namespace: SomeSubstitutionsType | None = None,
        exec_name: SomeSubstitutionsType | None = None, parameters: Sequence[Any] | None = None,
        remappings: Iterable[Any] | None = None,
        ros_arguments: Iterable[SomeSubstitutionsType] | None = None,
        arguments: Iterable[SomeSubstitutionsType] | None = None, **kwargs: Any
    ) -> None:
        cmd: list[SomeSubstitutionsType] = [
            executable if package is None else
            ExecutableInPackage(package=package, executable=executable)]
        cmd += arguments or ()
        if ros_arguments is not None:
            cmd += ['--ros-args', *ros_arguments]
        cmd += ['--ros-args']
        if name is not None:
            cmd += ['-r', LocalSubstitution(
                "ros_specific_arguments['name']", description='node name')]
        self.__parameters: Sequence[Any] = ()
        if parameters is not None:
            ensure_argument_type(parameters, list, 'parameters', 'Node')
            self.__parameters = normalize_parameters(parameters)
        super().__init__(cmd=cmd, name=exec_name, **kwargs)
        self.__package = package
        self.__node_executable = executable
        self.__node_name = name
        self.__node_namespace = namespace
        self.__remappings = list(names.normalize_remap_rules(remappings or ()))
        self.__expanded_node_name = self.UNSPECIFIED_NODE_NAME
        self.__expanded_node_namespace = self.UNSPECIFIED_NODE_NAMESPACE
        self.__final_node_name: str | None = None
        self.__expanded_remappings: list[tuple[str, str]] | None = None
        self.__logger = launch.logging.get_logger(__name__)

    @classmethod
    def parse(
        cls, entity: Entity, parser: Parser, ignore: list[str] | None = None
    ) -> ParsedAction:
        _, kwargs = super().parse(entity, parser, ignore=['cmd', *(ignore or ())])
        for name, attribute in (('arguments', 'args'), ('ros_arguments', 'ros_args')):
            text = entity.get_attr(attribute, optional=True)
            if text is not None:
                kwargs[name] = cls._parse_cmdline(text, parser)
        kwargs['remappings'] = parse_remappings(entity, parser)
        parameters = entity.get_attr('param', data_type=List[Entity], optional=True)
        if parameters is not None:
            kwargs['parameters'] = cls.parse_nested_parameters(parameters, parser)
        return cls, kwargs

    @property
    def node_package(self) -> SomeSubstitutionsType | None:
        return self.__package

    @property
    def node_executable(self) -> SomeSubstitutionsType:
        return self.__node_executable

    @property
    def node_name(self) -> str:
        if self.__final_node_name is None:
            raise RuntimeError("cannot access 'node_name' before executing action")
        return self.__final_node_name

    @property
    def expanded_node_namespace(self) -> str:
        return self.__expanded_node_namespace

    @property
    def expanded_remapping_rules(self) -> list[tuple[str, str]] | None:
        """The pairs of names, global ones first, once substitutions are performed."""
        return self.__expanded_remappings

    def is_node_name_fully_specified(self) -> bool:
        return (self.UNSPECIFIED_NODE_NAME not in self.node_name
                and self.UNSPECIFIED_NODE_NAMESPACE not in self.node_name)

    def _create_params_file_from_dict(self, params: dict[str, Any]) -> str:
        node = self.node_name if self.is_node_name_fully_specified() else '/**'
        with NamedTemporaryFile(
                mode='w', prefix='launch_params_', delete=False, encoding='utf-8') as file:
            file.write(dump({node: {'ros__parameters': params}}))
        # not sooner: a node that is started again reads it again
        atexit.register(pathlib.Path(file.name).unlink, missing_ok=True)
        return file.name

    def __extend_cmd(self, *words: SomeSubstitutionsType) -> None:
        self.cmd.extend(normalize(word) for word in words)

    def __expand_name(self, context: LaunchContext) -> None:
        if self.__node_name is not None:
            self.__expanded_node_name = perform_substitutions(
                context, normalize(self.__node_name))
            names.check_node_name(self.__expanded_node_name)
        namespace = names.expand_namespace(context, self.__node_namespace)
        if namespace is not None:
            self.__expanded_node_namespace = namespace
            self.__extend_cmd('-r', LocalSubstitution("ros_specific_arguments['ns']"))
            names.check_namespace(self.__expanded_node_namespace)

    def __expand_parameters(self, context: LaunchContext) -> None:
        for given in context.launch_configurations.get('global_params', ()):
            if isinstance(given, tuple):
                self.__extend_cmd('-p', f'{given[0]}:={as_argument(given[1])}')
                continue
            path = os.path.abspath(given)
            if not os.path.isfile(path):
                raise AssertionError(f'Parameter file path is not a file: {path}')
            self.__extend_cmd('--params-file', path)
        for parameter in evaluate_parameters(context, self.__parameters):
            if isinstance(parameter, dict):
                self.__extend_cmd('--params-file', self._create_params_file_from_dict(parameter))
            elif os.path.isfile(parameter):
                self.__extend_cmd('--params-file', str(parameter))
            else:
                self.__logger.warning(f'Parameter file path is not a file: {parameter}')

    def __expand_remappings(self, context: LaunchContext) -> None:
        rules = names.expand_remappings(context, self.__remappings)
        self.__expanded_remappings = rules or None
        for source, target in rules:
            self.__extend_cmd('-r', f'{source}:={target}')

    def _perform_substitutions(self, context: LaunchContext) -> None:
        if self.__final_node_name is not None:
            # Derived classes need the name before this class executes.
            return
        try:
            self.__expand_name(context)
        except Exception:
            self.__logger.error(
                'Error while expanding or validating node name or namespace for '
                f"'package={self.__package}, executable={self.__node_executable}, "
                f"name={self.__node_name}, namespace={self.__node_namespace}':")
            raise
        self.__final_node_name = names.prefix_namespace(
            self.__expanded_node_namespace, self.__expanded_node_name)
        self.__expand_parameters(context)
        self.__expand_remappings(context)

    def execute(self, context: LaunchContext) -> list[LaunchDescriptionEntity] | None:
        self._perform_substitutions(context)
        context.extend_locals({'ros_specific_arguments': {
            'name': f'__node:={self.__expanded_node_name}',
            'ns': f'__ns:={self.__expanded_node_namespace}'}})
        entities = super().execute(context)
        if self.is_node_name_fully_specified():
            if warning := names.add_node_name(context, self.node_name):
                launch.logging.get_logger(self.name).warning(warning)
        return entities
