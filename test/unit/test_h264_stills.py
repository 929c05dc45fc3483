# SPDX-License-Identifier: Apache-2.0
"""JPEG and PNG by value."""

from __future__ import annotations

import numpy
import pytest

pytest.importorskip('av', reason='PyAV (the extra "video") is not installed')
pytest.importorskip('cv2', reason='OpenCV (the extra "video") is not installed')
from image_transport_h264 import stills
from image_transport_h264.codec import Decoder, Encoder
from image_transport_h264.picture import BadPicture, LAYOUTS, Picture


def picture(encoding: str, pad: int = 0, big: bool = False) -> Picture:
    y, x = numpy.mgrid[0:31, 0:45 * LAYOUTS[encoding].pixel_bytes]
    waves = 128 + 60 * numpy.sin((x // LAYOUTS[encoding].pixel_bytes) / 19) * numpy.cos(y / 23)
    rows = numpy.pad(waves.astype(numpy.uint8), ((0, 0), (0, pad)))
    return Picture(45, 31, encoding, rows.shape[1], rows.tobytes(), big)


@pytest.mark.parametrize('encoding', [
    'rgb8', 'bgr8', 'rgba8', 'bgra8', 'mono8', '16UC1', 'mono16'])
@pytest.mark.parametrize('pad', [0, 6])
def test_png_is_exact(encoding: str, pad: int) -> None:
    sent = picture(encoding, pad)
    form, data = stills.encode(sent, 'png')
    assert form.startswith(f'{encoding}; png compressed')
    got = stills.decode(form, data)
    assert (got.width, got.height, got.encoding) == (45, 31, encoding)
    assert (got.rows() == sent.rows()).all()


def test_png_of_big_endian_comes_back_as_the_same_numbers() -> None:
    sent = picture('16UC1', big=True)
    got = stills.decode(*stills.encode(sent, 'png'))
    assert (got.rows().view('<u2') == sent.rows().view('>u2')).all()


@pytest.mark.parametrize('encoding', ['rgb8', 'bgr8', 'rgba8', 'bgra8', 'mono8'])
def test_jpeg_is_near(encoding: str) -> None:
    sent = picture(encoding)
    form, data = stills.encode(sent, 'jpeg', 90)
    assert data.startswith(b'\xff\xd8')
    got = stills.decode(form, data)
    assert got.encoding == encoding
    colours = slice(None) if not LAYOUTS[encoding].alpha else [
        i for i in range(sent.row_bytes) if i % 4 != 3]
    difference = got.rows().astype(int)[:, colours] - sent.rows()[:, colours]
    assert numpy.abs(difference).mean() < 4


@pytest.mark.parametrize('encoding', ['yuv422', 'yuv422_yuy2'])
def test_yuv_comes_back_as_colours(encoding: str) -> None:
    # of 4:2:2 the width is even
    data = bytes([128]) * (44 * 2 * 31)
    got = stills.decode(*stills.encode(Picture(44, 31, encoding, 88, data), 'jpeg'))
    assert got.encoding == 'bgr8'
    assert 125 < got.rows().mean() < 135


@pytest.mark.parametrize(('encoding', 'kind', 'message'), [
    ('16UC1', 'jpeg', "JPEG can't hold 16UC1.* 'h264'.*or 'compressed' with format='png'"),
    ('32FC1', 'jpeg', "JPEG can't hold 32FC1: use the transport 'h264'.* for it$"),
    ('32FC1', 'png', "PNG can't hold 32FC1: use the transport 'h264'.* for it$"),
    ('yuv422', 'jpeg', "yuv422 of an odd width: use the transport 'h264'$"),
    ('uyvy', 'png', "uyvy of an odd width: use the transport 'h264'$"),
    ('bayer_rggb8', 'jpeg', "'bayer_rggb8' isn't one of .* the transport 'raw', which carries"),
    ('rgb16', 'png', "'rgb16' isn't one of .* the transport 'raw', which carries")])
def test_refused_picture_names_what_carries_it(
    encoding: str, kind: stills.Format, message: str,
) -> None:
    sent = picture(encoding) if encoding in LAYOUTS else Picture(4, 4, encoding, 24, bytes(96))
    with pytest.raises(BadPicture, match=message):
        stills.encode(sent, kind)
    if encoding in LAYOUTS:
        assert Decoder().decode(Encoder().encode(sent).data).encoding == encoding
