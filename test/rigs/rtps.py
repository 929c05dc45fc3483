# SPDX-License-Identifier: Apache-2.0
"""
Send messages of DDS (RTPS 2.5) that no middleware would send; standard library only.

    rtps.py announce PLACES LOCATOR...     for each address:port, a participant that claims it
    rtps.py inject PLACES TOPIC TEXT       a std_msgs/String

Both send to PLACES (``address:port,...``) until they are ended, and print a line for each round.
"""

from __future__ import annotations

from collections.abc import Sequence
import itertools
import json
import os
import socket
import struct
import sys
import time

#: Entity ids: 9.3.1 of the specification.
PARTICIPANT, SPDP, SEDP = b'\0\0\1\xc1', b'\0\1\0\xc2', b'\0\0\3\xc2'
WRITER = b'\0\0\1\3'
ANYBODY = bytes(4)
#: Version 2.3, and the vendor id of eProsima.
VERSION, VENDOR = b'\2\3', b'\1\x0f'
Places = Sequence[tuple[str, int]]


def split(word: str) -> tuple[str, int]:
    host, _, port = word.partition(':')
    return host, int(port)


def locator(address: str, port: int) -> bytes:
    return struct.pack('<iI12x4s', 1, port, socket.inet_aton(address))


def text(value: str) -> bytes:
    data = value.encode() + b'\0'
    return struct.pack('<I', len(data)) + data


def parameters(*pairs: tuple[int, bytes]) -> bytes:
    """Return a parameter list (9.4.2.11) with its encapsulation."""
    parts = [b'\0\3\0\0']
    for number, value in pairs:
        value += bytes(-len(value) % 4)
        parts.append(struct.pack('<HH', number, len(value)) + value)
    return b''.join([*parts, b'\1\0\0\0'])


def heartbeat(writer: bytes, last: int, count: int) -> bytes:
    body = ANYBODY + writer + struct.pack('<iIiII', 0, 1, 0, last, count)
    return struct.pack('<BBH', 7, 3, len(body)) + body


def data(writer: bytes, number: int, payload: bytes) -> bytes:
    body = struct.pack('<HH', 0, 16) + ANYBODY + writer + struct.pack('<iI', 0, number) + payload
    return struct.pack('<BBH', 0x15, 5, len(body)) + body


class Participant:
    """A participant that only sends."""

    def __init__(self) -> None:
        self.prefix = VENDOR + os.urandom(10)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.count = 0

    def send(self, places: Places, *parts: bytes) -> None:
        for place in places:
            self.socket.sendto(self.message(*parts), place)

    def message(self, *parts: bytes) -> bytes:
        """Return a message of these submessages."""
        return b'RTPS' + VERSION + VENDOR + self.prefix + b''.join(parts)

    def announcement(self, locators: list[bytes]) -> bytes:
        """Return the announcement of a participant that claims these addresses."""
        return data(SPDP, 1, parameters(
            (0x15, VERSION), (0x16, VENDOR), (0x50, self.prefix + PARTICIPANT),
            (2, struct.pack('<iI', 100, 0)), (0x58, struct.pack('<I', 0xc3f)),
            *((kind, one) for one in locators for kind in (0x32, 0x31))))

    def inject(self, places: Places, topic: str, message: str) -> None:
        """Announce a writer of a topic, and send it a message, without an answer."""
        self.count += 1
        # an address that participants of the VPN may use, or they would ignore this one
        self.send(places, self.announcement([locator('198.18.7.9', 7410)]))
        time.sleep(0.2)
        self.send(places, heartbeat(SEDP, 1, self.count), data(SEDP, 1, parameters(
            (0x15, VERSION), (0x16, VENDOR), (0x5a, self.prefix + WRITER),
            (5, text(f'rt{topic}')), (7, text('std_msgs::msg::dds_::String_')),
            (0x1a, struct.pack('<IiI', 2, 0, 0)), (0x1d, struct.pack('<I', 0)))))
        time.sleep(0.2)
        self.send(places, heartbeat(WRITER, self.count, self.count),
                  data(WRITER, self.count, b'\0\1\0\0' + text(message)))


def main() -> None:
    what, to, *words = sys.argv[1:]
    places = [split(word) for word in to.split(',')]
    participants = [Participant() for _ in words]
    for count in itertools.count(1):
        if what == 'inject':
            participants[0].inject(places, *words)
        else:
            for one, word in zip(participants, words):
                one.send(places, one.announcement([locator(*split(word))]))
            time.sleep(0.3)
        print(json.dumps({'round': count}), flush=True)


if __name__ == '__main__':
    main()
