# SPDX-License-Identifier: Apache-2.0
"""
The embedded default and ROS 2 on one wire, where both are installed.

These run on the embedded default and start ROS 2's own programs beside it. ROS2_SETUP names the
set-up script of a ROS 2 Jazzy that isn't in its usual place.
"""

import contextlib
import importlib.metadata
import os
from pathlib import Path
import subprocess
import sys
import time

from example_interfaces.srv import AddTwoInts
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import String

from rigs.domains import taken

SETUP = Path(os.environ.get('ROS2_SETUP', '/opt/ros/jazzy/setup.sh'))
LIMIT = 20.0  # seconds until something that should happen hasn't


def embedded():
    try:
        return importlib.metadata.version('ros2-embedded')
    except importlib.metadata.PackageNotFoundError:
        return None


pytestmark = [
    pytest.mark.skipif(not SETUP.is_file(), reason='ROS 2 Jazzy is not installed'),
    pytest.mark.skipif(not embedded() or 'ROS_DISTRO' in os.environ and os.path.exists(
        '/opt/ros/jazzy') and '/opt/ros/jazzy' in os.environ.get('PYTHONPATH', ''),
        reason='this is ROS 2 itself')]

PEER = '''
import rclpy
from example_interfaces.action import Fibonacci
from example_interfaces.srv import AddTwoInts
from rclpy.action import ActionServer
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node('peer', namespace='/real')
node.declare_parameter('gain', 2.0)
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
node.create_publisher(String, 'latched', latched).publish(String(data='from ROS 2'))
back = node.create_publisher(String, 'back', 10)
node.create_subscription(String, 'there', back.publish, 10)
image = node.create_publisher(Image, 'image_back', 10)
node.create_subscription(Image, 'image_there', image.publish, 10)
def add(request, response):
    response.sum = request.a + request.b
    return response
node.create_service(AddTwoInts, 'add', add)
action = ActionServer(node, Fibonacci, 'count', lambda goal: Fibonacci.Result())
node.get_logger().info('ready')
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
'''


def ros2(*command, **kwargs):
    """Start a program in ROS 2's environment."""
    keep = ('CYCLONEDDS_URI', 'ROS_DOMAIN_ID', 'ROS_AUTOMATIC_DISCOVERY_RANGE',
            'ROS_STATIC_PEERS', 'HOME', 'LANG')
    environment = {name: os.environ[name] for name in keep if name in os.environ}
    environment.update(PATH='/usr/local/bin:/usr/bin:/bin', PYTHONUNBUFFERED='1')
    script = f'. "{SETUP}" && export RMW_IMPLEMENTATION=rmw_cyclonedds_cpp && exec "$@"'
    return subprocess.Popen(['sh', '-c', script, 'sh', *command], env=environment, text=True,
                            cwd='/', stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **kwargs)


def output(*command):
    with ros2(*command) as process:
        try:
            return process.communicate(timeout=60)[0]
        finally:
            process.kill()


@contextlib.contextmanager
def running_peer():
    """Run a node of ROS 2, and end it whatever happens; give what it has written so far."""
    with ros2('python3', '-c', PEER) as process:
        try:
            lines = [process.stdout.readline()]
            assert 'ready' in lines[0]
            yield lines
            process.terminate()
            lines += process.communicate(timeout=20)[0].splitlines()
        finally:
            process.kill()


@pytest.fixture(scope='module')
def peer():
    with running_peer() as lines:
        yield lines
    assert [line for line in lines if '[WARN]' in line or '[ERROR]' in line] == []


class Side:
    """The embedded side."""

    def __init__(self):
        self.context = Context()
        self.context.init(args=[])
        self.node = rclpy.create_node('ours', namespace='/embedded', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def until(self, condition):
        end = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < end, 'it did not happen'
            self.executor.spin_once(timeout_sec=0.05)


@pytest.fixture
def side(peer):
    made = Side()
    yield made
    made.node.destroy_node()
    made.executor.shutdown()
    made.context.try_shutdown()


def test_ros2_node_returns_a_message(side):
    got = []
    publisher = side.node.create_publisher(String, '/real/there', 10)
    side.node.create_subscription(String, '/real/back', got.append, 10)
    side.until(lambda: publisher.get_subscription_count() == 1
               and side.node.count_publishers('/real/back') == 1)
    side.until(lambda: got or publisher.publish(String(data='grüße')))
    assert got[0].data == 'grüße'


def test_ros2_node_returns_a_large_message(side):
    got, image = [], Image(height=720, width=1280, encoding='bgr8', step=3840)
    image.data = bytes(range(256)) * 10800
    publisher = side.node.create_publisher(Image, '/real/image_there', 10)
    side.node.create_subscription(Image, '/real/image_back', got.append, 10)
    side.until(lambda: publisher.get_subscription_count() == 1
               and side.node.count_publishers('/real/image_back') == 1)
    publisher.publish(image)
    side.until(lambda: got)
    assert got[0] == image


def test_latched_message_of_ros2_is_received_late(side):
    got = []
    side.node.create_subscription(String, '/real/latched', got.append, QoSProfile(
        depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    side.until(lambda: got)
    assert got[0].data == 'from ROS 2'


def test_service_of_ros2_answers(side):
    client = side.node.create_client(AddTwoInts, '/real/add')
    assert client.wait_for_service(timeout_sec=LIMIT)
    futures = [client.call_async(AddTwoInts.Request(a=number, b=2)) for number in range(8)]
    side.until(lambda: all(future.done() for future in futures))
    assert [future.result().sum for future in futures] == list(range(2, 10))


def test_parameter_of_a_ros2_node_is_set(side):
    client = AsyncParameterClient(side.node, '/real/peer')
    assert client.wait_for_services(timeout_sec=LIMIT)
    from rclpy.parameter import Parameter
    future = client.set_parameters([Parameter('gain', value=4.5)])
    side.until(future.done)
    assert future.result().results[0].successful


def test_ros2_node_is_in_our_graph(side):
    side.until(lambda: ('peer', '/real') in side.node.get_node_names_and_namespaces())
    side.until(lambda: ('/real/add', ['example_interfaces/srv/AddTwoInts'])
               in side.node.get_service_names_and_types_by_node('peer', '/real'))
    info = side.node.get_publishers_info_by_topic('/real/back')[0]
    ours = side.node.get_publishers_info_by_topic('/rosout')
    assert (info.node_name, info.topic_type) == ('peer', 'std_msgs/msg/String')
    assert {one.node_name for one in ours} >= {'peer', 'ours'}
    assert len({str(one.topic_type_hash) for one in ours}) == 1


def test_commands_of_ros2_see_our_node(side):
    side.node.declare_parameter('speed', 1.5)
    side.node.create_publisher(String, 'chatter', 3)

    def add(request, response):
        response.sum = request.a + request.b
        return response

    side.node.create_service(AddTwoInts, 'add', add)
    import threading
    thread = threading.Thread(target=side.executor.spin, daemon=True)
    thread.start()
    try:
        assert '/embedded/ours' in output('ros2', 'node', 'list', '--no-daemon')
        info = output('ros2', 'node', 'info', '--no-daemon', '/embedded/ours')
        assert '/embedded/chatter: std_msgs/msg/String' in info
        assert '/embedded/add: example_interfaces/srv/AddTwoInts' in info
        topic = output('ros2', 'topic', 'info', '-v', '--no-daemon', '/embedded/chatter')
        assert 'Node name: ours' in topic and 'RIHS01_df668c74' in topic
        assert 'History (Depth): KEEP_LAST (3)' in topic
        topics = output('ros2', 'topic', 'list', '--no-daemon')
        assert '/embedded/chatter' in topics.splitlines()
        values = output('ros2', 'param', 'get', '--no-daemon', '/embedded/ours', 'speed')
        assert 'Double value is: 1.5' in values
        called = output('ros2', 'service', 'call', '/embedded/add',
                        'example_interfaces/srv/AddTwoInts', '{a: 3, b: 4}')
        assert 'sum=7' in called
        for text in (info, topic, topics, values, called):
            assert 'WARN' not in text and 'Failed' not in text
    finally:
        side.executor.shutdown()
        thread.join(LIMIT)


def test_our_commands_see_a_ros2_node(peer):
    command = str(Path(sys.executable).with_name('ros2'))
    for words, expected in ((('node', 'list'), '/real/peer'), (('topic', 'list'), '/real/there'),
                            (('service', 'list'), '/real/add'),
                            (('node', 'info', '/real/peer'),
                             '    /real/count: example_interfaces/action/Fibonacci'),
                            (('param', 'get', '/real/peer', 'gain'), 'Double value is: ')):
        done = subprocess.run([command, *words], capture_output=True, text=True, timeout=60)
        assert done.returncode == 0 and done.stderr == ''
        assert any(line.startswith(expected) for line in done.stdout.splitlines()), done.stdout


@pytest.fixture
def domain():
    with taken() as domain:
        yield domain


@pytest.mark.parametrize('peers', ['', '127.0.0.2'])
def test_nodes_discover_each_other_on_one_computer(monkeypatch, domain, peers):
    """The older one to be there is ours, then ROS 2's: each has to answer a newcomer."""
    monkeypatch.delenv('CYCLONEDDS_URI')
    monkeypatch.setenv('ROS_DOMAIN_ID', domain)
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setenv('ROS_STATIC_PEERS', peers)
    context = Context()
    context.init(args=[])
    node = rclpy.create_node('first', context=context)
    try:
        with running_peer():
            assert '/first' in output('ros2', 'node', 'list', '--no-daemon').splitlines()
            end = time.monotonic() + LIMIT
            while ('peer', '/real') not in node.get_node_names_and_namespaces():
                assert time.monotonic() < end, 'ROS 2 was not seen'
                time.sleep(0.05)
            late = subprocess.run([str(Path(sys.executable).with_name('ros2')), 'node', 'list'],
                                  capture_output=True, text=True, timeout=60)
            assert sorted(late.stdout.splitlines()) == ['/first', '/real/peer']
    finally:
        node.destroy_node()
        context.try_shutdown()


def test_neither_side_logs_a_warning(side, capfd):
    publisher = side.node.create_publisher(String, '/real/there', 10)
    side.node.create_subscription(String, '/real/back', lambda _: None, 10)
    side.until(lambda: publisher.get_subscription_count() == 1)
    publisher.publish(String(data='one more'))
    side.until(lambda: side.node.count_publishers('/real/back') == 1)
    said = capfd.readouterr()
    assert 'WARN' not in said.err + said.out and 'ERROR' not in said.err + said.out


# every field of every interface gets a value; printed is what each is and how it is written
INTERFACES = r'''
import importlib, re, sys
from rclpy.serialization import serialize_message
count = 0
def value(kind):
    global count
    count = count % 90 + 1
    text = re.match(r'w?string(<(\d+)>)?$', kind)
    if text:
        return 'abcdefg'[:count % 7 + 1][:int(text[2]) if text[2] else None]
    if '/' in kind:
        package, name = kind.split('/')
        name, _, part = name.partition('_')
        module = importlib.import_module(f'{package}.{"srv" if part else "msg"}')
        return filled(getattr(getattr(module, name), part) if part else getattr(module, name))
    return {'boolean': count % 2 == 0, 'octet': bytes([count]), 'float': count * 0.5,
            'double': count * 0.25}.get(kind, count)
def filled(cls):
    message = cls()
    for name, kind in message.get_fields_and_field_types().items():
        many = re.match(r'sequence<(.*?)(, (\d+))?>$', kind)
        fixed = re.match(r'(.*)\[(\d+)\]$', kind)
        if many:
            given = [value(many[1]) for _ in range(min(int(many[3] or 3), count % 4))]
        elif fixed:
            given = [value(fixed[1]) for _ in range(int(fixed[2]))]
        else:
            given = value(kind)
        setattr(message, name, given)
    return message
for name in sys.argv[1:]:
    package, kind, short = name.split('/')
    try:
        cls = getattr(importlib.import_module(f'{package}.{kind}'), short)
    except ModuleNotFoundError:
        continue
    for one in ([cls] if kind == 'msg' else [cls.Request, cls.Response, cls.Event]):
        count = 4
        print(one.__name__, one(), one.get_fields_and_field_types(),
              serialize_message(one()).hex(), serialize_message(filled(one)).hex())
'''


def test_every_interface_is_serialized_as_by_ros2():
    from rosidl_embedded.definition import table, TABLES
    names = [f'{package}/{name}' for package in sorted(one.stem for one in TABLES.glob('*.txt'))
             for name in table(package)]
    ours = subprocess.run([sys.executable, '-c', INTERFACES, *names], capture_output=True,
                          text=True, timeout=60)
    assert ours.returncode == 0, ours.stderr
    known = ours.stdout.splitlines()
    theirs = output('python3', '-c', INTERFACES, *names).splitlines()
    assert len(theirs) > 250
    assert [line for line in theirs if line not in known] == []


def test_type_hashes_equal_those_of_ros2():
    import json

    from rosidl_embedded.definition import table, TABLES
    from rosidl_embedded.typehash import type_hash
    prefix = output('sh', '-c', 'echo ${AMENT_PREFIX_PATH%%:*}').strip()
    compared = 0
    for package in (one.stem for one in TABLES.glob('*.txt')):
        for name in table(package):
            file = Path(prefix, 'share', package, f'{name}.json')
            if file.is_file():
                for one in json.loads(file.read_text())['type_hashes']:
                    assert type_hash(one['type_name']) == one['hash_string'], one['type_name']
                    compared += 1
    assert compared > 500
