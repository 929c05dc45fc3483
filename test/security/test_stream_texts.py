# SPDX-License-Identifier: Apache-2.0
"""Names and texts in the messages of a stream take little memory, and control no terminal."""

from __future__ import annotations

from collections.abc import Callable
import random
import struct
import threading
import time
import tracemalloc
from types import SimpleNamespace
from unittest import mock

import pytest

pytest.importorskip('av', reason='PyAV (the extra "video") is not installed')
pytest.importorskip('zstandard', reason='the extra "point-clouds" is not installed')
from fogros2_replicas.pairs import header_of, Pair
from image_transport_h264.budget import Budget, REPORT
from image_transport_h264.codec import Settings
from image_transport_h264.control import Control
from image_transport_h264.lazy import LazyNode, MOST_CAUSES
from image_transport_h264.sharing import Claim, Link, LISTEN, MOST_LINKS
from point_cloud_stream.cloud import CloudError, Field, Layout

#: Bytes that the names of a hijacked machine may take.
LIMIT = 5e6


def taken(attack: Callable[[], object]) -> int:
    """Return the bytes that a call keeps."""
    tracemalloc.start()
    try:
        attack()
        return tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()


def test_acknowledgements_of_many_names_take_little() -> None:
    control = Control(Settings())
    control.heard(1, 0, 0, 0.0)

    def flood() -> None:
        for name in range(2, 60_000):
            control.heard(name, 0, 0, 0.1)
        begin = time.process_time()
        for number in range(1, 7):
            assert control.due(0.1 + number / 30, 640 * 480)
            control.sent(number, 1000, 0.1 + number / 30)
            control.heard(1, number, 0, 0.15 + number / 30)
        assert time.process_time() - begin < 0.2

    assert taken(flood) < LIMIT
    # the decoder that came first counts, and others take the places of silent names
    assert control.round_trip == pytest.approx(0.05)
    control.due(4.0, 640 * 480)
    control.heard(70_000, 10, 3, 4.0)
    control.heard(70_000, 11, 4, 4.0)
    assert control.protects(4.0)


def test_claims_on_links_take_little() -> None:
    links = [Link(10e6, -LISTEN) for _ in range(MOST_LINKS)]

    def flood() -> None:
        for link in links:
            for number in range(600):
                label = f'{number}'.ljust(60_000 if number < 300 else 255)
                link.heard(SimpleNamespace(
                    layout=SimpleNamespace(dim=[SimpleNamespace(label=label)]),
                    data=[0.01 + number % 100, 0.0, 1e3 * (number + 1), 1e9, 0.0, 0.0]), 0.0)

    assert taken(flood) < LIMIT
    begin = time.process_time()
    for link in links:
        link.share('/own/h264', Claim(1.0, 2e5, 1e6, 1e9, 0.0), 0.1)
    assert time.process_time() - begin < REPORT / 5


def test_frame_ids_of_one_stamp_take_little() -> None:
    pair = Pair(['a', 'b'])
    pair.input(0.0, (1, ''))
    assert pair.output(0.1, 'a', (1, ''))

    def flood() -> None:
        for number in range(20_000):
            frame = f'{number}'.encode() + bytes(5000)
            header = header_of(b'\0\1\0\0' + struct.pack('<iII', 0, 1, len(frame)) + frame)
            pair.output(0.1, 'b', header)

    assert taken(flood) < LIMIT
    pair.input(1.0, (2, ''))
    assert pair.output(1.1, 'a', (2, ''))


@pytest.mark.parametrize(('name', 'link'), [
    ('/fogros2/planner_1/link_in', True), ('/fogros2/m/link_out', True),
    ('/forward_velocity_controller/commands', False), ('/fogros2/m/cmd', False),
    ('/fogros2/m/link_in/x', False), ('/fogros2/a/b/link_in', False), ('link_in', False),
    ('/x/fogros2/m/link_in', False), ('/fogros2//link_in', False),
    # rclpy raises an error for them, which would end the encoder
    ('/fogros2/0/link_in', False), (f'/fogros2/{300 * "m"}/link_in', False)],
    ids=lambda value: str(value)[:40])
def test_encoder_publishes_claims_on_links_alone(name: str, link: bool) -> None:
    """Controllers take the type of a claim, and a decoder announces the topics."""
    node = mock.Mock()
    node.declare_parameter.return_value.value = 1.0
    Budget(node, '/camera/h264', lambda: 1)
    join = node.create_subscription.call_args_list[0].args[2]
    node.create_publisher.reset_mock()
    layout = SimpleNamespace(dim=[SimpleNamespace(label=name)])
    join(SimpleNamespace(layout=layout, data=[1e6]))
    assert [call.args[1] for call in node.create_publisher.call_args_list] == [name] * link


def test_names_of_fields_are_in_no_error() -> None:
    """A node logs each error once, by its text."""
    texts = set()
    for number in range(200):
        name = f'\x1b[2J{random.Random(number).random()}'
        for field in (Field(name, 0, 99), Field(name, 4096, 7), Field(name, 0, 8, 9)):
            fields = *(Field(axis, 4 * i, 7) for i, axis in enumerate('xyz')), field
            with pytest.raises(CloudError) as error:
                Layout(1, 1, fields, 12, 12).check()
            texts.add(str(error.value))
    assert len(texts) < 5 and all(map(str.isprintable, texts))


def test_warnings_of_a_node_are_few_and_control_no_terminal() -> None:
    """A sender could otherwise fill the log with names of encodings."""
    said: list[str] = []
    node = SimpleNamespace(_complaining=threading.Lock(), _complained=set(),
                           get_logger=lambda: SimpleNamespace(warning=said.append))
    for number in range(10 * MOST_CAUSES):
        LazyNode.complain(node, f'encoding {number}', 'encoding \x1b]52;c;eA==\x07\u202e\r')  # type: ignore
    assert len(said) == MOST_CAUSES
    assert said[0].startswith('encoding ?]52') and said[0].isprintable()
