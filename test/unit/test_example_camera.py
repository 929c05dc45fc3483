# SPDX-License-Identifier: Apache-2.0
"""The frames of the example's camera."""

from __future__ import annotations

from pathlib import Path

import numpy
import pytest

pytest.importorskip('cv2', reason='OpenCV is in the extra video')

import cv2

from fogros2_examples.camera import captured


def test_wide_video_keeps_its_proportions(tmp_path: Path) -> None:
    path = tmp_path / 'wide.avi'
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*'MJPG'), 30.0, (160, 90))
    assert writer.isOpened()
    writer.write(numpy.full((90, 160, 3), 255, numpy.uint8))
    writer.release()
    frame = next(captured(str(path), 64, 48))
    assert frame.shape == (48, 64, 3)
    assert frame[:6].max() == frame[42:].max() == 0
    assert frame[6:42].min() > 200
