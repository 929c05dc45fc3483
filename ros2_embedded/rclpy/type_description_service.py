# SPDX-License-Identifier: Apache-2.0
"""The service that describes types to others (REP-2016)."""

from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from rclpy.node import Node


class TypeDescriptionService:
    """Serves ``~/get_type_description``."""

    def __init__(self, node: 'Node') -> None:
        from type_description_interfaces.srv import GetTypeDescription
        node.create_service(GetTypeDescription, '~/get_type_description', self._describe)

    def _describe(self, request: Any, response: Any) -> Any:
        from rosidl_embedded.typehash import describe, type_hash
        from type_description_interfaces import msg
        try:
            if type_hash(request.type_name) != request.type_hash:
                raise KeyError('the type hash is not that of the type')
            top, others = describe(request.type_name)
        except (KeyError, ValueError) as error:
            response.successful = False
            response.failure_reason = f"Type '{request.type_name}' is unknown here: {error}"
            return response

        def individual(described: dict[str, Any]) -> Any:
            return msg.IndividualTypeDescription(
                type_name=described['type_name'],
                fields=[msg.Field(name=one['name'], type=msg.FieldType(**one['type']))
                        for one in described['fields']])

        response.successful = True
        response.type_description = msg.TypeDescription(
            type_description=individual(top),
            referenced_type_descriptions=[individual(other) for other in others])
        return response
