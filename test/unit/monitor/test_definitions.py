# SPDX-License-Identifier: Apache-2.0
"""Message definitions for viewers, against the types that a message class tells."""

from __future__ import annotations

import pytest

from fogros2 import ros_types
from fogros2_monitor.definitions import definition

RULE = '=' * 80


def test_definition_has_fields_and_nested_messages():
    pytest.importorskip('sensor_msgs.msg')
    assert definition('sensor_msgs/msg/Imu').split(RULE)[0] == (
        'std_msgs/Header header\n'
        'geometry_msgs/Quaternion orientation\n'
        'float64[9] orientation_covariance\n'
        'geometry_msgs/Vector3 angular_velocity\n'
        'float64[9] angular_velocity_covariance\n'
        'geometry_msgs/Vector3 linear_acceleration\n'
        'float64[9] linear_acceleration_covariance\n')
    parts = definition('sensor_msgs/msg/Imu').split(f'{RULE}\n')[1:]
    assert [part.splitlines()[0] for part in parts] == [
        'MSG: std_msgs/Header', 'MSG: geometry_msgs/Quaternion', 'MSG: geometry_msgs/Vector3',
        'MSG: builtin_interfaces/Time']


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


def test_definition_of_a_service_has_its_request_and_response():
    srv = pytest.importorskip('nav_msgs.srv')
    kind = 'nav_msgs/srv/LoadMap'
    assert definition(f'{kind}_Request', srv.LoadMap.Request) == 'string map_url\n'
    first, *parts = definition(f'{kind}_Response', srv.LoadMap.Response).split(f'{RULE}\n')
    assert first == 'nav_msgs/OccupancyGrid map\nuint8 result\n'
    assert parts[0].splitlines()[0] == 'MSG: nav_msgs/OccupancyGrid'
    trigger = pytest.importorskip('std_srvs.srv').Trigger
    assert definition('std_srvs/srv/Trigger_Request', trigger.Request) == ''


@pytest.mark.parametrize('name', [
    'std_msgs/msg/Nothing', 'no_such_msgs/msg/String', 'std_msgs/srv/String', 'String',
    'std_msgs/msg/a/b'])
def test_missing_message_is_named(name):
    with pytest.raises(LookupError, match=name):
        ros_types.message(name)
