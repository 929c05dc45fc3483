# SPDX-License-Identifier: Apache-2.0
"""The codec against reference pixels, and FFmpeg's own programs as an outside judge."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
import shutil
import subprocess

import numpy
from numpy.typing import NDArray
import pytest

pytest.importorskip('av', reason='PyAV (the extra "video") is not installed')
from image_transport_h264 import annexb
from image_transport_h264.codec import (
    BadPicture,
    Decoder,
    Encoder,
    Missing,
    Picture,
    Settings,
    working_encoders,
)
from image_transport_h264.picture import LAYOUTS

SIZES = [(64, 48), (63, 47), (1, 1), (2, 1), (5, 3), (17, 200)]
EIGHT_BIT = [name for name, layout in LAYOUTS.items() if layout.kind != 'deep']
DEEP = [name for name, layout in LAYOUTS.items() if layout.kind == 'deep']


def smooth(width: int, height: int, number: int = 0) -> NDArray[numpy.uint8]:
    """Return a picture (height, width, 3) that any codec keeps: soft waves in soft colours."""
    y, x = numpy.arange(height), numpy.arange(width)
    waves = [128 + 60 * numpy.outer(numpy.cos(y / 31 - c), numpy.sin((x + 2 * number) / 23 + c))
             for c in (0, 0.3, 0.6)]
    return numpy.dstack(waves).astype(numpy.uint8)


def picture(
    encoding: str, width: int, height: int, number: int = 0, pad: int = 0, big: bool = False,
) -> Picture:
    """Return picture ``number`` of a sequence, with ``pad`` bytes behind each row."""
    layout = LAYOUTS[encoding]
    colours = smooth(width, height, number)
    if layout.kind == 'deep':
        rows = numpy.repeat(colours[:, :, 0], layout.pixel_bytes, axis=1)
    elif layout.kind == 'grey':
        rows = colours[:, :, 0]
    elif layout.kind == 'yuv422':
        rows = numpy.repeat(colours[:, :, 1], 2, axis=1)
    else:
        if layout.pixel_bytes == 4:
            colours = numpy.dstack([colours, colours[:, :, 1] // 2])
        rows = colours.reshape(height, -1)
    rows = numpy.pad(rows, ((0, 0), (0, pad)))
    return Picture(width, height, encoding, rows.shape[1], rows.tobytes(), big)


def psnr(a: Picture, b: Picture) -> float:
    """Return the peak signal-to-noise ratio in dB."""
    error = float(((a.rows().astype(int) - b.rows()) ** 2).mean())
    return 99.0 if error == 0 else 10 * numpy.log10(255 ** 2 / error)


def shown(decoder: Decoder, data: bytes) -> Picture:
    """Return the packet's picture, which there has to be."""
    result = decoder.decode(data)
    assert result is not None
    return result


def fields(p: Picture) -> tuple[object, ...]:
    return p.width, p.height, p.encoding, p.step, p.is_bigendian


@pytest.mark.parametrize('encoding', EIGHT_BIT)
@pytest.mark.parametrize('size', SIZES, ids=str)
def test_picture_survives_encoding_and_decoding(encoding: str, size: tuple[int, int]) -> None:
    """All fields are as they were, the pixels nearly; each packet gives its picture at once."""
    encoder, decoder = Encoder(Settings(quality=18)), Decoder()
    for number in range(4):
        sent = picture(encoding, *size, number, pad=3 * number, big=number == 2)
        got = shown(decoder, encoder.encode(sent, seconds=number / 30).data)
        assert fields(got) == fields(sent)
        assert psnr(sent, got) > 34
        if LAYOUTS[encoding].alpha:
            assert (got.rows()[:, 3::4] == sent.rows()[:, 3::4]).all()


@pytest.mark.parametrize('encoding', EIGHT_BIT + DEEP)
@pytest.mark.parametrize('size', SIZES, ids=str)
def test_lossless_is_identical(encoding: str, size: tuple[int, int]) -> None:
    """Depth with any settings, not-a-number and infinity included."""
    random = numpy.random.default_rng(7)
    encoder, decoder = Encoder(Settings(lossless=encoding in EIGHT_BIT)), Decoder()
    for big in (False, True, False):
        row = size[0] * LAYOUTS[encoding].pixel_bytes
        noise = random.integers(0, 256, (size[1], row), dtype=numpy.uint8)
        rows = numpy.pad(noise, ((0, 0), (0, 5 * big)))
        sent = Picture(*size, encoding, row + 5 * big, rows.tobytes(), big)
        got = shown(decoder, encoder.encode(sent).data)
        assert fields(got) == fields(sent)
        assert bytes(got.data) == sent.data


def test_texture_is_kept_as_well_as_what_is_smooth() -> None:
    """Those who look for features look there: no bits go from texture to smooth walls."""
    random = numpy.random.default_rng(5)
    rows = smooth(320, 240)[:, :, 0].copy()
    rows[:, 160:] = random.integers(60, 200, (240, 160))
    sent = Picture(320, 240, 'mono8', 320, rows.tobytes())
    got = shown(Decoder(), Encoder(Settings(bitrate=100_000_000)).encode(sent).data).rows()
    error = numpy.abs(got.astype(int) - rows)
    assert error[:, 160:].mean() < 3


def test_alpha_of_one_level_costs_a_byte() -> None:
    encoder = Encoder()
    rows = numpy.dstack([smooth(64, 48), numpy.full((48, 64), 77, numpy.uint8)])
    packet = encoder.encode(Picture(64, 48, 'rgba8', 256, rows.tobytes()))
    assert packet.tag.alpha_level == 77
    assert (shown(Decoder(), packet.data).rows()[:, 3::4] == 77).all()


def test_size_and_encoding_change_midway() -> None:
    """The packet after a change is a key, and every packet gives its own picture."""
    encoder, decoder = Encoder(), Decoder()
    last: object = None
    plan = [('bgr8', 64, 48), ('bgr8', 64, 48), ('bgr8', 96, 40), ('mono8', 96, 40),
            ('16UC1', 96, 40), ('mono8', 96, 40), ('yuv422', 33, 77), ('rgb8', 33, 77),
            ('rgb8', 33, 77), ('bgr8', 64, 48)]
    for number, what in enumerate(plan):
        packet = encoder.encode(picture(*what, number))
        assert packet.tag.key == (what != last)
        assert packet.tag.sequence == number
        assert fields(shown(decoder, packet.data))[:3] == (what[1], what[2], what[0])
        last = what


def test_settings_change_midway() -> None:
    encoder, decoder = Encoder(Settings(bitrate=4_000_000)), Decoder()
    sizes = []
    for number in range(40):
        if number == 20:
            encoder.settings = Settings(bitrate=100_000)
        noise = numpy.random.default_rng(number).integers(0, 256, (120, 160 * 3), numpy.uint8)
        sent = Picture(160, 120, 'bgr8', 480, noise.tobytes())
        packet = encoder.encode(sent, seconds=number / 30)
        shown(decoder, packet.data)
        sizes.append(len(packet.data))
    # bits per second over what came after the key
    assert sum(sizes[21:]) * 8 / 19 * 30 < 150_000 < sum(sizes[1:20]) * 8 / 19 * 30


def test_key_on_demand_and_by_gop() -> None:
    encoder = Encoder(Settings(gop=5))
    keys = [encoder.encode(picture('bgr8', 32, 32, n), key=n == 7, seconds=n / 30).tag.key
            for n in range(14)]
    assert [n for n, key in enumerate(keys) if key] == [0, 5, 7, 12]


def test_loss_duplicates_and_late_packets() -> None:
    encoder, decoder = Encoder(), Decoder()
    packets = [encoder.encode(picture('bgr8', 64, 48, n), key=n == 6) for n in range(9)]
    shown(decoder, packets[0].data)
    shown(decoder, packets[1].data)
    assert decoder.decode(packets[1].data) is None
    assert decoder.decode(packets[0].data) is None
    with pytest.raises(Missing, match='1 packets missing'):
        decoder.decode(packets[3].data)
    with pytest.raises(Missing):
        decoder.decode(packets[4].data)
    assert decoder.needs_key
    for packet in packets[6:]:
        shown(decoder, packet.data)
    assert decoder.decode(packets[5].data) is None


def test_late_packet_closes_the_gap() -> None:
    """A lost packet that comes again is decoded, and so are those after it, come again."""
    encoder, decoder = Encoder(), Decoder()
    packets = [encoder.encode(picture('bgr8', 64, 48, n)) for n in range(5)]
    shown(decoder, packets[0].data)
    with pytest.raises(Missing):
        decoder.decode(packets[2].data)
    for packet in packets[1:]:
        shown(decoder, packet.data)


def test_an_encoder_that_started_anew_is_another_stream() -> None:
    first, second, decoder = Encoder(), Encoder(), Decoder()
    for number in range(6):
        shown(decoder, first.encode(picture('bgr8', 64, 48, number)).data)
    packets = [second.encode(picture('bgr8', 64, 48, n)) for n in range(3)]
    with pytest.raises(Missing):
        decoder.decode(packets[1].data)
    for packet in packets:
        shown(decoder, packet.data)


def test_streams_of_others_have_no_tag() -> None:
    """Annex B as FFMPEGPacket or CompressedVideo bring it: size and pixels from the stream."""
    encoder, decoder = Encoder(Settings(quality=18)), Decoder(encoding='rgb8')
    for number in range(3):
        sent = picture('rgb8', 64, 48, number)
        tag, plain = annexb.extract(encoder.encode(sent).data)
        assert tag is not None
        assert annexb.SEI not in annexb.kinds(plain) or annexb.extract(plain)[0] is None
        got = shown(decoder, plain)
        assert fields(got) == fields(sent)
        assert psnr(got, sent) > 34


@pytest.mark.parametrize(('change', 'cause'), [
    ({'width': 0}, 'size'), ({'height': 0}, 'size'), ({'step': 0}, 'step'),
    ({'step': 191}, 'step'), ({'data': b'\0' * 100}, 'length'),
    ({'data': b'\0' * (192 * 48 + 1)}, 'length'), ({'encoding': 'bayer_rggb8'}, 'encoding'),
    ({'encoding': ''}, 'encoding'), ({'width': 20000, 'step': 60000}, 'size')])
def test_bad_pictures_are_refused(change: dict[str, object], cause: str) -> None:
    good: dict[str, object] = {'width': 64, 'height': 48, 'encoding': 'bgr8', 'step': 192,
                               'data': b'\0' * (192 * 48)}
    encoder = Encoder()
    with pytest.raises(BadPicture) as caught:
        encoder.encode(Picture(**{**good, **change}))  # type: ignore[arg-type]
    assert caught.value.cause.startswith(cause)
    assert encoder.encode(Picture(**good)).tag.key  # type: ignore[arg-type]


@pytest.mark.parametrize('bad', [
    {'bitrate': 0}, {'quality': 52}, {'preset': 'fastest'}, {'gop': 0}, {'rate': 0},
    {'encoder': 'x265'}])
def test_bad_settings_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=str(next(iter(bad)))):
        Settings(**bad)  # type: ignore[arg-type]


def test_the_last_resort_among_encoders_is_libx264() -> None:
    assert working_encoders()[-1] == 'libx264'
    encoder = Encoder(Settings(encoder='auto'))
    assert shown(Decoder(), encoder.encode(picture('bgr8', 320, 240)).data).width == 320


# --- the stream as others see it ----------------------------------------------------------------

@pytest.fixture(scope='module')
def ffmpeg() -> None:
    """Skip where FFmpeg's programs are not installed."""
    if not (shutil.which('ffmpeg') and shutil.which('ffprobe')):
        pytest.skip('needs the programs ffmpeg and ffprobe')


def recording(settings: Settings, encoding: str, size: tuple[int, int]) -> tuple[
        bytes, list[Picture]]:
    encoder, decoder = Encoder(settings), Decoder()
    pictures, stream = [], b''
    for number in range(14):
        packet = encoder.encode(picture(encoding, *size, number), key=number == 11,
                                seconds=number / 30)
        stream += packet.data
        pictures.append(shown(decoder, packet.data))
    return stream, pictures


def test_annex_b_as_foxglove_wants_it() -> None:
    encoder = Encoder()
    for number in range(12):
        packet = encoder.encode(picture('bgr8', 61, 43, number), key=number == 6)
        kinds = annexb.kinds(packet.data)
        assert packet.data.startswith((b'\0\0\0\1', b'\0\0\1'))
        if packet.tag.key:
            assert {annexb.SPS, annexb.PPS, annexb.IDR} <= set(kinds)
            assert kinds.index(annexb.SPS) < kinds.index(annexb.PPS) < kinds.index(annexb.IDR)
            assert annexb.SLICE not in kinds
        else:
            assert annexb.SLICE in kinds
            assert annexb.IDR not in kinds


@pytest.mark.parametrize(('encoding', 'size', 'lossless'), [
    ('rgb8', (1280, 720), False), ('mono8', (61, 43), False), ('bgr8', (63, 47), True)])
def test_ffmpeg_agrees(
    ffmpeg: None, tmp_path: Path, encoding: str, size: tuple[int, int], lossless: bool,
) -> None:
    """FFmpeg reports no error, no B-frames, and the same pixels as our decoder's."""
    stream, pictures = recording(Settings(lossless=lossless), encoding, size)
    path = tmp_path / 'recorded.h264'
    path.write_bytes(stream)
    probe = subprocess.run(
        ['ffprobe', '-v', 'error', '-show_streams', '-show_frames', '-of', 'json', str(path)],
        capture_output=True, text=True, check=True, timeout=60)
    assert probe.stderr == ''
    told = json.loads(probe.stdout)
    assert told['streams'][0]['codec_name'] == 'h264'
    assert told['streams'][0]['has_b_frames'] == 0
    kinds = ''.join(frame['pict_type'] for frame in told['frames'])
    assert kinds == 'I' + 'P' * 10 + 'I' + 'P' * 2
    raw = subprocess.run(
        ['ffmpeg', '-v', 'error', '-xerror', '-err_detect', 'explode', '-i', str(path),
         '-f', 'rawvideo', '-pix_fmt', 'rgb24', '-'],
        capture_output=True, check=True, timeout=60)
    assert raw.stderr == b''
    width, height = told['streams'][0]['width'], told['streams'][0]['height']
    frames = numpy.frombuffer(raw.stdout, numpy.uint8).reshape(14, height, width, 3)
    if encoding in ('rgb8', 'bgr8'):
        ours = numpy.stack([p.rows().reshape(size[1], size[0], 3) for p in pictures])
        if encoding == 'bgr8':
            ours = ours[..., ::-1]
        difference = numpy.abs(frames[:, :size[1], :size[0]].astype(numpy.int16) - ours)
        assert difference.max() == 0 if lossless else difference.mean() < 1.5


@pytest.mark.parametrize('value', [
    b'', b'\0', b'\0\0\0', b'\0\0\1\0\0\3\0\0\0\0', bytes(range(256)) * 3, b'\0' * 700])
def test_a_tag_survives_emulation_prevention(value: bytes) -> None:
    tag = annexb.Tag(0, 0x00000100, True, 1, 1, 'bgra8', 0, False, alpha_plane=value or b'\0')
    body = b'\0\0\0\1\x67abc' + b'\0\0\1\x65' + b'\x11' * 9
    whole = annexb.insert(tag, body)
    unit = next(iter(annexb.units(whole)))
    assert not any(bytes([0, 0, n]) in whole[unit[0]:unit[1]] for n in range(3))
    back, rest = annexb.extract(whole)
    assert rest == body
    assert back is not None
    assert (back.sequence, back.alpha_plane) == (tag.sequence, tag.alpha_plane)


def test_a_tag_goes_behind_an_access_unit_delimiter() -> None:
    body = b'\0\0\0\1\x09\x10\0\0\0\1\x65abc'
    whole = annexb.insert(annexb.Tag(1, 2, True, 3, 4, 'mono8', 3, True), body)
    assert annexb.kinds(whole) == [annexb.DELIMITER, annexb.SEI, annexb.IDR]
    assert annexb.extract(whole)[1] == body


def test_sequence_numbers_wrap() -> None:
    encoder, decoder = Encoder(), Decoder()
    encoder._sequence = 0xfffffffe
    numbers = []
    for number in range(4):
        packet = encoder.encode(picture('mono8', 32, 32, number))
        numbers.append(packet.tag.sequence)
        shown(decoder, packet.data)
    assert numbers == [0xfffffffe, 0xffffffff, 0, 1]
    assert all((b - a) & 0xffffffff == 1 for a, b in itertools.pairwise(numbers))
