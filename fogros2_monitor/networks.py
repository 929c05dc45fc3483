# SPDX-License-Identifier: Apache-2.0
"""Read the networks of a launch file's ``monitor_allow``."""

from __future__ import annotations

import ipaddress
from typing import Any, TYPE_CHECKING

from fogros2.describe import values
from fogros2.errors import ConfigurationError

if TYPE_CHECKING:
    from launch import LaunchContext

_SUCH = "write networks such as '198.51.100.0/28', or addresses"


def items(content: Any) -> Any:
    """
    Read a value of ``monitor_allow``; see :func:`values.checked_items`.

    :raises ConfigurationError: a single text, or no network.
    """
    if isinstance(content, str):
        raise ConfigurationError(
            f'monitor_allow={content!r} is no list', f'monitor_allow=[{content!r}]')
    return values.checked_items(content, normal)


def resolve(context: LaunchContext, networks: Any) -> tuple[str, ...]:
    """
    Resolve networks; return them in CIDR form.

    :param networks: a result of :func:`items`.
    :raises ConfigurationError: an invalid network.
    """
    return tuple(normal(str(value)) for value in values.resolve(context, networks) or ())


def normal(text: str) -> str:
    """
    Convert a network or an address to CIDR form.

    :raises ConfigurationError: it is neither, or has bits set beyond its mask.
    """
    try:
        return str(ipaddress.ip_network(text.strip()))
    except ValueError:
        pass
    try:
        meant = str(ipaddress.ip_network(text.strip(), strict=False))
    except ValueError as error:
        raise ConfigurationError(f"monitor_allow: '{text}' is no network", _SUCH) from error
    raise ConfigurationError(f"monitor_allow: '{text}' is not the address of a network",
                             f"write '{meant}', or the address alone")
