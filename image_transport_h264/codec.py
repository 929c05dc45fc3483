# SPDX-License-Identifier: Apache-2.0
"""
Encode pictures as H.264 and decode them without delay: one packet per picture; without ROS.

A packet is one access unit in Annex B form. It has SPS and PPS with each IDR, no B-frames, and a
SEI unit with a Tag. Deep pictures (16 bit, float) are coded by FFV1 instead, always lossless.
"""

from __future__ import annotations

import dataclasses
from fractions import Fraction
import functools
import os
import secrets
import time
from typing import Any, Optional
import zlib

import av
from av.codec.context import CodecContext
from av.error import FFmpegError
from av.video.codeccontext import VideoCodecContext
from av.video.frame import PictureType, VideoFrame
from av.video.reformatter import ColorRange, Colorspace
import numpy

from image_transport_h264 import annexb
from image_transport_h264.annexb import Tag
from image_transport_h264.deep import DeepDecoder, DeepEncoder, lines, MAGIC, split
from image_transport_h264.picture import (
    BadPicture,
    Buffer,
    check_size,
    CodecError,
    Layout,
    LAYOUTS,
    MAX_PIXELS,
    Picture,
    Pixels,
)
from image_transport_h264.settings import HARDWARE, Settings, SOFTWARE

__all__ = [
    'BadPicture', 'CodecError', 'Damaged', 'Decoder', 'Encoder', 'Missing', 'Packet', 'Picture',
    'Settings', 'peek', 'working_encoders',
]

#: Seconds of the allowed bitrate that one picture may use; limits a keyframe's time on the wire.
BUFFER_SECONDS = 0.05
CLOCK = 90000
#: Pixels from which speed matters more than size: libx264's preset ultrafast, with half-pixel
#: motion, and no filter before chroma is halved. A 1080p picture is then 12 kB in 11 ms;
#: plain ultrafast makes 20 kB in 9 ms, superfast 11 kB in 14 ms (8 kB take 6 ms at 10 Mbit/s).
LARGE = 1500 * 1000
#: Pixels from which several cores share a picture.
MANY_PIXELS = 1000 * 700


class Damaged(CodecError):
    """A packet was damaged on its way; decoding continues with the next keyframe."""


class Missing(CodecError):
    """A packet needs a lost packet; decoding continues with the next keyframe."""


@dataclasses.dataclass(frozen=True)
class Packet:
    """
    One coded picture.

    :param format: 'h264' or 'ffv1'.
    :param data: Annex B form, or the form of FFV1 packets (see ``deep``).
    :param tag: metadata, also part of ``data``.
    """

    format: str
    data: bytes
    tag: Tag


class Encoder:
    """Encode pictures of one topic; size and encoding may change between pictures."""

    def __init__(self, settings: Optional[Settings] = None) -> None:
        #: A change takes effect with the next picture, as a keyframe.
        self.settings = settings or Settings()
        self._codec: Optional[VideoCodecContext] = None
        self._opened: object = None
        self._coding = Coding('', '', False)
        self._deep = DeepEncoder()
        self._stream = secrets.randbits(32)
        self._sequence = 0
        self._pts = -1

    def encode(
        self, picture: Picture, *, key: bool = False, seconds: Optional[float] = None,
    ) -> Packet:
        """
        Encode a picture.

        :param key: make the picture a keyframe.
        :param seconds: time of the picture on any clock that runs forward; None: now.
        :raises BadPicture: the picture's fields contradict each other, or its encoding is unknown.
        :raises CodecError: the encoder failed.
        """
        picture.check()
        layout = picture.layout
        level, plane = _alpha(picture) if layout.alpha else (None, b'')
        tag = Tag(self._stream, self._sequence, False, picture.width, picture.height,
                  picture.encoding, picture.step, picture.is_bigendian,
                  alpha_level=level, alpha_plane=plane)
        if layout.kind == 'deep':
            data = self._deep.encode(picture, tag)
            tag = dataclasses.replace(tag, key=True)
            self._opened = None  # the next H.264 picture cannot refer to the one before this one
        else:
            data, is_key = self._encode(picture, layout, key, seconds)
            tag = dataclasses.replace(tag, key=is_key)
            data = annexb.insert(tag, data)
        self._sequence = (self._sequence + 1) & 0xffffffff
        return Packet('ffv1' if layout.kind == 'deep' else 'h264', data, tag)

    def _encode(
        self, picture: Picture, layout: Layout, key: bool, seconds: Optional[float],
    ) -> tuple[bytes, bool]:
        settings = self.settings
        wanted = (picture.width, picture.height, picture.encoding, settings)
        if self._codec is None or self._opened != wanted:
            self._coding = _coding(layout, settings)
            self._codec = _open(self._coding, picture.width, picture.height, settings)
            self._opened, self._pts = wanted, -1
        frame = _frame(picture, layout, self._coding)
        now = time.monotonic() if seconds is None else seconds
        self._pts = max(self._pts + 1, int(now * CLOCK))
        frame.pts, frame.time_base = self._pts, Fraction(1, CLOCK)
        frame.pict_type = PictureType.I if key else PictureType.NONE
        try:
            packets = self._codec.encode(frame)
        except (FFmpegError, ValueError) as error:
            self._opened = None
            raise CodecError(f'{self._coding.codec}: {error}', 'encoder') from error
        if len(packets) != 1:
            self._opened = None
            raise CodecError(f'{self._coding.codec} gave {len(packets)} packets for a picture',
                             'encoder')
        data = bytes(packets[0])
        return data, annexb.IDR in annexb.kinds(data)


class Decoder:
    """
    Decode packets of one topic, in the order of their arrival.

    :param encoding: encoding of pictures whose packets have no tag, from other encoders.
    :param max_pixels: larger pictures are refused before they take memory.
    """

    def __init__(
        self, *, encoding: str = 'bgr8', max_pixels: int = MAX_PIXELS,
    ) -> None:
        self.encoding = encoding
        self.max_pixels = max_pixels
        self._codec: Optional[VideoCodecContext] = None
        self._deep = DeepDecoder()
        self._last: Optional[Tag] = None
        #: Whether decoding needs a keyframe first.
        self.needs_key = True

    def decode(self, data: Buffer) -> Optional[Picture]:
        """
        Decode a packet; return None for a packet that was decoded before or came too late.

        :raises Missing: the packet needs a lost packet.
        :raises Damaged: the packet was damaged on its way.
        """
        packet = bytes(data)
        try:
            if packet[:len(MAGIC)] == MAGIC:
                return self._decode_deep(packet)
            return self._decode(packet)
        except Damaged:
            self.needs_key = True
            raise

    def _decode_deep(self, packet: bytes) -> Optional[Picture]:
        try:
            tag, extra, coded = split(packet)
            if self._is_old(tag):
                return None
            picture = self._deep.decode(tag, extra, coded, self.max_pixels)
        except CodecError as error:
            raise Damaged(str(error), error.cause) from error
        self._last, self.needs_key, self._codec = tag, False, None
        return picture

    def _decode(self, packet: bytes) -> Optional[Picture]:
        tag, coded = annexb.extract(packet)
        kinds = annexb.kinds(coded)
        if tag is None:
            key = annexb.IDR in kinds
        elif tag.checksum != zlib.crc32(coded):
            raise Damaged('a packet whose checksum is another', 'damage')
        else:
            if self._is_old(tag):
                return None
            key = tag.key
        if not key:
            self._check_order(tag)
        self._check_sizes(coded)
        if key and (self.needs_key or self._codec is None
                    or (tag is not None and not _same_picture(tag, self._last))):
            self._codec = None  # a new codec: no reference to an older stream or another size
        if self._codec is None:
            self._codec = _decoder()
        try:
            frames = self._codec.decode(av.Packet(coded))
        except (FFmpegError, ValueError) as error:
            self._codec = None
            raise Damaged(f'H.264: {error}', 'damage') from error
        if len(frames) != 1 or frames[0].is_corrupt:
            self._codec = None
            raise Damaged(f'{len(frames)} whole pictures in a packet', 'damage')
        picture = self._picture(frames[0], tag)
        self._last, self.needs_key = tag, False
        return picture

    def _check_sizes(self, coded: bytes) -> None:
        try:
            for sps in annexb.parameter_sets(coded):
                # the references, the current frame, and one that waits for its conversion
                check_size(max(1, sps.width - 15), max(1, sps.height - 31), self.max_pixels,
                           sps.sample_bytes * (sps.references + 2))
        except ValueError as error:
            raise Damaged(f'H.264: {error}', getattr(error, 'cause', 'damage')) from error
        if annexb.pictures(coded) > 2:  # the two fields of a frame
            raise Damaged('several pictures in a packet', 'damage')

    def _check_order(self, tag: Optional[Tag]) -> None:
        """
        Check that a packet that is no keyframe follows the last decoded packet.

        :raises Missing: packets are missing before this packet.
        """
        last = self._last
        if tag is None or last is None or self._codec is None:
            # Without tags, only errors of the decoder reveal a loss.
            if self.needs_key or self._codec is None or tag is not last:
                self.needs_key = True
                raise Missing('waiting for a key', 'waiting')
        elif not _follows(tag, last):
            gap = (tag.sequence - last.sequence) & 0xffffffff
            waiting, self.needs_key = self.needs_key, True
            raise Missing(f'{gap - 1} packets missing', 'waiting' if waiting else 'loss')

    def _is_old(self, tag: Tag) -> bool:
        last = self._last
        if last is None or tag.stream != last.stream or self.needs_key and tag.key:
            return False
        return (tag.sequence - last.sequence - 1) & 0xffffffff >= 0x80000000

    def _picture(self, frame: VideoFrame, tag: Optional[Tag]) -> Picture:
        """Convert the decoded frame to the tag's encoding, and crop it to the tag's size."""
        encoding = self.encoding if tag is None else tag.encoding
        layout = LAYOUTS.get(encoding)
        if layout is None or layout.kind == 'deep':
            raise Damaged(f"H.264 of encoding '{encoding}'", 'damage')
        if tag is None:
            width, height = frame.width, frame.height
            step, big = width * layout.pixel_bytes, False
        else:
            width, height, step, big = tag.width, tag.height, tag.step, tag.is_bigendian
            row = width * layout.pixel_bytes
            # The encoder pads by at most one pixel, to make a side even.
            if not (0 <= frame.width - width <= 1 and 0 <= frame.height - height <= 1
                    and 0 < width and row <= step and step * height <= 4 * self.max_pixels):
                self._codec = None
                raise Damaged(f'a picture of {frame.width}x{frame.height}, where its tag says '
                              f'{width}x{height} in rows of {step} bytes', 'damage')
        data = _pixels(frame, layout, width, height, step)
        if tag is not None and layout.alpha:
            _put_alpha(data, tag)
        return Picture(width, height, encoding, step, data.reshape(-1).data, big)


def peek(data: bytes) -> Optional[Tag]:
    """Return the tag of a packet in either format, None if it has no complete tag."""
    if data[:len(MAGIC)] != MAGIC:
        return annexb.extract(data)[0]
    try:
        return split(data)[0]
    except CodecError:
        return None


def _follows(tag: Tag, last: Tag) -> bool:
    return tag.stream == last.stream and tag.sequence == (last.sequence + 1) & 0xffffffff


def _same_picture(tag: Tag, last: Optional[Tag]) -> bool:
    return last is not None and (tag.stream, tag.width, tag.height, tag.encoding) == (
        last.stream, last.width, last.height, last.encoding)


# --- encoder options ----------------------------------------------------------------------------

@dataclasses.dataclass(frozen=True)
class Coding:
    """
    How FFmpeg codes a kind of pictures.

    :param codec: FFmpeg's name of the encoder.
    :param av_format: pixel format of the encoder's input.
    :param full_range: whether luma uses the range 0 to 255; the stream states it.
    """

    codec: str
    av_format: str
    full_range: bool

    @property
    def even(self) -> bool:
        """Whether sides must be even, because half-size chroma cannot be cropped by one pixel."""
        return self.av_format in ('yuv420p', 'nv12', 'yuv422p')


def _coding(layout: Layout, settings: Settings) -> Coding:
    # YUV of a camera keeps its range, which the message does not state.
    full = layout.kind != 'yuv422'
    if settings.lossless:
        codec, av_format = {
            'rgb': ('libx264rgb', 'bgr24' if layout.av_format.startswith('bgr') else 'rgb24'),
            'grey': (SOFTWARE, 'gray'),
            'yuv422': (SOFTWARE, 'yuv422p'),
        }[layout.kind]
        return Coding(codec, av_format, full)
    codec = settings.encoder
    if codec == 'auto':
        codec = working_encoders()[0]
    return Coding(codec, 'nv12' if codec in ('h264_qsv', 'h264_amf') else 'yuv420p', full)


def _open(coding: Coding, width: int, height: int, settings: Settings) -> VideoCodecContext:
    """
    Open FFmpeg's encoder.

    :raises CodecError: the encoder cannot be opened.
    """
    try:
        codec = CodecContext.create(coding.codec, 'w')
        assert isinstance(codec, VideoCodecContext)
        if coding.even:
            width, height = width + width % 2, height + height % 2
        codec.width, codec.height, codec.pix_fmt = width, height, coding.av_format
        codec.time_base = Fraction(1, CLOCK)
        codec.framerate = Fraction(settings.rate).limit_denominator(1000)
        codec.gop_size = settings.gop
        codec.max_b_frames = 0
        if coding.codec != 'libx264rgb':
            codec.colorspace = int(Colorspace.ITU601)
            if coding.full_range:
                codec.color_range = int(ColorRange.JPEG)
        # Slices let several cores decode too, but make packets larger: only for large pictures.
        codec.thread_type = 'SLICE'
        codec.thread_count = min(4, os.cpu_count() or 1) if width * height >= MANY_PIXELS else 1
        codec.options = _options(coding, settings, width * height)
        if coding.codec not in (SOFTWARE, 'libx264rgb'):
            codec.bit_rate = settings.bitrate
        codec.open()
    except (FFmpegError, ValueError) as error:
        raise CodecError(f'{coding.codec} at {width}x{height}: {error}', 'encoder') from error
    return codec


def _options(coding: Coding, settings: Settings, pixels: int) -> dict[str, str]:
    limits = {'maxrate': str(settings.bitrate),
              'bufsize': str(max(1000, int(settings.bitrate * BUFFER_SECONDS)))}
    if coding.codec in (SOFTWARE, 'libx264rgb'):
        options = {'preset': settings.preset, 'tune': 'zerolatency', 'forced-idr': '1'}
        if settings.preset == 'auto' and pixels >= LARGE:
            options |= {'preset': 'ultrafast', 'x264-params': 'subme=1'}
        elif settings.preset == 'auto':
            options['preset'] = 'superfast'
        if settings.lossless:
            return options | {'qp': '0'}
        # Adaptive quantisation takes bits from texture, where viewers miss errors, but robots
        # need texture. Without it, VGA pictures of a room have 1 dB more for 20 % more bytes, and
        # the path of SLAM 10 % less error; a smooth scene has 0.6 dB more for 2 % more bytes.
        options['aq-mode'] = '0'
        return options | limits | {'crf': f'{settings.quality:g}'}
    # Each encoder has its own options for zero latency; FFmpeg skips options that it lacks.
    return limits | {
        'forced-idr': '1', 'forced_idr': '1', 'delay': '0', 'zerolatency': '1', 'tune': 'ull',
        'async_depth': '1', 'low_delay_brc': '1', 'usage': 'ultralowlatency',
        'repeat-headers': '1'}


@functools.lru_cache(maxsize=None)
def working_encoders() -> list[str]:
    """
    Return the encoders that work on this computer, hardware first, libx264 last; probed once.

    An encoder works if each of its first packets decodes at once to nearly the same picture.
    """
    return [*(name for name in HARDWARE if _works(name)), SOFTWARE]


def _works(name: str) -> bool:
    if name not in av.codec.codecs_available:
        return False
    ramp = numpy.linspace(40, 200, 320, dtype=numpy.uint8)
    data = numpy.ascontiguousarray(numpy.broadcast_to(ramp[None, :, None], (240, 320, 3)))
    picture = Picture(320, 240, 'bgr8', 960, data.reshape(-1).data)
    encoder, decoder = Encoder(Settings(encoder=name)), Decoder()
    try:
        for _ in range(3):
            shown = decoder.decode(encoder.encode(picture).data)
    except CodecError:
        return False
    return shown is not None and float(
        numpy.abs(shown.rows().astype(int) - picture.rows()).mean()) < 4


def _decoder() -> VideoCodecContext:
    codec = CodecContext.create('h264', 'r')
    assert isinstance(codec, VideoCodecContext)
    # Frame threads would delay pictures; slice threads do not.
    codec.thread_type, codec.thread_count = 'SLICE', min(4, os.cpu_count() or 1)
    codec.options = {'flags': '+low_delay'}
    return codec


# --- conversion from and to FFmpeg's frames -----------------------------------------------------

#: Older versions of PyAV lack the option and convert in one thread.
_ONE_THREAD: dict[str, Any] = (
    {'threads': 1} if 'threads' in (VideoFrame.reformat.__doc__ or '') else {})


def _reformat(frame: VideoFrame, **options: Any) -> VideoFrame:
    """
    Convert a frame in one thread.

    swscale's slices write a few bytes beyond their last row (9.5, 4:2:2 of some widths). With
    several threads they would overwrite a row that is already converted.
    """
    return frame.reformat(**_ONE_THREAD, **options)


def _padded(rows: Pixels, layout: Layout, even: bool) -> Pixels:
    """Return the rows; repeat the last row and column if the sides must be even."""
    height, row = rows.shape
    width = row // layout.pixel_bytes
    if not even or not (height % 2 or width % 2):
        return rows
    if width % 2:
        # In 4:2:2, the last pixel has only one chroma value; take the other one of its neighbour.
        tail = rows[:, -layout.pixel_bytes:]
        if layout.kind == 'yuv422':
            tail = tail.copy()
            chroma = 0 if layout.av_format == 'uyvy422' else 1
            tail[:, chroma] = rows[:, -4 + chroma] if width > 1 else 128
        rows = numpy.concatenate([rows, tail], axis=1)
    if height % 2:
        rows = numpy.concatenate([rows, rows[-1:]])
    return rows


def _frame(picture: Picture, layout: Layout, coding: Coding) -> VideoFrame:
    """Convert a picture to a frame for the encoder."""
    rows = picture.rows()
    if layout.alpha and coding.codec == 'libx264rgb':
        pixels = numpy.ascontiguousarray(rows).reshape(picture.height, picture.width, 4)
        opaque = pixels[:, :, :3].copy()
        return VideoFrame.from_numpy_buffer(opaque, coding.av_format)
    rows = _padded(rows, layout, coding.even)
    height, width = rows.shape[0], rows.shape[1] // layout.pixel_bytes
    if layout.kind == 'grey':
        frame = VideoFrame(width, height, coding.av_format)
        lines(frame)[:height, :width] = rows
        for plane in range(1, len(frame.planes)):
            lines(frame, plane)[:] = 128
        return frame
    if layout.kind == 'yuv422':
        frame = VideoFrame(width, height, layout.av_format)
        lines(frame)[:height, :rows.shape[1]] = rows
        return _reformat(frame, format=coding.av_format)
    # The frame shares the memory of the message.
    shared = numpy.lib.stride_tricks.as_strided(
        rows, (height, width, layout.pixel_bytes), (rows.strides[0], layout.pixel_bytes, 1),
        writeable=False)
    frame = VideoFrame.from_numpy_buffer(shared, layout.av_format)
    if coding.av_format == layout.av_format:
        return frame
    return _reformat(
        frame, format=coding.av_format, dst_colorspace=Colorspace.ITU601,
        interpolation='POINT' if width * height >= LARGE else 'BILINEAR',
        dst_color_range=ColorRange.JPEG if coding.full_range else ColorRange.MPEG)


def _pixels(
    frame: VideoFrame, layout: Layout, width: int, height: int, step: int,
) -> Pixels:
    """
    Convert a frame to an array (height, step) in the layout.

    The array shares the frame's memory where its rows have ``step`` bytes. Then the only copy of
    the pixels is the one into the message.
    """
    rows, row = _converted(frame, layout, width, height), width * layout.pixel_bytes
    if rows.shape[1] == row == step:
        return rows[:height]
    out = numpy.zeros((height, step), numpy.uint8)
    out[:, :row] = rows[:height, :row]
    return out


def _converted(frame: VideoFrame, layout: Layout, width: int, height: int) -> Pixels:
    """Return a frame's rows in the layout, of the picture's width and height or more."""
    if layout.kind == 'grey' and frame.format.name.startswith(('gray', 'yuv', 'nv')):
        return lines(frame)
    if layout.kind == 'yuv422':
        return lines(_reformat(
            frame, format=layout.av_format, src_color_range=ColorRange.MPEG,
            dst_color_range=ColorRange.MPEG))
    # swscale (9.5, x86) leaves the last 2 or 4 of 16n + 2 or 4 four-byte pixels unwritten.
    narrow = layout.alpha and frame.width % 16 != 0
    av_format = layout.av_format.replace('a', '24') if narrow else layout.av_format
    rows = lines(_reformat(
        frame, format=av_format, src_colorspace=_colorspace(frame),
        dst_colorspace=Colorspace.ITU601))
    if not narrow:
        return rows
    pixels = numpy.full((height, width, 4), 255, numpy.uint8)
    pixels[:, :, :3] = rows[:height, :3 * width].reshape(height, width, 3)
    return pixels.reshape(height, 4 * width)


def _colorspace(frame: VideoFrame) -> int:
    # The default of streams that state none: BT.601 for standard definition, BT.709 for high.
    value = int(frame.colorspace)
    if value in (1, 4, 5, 6, 7, 9):
        return value
    return int(Colorspace.ITU601 if frame.height < 720 else Colorspace.ITU709)


def _alpha(picture: Picture) -> tuple[Optional[int], bytes]:
    """Return the common opacity of all pixels, or the compressed opacities."""
    opacity = picture.rows()[:, 3::4]
    first = int(opacity[0, 0])
    if (opacity == first).all():
        return first, b''
    return None, zlib.compress(opacity.tobytes(), 1)


def _put_alpha(data: Pixels, tag: Tag) -> None:
    target = data[:, 3:tag.width * 4:4]
    if tag.alpha_level is not None:
        target[:] = tag.alpha_level
        return
    inflater = zlib.decompressobj()
    try:
        plane = inflater.decompress(tag.alpha_plane, tag.width * tag.height)
    except zlib.error as error:
        raise Damaged(f'opacity: {error}', 'damage') from error
    if len(plane) != tag.width * tag.height:
        raise Damaged('opacity of another size than the picture', 'damage')
    target[:] = numpy.frombuffer(plane, numpy.uint8).reshape(tag.height, tag.width)
