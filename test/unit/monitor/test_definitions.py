# SPDX-License-Identifier: Apache-2.0
"""Message definitions for viewers, against the types that a message class tells."""

from __future__ import annotations

import pytest

from fogros2_monitor.definitions import definition


@pytest.mark.parametrize(('name', 'line'), [
    ('std_msgs/msg/Bool', 'bool data'),
    ('std_msgs/msg/Byte', 'byte data'),
    ('std_msgs/msg/String', 'string data'),
    ('std_msgs/msg/Float32', 'float32 data'),
    ('sensor_msgs/msg/Image', 'uint8[] data'),
    ('sensor_msgs/msg/PointCloud2', 'sensor_msgs/PointField[] fields'),
    ('shape_msgs/msg/SolidPrimitive', 'float64[<=3] dimensions'),
    ('geometry_msgs/msg/PoseWithCovariance', 'float64[36] covariance'),
])
def test_types_of_fields_are_those_of_message_files(name, line):
    assert line in definition(name).splitlines()
