# SPDX-License-Identifier: Apache-2.0
"""What ``package.msg`` and ``package.srv`` answer when a name is imported from them."""

from rosidl_embedded import definition, message


def interface(module: str, name: str) -> type:
    """
    Give ``name`` of module ``package.msg`` or ``package.srv``.

    :raises AttributeError: if the package has no such interface.
    """
    package, kind = module.split('.')
    try:
        if kind == 'srv' and name.rpartition('_')[2] not in ('Request', 'Response', 'Event'):
            return message.service_class(f'{package}/srv/{name}')
        return message.message_class(f'{package}/{kind}/{name}')
    except (KeyError, ValueError):
        raise AttributeError(f"module '{module}' has no attribute '{name}'") from None


def contents(module: str) -> list[str]:
    """List the interfaces of module ``package.msg`` or ``package.srv``."""
    package, kind = module.split('.')
    return definition.names(package, kind)
