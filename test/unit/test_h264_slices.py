# SPDX-License-Identifier: Apache-2.0
"""Messages in slices, from a sender to receivers that this process connects."""

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
from image_transport_h264.slices import (
    Assembler,
    HEADER,
    LARGEST,
    LEAST,
    OPEN,
    SliceReceiver,
    SliceSender,
)


class Wire:
    """Stands for the nodes of both sides: passes each message on at once, or as ``lose`` says."""

    def __init__(self) -> None:
        self.heard: dict[str, list[Callable[[Any], None]]] = {}
        self.changed: dict[str, Callable[[], None]] = {}
        self.sent: list[bytes] = []
        self.complaints: list[str] = []
        self.lose: Callable[[str, Any], bool] = lambda topic, data: False

    def offer(self, kind: Any, topic: str, qos: Any, changed: Callable[[], None]) -> str:
        self.changed[topic] = changed
        return topic

    def all_acknowledged(self, topic: str) -> bool:
        return True

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


def sender(wire: Wire, *, fine: bool = False) -> SliceSender:
    return SliceSender(
        wire, '/camera/raw', lambda: None, fine)  # type: ignore[arg-type]


def receiver(wire: Wire, largest: int = LARGEST) -> list[bytes]:
    whole: list[bytes] = []
    SliceReceiver(
        wire, '/camera/raw', whole.append, largest).tap.want(True)  # type: ignore[arg-type]
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


def test_fine_slices_are_many_and_stay_small(wire: Wire) -> None:
    images = receiver(wire)
    one = sender(wire, fine=True)
    for size, count in ((100, 1), (LEAST, 2), (2 * LEAST, 4), (6 * LEAST, 8), (20 * LEAST, 20)):
        for _ in range(2):
            wire.sent.clear()
            one.send(bytes(size))
            assert len(wire.sent) == count and images[-1] == bytes(size)


def second_held_back(wire: Wire) -> list[UInt64MultiArray]:
    """Return the acknowledgements of the second receiver from its second one on."""
    late: list[UInt64MultiArray] = []
    receivers: list[int] = []

    def hold(topic: str, data: Any) -> bool:
        if isinstance(data, bytes):
            return False
        if data.data[0] not in receivers:
            receivers.append(data.data[0])
        elif data.data[0] == receivers[-1] and len(receivers) == 2:
            late.append(data)
            return True
        return False

    wire.lose = hold
    return late


def test_receiver_that_goes_delays_nobody(
    wire: Wire, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(slices, 'LONGEST', 600.0)
    images, _ = receiver(wire), receiver(wire)
    one, topic = sender(wire), '/camera/raw/slices'
    wire.changed[topic]()
    late = second_held_back(wire)
    thread = threading.Thread(target=one.send, args=(bytes(3 * LEAST),))
    thread.start()
    wait_until(lambda: late, timeout=30, what='a slice that waits')
    del wire.heard[topic][1]
    wire.changed[topic]()
    thread.join(30)
    assert not thread.is_alive() and images == [bytes(3 * LEAST)]


def test_next_slice_waits_for_the_slowest_receiver(wire: Wire) -> None:
    images, slow = receiver(wire), receiver(wire)
    one = sender(wire)
    (acknowledged,) = wire.heard['/camera/raw/acknowledged']
    late = second_held_back(wire)
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
    times: list[float] = []

    def send(count: int) -> None:
        one.send(bytes(count * LEAST), arrived=lambda seconds, _: times.append(seconds))

    send(2)
    assert len(wire.sent) == 1 and times == []  # there may be no receiver yet
    wire.lose = lambda topic, data: False
    send(3)
    assert images == [bytes(3 * LEAST)] and len(times) == 1
    wire.lose = lambda topic, data: True
    send(2)
    assert times[1:] == [0.05]


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
    HEADER.pack(1, 1, 101, 0) + b'too large', HEADER.pack(1, 1, 3, 0) + b'too long'])
def test_malformed_slices_give_no_image(wire: Wire, data: bytes) -> None:
    images = receiver(wire, 100)
    wire.put_out('/camera/raw/slices', message.in_pieces(data))
    wire.put_out('/camera/raw/slices', data)
    assert images == [] and wire.complaints


def part(sender: int, number: int, size: int, place: int, data: bytes) -> bytes:
    return HEADER.pack(sender, number, size, place) + data


def test_senders_are_put_together_side_by_side() -> None:
    assembler = Assembler()
    for place in range(3):
        for one in range(OPEN):
            added = assembler.add(part(one, place, 3, place, bytes([one])))
            assert added == (one, place, bytes(3 * [one]) if place == 2 else None)


def test_equal_message_does_not_fill_the_gap_of_another() -> None:
    """Of two images of a size, the end of one and the beginning of the next were lost."""
    assembler = Assembler()
    assembler.add(part(1, 1, 3, 0, b'a'))
    for place in (1, 2):
        assert assembler.add(part(1, place + 4, 3, place, b'b')) == (1, place + 4, None)


def test_endless_messages_take_bounded_memory() -> None:
    assembler = Assembler(10_000)
    for number in range(100):
        for one in range(OPEN):
            assembler.add(part(one, number, 9_999, 99 * number, bytes(99)))
        assert sum(len(each.data) for each in assembler._messages.values()) <= 10_000


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
    sizes: list[float] = []
    one.send_to_all('/camera/raw', bytes(3 * LEAST), sizes.append,  # type: ignore[arg-type]
                    lambda seconds, _: sizes.append(seconds))
    assert wire.sent == [bytes(3 * LEAST)] and sizes[0] == 3 * LEAST and sizes[1] < 1.0
