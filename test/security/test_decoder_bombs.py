# SPDX-License-Identifier: Apache-2.0
"""A small packet from a hijacked machine takes no more than 300 MB of the robot's memory."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator
import dataclasses
from fractions import Fraction
import json
import struct
import subprocess
import sys
import zlib

import pytest

pytest.importorskip('av', reason='PyAV (the extra "video") is not installed')
pytest.importorskip('cv2', reason='OpenCV (the extra "video") is not installed')
import cv2
import numpy

from image_transport_h264 import annexb, deep, stills
from image_transport_h264.codec import Damaged, Decoder, Encoder, Packet, Picture, Settings

#: Bytes that decoding may take.
LIMIT = 300e6
SIDE = 4096
#: Decodes what a file has, as a node does, in a fork for each line of the input. Prints how many
#: bytes more the process held.
DECODE = """\
import base64, json, os, re, sys
from pathlib import Path
from image_transport_h264 import stills
from image_transport_h264.codec import CodecError, Decoder, Encoder, Picture
def peak():
    return 1024 * int(re.search(r'VmHWM:\\s*(\\d+)', Path('/proc/self/status').read_text())[1])
for line in sys.stdin:
    if os.fork():
        if os.wait()[1]:
            print(0, 'killed', '', sep=';', flush=True)
        continue
    packets = [(form, base64.b64decode(data))
               for form, data in json.loads(Path(line.strip()).read_text())]
    decoder = Decoder()
    small = Picture(64, 64, 'bgr8', 192, bytes(64 * 64 * 3))
    decoder.decode(Encoder().encode(small).data)
    stills.decode('', stills.encode(small, 'png')[1])
    Path('/proc/self/clear_refs').write_text('5')
    before = peak()
    shown, why = None, ''
    for form, data in packets:
        try:
            shown = stills.decode(form, data) if form else decoder.decode(data)
        except CodecError as error:
            shown, why = None, why or str(error)
    print(peak() - before, shown and (shown.width, shown.height), why, sep=';', flush=True)
    os._exit(0)
"""
#: Decodes packets in a process of their own; returns its additional memory, the size shown, the
#: error.
Decode = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope='module')
def decode(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Decode]:
    file = tmp_path_factory.mktemp('bombs') / 'packets'
    with subprocess.Popen([sys.executable, '-c', DECODE], stdin=subprocess.PIPE,
                          stdout=subprocess.PIPE, text=True) as judge:
        assert judge.stdin and judge.stdout
        reader, writer = judge.stdout, judge.stdin

        def decode(*packets: tuple[str, bytes]) -> tuple[int, str, str]:
            file.write_text(json.dumps(
                [(form, base64.b64encode(data).decode()) for form, data in packets]))
            print(file, file=writer, flush=True)
            taken, shown, why = reader.readline().strip().split(';')
            return int(taken), shown, why

        yield decode
        writer.close()


def png(width: int, height: int, depth: int, colours: int) -> bytes:
    """Return a black picture, of the same 16 rows again and again: that is packed soon."""
    channels = {0: 1, 2: 3, 6: 4}[colours]
    rows = bytes(16 * (1 + width * channels * depth // 8))
    packer, checksum = zlib.compressobj(9, wbits=-15), 1
    packed = packer.compress(rows) + packer.flush(zlib.Z_FULL_FLUSH)
    for _ in range(height // 16):
        checksum = zlib.adler32(rows, checksum)
    data = b'\x78\xda' + height // 16 * packed + b'\3\0' + struct.pack('>I', checksum)
    out = b'\x89PNG\r\n\x1a\n'
    for kind, body in ((b'IHDR', struct.pack('>IIBBBBB', width, height, depth, colours, 0, 0, 0)),
                       (b'IDAT', data), (b'IEND', b'')):
        out += struct.pack('>I', len(body)) + kind + body
        out += struct.pack('>I', zlib.crc32(kind + body))
    return out


def black(width: int, height: int, encoding: str = 'mono8', pixel_bytes: int = 1) -> Picture:
    step = width * pixel_bytes
    return Picture(width, height, encoding, step, bytes(step * height))


def retag(packet: Packet, **fields: int) -> bytes:
    """Return an H.264 packet with other fields in its tag."""
    tag, coded = annexb.extract(packet.data)
    assert tag is not None
    return annexb.insert(dataclasses.replace(tag, **fields), coded)


def test_a_large_png_is_refused_before_it_is_decoded(decode: Decode) -> None:
    data = png(12000, 12000, 8, 6)
    assert len(data) < 700_000
    taken, shown, why = decode(('bgra8; png compressed bgra8', data))
    assert taken < LIMIT and shown == 'None' and 'max_pixels' in why, (taken, why)


def test_a_png_chunk_longer_than_its_file_is_refused(decode: Decode) -> None:
    data = bytearray(png(64, 48, 8, 2))
    data[33:37] = struct.pack('>I', 1_900_000_000)  # the length of IDAT
    taken, shown, why = decode(('png', bytes(data)))
    assert taken < LIMIT and shown == 'None' and 'longer than the file' in why, (taken, why)


def test_a_png_of_deep_colours_is_refused(decode: Decode) -> None:
    taken, shown, why = decode(('bgra8; png', png(SIDE, SIDE, 16, 6)))
    assert taken < LIMIT and shown == 'None' and '16-bit' in why, (taken, why)


def test_a_large_jpeg_is_refused_before_it_is_decoded(decode: Decode) -> None:
    _, coded = cv2.imencode('.jpg', numpy.zeros((16, 16, 3), numpy.uint8))
    data = bytearray(coded.tobytes())
    at = data.index(b'\xff\xc0')
    data[at + 5:at + 9] = struct.pack('>HH', 20000, 20000)
    taken, shown, why = decode(('bgr8; jpeg', bytes(data)))
    assert taken < LIMIT and shown == 'None' and 'max_pixels' in why, (taken, why)


@pytest.mark.parametrize('hidden', [b'\xff\xd0', b'\xff\x01', b'\xff\xff', b'x'])
def test_a_frame_header_of_jpeg_cannot_be_hidden(hidden: bytes) -> None:
    """A decoder that skips bytes otherwise would read another header than the checked one."""
    _, coded = cv2.imencode('.jpg', numpy.zeros((16, 16, 3), numpy.uint8))
    data = coded.tobytes()
    at = data.index(b'\xff\xc0')
    with pytest.raises(Damaged):
        stills.decode('', data[:at] + hidden + data[at:])


@pytest.mark.parametrize('data', [b'BM' + bytes(60), b'GIF89a' + bytes(60),
                                  b'RIFF\0\0\0\0WEBPVP8 ' + bytes(60), b'II*\0' + bytes(60)])
def test_other_formats_never_reach_their_decoders(data: bytes) -> None:
    with pytest.raises(Damaged, match='neither JPEG nor PNG'):
        stills.decode('', data)


def test_a_large_h264_picture_is_refused_before_decoding(decode: Decode) -> None:
    data = Encoder(Settings(preset='ultrafast')).encode(black(10240, 8192)).data
    assert len(data) < 400_000
    taken, shown, why = decode(('', data))
    assert taken < LIMIT and shown == 'None' and 'max_pixels' in why, (taken, why)
    # as from another encoder
    taken, shown, why = decode(('', annexb.extract(data)[1]))
    assert taken < LIMIT and shown == 'None' and 'max_pixels' in why, (taken, why)


def test_many_reference_frames_are_refused(decode: Decode) -> None:
    """The size is allowed, but 16 frames of it would be kept."""
    import av
    codec = av.CodecContext.create('libx264', 'w')
    codec.width, codec.height, codec.pix_fmt = SIDE, SIDE, 'yuv420p'
    codec.options = {'preset': 'ultrafast', 'tune': 'zerolatency', 'x264-params': 'ref=16'}
    packets = []
    for number in range(2):
        frame = av.VideoFrame(SIDE, SIDE, 'yuv420p')
        deep.lines(frame)[:] = number
        deep.lines(frame, 1)[:] = deep.lines(frame, 2)[:] = 128
        frame.pts = number
        packets += [('', bytes(packet)) for packet in codec.encode(frame)]
    taken, shown, why = decode(*packets)
    assert taken < LIMIT and shown == 'None' and 'max_pixels' in why, (taken, why)


def wrapped(tag: annexb.Tag, extra: bytes, coded: bytes) -> bytes:
    """Return an FFV1 packet."""
    packed = dataclasses.replace(tag, checksum=zlib.crc32(extra + coded)).pack()
    return (deep.MAGIC + struct.pack('>HHI', len(packed), len(extra), len(coded)) + packed
            + extra + coded)


def test_many_slices_of_a_deep_picture_are_refused(decode: Decode) -> None:
    """Each slice has contexts of its own, however small the picture is."""
    import av
    codec = av.CodecContext.create('ffv1', 'w')
    codec.width, codec.height, codec.pix_fmt = 1024, 1024, 'gray16le'
    codec.time_base = Fraction(1, 30)
    codec.options = {'level': '3', 'slices': '1024', 'context': '1', 'coder': '1'}
    frame = av.VideoFrame(1024, 1024, 'gray16le')
    deep.lines(frame)[:] = 0
    coded = b''.join(map(bytes, codec.encode(frame)))
    tag = annexb.Tag(1, 0, True, 1024, 1024, '16UC1', 2048, False)
    data = wrapped(tag, bytes(codec.extradata), coded)
    assert len(data) < 20_000
    taken, shown, why = decode(('', data))
    assert taken < 100e6 and shown == 'None', (taken, shown)


@pytest.mark.parametrize('encoding, pixel_bytes', [('bgr8', 3), ('16UC1', 2)])
def test_rows_longer_than_any_picture_s_are_refused(
    encoding: str, pixel_bytes: int, decode: Decode,
) -> None:
    packet = Encoder().encode(black(64, 1024, encoding, pixel_bytes))
    if packet.format == 'h264':
        data = retag(packet, step=2 ** 20)
    else:
        tag, extra, coded = deep.split(packet.data)
        data = wrapped(dataclasses.replace(tag, step=2 ** 20), extra, coded)
    taken, shown, why = decode(('', data))
    assert taken < LIMIT and shown == 'None', (taken, shown)


@pytest.mark.parametrize('encoding, pixel_bytes, lossless', [
    ('rgba8', 4, False), ('bgr8', 3, True), ('16UC1', 2, False)])
def test_the_largest_allowed_picture_stays_below_the_limit(
    encoding: str, pixel_bytes: int, lossless: bool, decode: Decode,
) -> None:
    encoder = Encoder(Settings(lossless=lossless))
    packets = [('', encoder.encode(black(SIDE, SIDE, encoding, pixel_bytes)).data)
               for _ in range(2)]
    taken, shown, why = decode(*packets)
    assert shown == f'({SIDE}, {SIDE})' and taken < LIMIT, (taken, why)


def test_the_largest_allowed_png_stays_below_the_limit(decode: Decode) -> None:
    taken, shown, why = decode(('bgra8; png', png(SIDE, SIDE, 8, 6)))
    assert shown == f'({SIDE}, {SIDE})' and taken < LIMIT, (taken, why)


def test_the_limit_is_the_receiver_s_own() -> None:
    decoder = Decoder(max_pixels=64 * 48)
    encoder = Encoder()
    assert decoder.decode(encoder.encode(black(64, 48)).data) is not None
    with pytest.raises(Damaged, match='max_pixels'):
        decoder.decode(encoder.encode(black(64, 96)).data)


@pytest.mark.parametrize('preset', ['ultrafast', 'veryslow'])
@pytest.mark.parametrize('lossless', [False, True])
@pytest.mark.parametrize('encoding, pixel_bytes', [('bgr8', 3), ('mono8', 1), ('yuyv', 2)])
def test_sizes_are_read_as_encoders_write_them(
    preset: str, lossless: bool, encoding: str, pixel_bytes: int,
) -> None:
    data = Encoder(Settings(preset=preset, lossless=lossless)).encode(
        black(100, 50, encoding, pixel_bytes)).data
    (sps,) = set(annexb.parameter_sets(data))
    assert (sps.width, sps.height) == (112, 64) and sps.references <= 16
    assert sps.sample_bytes == (
        {'bgr8': 3, 'mono8': 1.5, 'yuyv': 2}[encoding] if lossless else 1.5)
