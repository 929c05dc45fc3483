# SPDX-License-Identifier: Apache-2.0
"""
Carry the VPN in a machine's shell where its UDP is blocked: ``vpn_path``.

WireGuard stays as it is at both ends, with its keys, addresses and filters. In place of the other
end, each finds a program at its host's loopback, and between the two is a stream: standard input
and output of a program on the machine. ``carrier`` is this program, and the robot's end.
``feature`` chooses the path.
"""

from fogros2_features.vpn_path.feature import VpnPath

__all__ = ['VpnPath']
