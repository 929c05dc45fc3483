# SPDX-License-Identifier: Apache-2.0
"""Interfaces by name, and messages as text and dictionaries: not in any package index."""

from embedded_default.lacking import lacking

from rosidl_runtime_py.convert import message_to_ordereddict, message_to_yaml
from rosidl_runtime_py.set_message import set_message_fields

__all__ = ['message_to_ordereddict', 'message_to_yaml', 'set_message_fields']
__getattr__ = lacking(__name__, 'get_action_interfaces get_interface_packages get_interface_path '
                      'get_interfaces get_message_interfaces get_message_slot_types '
                      'get_service_interfaces import_message_from_namespaced_type '
                      'message_to_csv')
