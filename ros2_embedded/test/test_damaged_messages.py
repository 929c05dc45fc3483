# SPDX-License-Identifier: Apache-2.0
"""Bytes from the wire that are no messages: an error that is logged, and the node goes on."""

import importlib.metadata
import struct

import pytest

pytest.importorskip('hypothesis', reason='hypothesis is not installed')
try:
    importlib.metadata.version('ros2-embedded')
except importlib.metadata.PackageNotFoundError:
    # its readers allocate what a damaged length asks for, so that it may end for such bytes
    pytest.skip('this is ROS 2 itself', allow_module_level=True)

from example_interfaces.srv import AddTwoInts
from hypothesis import given, HealthCheck, settings, strategies
from nav_msgs.msg import Path
import rclpy
from rclpy.context import Context
from rclpy.exceptions import RCLError
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, Image, JointState, PointCloud2
from std_msgs.msg import String, UInt8MultiArray
from tf2_msgs.msg import TFMessage

TYPES = [CameraInfo, Image, JointState, Path, PointCloud2, String, TFMessage, UInt8MultiArray,
         AddTwoInts.Request]
quick = settings(max_examples=300, deadline=None, derandomize=True, database=None,
                 suppress_health_check=list(HealthCheck))


@quick
@given(strategies.sampled_from(TYPES), strategies.binary(max_size=200))
def test_any_bytes_are_a_message_or_an_error(kind, data):
    try:
        message = deserialize_message(b'\0\1\0\0' + data, kind)
    except RCLError:
        return
    assert isinstance(message, kind)
    assert deserialize_message(serialize_message(message), kind) is not None


@quick
@given(strategies.binary(max_size=8))
def test_other_encoding_than_little_endian_cdr_is_an_error(head):
    if head[:2] != b'\0\1':
        with pytest.raises(RCLError):
            deserialize_message(head + bytes(64), String)


def test_length_beyond_the_message_is_an_error():
    for count in (2 ** 32 - 1, 2 ** 31, 17):
        for kind in (String, UInt8MultiArray, TFMessage, JointState):
            with pytest.raises(RCLError):
                deserialize_message(b'\0\1\0\0' + struct.pack('<4I', *[count] * 4), kind)


@pytest.fixture(scope='module')
def node():
    context = Context()
    context.init(args=[])
    made = rclpy.create_node('hardy', context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(made)
    made.spin = lambda: executor.spin_once(timeout_sec=0.01)
    yield made
    made.destroy_node()
    executor.shutdown()
    context.try_shutdown()


def test_node_drops_a_damaged_message(node, capfd):
    got = []
    node.create_subscription(Path, 'noise', got.append, 100)
    publisher = node.create_publisher(Path, 'noise', 100)
    while not publisher.get_subscription_count():
        node.spin()

    @settings(quick, max_examples=60)
    @given(strategies.binary(min_size=1, max_size=64))
    def send(data):
        publisher.publish(b'\0\1\0\0' + data)
        node.spin()

    send()
    good = Path()
    good.header.frame_id = 'whole'
    publisher.publish(good)
    while not any(message.header.frame_id == 'whole' for message in got):
        node.spin()
    assert "Dropped a message on topic 'noise'" in capfd.readouterr().err


def test_server_drops_a_damaged_request(node, capfd):
    from rclpy._dds import Policies, Writer

    def add(request, response):
        response.sum = request.a + request.b
        return response

    service = node.create_service(AddTwoInts, 'hardy_add', add)
    client = node.create_client(AddTwoInts, 'hardy_add')
    stranger = Writer(node._graph.participant, 'rq/hardy_addRequest',
                      'example_interfaces::srv::dds_::AddTwoInts_Request_', Policies(depth=10))
    try:
        while not stranger.matched() or not client.service_is_ready():
            node.spin()
        for size in (1, 8, 20, 31):
            stranger.write(bytearray(b'\0\1\0\0' + bytes(size)))
            node.spin()
        future = client.call_async(AddTwoInts.Request(a=40, b=2))
        while not future.done():
            node.spin()
    finally:
        stranger.close()
    assert future.result().sum == 42
    assert "Dropped a request to service 'hardy_add'" in capfd.readouterr().err
    node.destroy_client(client)
    node.destroy_service(service)
