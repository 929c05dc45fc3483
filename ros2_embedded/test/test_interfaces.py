# SPDX-License-Identifier: Apache-2.0
"""Messages and services as classes and as bytes."""

import array
import copy
import pickle
import random

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from example_interfaces.msg import WString
from example_interfaces.srv import AddTwoInts
from geometry_msgs.msg import Polygon, PoseStamped, Quaternion
import numpy
import pytest
from rcl_interfaces.msg import Log, ParameterDescriptor, ParameterValue
from rcl_interfaces.srv import ListParameters
from rclpy.serialization import deserialize_message, serialize_message
from rosidl_runtime_py import (
    message_to_ordereddict,
    message_to_yaml,
    set_message_fields,
)
from rosidl_runtime_py.utilities import get_message, get_service
from sensor_msgs.msg import CameraInfo, Image, NavSatStatus, PointCloud2
from std_msgs.msg import (
    Bool,
    ByteMultiArray,
    Empty,
    Float64,
    Header,
    Int8,
    String,
    UInt8MultiArray,
)
from std_srvs.srv import Empty as EmptyService
from std_srvs.srv import SetBool, Trigger

PACKAGES = {
    'action_msgs': 'msg/GoalInfo', 'builtin_interfaces': 'msg/Duration',
    'composition_interfaces': 'srv/LoadNode', 'diagnostic_msgs': 'msg/DiagnosticArray',
    'example_interfaces': 'msg/WString', 'geometry_msgs': 'msg/TwistStamped',
    'lifecycle_msgs': 'srv/ChangeState', 'nav_msgs': 'msg/Odometry',
    'rcl_interfaces': 'srv/SetParameters', 'rosgraph_msgs': 'msg/Clock',
    'sensor_msgs': 'srv/SetCameraInfo', 'service_msgs': 'msg/ServiceEventInfo',
    'shape_msgs': 'msg/Mesh', 'statistics_msgs': 'msg/MetricsMessage', 'std_msgs': 'msg/ColorRGBA',
    'std_srvs': 'srv/SetBool', 'stereo_msgs': 'msg/DisparityImage',
    'trajectory_msgs': 'msg/JointTrajectory', 'unique_identifier_msgs': 'msg/UUID',
    'type_description_interfaces': 'srv/GetTypeDescription',
    'visualization_msgs': 'msg/MarkerArray'}


@pytest.mark.parametrize('package', PACKAGES)
def test_each_interface_package_can_be_used(package):
    name = f'{package}/{PACKAGES[package]}'
    if '/srv/' in name:
        kind = get_service(name)
        assert kind.Request() == kind.Request()
        assert kind.Response() == kind.Response()
    else:
        message = get_message(name)()
        assert deserialize_message(serialize_message(message), type(message)) == message


def test_unknown_interface_is_refused():
    with pytest.raises(ImportError):
        from std_msgs.msg import Strong  # noqa: F401
    with pytest.raises(AttributeError):
        get_message('std_msgs/msg/Strong')
    with pytest.raises(ModuleNotFoundError):
        get_message('no_such_msgs/msg/String')
    with pytest.raises(ValueError):
        get_message('std_srvs/srv/Trigger')
    with pytest.raises(ValueError):
        get_service('std_msgs/msg/String')


def test_new_message_has_default_values():
    assert String().data == ''
    assert Quaternion().w == 1.0 and Quaternion().x == 0.0
    assert Quaternion.W__DEFAULT == 1.0
    assert NavSatStatus().status == NavSatStatus.STATUS_UNKNOWN == -2
    assert ParameterDescriptor().read_only is False
    assert ListParameters.Request.DEPTH_RECURSIVE == 0
    assert Log.WARN == 30 and Log().WARN == 30
    pose = PoseStamped()
    assert pose.header.stamp == Time() and pose.pose.orientation.w == 1.0
    assert PoseStamped().header is not pose.header


def test_constant_has_the_type_of_its_field():
    assert DiagnosticStatus.STALE == b'\x03'
    assert DiagnosticStatus(level=DiagnosticStatus.WARN).level == b'\x01'
    assert NavSatStatus.STATUS_NO_FIX == -1


def test_constructor_takes_fields_as_keywords():
    stamp = Time(sec=3, nanosec=5)
    header = Header(stamp=stamp, frame_id='map')
    assert header.stamp.nanosec == 5 and header.frame_id == 'map'
    with pytest.raises(AssertionError, match='Invalid arguments passed to constructor: datum'):
        String(datum='x')


@pytest.mark.parametrize('make, text', [
    (lambda: String(data=3), "The 'data' field must be of type 'str'"),
    (lambda: Bool(data=1), "The 'data' field must be of type 'bool'"),
    (lambda: Float64(data=1), "The 'data' field must be of type 'float'"),
    (lambda: Int8(data=128), r"The 'data' field must be an integer in \[-128, 127\]"),
    (lambda: Int8(data=1.0), "The 'data' field must be of type 'int'"),
    (lambda: Time(nanosec=-1), r'must be an unsigned integer in \[0, 4294967295\]'),
    (lambda: Header(stamp=3), "The 'stamp' field must be a sub message of type 'Time'"),
    (lambda: ParameterValue(string_array_value=[1]),
     "The 'string_array_value' field must be a set or sequence and each value of type 'str'"),
    (lambda: ParameterValue(string_array_value='ab'), 'must be a set or sequence'),
    (lambda: ParameterDescriptor(integer_range=[3]), 'with length <= 1'),
])
def test_wrong_field_type_is_refused_with_the_text_of_ros2(make, text):
    with pytest.raises(AssertionError, match=text):
        make()


def test_number_sequence_is_an_array():
    image = Image(data=[1, 2, 255])
    assert isinstance(image.data, array.array) and image.data.typecode == 'B'
    image.data = bytes([7, 8])
    assert image.data == array.array('B', [7, 8])
    image.data = array.array('B', [9])
    assert image.data.tolist() == [9]
    with pytest.raises(AssertionError):
        image.data = array.array('b', [1])
    with pytest.raises((AssertionError, OverflowError)):
        image.data = [256]
    info = CameraInfo()
    assert isinstance(info.k, numpy.ndarray) and info.k.dtype == numpy.float64
    info.k = [float(number) for number in range(9)]
    assert info.k.tolist() == list(range(9))
    with pytest.raises(AssertionError, match='with length 9'):
        info.k = [1.0]
    assert isinstance(info.d, array.array) and info.d.typecode == 'd'
    assert Polygon().points == []


def test_message_lists_its_field_types():
    assert String.get_fields_and_field_types() == {'data': 'string'}
    assert CameraInfo.get_fields_and_field_types()['k'] == 'double[9]'
    assert Image.get_fields_and_field_types()['data'] == 'sequence<uint8>'
    assert Header.get_fields_and_field_types()['stamp'] == 'builtin_interfaces/Time'
    assert ParameterDescriptor.get_fields_and_field_types()['integer_range'] == \
        'sequence<rcl_interfaces/IntegerRange, 1>'
    assert Bool.get_fields_and_field_types() == {'data': 'boolean'}
    assert '_data' in String.__slots__


def test_messages_compare_print_copy_and_pickle():
    one = Header(frame_id='map')
    assert one == Header(frame_id='map') and one != Header() and one != 'map'
    assert repr(String(data='x')) == "std_msgs.msg.String(data='x')"
    assert repr(UInt8MultiArray(data=[1]))[-10:] == ' data=[1])'
    assert 'stamp=builtin_interfaces.msg.Time(sec=0, nanosec=0)' in repr(one)
    other = copy.deepcopy(one)
    other.frame_id = 'odom'
    assert one.frame_id == 'map'
    assert pickle.loads(pickle.dumps(String(data='x'))) == String(data='x')  # noqa: S301


def test_service_has_request_and_response_classes():
    assert AddTwoInts.Request(a=1, b=2).b == 2
    assert AddTwoInts.Response().sum == 0
    assert Trigger.Response(success=True).success and SetBool.Request().data is False
    assert EmptyService.Request() == EmptyService.Request()
    assert repr(AddTwoInts.Request(a=1)) == 'example_interfaces.srv.AddTwoInts_Request(a=1, b=0)'
    with pytest.raises(NotImplementedError):
        AddTwoInts()


@pytest.mark.parametrize('message, data', [
    (String(data='abc'), '00010000 04000000 61626300'),
    (Empty(), '00010000 00'),
    (Time(sec=1, nanosec=2), '00010000 01000000 02000000'),
    (Float64(data=1.0), '00010000 000000000000f03f'),
    (Header(frame_id='m'), '00010000 00000000 00000000 02000000 6d00'),
    (ByteMultiArray(data=[b'\x01', b'\xff']),
     '00010000 00000000 00000000 02000000 01ff'),
])
def test_message_is_serialized_as_cdr(message, data):
    expected = bytes.fromhex(data.replace(' ', ''))
    written = serialize_message(message)
    assert written[:len(expected)] == expected
    assert len(written) - len(expected) < 4 and not any(written[len(expected):])
    assert deserialize_message(written, type(message)) == message


def test_fields_are_aligned_after_strings_and_sequences():
    cloud = PointCloud2(header=Header(frame_id='four'), height=1, width=2, data=[1, 2, 3],
                        is_dense=True)
    values = ParameterValue(string_value='abc', integer_array_value=[-1, 2 ** 40],
                            double_array_value=[0.5], bool_array_value=[True, False],
                            string_array_value=['', 'xy'], byte_array_value=[b'\x05'])
    for message in (cloud, values):
        assert deserialize_message(serialize_message(message), type(message)) == message


def test_wide_string_is_serialized_as_utf16():
    for text, written in (('', '00000000'), ('a', '0100000061000000'),
                          ('€𝄞', '03000000ac20000034d800001edd0000')):
        data = serialize_message(WString(data=text))
        assert data.hex() == '00010000' + written and \
            deserialize_message(data, WString).data == text


def test_damaged_bytes_raise_an_error():
    numbers = random.Random(7)
    whole = serialize_message(PointCloud2(header=Header(frame_id='map'), data=[1] * 20))
    for _ in range(300):
        data = bytearray(whole)
        for _ in range(3):
            data[numbers.randrange(4, len(data))] = numbers.randrange(256)
        try:
            deserialize_message(bytes(data[:numbers.randrange(8, len(data))]), PointCloud2)
        except Exception as error:  # noqa: BLE001 - which one is not ROS's promise
            assert not isinstance(error, (MemoryError, SystemError))


def test_message_is_converted_to_yaml_and_dictionary():
    header = Header(stamp=Time(sec=1, nanosec=2), frame_id='map')
    assert message_to_yaml(header) == 'stamp:\n  sec: 1\n  nanosec: 2\nframe_id: map\n'
    assert list(message_to_ordereddict(header)) == ['stamp', 'frame_id']
    numbers = UInt8MultiArray(data=range(9))
    assert message_to_ordereddict(numbers, truncate_length=2)['data'] == [0, 1, '...']
    assert message_to_ordereddict(numbers, no_arr=True)['data'] == \
        '<sequence type: uint8, length: 9>'
    assert message_to_ordereddict(header, no_str=True)['frame_id'] == '<string length: <3>>'


def test_message_fields_are_set_from_a_dictionary():
    pose = PoseStamped()
    set_message_fields(pose, {'header': {'stamp': {'sec': 9}}, 'pose': {'position': {'x': 1.5}}})
    assert pose.header.stamp.sec == 9 and pose.pose.position.x == 1.5
    with pytest.raises(AttributeError):
        set_message_fields(pose, {'posture': 1})
    with pytest.raises(TypeError):
        set_message_fields(pose, {'pose': {'position': [1]}})
