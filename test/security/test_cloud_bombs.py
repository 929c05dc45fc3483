# SPDX-License-Identifier: Apache-2.0
"""A small point cloud from a hijacked machine takes no more than 300 MB of the robot's memory."""

from __future__ import annotations

from pathlib import Path
import struct
import subprocess
import sys

import numpy
import pytest

pytest.importorskip('zstandard', reason='the extra "point-clouds" is not installed')
from point_cloud_stream import codec
from point_cloud_stream.cloud import Field, Layout, MAX_BYTES
from point_cloud_stream.numbers import Writer

#: Bytes that decoding may take.
LIMIT = 300e6
#: Decodes files, each in a process of its own; prints how many bytes more it held, and what came.
DECODE = """\
import os, resource, sys
from pathlib import Path
from point_cloud_stream.codec import decode
from point_cloud_stream.cloud import CloudError
for name in sys.argv[1:]:
    if os.fork():
        os.wait()
        continue
    data = Path(name).read_bytes()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        said = decode(data)[1].size
    except CloudError as error:
        said = error
    taken = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    print(taken, said, sep=';', flush=True)
    os._exit(0)
"""
FIELDS = tuple(Field(name, 4 * index, 7) for index, name in enumerate('xyz'))


def decode(folder: Path, *clouds: bytes) -> list[tuple[int, str]]:
    """Return bytes of memory that each decoding took, and the size of the cloud or the refusal."""
    paths = [folder / str(number) for number in range(len(clouds))]
    for path, data in zip(paths, clouds):
        path.write_bytes(data)
    done = subprocess.run(
        [sys.executable, '-c', DECODE, *map(str, paths)], capture_output=True, text=True,
        timeout=60, env={'PYTHONPATH': str(Path(__file__).parents[2])})
    lines = [line.split(';') for line in done.stdout.splitlines()]
    assert len(lines) == len(clouds), done.stderr
    return [(int(taken), said) for taken, said in lines]


def smooth(height: int, width: int) -> bytes:
    """Return a coded range image of few bytes."""
    turn = numpy.linspace(-3, 3, width)
    rows = numpy.linspace(-5, 5, height)[:, None]
    points = numpy.stack(numpy.broadcast_arrays(
        50 * numpy.cos(turn), 50 * numpy.sin(turn), rows), -1).astype('<f4')
    return codec.encode(Layout(height, width, FIELDS, 12, 12 * width), points.tobytes(),
                        0.01).data


def test_the_largest_allowed_cloud_stays_below_the_limit(tmp_path: Path) -> None:
    data = smooth(1024, MAX_BYTES // 12 // 1024)
    assert data[4] == codec.LIDAR and len(data) < 10_000
    ((taken, said),) = decode(tmp_path, data)
    assert int(said) > 0.99 * MAX_BYTES and taken < LIMIT, taken


def test_absurd_sizes_are_refused_before_memory_is_taken(tmp_path: Path) -> None:
    clouds = []
    for sizes in ((2 ** 31, 2 ** 31, 12, 2 ** 31), (0, 2 ** 31, 12, 0), (2 ** 31, 0, 12, 0),
                  (1, 1, 2 ** 31, 2 ** 31), (0, 0, 2 ** 31, 0), (2 ** 31, 1, 0, 0),
                  (1, 100, 12, 2 ** 32 - 1)):
        data = bytearray(smooth(8, 64))
        struct.pack_into('<IIII', data, 13, *sizes)
        clouds.append(bytes(data))
    for taken, said in decode(tmp_path, *clouds):
        assert not said.isdecimal() and taken < 20e6, (taken, said)


def zeros(height: int, width: int) -> bytes:
    """Return a range image of points that are all odd, at zero; most columns take no bytes."""
    layout = Layout(height, width, FIELDS, 12, 12 * width)
    out = Writer()
    out.differences(numpy.zeros((layout.points + 7) // 8, numpy.uint8))
    for count in (*3 * (layout.points,), width, height, height, *4 * (0,)):
        out.differences(numpy.zeros(count, '<i4'))
    return codec._HEAD.pack(codec.MAGIC, codec.LIDAR, 0.01) + layout.pack() + out.data()


def test_lines_without_points_are_refused(tmp_path: Path) -> None:
    clouds = [zeros(*shape) for shape in ((1 << 25, 0), (0, 1 << 25), (1 << 25, 1))]
    assert all(len(data) < 10_000 for data in clouds)
    for taken, said in decode(tmp_path, *clouds):
        assert said == 'more points or bytes than allowed' and taken < 20e6, (taken, said)


def test_any_allowed_shape_stays_below_the_limit(tmp_path: Path) -> None:
    most = MAX_BYTES // 12
    shapes = [(most, 1), (1, most), (most, 0), (0, most), (1672, 1672)]
    decoded = decode(tmp_path, *(zeros(*shape) for shape in shapes))
    for (height, width), (taken, said) in zip(shapes, decoded):
        assert int(said) == 12 * height * width and taken < LIMIT, (taken, said)


def test_empty_cloud_is_a_cloud(tmp_path: Path) -> None:
    """Nodes publish a cloud without points when they see nothing."""
    data = codec.encode(Layout(1, 0, FIELDS, 12, 0), b'', 0.01).data
    assert decode(tmp_path, data)[0][1] == '0'
