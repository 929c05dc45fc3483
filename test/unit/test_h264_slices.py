# SPDX-License-Identifier: Apache-2.0
"""Large images in slices, from a sender to receivers that this process connects."""

from __future__ import annotations

from collections.abc import Callable
import secrets
import threading
import time
from typing import Any

import pytest
from std_msgs.msg import UInt64MultiArray

from fogros2.waiting import wait_until
from image_transport_h264 import message, slices
from image_transport_h264.slices import LEAST, SliceReceiver, SliceSender

HEADER = slices._HEADER


class Wire:
    """Stands for the nodes of both sides: passes each message on at once, or as ``lose`` says."""

    def __init__(self) -> None:
        self.heard: dict[str, list[Callable[[Any], None]]] = {}
        self.sent: list[bytes] = []
        self.complaints: list[str] = []
        self.lose: Callable[[str, Any], bool] = lambda topic, data: False

    def offer(self, kind: Any, topic: str, qos: Any, changed: Any) -> str:
        return topic

    def create_publisher(self, kind: Any, topic: str, qos: Any) -> str:
        return topic

    def create_subscription(
        self, kind: Any, topic: str, heard: Callable[[Any], None], qos: Any, **more: Any,
    ) -> None:
        self.heard.setdefault(topic, []).append(heard)

    def put_out(self, topic: str, data: Any) -> None:
        if isinstance(data, bytes):
            self.sent.append(data)
        if not self.lose(topic, data):
            for heard in self.heard.get(topic, []):
                heard(data)

    def subscribers(self, topic: str) -> int:
        return len(self.heard.get(topic, []))

    def complain(self, cause: str, text: str) -> None:
        self.complaints.append(text)


@pytest.fixture
def wire() -> Wire:
    return Wire()


def sender(wire: Wire) -> SliceSender:
    return SliceSender(wire, '/camera/raw', lambda: None)  # type: ignore[arg-type]


def receiver(wire: Wire) -> list[bytes]:
    whole: list[bytes] = []
    SliceReceiver(wire, '/camera/raw', whole.append).tap.want(True)  # type: ignore[arg-type]
    return whole


def sizes(wire: Wire) -> list[int]:
    return [len(message.piece(data)) - HEADER.size for data in wire.sent]


@pytest.mark.parametrize('size', [1, LEAST, LEAST + 1, 921_664])
def test_image_arrives_in_slices_of_one_size(wire: Wire, size: int) -> None:
    images = receiver(wire)
    data = secrets.token_bytes(size)
    sender(wire).send(data)
    assert images == [data]
    first, *_, last = [*sizes(wire), sizes(wire)[-1]]
    assert max(sizes(wire)) == first <= LEAST and first - last < len(wire.sent)


def test_slices_of_a_quick_link_grow_and_of_a_slow_one_shrink(wire: Wire) -> None:
    receiver(wire)
    one = sender(wire)
    for _ in range(3):
        one.send(bytes(4 * LEAST))
    assert sizes(wire) == [LEAST] * 4 + [4 * LEAST] * 2
    for seconds in (0.05, 0.2, 0.2, 0.2):
        one._adapt(seconds)
    assert one._size == LEAST


def test_next_slice_waits_for_the_slowest_receiver(wire: Wire) -> None:
    images, slow = receiver(wire), receiver(wire)
    late: list[UInt64MultiArray] = []
    one = sender(wire)
    (acknowledged,) = wire.heard['/camera/raw/acknowledged']
    receivers: list[int] = []

    def delay(topic: str, data: Any) -> bool:
        """Hold the second receiver's acknowledgements back."""
        if isinstance(data, bytes):
            return False
        if data.data[0] not in receivers:
            receivers.append(data.data[0])
        elif data.data[0] == receivers[-1] and len(receivers) == 2:
            late.append(data)
            return True
        return False

    wire.lose = delay
    thread = threading.Thread(target=one.send, args=(bytes(3 * LEAST),))
    thread.start()
    wait_until(lambda: len(late) == 1, timeout=30, what='the second acknowledgement')
    assert len(wire.sent) == 2 and images == []
    while thread.is_alive() and late:
        acknowledged(late.pop())
        wait_until(lambda: late or not thread.is_alive(), timeout=30, what='the next slice')
    thread.join()
    assert len(images) == len(slow) == 1


def test_cut_link_costs_the_image_and_no_more(
    wire: Wire, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(slices, 'LONGEST', 0.05)
    images = receiver(wire)
    one = sender(wire)
    wire.lose = lambda topic, data: True
    one.send(bytes(2 * LEAST))
    assert len(wire.sent) == 1
    wire.lose = lambda topic, data: False
    one.send(bytes(3 * LEAST))
    assert images == [bytes(3 * LEAST)]


def test_slices_that_a_link_does_not_carry_in_time_shrink(
    wire: Wire, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(slices, 'LONGEST', 0.05)
    receiver(wire)
    one = sender(wire)
    for _ in range(6):  # a quick link, for which the whole image is one slice at last
        one.send(bytes(16 * LEAST))
    assert one._size == 16 * LEAST
    wire.lose = lambda topic, data: True
    for _ in range(5):
        one.send(bytes(16 * LEAST))
    assert sizes(wire)[-1] == LEAST


@pytest.mark.parametrize('first', [0, 1, 2])
def test_image_with_a_slice_missing_is_not_shown(wire: Wire, first: int) -> None:
    images = receiver(wire)
    one = sender(wire)
    one.send(bytes(3 * LEAST))
    parts = wire.sent[:]
    for number, part in enumerate(parts):
        if number != first:
            wire.put_out('/camera/raw/slices', part)
    assert images == [bytes(3 * LEAST)]


@pytest.mark.parametrize('data', [
    b'', b'x', HEADER.pack(1, 1, 10, 0)[:-1],
    HEADER.pack(1, 1, 2 ** 32 - 1, 0) + b'too large', HEADER.pack(1, 1, 3, 0) + b'too long'])
def test_malformed_slices_give_no_image(wire: Wire, data: bytes) -> None:
    images = receiver(wire)
    wire.put_out('/camera/raw/slices', message.in_pieces(data))
    wire.put_out('/camera/raw/slices', data)
    assert images == [] and wire.complaints


def test_strangers_acknowledge_nothing(wire: Wire) -> None:
    one = sender(wire)
    for data in ([], [1, 2, 3], [1, 2], [1, 2, 3, 4]):
        one._heard(UInt64MultiArray(data=data))
    one._heard(UInt64MultiArray(data=[1, one._identity, 1]))
    assert one._heard_of == {}
    for number in range(1000):
        one._heard(UInt64MultiArray(data=[number, one._identity, 0]))
    assert len(one._heard_of) < 100


def test_receiver_that_hangs_keeps_no_image_from_others(
    wire: Wire, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(slices, 'LONGEST', 0.05)
    images = receiver(wire)
    one = sender(wire)
    wire.heard['/camera/raw/slices'].insert(0, lambda data: one._heard(
        UInt64MultiArray(data=[1, one._identity, 0])))
    begin = time.monotonic()
    one.send(bytes(40 * LEAST))
    assert images == [bytes(40 * LEAST)]
    assert time.monotonic() - begin < 1.0


def test_whole_images_go_to_subscribers_without_slices(wire: Wire) -> None:
    one = sender(wire)
    receiver(wire)
    wire.heard['/camera/raw'] = [lambda data: None]
    assert one.replace('/camera/raw')  # type: ignore[arg-type]
    wire.heard['/camera/raw'] *= 2
    assert not one.replace('/camera/raw')  # type: ignore[arg-type]
