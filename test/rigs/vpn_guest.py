# SPDX-License-Identifier: Apache-2.0
"""
A guest of the machine in the lab of ``vpn_lab``: a second robot behind a NAT of its own.

::

    machine 203.0.113.65 --- .66  nat  192.168.78.1 --- .2  guest
"""

from __future__ import annotations

import json
from typing import Any

import pytest

from fogros2.model import Command, Peer, VpnInterface
from fogros2.waiting import wait_until
from fogros2_features.guests import listing, network
from rigs.second_robot import NAT
from rigs.vpn_lab import Lab, MACHINE, NETWORK, PORT

GUEST, OUTSIDE = '198.18.7.224', '203.0.113.65'


class Guest:
    """The guest's computer, and what the machine's list says of it."""

    def __init__(self, lab: Lab) -> None:
        self.lab = lab
        for host in ('guest', 'nat'):
            lab.spaces[host] = f'{lab.mark}{host[0]}x'
            lab.ip('netns', 'add', lab.spaces[host])
            lab.ip('-n', lab.spaces[host], 'link', 'set', 'lo', 'up')
        lab.link('machine', 'e2', f'{OUTSIDE}/26', 'nat', 'out', '203.0.113.66/26')
        lab.link('nat', 'in', '192.168.78.1/24', 'guest', 'e0', '192.168.78.2/24')
        lab.ip('-n', lab.spaces['nat'], 'route', 'add', 'default', 'via', OUTSIDE)
        lab.ip('-n', lab.spaces['guest'], 'route', 'add', 'default', 'via', '192.168.78.1')
        lab.run('nat', Command(('sh', '-ec', 'echo 1 >/proc/sys/net/ipv4/ip_forward; nft -f -'),
                               input=NAT.encode()))
        # what the machine's VPN port sends here
        lab.shell('guest', 'nft add table inet watch; '
                  'nft add chain inet watch c "{ type filter hook input priority -300; }"; '
                  f'nft add rule inet watch c udp sport {PORT} counter')
        self.interface = VpnInterface(f'{lab.mark}x', GUEST, NETWORK, PORT,
                                      str(lab.folder / 'x/vpn.key'), firewall=True)
        lab.interfaces['guest'] = self.interface
        self.machine_key = lab.run(
            'machine', lab.vpn.keys(lab.interfaces['machine'])).stdout.strip()
        self.new_key()

    def new_key(self) -> str:
        self.lab.shell('guest', f'rm -f {self.interface.key_file}')
        self.key = self.lab.run('guest', self.lab.vpn.keys(self.interface)).stdout.strip()
        return self.key

    def ask(self, verb: str, **request: Any) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = json.loads(self.lab.run('machine', listing.request(
            self.lab.interfaces['machine'], verb, request)).stdout)
        return found

    def admit(self, seconds: float = 60.0, patience: float = 180.0) -> None:
        interface, dds = self.lab.interfaces['machine'], self.lab.dds
        self.lab.run('machine', listing.install(interface))
        (own,) = self.ask('admit', key=self.key, label='second', seconds=seconds,
                          patience=patience, left=3600.0, secret='5a' * 32, addresses=[GUEST],
                          rules=network.rules(interface, dds.ports))
        assert own['address'] == GUEST and own['heard'] is None

    def up(self, *, answered: bool = True) -> None:
        """Bring the guest's interface up; wait for the first handshake if there will be one."""
        self.lab.do('guest', self.lab.vpn.up(self.interface, [
            Peer('machine', self.machine_key, MACHINE, f'{OUTSIDE}:{PORT}')]))
        if answered:
            wait_until(lambda: self.received() > 0, timeout=60.0, what='an answer')
            assert self.lab.ping('guest', MACHINE, timeout=60.0)

    def down(self) -> None:
        """Take the interface down; the key stays, as that of a computer does."""
        key = self.interface.key_file  # of root
        self.lab.shell('guest', f'cp -p {key} {key}.kept')
        self.lab.do('guest', self.lab.vpn.down(self.interface))
        self.lab.shell('guest', f'mv {key}.kept {key}')

    def received(self) -> int:
        """Return the number of packets that the machine's VPN port has sent here."""
        text = self.lab.shell('guest', 'nft -j list chain inet watch c')
        rules = [entry['rule'] for entry in json.loads(text)['nftables'] if 'rule' in entry]
        return int(next(part['counter']['packets'] for part in rules[0]['expr']
                        if 'counter' in part))


@pytest.fixture
def guest(vpn: Lab) -> Guest:
    return Guest(vpn)
