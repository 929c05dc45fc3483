# SPDX-License-Identifier: Apache-2.0
"""Classes of interfaces by their names."""

import importlib
from typing import Any

from ament_index_python import has_resource
from embedded_default.lacking import lacking

__getattr__ = lacking(__name__, 'get_action get_interface is_action')


def _import(identifier: str, kind: str) -> Any:
    parts = identifier.split('/')
    if len(parts) == 2:
        parts.insert(1, kind)
    if len(parts) != 3 or parts[1] not in ('msg', 'srv', 'action'):
        raise ValueError(f"'{identifier}' is not of the form package/kind/Name")
    # The name may come from any node of the network: import no other module than a package's.
    if not has_resource('rosidl_interfaces', parts[0]):
        raise ModuleNotFoundError(f"No package '{parts[0]}' with interfaces is installed")
    return getattr(importlib.import_module('.'.join(parts[:2])), parts[2])


def get_message(identifier: str) -> Any:
    """
    Give the class of ``package/msg/Name`` or ``package/Name``.

    :raises ModuleNotFoundError: if there is no such package.
    :raises AttributeError: if it has no such message.
    :raises ValueError: if it is no message.
    """
    interface = _import(identifier, 'msg')
    if not is_message(interface):
        raise ValueError(f"Expected the full name of a message, got '{identifier}'")
    return interface


def get_service(identifier: str) -> Any:
    """
    Give the class of ``package/srv/Name`` or ``package/Name``; see :func:`get_message`.

    :raises ValueError: if it is no service.
    """
    interface = _import(identifier, 'srv')
    if not is_service(interface):
        raise ValueError(f"Expected the full name of a service, got '{identifier}'")
    return interface


def is_message(interface: Any) -> bool:
    """Say whether it is a message's class."""
    return hasattr(interface, '_fields_and_field_types')


def is_service(interface: Any) -> bool:
    """Say whether it is a service's class."""
    return hasattr(interface, 'Request') and hasattr(interface, 'Response')
