# SPDX-License-Identifier: Apache-2.0
"""The public address from which this robot's connections reach a cloud."""

from __future__ import annotations

from collections.abc import Iterable
import contextlib
import ipaddress
import os
import socket
import threading
import time

from fogros2.errors import ProviderError
from fogros2.provider.vm.options import cidr

#: Names this robot's address (or network) as machines see it; then no service is asked.
ADDRESS_VARIABLE = 'FOGROS2_ROBOT_ADDRESS'
#: Service that returns the address of the caller, and the variable that names another one.
CHECKIP, CHECKIP_VARIABLE = 'https://checkip.amazonaws.com', 'FOGROS2_AWS_CHECKIP'
#: Name files or folders with certificates of authorities.
BUNDLE_VARIABLES = 'REQUESTS_CA_BUNDLE', 'AWS_CA_BUNDLE'
#: Seconds for which an answer is used again, so that machines of one launch ask once.
ADDRESS_AGE = 5.0
#: Public addresses, to which the system chooses a route; nothing is sent.
FAR_IPV4, FAR_IPV6 = ('3.80.0.1', 22), ('2600:1f18::1', 22)


class RobotAddress:
    """The public address of this computer, requested at most every 5 s; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known = ('', '', 0.0)

    def __call__(self) -> str:
        """
        Return the address in CIDR form.

        :raises ConfigurationError: the variable that names it has no address.
        :raises ProviderError: the service does not answer.
        """
        configured = os.environ.get(ADDRESS_VARIABLE, '')
        if configured:
            return cidr(configured)
        url = os.environ.get(CHECKIP_VARIABLE, CHECKIP)
        with self._lock:
            address, last_url, when = self._known
            if last_url != url or time.monotonic() - when > ADDRESS_AGE:
                address = self._ask(url)
                self._known = (address, url, time.monotonic())
            return address

    def with_ipv6(self, networks: Iterable[str]) -> list[str]:
        """Return networks; if this computer's address is among them, add its IPv6 address."""
        named = list(networks)
        own = own_ipv6() if self._known[0] in named else ''
        return [*named, *([own] if own else [])]

    def _ask(self, url: str) -> str:
        # ssl and email too: 10 ms that a listing does not need
        from http.client import HTTPException
        import ssl
        import urllib.request
        hint = f'{ADDRESS_VARIABLE}=... names it'
        try:
            # beside the system's authorities those of a proxy, which the clouds' libraries read
            trust = ssl.create_default_context()
            for bundle in filter(None, map(os.environ.get, BUNDLE_VARIABLES)):
                trust.load_verify_locations(
                    **{'capath' if os.path.isdir(bundle) else 'cafile': bundle})
            with urllib.request.urlopen(url, timeout=5.0, context=trust) as answer:
                text = answer.read(100).decode('ascii', 'replace').strip()
        except (OSError, HTTPException, ValueError) as error:
            # a computer without IPv4 reaches only machines with IPv6
            own = '' if has_ipv4() else own_ipv6()
            if own:
                return own
            raise ProviderError(
                f"{url} did not return this robot's public address: {error}", hint) from error
        try:
            return cidr(str(ipaddress.ip_address(text)))
        except ValueError as error:
            raise ProviderError(f"{url} returned '{text[:40]}', not an address", hint) from error


def has_ipv4() -> bool:
    """Return whether this computer has a route to public IPv4 addresses; send nothing."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(FAR_IPV4)
        return True
    return False


def own_ipv6() -> str:
    """Return this computer's public IPv6 address (CIDR), '' without one; send nothing."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as probe:
        probe.connect(FAR_IPV6)  # the system chooses a route, and the address for that route
        address = ipaddress.IPv6Address(probe.getsockname()[0])
        if address.is_global:
            return f'{address}/128'
    return ''
