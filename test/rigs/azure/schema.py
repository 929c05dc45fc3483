# SPDX-License-Identifier: Apache-2.0
"""Compare the bodies of requests with the models of Azure's own SDK."""

from __future__ import annotations

from collections.abc import Mapping
import functools
import importlib
import typing
from typing import Any

#: Kind of resource: module and model of its body.
_MODELS = {
    'virtualmachines': ('compute', 'VirtualMachine'),
    'extensions': ('compute', 'VirtualMachineExtension'), 'snapshots': ('compute', 'Snapshot'),
    'galleries': ('compute', 'Gallery'), 'images': ('compute', 'GalleryImage'),
    'versions': ('compute', 'GalleryImageVersion'), 'disks': ('compute', 'Disk'),
    'networksecuritygroups': ('network', 'NetworkSecurityGroup'),
    'securityrules': ('network', 'SecurityRule'),
    'publicipaddresses': ('network', 'PublicIPAddress'),
    'virtualnetworks': ('network', 'VirtualNetwork'),
    'networkinterfaces': ('network', 'NetworkInterface'),
}


def unknown(kind: str, body: Mapping[str, Any]) -> str:
    """Return the path of a member that the model of this kind does not have, else ''."""
    if kind not in _MODELS:
        return ''
    package, name = _MODELS[kind]
    models = importlib.import_module(f'azure.mgmt.{package}.models')
    return _unknown(getattr(models, name), body, '')


@functools.cache
def _members(model: Any) -> dict[str, Any]:
    """Return the type of each member of a model by its name in JSON."""
    model(**{})  # the SDK fills its tables when a model is made
    module = importlib.import_module(model.__module__)
    models = importlib.import_module(module.__package__ or '')
    hints = typing.get_type_hints(model, {**vars(module), '_models': models, '_types': typing})
    return {field._rest_name: hints[name] for name, field in model._attr_to_rest_field.items()}


def _unknown(model: Any, value: Any, path: str) -> str:
    inner = [one for one in typing.get_args(model) if one is not type(None)]
    if inner:
        if typing.get_origin(model) is list:
            return next((bad for one in value if (bad := _unknown(inner[0], one, path))), '')
        # an optional one, or one of several: an enumeration and text
        return '' if typing.get_origin(model) is dict else _unknown(inner[0], value, path)
    if not isinstance(value, Mapping) or 'models' not in getattr(model, '__module__', ''):
        return ''
    members = _members(model)
    for key, below in value.items():
        if key not in members:
            return f"'{path}.{key}' in {model.__name__}"
        if bad := _unknown(members[key], below, f'{path}.{key}'):
            return bad
    return ''
