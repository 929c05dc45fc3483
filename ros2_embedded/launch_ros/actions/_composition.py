# SPDX-License-Identifier: Apache-2.0
"""Containers of composable nodes, and what they load."""
from __future__ import annotations

from pathlib import Path
from typing import Any, List

import launch
from launch import LaunchContext
from launch._base import Entities, ParsedAction
from launch.frontend import Entity, expose_action, Parser
import launch.logging
from launch.utilities import ensure_argument_type, perform_substitutions
from launch.utilities import normalize_to_list_of_substitutions as normalize

from ..descriptions import ComposableNode
from ..parameter_descriptions import ParameterFile
from ..ros_adapters import call_service, get_ros_node
from ..utilities import parameters as ros_parameters
from ..utilities.names import add_node_name, expand_namespace, expand_remappings
from .node import Node


def _parse_nodes(entities: list[Entity], parser: Parser) -> list[ComposableNode]:
    parsed = [ComposableNode.parse(parser, entity) for entity in entities]
    return [cls(**kwargs) for cls, kwargs in parsed]


@expose_action('node_container')
class ComposableNodeContainer(Node):
    """Executes a container, and has it load composable nodes."""

    def __init__(
        self, *, name: launch.SomeSubstitutionsType, namespace: launch.SomeSubstitutionsType,
        composable_node_descriptions: list[ComposableNode] | None = None, **kwargs: Any
    ) -> None:
        super().__init__(name=name, namespace=namespace, **kwargs)
        self.__composable_node_descriptions = composable_node_descriptions

    @classmethod
    def parse(
        cls, entity: Entity, parser: Parser, ignore: list[str] | None = None
    ) -> ParsedAction:
        _, kwargs = super().parse(entity, parser, ignore)
        nodes = entity.get_attr('composable_node', data_type=List[Entity], optional=True)
        if nodes is not None:
            kwargs['composable_node_descriptions'] = _parse_nodes(nodes, parser)
        return cls, kwargs

    def execute(self, context: LaunchContext) -> Entities | None:
        nodes = [
            node for node in self.__composable_node_descriptions or ()
            if (condition := node.condition()) is None or condition.evaluate(context)]
        entities = list(super().execute(context) or ())
        if nodes:
            entities.append(LoadComposableNodes(
                composable_node_descriptions=nodes, target_container=self))
        return entities or None


@expose_action('load_composable_node')
class LoadComposableNodes(launch.Action):
    """
    Has a container load composable nodes, one after another.

    :param target_container: the action, or the container's full name.
    """

    def __init__(
        self, *, composable_node_descriptions: list[ComposableNode],
        target_container: launch.SomeSubstitutionsType | ComposableNodeContainer, **kwargs: Any
    ) -> None:
        ensure_argument_type(
            target_container, (*launch.SomeSubstitutionsType_types_tuple, ComposableNodeContainer),
            'target_container', 'LoadComposableNodes')
        super().__init__(**kwargs)
        self.__composable_node_descriptions = composable_node_descriptions
        self.__target_container = target_container
        self.__final_target_container_name: str | None = None
        self.__rclpy_load_node_client: Any = None
        self.__logger = launch.logging.get_logger(__name__)

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> ParsedAction:
        _, kwargs = super().parse(entity, parser)
        kwargs['target_container'] = parser.parse_substitution(entity.get_attr('target'))
        kwargs['composable_node_descriptions'] = _parse_nodes(
            entity.get_attr('composable_node', data_type=List[Entity]), parser)
        return cls, kwargs

    def _load_node(self, request: Any, context: LaunchContext) -> None:
        response = call_service(
            self.__rclpy_load_node_client, request, context, self.__logger)
        if response is None:
            return
        container = self.__final_target_container_name
        name = response.full_node_name or request.node_name
        if not response.success:
            self.__logger.error(
                f"Failed to load node '{name}' of type '{request.plugin_name}' in container "
                f"'{container}': {response.error_message}")
            return
        if warning := add_node_name(context, name):
            launch.logging.get_logger(container).warning(warning)
        self.__logger.info(
            f"Loaded node '{response.full_node_name}' in container '{container}'")

    def execute(self, context: LaunchContext) -> Entities | None:
        if isinstance(self.__target_container, ComposableNodeContainer):
            container = self.__target_container.node_name
        else:
            container = perform_substitutions(
                context, normalize(self.__target_container))
        self.__final_target_container_name = container
        from composition_interfaces.srv import LoadNode
        self.__rclpy_load_node_client = get_ros_node(context).create_client(
            LoadNode, f'{container}/_container/load_node')
        requests = [
            request for node in self.__composable_node_descriptions
            if (request := get_composable_node_load_request(node, context)) is not None]

        def load_in_sequence() -> None:
            for request in requests:
                self._load_node(request, context)

        context.add_completion_future(
            context.asyncio_loop.run_in_executor(None, load_in_sequence))
        return None


def get_composable_node_load_request(
    composable_node_description: ComposableNode, context: LaunchContext
) -> Any:
    """Return the LoadNode request for a composable node, None if its condition is false."""
    node = composable_node_description
    condition = node.condition()
    if condition is not None and not condition.evaluate(context):
        return None
    from composition_interfaces.srv import LoadNode
    request = LoadNode.Request()
    request.package_name = perform_substitutions(context, node.package)
    request.plugin_name = perform_substitutions(context, node.node_plugin)
    if node.node_name is not None:
        request.node_name = perform_substitutions(context, node.node_name)
    namespace = expand_namespace(context, node.node_namespace)
    if namespace is not None:
        request.node_namespace = namespace
    request.remap_rules = [f'{source}:={target}' for source, target in expand_remappings(
        context, node.remappings or ())]

    def messages(parameters: list[Any]) -> list[Any]:
        return [parameter.to_parameter_msg() for parameter in ros_parameters.to_parameters_list(
            context, request.node_name, namespace,
            ros_parameters.evaluate_parameters(context, parameters))]

    parameters: list[Any] = [
        ros_parameters.normalize_parameter_dict({given[0]: given[1]}) if isinstance(given, tuple)
        else ParameterFile(Path(given).resolve())
        for given in context.launch_configurations.get('global_params', ())]
    request.parameters = messages([*parameters, *(node.parameters or ())])
    request.extra_arguments = messages([*(node.extra_arguments or ())])
    return request
