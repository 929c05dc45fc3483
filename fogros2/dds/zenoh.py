# SPDX-License-Identifier: Apache-2.0
"""
Configure Zenoh, ROS 2's ``rmw_zenoh_cpp``: one router per host, connected over the VPN.

Nodes connect only to their host's router, at the host's VPN address. That address belongs to one
launch, so it cannot conflict with other launches or with a router that runs already. The robot's
router dials the machines' routers, because the robot admits no TCP from the VPN. The machines'
routers dial each other.

Routers forward everything to each other, and a node can use one router only. So the robot's router
dials no router of the user's unless the user names it: a hijacked machine would reach all nodes
behind it, those of other launches and of the LAN included.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import json
import re
from types import MappingProxyType
from typing import Any, ClassVar, Optional

from fogros2.dds import check_discovery, DdsVendor, local_only, Router, static_peers
from fogros2.errors import DdsError
from fogros2.model import DdsInterface

#: TCP port of routers in the VPN; rmw_zenoh's own router uses 7447 on all interfaces.
PORT = 7448
USERS_ROUTER = '127.0.0.1', 7447
#: Milliseconds between attempts to dial a router: the first value, doubled up to the second.
RETRY, RETRY_MAX = 250, 2000
#: Milliseconds without a sign of life after which a link counts as broken and is dialled again.
LEASE = 10_000
#: Time-out in milliseconds of a service or action call: practically none.
QUERY_TIMEOUT = 600_000


class Zenoh(DdsVendor):
    """
    Write the configurations of sessions and routers.

    :param domain: ROS_DOMAIN_ID, which rmw_zenoh itself adds to its keys.
    """

    rmw: ClassVar[str] = 'rmw_zenoh_cpp'
    by_address: ClassVar[bool] = True
    file_name: ClassVar[str] = 'dds.json5'

    @property
    def ports(self) -> Sequence[tuple[int, int]]:
        """None: the robot's router connects to those of machines, by TCP."""
        return []

    def robot_interfaces(
        self, vpn: str, lan: Optional[str], user: Mapping[str, str],
    ) -> list[DdsInterface]:
        """
        Return the address of the robot's router.

        :raises DdsError: the user's environment connects nodes to another router.
        """
        if user.get('ZENOH_SESSION_CONFIG_URI'):
            raise DdsError(
                "ZENOH_SESSION_CONFIG_URI makes nodes bypass the launch's router",
                'unset it, and set your changes in ZENOH_CONFIG_OVERRIDE')
        override = user.get('ZENOH_CONFIG_OVERRIDE', '')
        if re.search(r'(^|;)[\s/]*(connect|listen|mode)\s*[=/]', override):
            raise DdsError(
                f"ZENOH_CONFIG_OVERRIDE={override} makes nodes bypass the launch's router",
                "leave 'connect', 'listen' and 'mode' out of it")
        return [DdsInterface(vpn)]

    def machine_interfaces(self, vpn: str) -> list[DdsInterface]:
        """Return the address of the machine's router."""
        return [DdsInterface(vpn)]

    def render(
        self, interfaces: Sequence[DdsInterface], peers: Sequence[str],
        user: Mapping[str, str] = MappingProxyType({}), *, quiet: bool = False,
    ) -> str:
        """
        Return the configuration of the nodes' sessions as JSON.

        :param interfaces: one, given by its address.
        :param peers: ignored: the router dials them.
        """
        return _text({
            'mode': 'peer',
            'connect': {'endpoints': [_endpoint(interfaces[0].name)], **_PATIENT},
            # other nodes of the host get this address from the router, then talk directly
            'listen': {'endpoints': ['tcp/127.0.0.1:0']},
            'scouting': {
                'multicast': {'enabled': False},
                'gossip': {'enabled': True, 'multihop': False,
                           'autoconnect': {'router': [], 'peer': ['router', 'peer']}}},
            **_COMMON})

    def router(
        self, address: str, others: Sequence[str], user: Optional[Mapping[str, str]],
    ) -> Optional[Router]:
        """
        Return the host's router.

        :param user: ROS_STATIC_PEERS have routers too, at rmw_zenoh's own port. With
            ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST the router connects only to machines.
        """
        host, port = USERS_ROUTER
        wide = user is not None and not local_only(user)
        named = static_peers(user) if user is not None and wide else []
        dialled = [*map(_endpoint, others), *(f'tcp/{name}:{port}' for name in named)]
        return Router('rmw_zenoh_cpp', 'rmw_zenohd', 'ZENOH_ROUTER_CONFIG_URI', _text({
            'mode': 'router',
            'listen': {'endpoints': [_endpoint(address)]},
            'connect': {'endpoints': dialled, **_PATIENT},
            # no multicast scouting, neither on the VPN nor on a LAN
            'scouting': {'multicast': {'enabled': False}, 'gossip': {'enabled': True}},
            **_COMMON}), beside=USERS_ROUTER if wide and host not in named else None)

    def environment(self, path: str, user: Mapping[str, str]) -> Mapping[str, str]:
        """
        Return RMW_IMPLEMENTATION and the path of the sessions' configuration.

        :raises DdsError: the user's environment disables discovery.
        """
        check_discovery(user)
        return {'RMW_IMPLEMENTATION': self.rmw, 'ZENOH_SESSION_CONFIG_URI': path}


#: Dial a missing router repeatedly, without failing.
_PATIENT: Mapping[str, Any] = {
    'timeout_ms': -1, 'exit_on_failure': False,
    'retry': {'period_init_ms': RETRY, 'period_max_ms': RETRY_MAX, 'period_increase_factor': 2}}
#: Settings of sessions and of routers.
_COMMON: Mapping[str, Any] = {
    # needed to keep the order of latched topics
    'timestamping': {'enabled': {'router': True, 'peer': True, 'client': True}},
    'queries_default_timeout': QUERY_TIMEOUT,
    'transport': {
        'unicast': {'open_timeout': 60_000, 'accept_timeout': 60_000, 'max_sessions': 10_000},
        'link': {'tx': {'lease': LEASE, 'keep_alive': 4}},
        # hosts share no memory, and a machine's limits are small
        'shared_memory': {'enabled': False}}}


def _endpoint(address: str) -> str:
    return f'tcp/{address}:{PORT}'


def _text(config: Mapping[str, Any]) -> str:
    return json.dumps(config, indent=2, default=dict) + '\n'
