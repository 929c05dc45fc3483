# SPDX-License-Identifier: Apache-2.0
"""Read the networks of a launch file's ``monitor_allow``."""

from __future__ import annotations

import ipaddress

from fogros2.errors import ConfigurationError

_SUCH = "write networks such as '198.51.100.0/28', or addresses"


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
