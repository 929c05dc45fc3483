# SPDX-License-Identifier: Apache-2.0
"""The services through which others read and set the levels of a node's loggers."""

from typing import Any, TYPE_CHECKING

from rclpy import logging
from rclpy.impl.logging_severity import LoggingSeverity

if TYPE_CHECKING:
    from rclpy.node import Node


class LoggingService:
    """Serves the levels of loggers."""

    def __init__(self, node: 'Node') -> None:
        from rcl_interfaces.srv import GetLoggerLevels, SetLoggerLevels
        node.create_service(GetLoggerLevels, '~/get_logger_levels', self._get)
        node.create_service(SetLoggerLevels, '~/set_logger_levels', self._set)

    def _get(self, request: Any, response: Any) -> Any:
        from rcl_interfaces.msg import LoggerLevel
        response.levels = [LoggerLevel(name=name, level=int(logging.get_logger_level(name)))
                           for name in request.names]
        return response

    def _set(self, request: Any, response: Any) -> Any:
        from rcl_interfaces.msg import SetLoggerLevelsResult
        for wanted in request.levels:
            result = SetLoggerLevelsResult(successful=True)
            try:
                logging.set_logger_level(wanted.name, LoggingSeverity(wanted.level))
            except ValueError as error:
                result = SetLoggerLevelsResult(successful=False, reason=str(error))
            response.results.append(result)
        return response
