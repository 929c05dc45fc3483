# SPDX-License-Identifier: Apache-2.0
"""
Invitations of other computers to a machine: sealed text that only the invited computer can open.

The text is ``fog1.`` and base64 of what ``sealing`` returns. All of the content is sealed and
authenticated, the expiry included. The sealing does not show who wrote the text: the user pastes
it, as a launch file.
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import dataclasses
import hashlib
import ipaddress
import re
import time
from typing import get_type_hints

from fogros2 import untrusted
from fogros2.errors import ConfigurationError
from fogros2.model import NETWORK_PREFIX, to_json
from fogros2.store import check_name, robot_name, Store, write_private
from fogros2.vpn.addresses import uses_lan_groups

_PREFIX = 'fog1.'
#: File with the secret for ``GuestShell`` in the folder of a machine's VPN (``Store.other_vpns``).
DOOR_KEY = 'door.key'
#: Private address space (RFC 1918), shared address space (RFC 6598), and the default pool.
_PRIVATE = tuple(map(ipaddress.IPv4Network, (
    '10.0.0.0/8', '172.16.0.0/12', '192.168.0.0/16', '100.64.0.0/10', '198.18.0.0/15')))
#: A computer's public key, with its name for people before it.
_KEY = re.compile(r'(?:([A-Za-z0-9_.-]{1,80}):)?([A-Za-z0-9+/]{43}=)')


@dataclasses.dataclass(frozen=True)
class Invitation:
    """
    What a computer needs to join the VPN of a machine.

    :param machine: the machine's name; ``key`` its WireGuard public key, ``address`` its VPN
        address, ``endpoint`` the ``host:port`` at which other computers dial it.
    :param joiner: VPN address of the invited computer; ``network`` is the VPN's, in CIDR form.
    :param rmw: RMW_IMPLEMENTATION of the launch; ``domain`` its ROS_DOMAIN_ID.
    :param expires: until when the computer may join, in seconds since the epoch.
    :param interface: name of the machine's VPN interface; '' of a machine without a door.
    :param secret: by which the computer proves to the door that it was invited, hexadecimal.
    """

    machine: str
    key: str
    address: str
    endpoint: str
    joiner: str
    network: str
    rmw: str
    domain: int
    expires: float
    interface: str = ''
    secret: str = dataclasses.field(default='', repr=False)

    def __post_init__(self) -> None:
        for name, kind in get_type_hints(type(self)).items():
            untrusted.checked(getattr(self, name), kind, name)
        check_name(self.machine)
        subnet = ipaddress.IPv4Network(self.network)
        if subnet.prefixlen < NETWORK_PREFIX:
            raise ValueError(f'{subnet} is larger than the network of a launch')
        if subnet.is_loopback or subnet.is_link_local or subnet.is_multicast or subnet.is_reserved:
            raise ValueError(f'{subnet} is the network of no computer')
        if uses_lan_groups(str(subnet)):
            raise ValueError(f"the multicast groups of {subnet} would be the LAN's")
        inside = {ipaddress.IPv4Address(self.address), ipaddress.IPv4Address(self.joiner)}
        if len(inside) != 2 or not all(address in subnet for address in inside):
            raise ValueError('its addresses are not those of one network')
        if not 0 <= self.domain <= 232:
            raise ValueError('its ROS domain is none')
        if self.interface and not re.fullmatch('fog[0-9a-f]{6}m[0-9]{1,3}', self.interface) \
                or len(bytes.fromhex(self.secret)) not in (0, 32):
            raise ValueError('its door is none')

    @property
    def private(self) -> bool:
        """Whether its network is one that no computer of the internet has."""
        return any(ipaddress.IPv4Network(self.network).subnet_of(each) for each in _PRIVATE)

    @property
    def number(self) -> str:
        """The name of the folder of the joined machine; digits of the interface's name too."""
        return hashlib.sha256(f'{self.key} {self.joiner}'.encode()).hexdigest()[:6]


def own_key(store: Store) -> bytes:
    """
    Return this computer's private key; make it if there is none.

    :raises ConfigurationError: its file is damaged.
    """
    from fogros2_features.guests import sealing
    path = store.root / 'key'
    if not path.exists():
        write_private(path, base64.b64encode(sealing.private_key()) + b'\n')
    with contextlib.suppress(ValueError):
        key = base64.b64decode(path.read_bytes().strip(), validate=True)
        if len(key) == 32:
            return key
    raise ConfigurationError(
        f'{path} holds no key', 'delete it: ros2 fog key makes a new one, for new invitations')


def public_text(key: bytes) -> str:
    """Return the public key of a private one as ``wg`` writes it."""
    from fogros2_features.guests import sealing
    return base64.b64encode(sealing.public_key(key)).decode()


def own_name(store: Store) -> str:
    """Return the text of ``ros2 fog key``: this computer's name and public key."""
    name = re.sub('[^A-Za-z0-9_.-]', '-', robot_name())[:80]
    return f'{name}:{public_text(own_key(store))}'


def parse_key(text: str) -> tuple[str, str]:
    """
    Return the name ('' if there is none) and the key of a text that ``ros2 fog key`` printed.

    :raises ConfigurationError: the text is no key.
    """
    match = _KEY.fullmatch(text.strip())
    if match is None:
        raise ConfigurationError(f'{text[:60]!r} is no key of a computer',
                                 'ros2 fog key prints it on the computer that joins')
    return match[1] or '', match[2]


def seal(invitation: Invitation, key: str) -> str:
    """
    Return the text of an invitation that only the holder of a key can open.

    :param key: the invited computer's public key, in base64.
    """
    from fogros2_features.guests import sealing
    sealed = sealing.seal(to_json(invitation).encode(), base64.b64decode(key), _PREFIX.encode())
    return _PREFIX + base64.urlsafe_b64encode(sealed).decode()


def unseal(text: str, key: bytes) -> Invitation:
    """
    Open an invitation to this computer.

    :raises ConfigurationError: the text is for another computer, changed, or expired.
    """
    from fogros2_features.guests import sealing
    text = ''.join(text.split())
    try:
        data = base64.b64decode(text.removeprefix(_PREFIX), b'-_', validate=True)
        if _PREFIX + base64.urlsafe_b64encode(data).decode() != text:
            raise ValueError('a character is changed')  # base64 ignores some bits of the last
        content = sealing.unseal(data, key, text[:len(_PREFIX)].encode())
        invitation = Invitation(**untrusted.parsed(content))
    except sealing.WrongKey:
        raise ConfigurationError(
            'this invitation is for another computer, or not complete',
            'ros2 fog key prints the key that the invitation needs') from None
    except (ValueError, TypeError, ConfigurationError) as error:
        why = 'it is not complete' if isinstance(error, binascii.Error) else error
        raise ConfigurationError(f'this is no invitation: {why}',
                                 'ros2 fog invite prints one, in one line') from error
    if time.time() > invitation.expires:
        raise ConfigurationError(f"the invitation to '{invitation.machine}' has expired",
                                 'ask for a new one: ros2 fog invite')
    return invitation
