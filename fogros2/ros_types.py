# SPDX-License-Identifier: Apache-2.0
"""
Read names from a ROS graph, and import the classes of messages and services by them.

A node of another computer chooses these names. Python would import a module of any name: a file of
the current folder, or a part of the standard library that acts when it is imported.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import re
from typing import Any

from ament_index_python import get_resource

_NAME = re.compile(r'([A-Za-z]\w*)/(?:(msg|srv|action)/)?([A-Z]\w*)', re.ASCII)
_TOPIC = re.compile(r'(/[A-Za-z_]\w*)+', re.ASCII)


def topics(node: Any) -> dict[str, str]:
    """
    Return the topics of a node's graph with the first type of each.

    Names and types that ROS 2 does not allow are left out: they may control a terminal.
    """
    return _allowed(node.get_topic_names_and_types())


def services(node: Any) -> dict[str, str]:
    """Return the services of a node's graph with the first type of each, like :func:`topics`."""
    return _allowed(node.get_service_names_and_types())


def _allowed(listed: list[tuple[str, list[str]]]) -> dict[str, str]:
    return {name: kinds[0] for name, kinds in listed
            if _TOPIC.fullmatch(name) and kinds and _NAME.fullmatch(kinds[0])}


def message(name: str) -> Any:
    """
    Import a message class.

    :param name: type name, such as ``std_msgs/msg/String`` or ``std_msgs/String``.
    :raises LookupError: it is no message of a package that is installed here.
    """
    return _imported(name, 'msg', 'get_fields_and_field_types')


def service(name: str) -> Any:
    """
    Import a service class.

    :param name: type name, such as ``std_srvs/srv/Trigger``.
    :raises LookupError: it is no service of a package that is installed here.
    """
    return _imported(name, 'srv', 'Request')


def _imported(name: str, kind: str, attribute: str) -> Any:
    parts = _NAME.fullmatch(name)
    if parts is None:
        raise LookupError(f'{name!r} is no name of a type')
    package = parts[1]
    try:
        get_resource('rosidl_interfaces', package)
        spec = importlib.util.find_spec(package)
        if spec is None or spec.origin is None:
            raise LookupError(f'there is no Python package {package}')
        folder = os.path.dirname(os.path.dirname(os.path.realpath(spec.origin)))
        if folder == os.path.realpath(os.getcwd()):
            raise LookupError(f'{package} of the current folder is not imported')
        cls = getattr(importlib.import_module(f'{package}.{parts[2] or kind}'), parts[3])
        getattr(cls, attribute)
    except (ImportError, AttributeError, LookupError, OSError, ValueError) as error:
        raise LookupError(f"'{name}' isn't installed here: {error}") from error
    return cls
