# SPDX-License-Identifier: Apache-2.0
"""Publish scans of a synthetic city on ``points``, 10 times a second."""

from __future__ import annotations

import array
from typing import Any, cast

import numpy
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2, PointField

from fogros2_examples.city import City, TURN
from fogros2_examples.nodes import run

#: Scans that are computed at the start, and published forwards and backwards in turn.
SCANS = 5
_KINDS = {'<f4': PointField.FLOAT32, '<u2': PointField.UINT16}


def message(scan: NDArray[Any]) -> PointCloud2:
    """Return a structured array (rows, columns) as a message."""
    fields = []
    for name in scan.dtype.names or ():
        kind, offset = cast(Any, scan.dtype.fields)[name][:2]
        fields.append(PointField(name=name, offset=offset, datatype=_KINDS[kind.str], count=1))
    step = scan.dtype.itemsize
    rows, columns = scan.shape
    return PointCloud2(
        height=rows, width=columns, fields=fields, is_bigendian=False, point_step=step,
        row_step=step * columns, data=array.array('B', scan.tobytes()),
        is_dense=not bool(numpy.isnan(scan['x']).any()))


class Lidar(Node):
    """Drive along a street; parameter ``count`` is the number of scans, 0 for no end."""

    def __init__(self) -> None:
        super().__init__('lidar')
        self.count = int(self.declare_parameter('count', 0).value)
        city = City(32, 512)
        scans = [message(city.scan(number)) for number in range(SCANS)]
        self.scans = [*scans, *scans[-2:0:-1]]
        self.sent = 0
        self.publisher = self.create_publisher(PointCloud2, 'points', 2)
        self.create_timer(TURN, self.publish)

    def publish(self) -> None:
        """Publish the next scan."""
        scan = self.scans[self.sent % len(self.scans)]
        scan.header.stamp = self.get_clock().now().to_msg()
        scan.header.frame_id = 'lidar'
        self.publisher.publish(scan)
        self.sent += 1
        if self.sent == self.count:
            raise SystemExit


def main() -> None:
    """Run the node until its last scan or a signal."""
    run('lidar', Lidar)
