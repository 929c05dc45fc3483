# SPDX-License-Identifier: Apache-2.0
"""Describe the settings of the H.264 encoder; without FFmpeg."""

from __future__ import annotations

import dataclasses

SOFTWARE = 'libx264'
#: Order of preference. VAAPI is missing, because it takes frames in the memory of the device.
HARDWARE = ('h264_nvenc', 'h264_qsv', 'h264_amf', 'h264_v4l2m2m')
ENCODERS = ('auto', SOFTWARE, *HARDWARE)
PRESETS = ('auto', 'ultrafast', 'superfast', 'veryfast', 'faster', 'fast', 'medium', 'slow',
           'slower', 'veryslow')
#: Least and largest bits per second, constant rate factor, and limit of pictures per second.
BITRATE, QUALITY, MAX_RATE = (10_000, 1_000_000_000), (0, 51), (0, 1000)


@dataclasses.dataclass(frozen=True)
class Settings:
    """
    Settings of an encoder.

    :param bitrate: maximum bits per second.
    :param quality: libx264's constant rate factor, 0 to 51, lower is better; applies while
        ``bitrate`` allows it.
    :param preset: libx264's preset: ultrafast, superfast, ...; slower presets make smaller
        packets of the same quality. 'auto': superfast, and a faster one for large pictures.
    :param gop: maximum distance of two keyframes, in pictures.
    :param rate: expected pictures per second, for the first guess of the rate control.
    :param encoder: 'auto' (a hardware encoder that works here, else libx264), or FFmpeg's name.
    :param lossless: preserve all pixels exactly, at any size.
    """

    bitrate: int = 8_000_000
    quality: float = 25.0
    preset: str = 'auto'
    gop: int = 300
    rate: float = 30.0
    encoder: str = SOFTWARE
    lossless: bool = False

    def __post_init__(self) -> None:
        if not BITRATE[0] <= self.bitrate <= BITRATE[1]:
            raise ValueError(f'bitrate {self.bitrate} is not between 10 kbit/s and 1 Gbit/s')
        if not QUALITY[0] <= self.quality <= QUALITY[1]:
            raise ValueError(f'quality {self.quality} is not between 0 and 51')
        if self.preset not in PRESETS:
            raise ValueError(f"preset '{self.preset}' is not one of {', '.join(PRESETS)}")
        if self.gop < 1:
            raise ValueError(f'gop {self.gop} is less than 1')
        if not 0 < self.rate <= 1000:
            raise ValueError(f'rate {self.rate} is not between 0 and 1000')
        if self.encoder not in ENCODERS:
            raise ValueError(f"encoder '{self.encoder}' is not one of {', '.join(ENCODERS)}")
