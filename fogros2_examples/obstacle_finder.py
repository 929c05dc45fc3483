# SPDX-License-Identifier: Apache-2.0
"""Find obstacles in the scans on ``points``, and publish them on ``obstacles``."""

from __future__ import annotations

import array

import numpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2

from fogros2_examples.nodes import run

#: Metres above the ground and from the lidar between which a point is an obstacle.
LOW, HIGH, FAR = 0.3, 2.5, 20.0
#: Height of the lidar in metres.
LIDAR = 1.8


class ObstacleFinder(Node):
    """Publish the points of each scan that are above the ground and near."""

    def __init__(self) -> None:
        super().__init__('obstacle_finder')
        self.publisher = self.create_publisher(PointCloud2, 'obstacles', 2)
        self.seen = 0
        self.create_subscription(PointCloud2, 'points', self.process, qos_profile_sensor_data)

    def process(self, scan: PointCloud2) -> None:
        """Publish a scan's obstacles in one row, with the same header."""
        offsets = {field.name: field.offset for field in scan.fields}
        points = numpy.frombuffer(scan.data, numpy.dtype({
            'names': list('xyz'), 'formats': 3 * ['<f4'],
            'offsets': [offsets[name] for name in 'xyz'], 'itemsize': scan.point_step}))
        height = points['z'] + LIDAR
        # false for NaN
        near = (numpy.hypot(points['x'], points['y']) < FAR) & (height > LOW) & (height < HIGH)
        octets = numpy.frombuffer(scan.data, numpy.uint8).reshape(-1, scan.point_step)[near]
        self.publisher.publish(PointCloud2(
            header=scan.header, height=1, width=len(octets), fields=scan.fields,
            is_bigendian=False, point_step=scan.point_step, row_step=octets.size,
            data=array.array('B', octets.tobytes()), is_dense=True))
        self.seen += 1
        if self.seen % 50 == 1:
            self.get_logger().info(f'{len(octets)} of {len(points)} points are obstacles')


def main() -> None:
    """Run the node until a signal."""
    run('obstacle_finder', ObstacleFinder)
