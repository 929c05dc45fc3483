# SPDX-License-Identifier: Apache-2.0
"""
Split packets into pieces, and repair lost pieces: forward error correction for lossy links.

The loss of one fragment loses a whole packet: with ten fragments and 2 % loss, every fifth one.
While a receiver reports losses, the sender also sends each packet in pieces that fit into one
datagram each, with parities. The pieces form groups in turn. The parity of a group (the exclusive
or of its pieces) replaces any one piece. No piece is sent on request, so a repair costs no round
trip.
"""

from __future__ import annotations

import dataclasses
import struct
from typing import Optional
import zlib

import numpy
from numpy.typing import NDArray

#: Bytes of a piece; with all headers it stays below the VPN's MTU of 1280 bytes.
PIECE = 1100
#: Number of pieces that share a parity.
GROUP = 5
#: Number of packets to reassemble at once; older ones are given up.
OPEN = 6
_HEADER = struct.Struct('>IIIHHH')
#: Checksum of a piece; a damaged piece counts as lost.
_SUM = struct.Struct('>I')


def pieces(stream: int, sequence: int, packet: bytes) -> list[bytes]:
    """Split a packet into pieces, parities last; one lost piece per group can be repaired."""
    count = max(1, -(-len(packet) // PIECE))
    parities = -(-count // GROUP)
    block = numpy.zeros((count, PIECE), numpy.uint8)
    block.reshape(-1)[:len(packet)] = numpy.frombuffer(packet, numpy.uint8)
    out = []
    for index in range(count + parities):
        if index < count:
            # The last piece is padded with zeros, which need not be sent.
            body = packet[index * PIECE:(index + 1) * PIECE]
        else:
            body = numpy.bitwise_xor.reduce(block[index - count::parities], axis=0).tobytes()
        head = _HEADER.pack(stream, sequence, len(packet), count, parities, index)
        out.append(_SUM.pack(zlib.crc32(head + body)) + head + body)
    return out


@dataclasses.dataclass
class _Packet:
    size: int
    count: int
    parities: int
    block: NDArray[numpy.uint8]
    have: set[int] = dataclasses.field(default_factory=set)
    done: bool = False


class Assembler:
    """Reassemble packets from pieces in any order."""

    def __init__(self) -> None:
        self._packets: dict[tuple[int, int], _Packet] = {}

    def add(self, piece: bytes) -> Optional[bytes]:
        """Add a piece; return its packet if this piece completes the packet, else None."""
        start = _SUM.size + _HEADER.size
        if len(piece) < start or _SUM.unpack_from(piece)[0] != zlib.crc32(piece[_SUM.size:]):
            return None
        stream, sequence, size, count, parities, index = _HEADER.unpack_from(piece, _SUM.size)
        body = piece[start:]
        if not (0 < count <= 4096 and (count - 1) * PIECE < max(size, 1) <= count * PIECE
                and parities == -(-count // GROUP) and index < count + parities
                and len(body) <= PIECE):
            return None
        packet = self._packets.get((stream, sequence))
        if packet is None:
            packet = _Packet(size, count, parities,
                             numpy.zeros((count + parities, PIECE), numpy.uint8))
            self._packets[stream, sequence] = packet
            while len(self._packets) > OPEN:
                del self._packets[next(iter(self._packets))]
        if packet.done or (packet.size, packet.count) != (size, count):
            return None
        packet.block[index, :len(body)] = numpy.frombuffer(body, numpy.uint8)
        packet.have.add(index)
        if not self._repair(packet):
            return None
        packet.done = True
        whole = packet.block[:count].reshape(-1)[:size].tobytes()
        packet.block = packet.block[:0]
        return whole

    def _repair(self, packet: _Packet) -> bool:
        """Repair groups with one missing piece; return whether the packet is complete."""
        whole = True
        for parity in range(packet.parities):
            members = [*range(parity, packet.count, packet.parities), packet.count + parity]
            missing = [m for m in members if m not in packet.have]
            if not missing or missing == [packet.count + parity]:
                continue
            if len(missing) > 1:
                whole = False
                continue
            others = [m for m in members if m != missing[0]]
            packet.block[missing[0]] = numpy.bitwise_xor.reduce(packet.block[others], axis=0)
            packet.have.add(missing[0])
        return whole
