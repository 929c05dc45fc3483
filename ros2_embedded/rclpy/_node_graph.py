# SPDX-License-Identifier: Apache-2.0
"""The part of a node that knows the others."""

from collections.abc import Iterable
from functools import partialmethod

from rclpy import _names
from rclpy._dds import Endpoint
from rclpy._graph import Graph, NodeInfo, user_data_value
from rclpy.exceptions import NodeNameNonExistentError
from rclpy.qos import QoSProfile
from rclpy.topic_endpoint_info import TopicEndpointInfo, TopicEndpointTypeEnum
from rclpy.type_hash import TypeHash

NamesAndTypes = list[tuple[str, list[str]]]


def _collect(pairs: Iterable[tuple[str, str]]) -> NamesAndTypes:
    found: dict[str, set[str]] = {}
    for name, kind in pairs:
        found.setdefault(name, set()).add(kind)
    return [(name, sorted(found[name])) for name in sorted(found)]


def _topics(endpoints: Iterable[Endpoint], no_demangle: bool) -> NamesAndTypes:
    if no_demangle:
        return _collect((endpoint.topic, endpoint.type) for endpoint in endpoints)
    return _collect((name, _names.ros_type(endpoint.type)) for endpoint in endpoints
                    if (name := _names.demangle_topic(endpoint.topic)) is not None)


def _services(endpoints: Iterable[Endpoint], requests: bool | None = None) -> NamesAndTypes:
    """Services that endpoints are part of; of those of requests, of responses, or (None) both."""
    demangled = (_names.demangle_service(one.topic, one.type) for one in endpoints)
    return _collect(found[:2] for found in demangled
                    if found is not None and requests in (None, found[2]))


class NodeGraph:
    """Asks for nodes, topics and services; a part of :class:`.Node`."""

    _graph: Graph
    _name: str
    _namespace: str

    # --- nodes ---

    def get_node_names(self) -> list[str]:
        """List the nodes' names."""
        return [node.name for node in self._graph.nodes()]

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        """List the nodes' names and namespaces."""
        return [(node.name, node.namespace) for node in self._graph.nodes()]

    def get_fully_qualified_node_names(self) -> list[str]:
        """List the nodes' names with their namespaces."""
        return [_names.join(node.namespace, node.name) for node in self._graph.nodes()]

    def _of_node(self, name: str, namespace: str, writers: bool) -> list[Endpoint]:
        found = [node for node in self._graph.nodes()
                 if (node.name, node.namespace) == (name, namespace or '/')]
        if not found:
            raise NodeNameNonExistentError(
                f"Cannot get information by node: node name not found: '{name}'")
        ids = {guid for node in found for guid in (node.writers if writers else node.readers)}
        return [one for one in self._graph.endpoints(writers) if one.guid in ids]

    def _topics_of_node(self, node_name: str, node_namespace: str, no_demangle: bool = False, *,
                        writers: bool) -> NamesAndTypes:
        """
        List the topics that a node publishes (or subscribes to), with their types.

        :raises NodeNameNonExistentError: if there is no such node.
        """
        return _topics(self._of_node(node_name, node_namespace, writers), no_demangle)

    get_publisher_names_and_types_by_node = partialmethod(_topics_of_node, writers=True)
    get_subscriber_names_and_types_by_node = partialmethod(_topics_of_node, writers=False)

    def _services_of_node(
            self, node_name: str, node_namespace: str, *, serves: bool) -> NamesAndTypes:
        """
        List the services that a node serves (or has clients of), with their types.

        :raises NodeNameNonExistentError: if there is no such node.
        """
        return _services(self._of_node(node_name, node_namespace, False), serves)

    get_service_names_and_types_by_node = partialmethod(_services_of_node, serves=True)
    get_client_names_and_types_by_node = partialmethod(_services_of_node, serves=False)

    # --- topics and services ---

    def _all(self) -> list[Endpoint]:
        return self._graph.endpoints(True) + self._graph.endpoints(False)

    def get_topic_names_and_types(self, no_demangle: bool = False) -> NamesAndTypes:
        """List the topics with their types."""
        return _topics(self._all(), no_demangle)

    def get_service_names_and_types(self) -> NamesAndTypes:
        """List the services with their types."""
        return _services(self._all())

    def _full(self, name: str, is_service: bool = False) -> str:
        full = _names.expand(name, self._name, self._namespace)
        _names.validate_full_topic_name(full, is_service=is_service)
        return full

    def _count(self, dds_topic: str, writers: bool) -> int:
        return sum(one.topic == dds_topic for one in self._graph.endpoints(writers))

    def count_publishers(self, topic_name: str) -> int:
        """Count the publishers of a topic; its name is expanded, not remapped."""
        return self._count('rt' + self._full(topic_name), True)

    def count_subscribers(self, topic_name: str) -> int:
        """Count the subscriptions of a topic; its name is expanded, not remapped."""
        return self._count('rt' + self._full(topic_name), False)

    def count_clients(self, service_name: str) -> int:
        """Count the clients of a service; its name is expanded, not remapped."""
        return self._count(f'rr{self._full(service_name, True)}Reply', False)

    def count_services(self, service_name: str) -> int:
        """Count the servers of a service; its name is expanded, not remapped."""
        return self._count(f'rq{self._full(service_name, True)}Request', False)

    def _info(self, topic_name: str, no_mangle: bool = False, *,
              writers: bool) -> list[TopicEndpointInfo]:
        """Describe the publishers (or subscriptions) of a topic; names aren't remapped."""
        name = topic_name if no_mangle else 'rt' + self._full(topic_name)
        nodes: dict[bytes, NodeInfo] = {
            guid: node for node in self._graph.nodes()
            for guid in (node.writers if writers else node.readers)}
        unknown = NodeInfo('_NODE_NAME_UNKNOWN_', '_NODE_NAMESPACE_UNKNOWN_', [], [])
        kind = TopicEndpointTypeEnum.PUBLISHER if writers else TopicEndpointTypeEnum.SUBSCRIPTION
        return [
            TopicEndpointInfo(
                node_name=nodes.get(one.guid, unknown).name,
                node_namespace=nodes.get(one.guid, unknown).namespace,
                topic_type=one.type if no_mangle else _names.ros_type(one.type),
                topic_type_hash=TypeHash._parse(user_data_value(one, 'typehash')),
                endpoint_type=kind,
                endpoint_gid=tuple(one.guid),
                qos_profile=QoSProfile._from_policies(one.policies))
            for one in self._graph.endpoints(writers) if one.topic == name]

    get_publishers_info_by_topic = partialmethod(_info, writers=True)
    get_subscriptions_info_by_topic = partialmethod(_info, writers=False)
