# SPDX-License-Identifier: Apache-2.0
"""Streams cut, reordered and damaged at random: the decoder stays up and shows nothing wrong."""

from __future__ import annotations

import functools

import numpy
import pytest

pytest.importorskip('av', reason='PyAV (the extra "video") is not installed')
from hypothesis import given, HealthCheck, settings, strategies

from image_transport_h264.codec import CodecError, Decoder, Encoder, Packet, Picture

WIDTH, HEIGHT = 64, 48
KEYS = (0, 7, 14)
LIMITS = settings(max_examples=60, deadline=None, derandomize=True,
                  suppress_health_check=[HealthCheck.function_scoped_fixture])


def clean(number: int, encoding: str) -> Picture:
    if encoding == 'bgr8':
        random = numpy.random.default_rng(number)
        rows = random.integers(0, 256, (HEIGHT, WIDTH * 3), numpy.uint8)
        return Picture(WIDTH, HEIGHT, encoding, WIDTH * 3, rows.tobytes())
    return Picture(WIDTH, HEIGHT, '16UC1', WIDTH * 2, bytes([number]) * (WIDTH * HEIGHT * 2))


@functools.lru_cache(maxsize=None)
def stream(encoding: str) -> list[tuple[Packet, bytes]]:
    """Return packets with what an undisturbed decoder shows for them."""
    encoder, decoder, out = Encoder(), Decoder(), []
    for number in range(20):
        packet = encoder.encode(clean(number, encoding), key=number in KEYS, seconds=number / 30)
        shown = decoder.decode(packet.data)
        assert shown is not None
        out.append((packet, bytes(shown.data)))
    return out


damage = strategies.one_of(
    strategies.tuples(strategies.just('drop')),
    strategies.tuples(strategies.just('twice')),
    strategies.tuples(strategies.just('swap')),
    strategies.tuples(strategies.just('cut'), strategies.floats(0, 1)),
    strategies.tuples(strategies.just('flip'), strategies.floats(0, 0.999),
                      strategies.integers(1, 255)),
    strategies.tuples(strategies.just('insert'), strategies.floats(0, 1),
                      strategies.binary(min_size=1, max_size=40)))


def disturb(
    packets: list[bytes], plan: dict[int, tuple[object, ...]],
) -> list[bytes]:
    """Return the packets with the damage that ``plan`` names by index."""
    out: list[bytes] = []
    for index, data in enumerate(packets):
        what = plan.get(index, ('keep',))
        if what[0] == 'drop':
            continue
        if what[0] == 'twice':
            out += [data, data]
        elif what[0] == 'swap' and out:
            out.insert(len(out) - 1, data)
        elif what[0] == 'cut':
            out.append(data[:int(len(data) * float(str(what[1])))])
        elif what[0] == 'flip':
            at = int(len(data) * float(str(what[1])))
            out.append(data[:at] + bytes([data[at] ^ int(str(what[2]))]) + data[at + 1:])
        elif what[0] == 'insert':
            at = int(len(data) * float(str(what[1])))
            assert isinstance(what[2], bytes)
            out.append(data[:at] + what[2] + data[at:])
        else:
            out.append(data)
    return out


@pytest.mark.parametrize('encoding', ['bgr8', '16UC1'])
@LIMITS
@given(plan=strategies.dictionaries(strategies.integers(0, 13), damage, max_size=8))
def test_nothing_wrong_is_ever_shown(
    encoding: str, plan: dict[int, tuple[object, ...]],
) -> None:
    """Whatever is shown is one of the pictures sent, and the next whole key ends all trouble."""
    packets = stream(encoding)
    right = {shown for _, shown in packets}
    decoder = Decoder()
    for data in disturb([p.data for p, _ in packets[:14]], plan):
        try:
            shown = decoder.decode(data)
        except CodecError:
            continue
        if shown is not None:
            assert (shown.width, shown.height) == (WIDTH, HEIGHT)
            assert bytes(shown.data) in right
    for packet, expected in packets[14:]:
        got = decoder.decode(packet.data)
        assert got is not None
        assert bytes(got.data) == expected
