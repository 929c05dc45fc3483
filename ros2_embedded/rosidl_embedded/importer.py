# SPDX-License-Identifier: Apache-2.0
"""What ``package.msg`` and ``package.srv`` answer when a name is imported from them."""

from collections.abc import Callable
from typing import Any

from rosidl_embedded import definition, message


def of(module: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Give ``__getattr__`` and ``__dir__`` of module ``package.msg`` or ``package.srv``."""
    package, kind = module.split('.')

    def contents() -> list[str]:
        return definition.names(package, kind)

    def interface(name: str) -> Any:
        if name == '__all__':
            return contents()
        part = name.rpartition('_')[2] in ('Request', 'Response', 'Event')
        try:
            if kind == 'srv' and not part:
                return message.service_class(f'{package}/srv/{name}')
            return message.message_class(f'{package}/{kind}/{name}')
        except (KeyError, ValueError):
            raise AttributeError(f"module '{module}' has no attribute '{name}'") from None

    return interface, contents
