# SPDX-License-Identifier: Apache-2.0
"""Packets in pieces: what may be lost, what comes in any order, what is damaged."""

from __future__ import annotations

import random

import pytest

pytest.importorskip('hypothesis', reason='hypothesis is not installed')
pytest.importorskip('numpy', reason='numpy is not installed')
from hypothesis import given, settings, strategies

from fogros2.dds.cyclonedds import FRAGMENT
from image_transport_h264.repair import Assembler, GROUP, PIECE, pieces


def packet(size: int, seed: int = 0) -> bytes:
    return random.Random(seed).randbytes(size)


@pytest.mark.parametrize('size', [0, 1, PIECE - 1, PIECE, PIECE + 1, 5 * PIECE, 60_000])
def test_any_one_piece_may_be_lost(size: int) -> None:
    whole = packet(size)
    sent = pieces(7, 1, whole)
    # with 16 bytes as a message; Cyclone sends a larger one in two packets
    assert all(len(piece) + 16 <= FRAGMENT for piece in sent)
    for missing in range(len(sent)):
        assembler = Assembler()
        got = [assembler.add(piece) for index, piece in enumerate(sent) if index != missing]
        assert [data for data in got if data is not None] == [whole]


@settings(max_examples=80, deadline=None, derandomize=True)
@given(size=strategies.integers(1, 30_000), seed=strategies.integers(0, 99),
       lost=strategies.floats(0, 0.4))
def test_it_is_whole_or_nothing(size: int, seed: int, lost: float) -> None:
    """In any order, twice or not at all: what comes out is what went in."""
    chance = random.Random(seed)
    whole = packet(size, seed)
    sent = [piece for piece in pieces(7, seed, whole) if chance.random() >= lost]
    sent += chance.sample(sent, len(sent) // 3)
    chance.shuffle(sent)
    assembler = Assembler()
    got = [data for data in map(assembler.add, sent) if data is not None]
    assert got in ([], [whole])


def test_a_loss_in_each_group_is_repaired() -> None:
    whole = packet(20 * PIECE)
    sent = pieces(7, 1, whole)
    parities = 20 // GROUP
    assert len(sent) == 20 + parities
    # neighbours are in groups of their own: a burst as long as there are parities is repaired
    kept = sent[:3] + sent[3 + parities:]
    assembler = Assembler()
    assert whole in [assembler.add(piece) for piece in kept]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(at=strategies.floats(0, 0.999), flip=strategies.integers(1, 255),
       noise=strategies.binary(max_size=60))
def test_damage_counts_as_loss(at: float, flip: int, noise: bytes) -> None:
    whole = packet(4000)
    sent = pieces(7, 1, whole)
    bad = bytearray(sent[1])
    bad[int(at * len(bad))] ^= flip
    assembler = Assembler()
    assert assembler.add(bytes(bad)) is None
    assert assembler.add(noise) is None
    got = [assembler.add(piece) for index, piece in enumerate(sent) if index != 1]
    assert [data for data in got if data is not None] == [whole]


def test_packets_are_kept_apart_and_old_ones_given_up() -> None:
    assembler = Assembler()
    first = pieces(7, 0, packet(3000))
    assembler.add(first[0])
    for sequence in range(1, 10):
        whole = packet(3000, sequence)
        got = [assembler.add(piece) for piece in pieces(7, sequence, whole)]
        assert [data for data in got if data is not None] == [whole]
    assert [assembler.add(piece) for piece in first[1:2]] == [None]
