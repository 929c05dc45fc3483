# SPDX-License-Identifier: Apache-2.0
"""Bridge and recorder as processes, judged by Foxglove's own client and by MCAP's reader."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator
import contextlib
import itertools
import json
import os
from pathlib import Path
import re
import secrets
import signal
import subprocess
import sys
import threading
import time
from typing import Any

import pytest

pytest.importorskip('foxglove', reason='the extra "monitor" is not installed')
pytest.importorskip('rclpy', reason='rclpy is not installed')
from geometry_msgs.msg import Twist
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
import numpy
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CompressedImage, Image, Imu
from std_msgs.msg import Float64MultiArray, Header, MultiArrayDimension, String
from std_srvs.srv import SetBool, Trigger
import yaml

from fogros2.errors import DeadlineExceeded
from fogros2.waiting import wait_until
from fogros2_monitor.bridge import WAITING
from fogros2_monitor.services import REQUEST
from rigs import viewer as viewers
from rigs.domains import taken

ROOT = Path(__file__).parents[2]
CACHE = ROOT / '.cache/node'
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
#: Messages a second that the robot publishes to a crowd of viewers.
RATE = 20.0
#: Bytes of a mesh, no text.
MESH = bytes(range(256)) * 1000


class Bench:
    """A bridge, a node in this process whose topics it serves, and viewers."""

    def __init__(self) -> None:
        self.processes: list[subprocess.Popen[str]] = []
        self.viewers: list[viewers.Viewer] = []
        self.lines: list[str] = []
        path = filter(None, [str(ROOT), os.environ.get('PYTHONPATH', '')])
        self.environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(path)}
        self.context = self.make_context()
        self.executor = SingleThreadedExecutor(context=self.context)
        self.node = self.make_node('bench')
        self._spinning = threading.Thread(target=self.executor.spin)
        self._spinning.start()
        self.bridge = self.run('-m', 'fogros2_monitor.bridge', '--ros-args', '-p', 'port:=0')
        self.url = self.serving()

    def make_context(self) -> Context:
        context = Context()
        rclpy.init(context=context, domain_id=int(self.environment['ROS_DOMAIN_ID']))
        return context

    def make_node(self, name: str) -> Node:
        node = Node(name, context=self.context)
        self.executor.add_node(node)
        return node

    def run(self, *words: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, *words], env=self.environment,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        assert process.stdout is not None
        threading.Thread(
            target=lambda: self.lines.extend(process.stdout or ()), daemon=True).start()
        self.processes.append(process)
        return process

    def serving(self) -> str:
        """Return the address of the first bridge whose line is there."""
        return self.until(
            lambda: re.search(r'serving (ws://\S+)', ''.join(self.lines)), 'a bridge')[1]

    def gate(self, token: Path) -> tuple[subprocess.Popen[str], str]:
        """Run a gate before the bridge; return it, and the address for viewers."""
        gate = self.run('-m', 'fogros2_monitor.gate', '--to', self.url.rpartition('/')[2],
                        '--listen', '127.0.0.1:0', '--token-file', str(token))
        port = self.until(lambda: re.search(
            r'listening on 127.0.0.1:(\d+)', ''.join(self.lines)), 'a gate')[1]
        return gate, f'ws://127.0.0.1:{port}/'

    def viewer(self, url: str = '') -> viewers.Viewer:
        made = viewers.Viewer(CACHE, url or self.url)
        self.viewers.append(made)
        made.until('open')
        return made

    def run_node(self, program: str, *words: str) -> subprocess.Popen[str]:
        """Run a program of Node's, which ends with its input."""
        return subprocess.Popen(
            [viewers.program('node'), str(CACHE / program), *words], stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, text=True)

    def until(self, probe: Callable[[], Any], what: str) -> Any:
        try:
            return wait_until(lambda: probe() or None, timeout=60, what=what)
        except DeadlineExceeded as error:
            raise DeadlineExceeded('\n'.join([
                str(error), *(f'viewer: {viewer.unread()}' for viewer in self.viewers),
                f'graph: {self.node.get_topic_names_and_types()}', *self.lines])) from None

    def listeners(self, topic: str, count: int) -> None:
        self.until(lambda: self.node.count_subscribers(topic) == count,
                   f'{count} subscriptions of {topic}')

    def end(self, processes: list[subprocess.Popen[str]]) -> None:
        """Have processes end, and all viewers."""
        for viewer in self.viewers:
            viewer.close()
        self.viewers.clear()
        for process in processes:
            process.send_signal(signal.SIGINT)
        codes = [process.wait(60) for process in processes]
        self.processes = [each for each in self.processes if each not in processes]
        assert {*codes} <= {0}, ''.join(self.lines)

    def close(self) -> None:
        try:
            self.end(self.processes)
        finally:
            self.executor.shutdown()
            self._spinning.join(60)
            self.node.destroy_node()
            self.context.try_shutdown()


@pytest.fixture(scope='module')
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """Have a bridge, for which a package with a mesh is installed."""
    why_not = viewers.install(ROOT / 'test/node', CACHE)
    if why_not:
        pytest.skip(why_not)
    prefix = tmp_path_factory.mktemp('prefix')
    index = prefix / 'share/ament_index/resource_index/packages'
    index.mkdir(parents=True)
    (index / 'arm_description').touch()
    (prefix / 'share/arm_description/meshes').mkdir(parents=True)
    (prefix / 'share/arm_description/meshes/arm.STL').write_bytes(MESH)
    others = os.environ.get('AMENT_PREFIX_PATH', '')
    with pytest.MonkeyPatch.context() as patch, taken() as domain:
        patch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        patch.setenv('ROS_DOMAIN_ID', domain)
        patch.setenv('AMENT_PREFIX_PATH', f'{prefix}{os.pathsep}{others}')
        made = Bench()
        try:
            yield made
        finally:
            made.close()


@pytest.fixture
def bench(running: Bench) -> Iterator[Bench]:
    """Return a bench whose bridge other tests use, too, with topics of other names."""
    running.lines.clear()
    yield running
    running.end(running.processes[1:])


def test_messages_arrive_as_they_were_published(bench):
    words = bench.node.create_publisher(String, '/words', 10)
    imus = bench.node.create_publisher(Imu, '/imu', 10)
    arrays = bench.node.create_publisher(Float64MultiArray, '/numbers', 10)
    images = bench.node.create_publisher(Image, '/image', 10)
    viewer = bench.viewer()
    for topic, schema in (('/words', 'std_msgs/msg/String'), ('/imu', 'sensor_msgs/msg/Imu'),
                          ('/numbers', 'std_msgs/msg/Float64MultiArray'),
                          ('/image', 'sensor_msgs/msg/Image')):
        channel = viewer.look(topic)
        assert (channel['encoding'], channel['schema']) == ('cdr', schema)
        bench.listeners(topic, 1)

    words.publish(String(data='Grüße, 世界'))
    assert viewer.message('/words') == {'data': 'Grüße, 世界'}

    imu = Imu()
    imu.header.stamp.sec, imu.header.stamp.nanosec = 1234567890, 987654321
    imu.header.frame_id = 'imu_link'
    imu.orientation.w, imu.angular_velocity.z = 0.5, -1e-300
    imu.linear_acceleration_covariance = numpy.arange(9, dtype=float)
    imus.publish(imu)
    seen = viewer.message('/imu')
    assert seen['header'] == {
        'stamp': {'sec': 1234567890, 'nanosec': 987654321}, 'frame_id': 'imu_link'}
    assert seen['orientation']['w'] == 0.5
    assert seen['angular_velocity']['z'] == -1e-300
    assert seen['linear_acceleration_covariance'] == list(range(9))

    numbers = Float64MultiArray(data=[1.5, -2.0])
    numbers.layout.dim = [MultiArrayDimension(label='x', size=2, stride=2)]
    arrays.publish(numbers)
    assert viewer.message('/numbers') == {
        'layout': {'dim': [{'label': 'x', 'size': 2, 'stride': 2}], 'data_offset': 0},
        'data': [1.5, -2.0]}

    pixels = numpy.random.default_rng(1).integers(0, 256, 7 * 5 * 3, numpy.uint8)
    images.publish(Image(height=5, width=7, encoding='rgb8', step=21, data=pixels.tobytes()))
    assert viewer.message('/image')['data'] == pixels.tolist()


def test_topic_is_subscribed_to_while_a_viewer_shows_it(bench):
    bench.node.create_publisher(String, '/shown', 10)
    first, second = bench.viewer(), bench.viewer()
    first.until('channel', '/shown')
    bench.listeners('/shown', 0)
    first.wish(subscribe='/shown')
    second.look('/shown')
    bench.listeners('/shown', 1)
    first.wish(unsubscribe='/shown')
    second.close()
    bench.listeners('/shown', 0)
    publisher = bench.node.create_publisher(String, '/late', 10)
    first.until('channel', '/late')
    bench.node.destroy_publisher(publisher)
    first.until('gone', '/late')


def test_early_and_late_viewers_get_latched_messages(bench):
    bench.node.create_subscription(String, '/map', lambda _: None, 10)
    viewer = bench.viewer()
    viewer.look('/map')
    bench.listeners('/map', 2)
    # says it before anybody has heard of it
    other = bench.make_context()
    node = Node('maps', context=other)
    try:
        node.create_publisher(String, '/map', LATCHED).publish(String(data='here'))
        assert viewer.message('/map') == {'data': 'here'}
        late = bench.viewer()
        late.look('/map')
        assert late.message('/map') == {'data': 'here'}
    finally:
        node.destroy_node()
        other.try_shutdown()


def test_viewers_publish_what_is_possible(bench):
    heard: list[Any] = []
    bench.node.create_subscription(Twist, '/cmd_vel', heard.append, 10)
    viewer = bench.viewer()
    vector = 'float64 x\nfloat64 y\nfloat64 z\n'
    definition = ('geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n'
                  f'{"=" * 80}\nMSG: geometry_msgs/Vector3\n{vector}')

    def publish() -> bool:
        viewer.wish(publish='/cmd_vel', schemaName='geometry_msgs/msg/Twist',
                    definition=definition, message={
                        'linear': {'x': 0.25, 'y': 0, 'z': 0},
                        'angular': {'x': 0, 'y': 0, 'z': -1}})
        return bool(heard)

    bench.until(publish, 'what a viewer published')
    assert (heard[0].linear.x, heard[0].angular.z) == (0.25, -1.0)
    # what cannot be published is reported
    viewer.wish(publish='/x', schemaName='no_such_msgs/msg/Thing', definition='string data',
                message={'data': ''})
    assert 'no_such_msgs' in viewer.until('status')['status']
    viewer.wish(publish='/a b', schemaName='std_msgs/msg/String', definition='string data',
                message={'data': ''})
    assert '/a b' in viewer.until('status')['status']
    if rclpy.get_rmw_implementation_identifier() == 'rmw_fastrtps_cpp':
        # a process has one type of a topic
        viewer.wish(publish='/parameter_events', schemaName='std_msgs/msg/String',
                    definition='string data', message={'data': ''})
        assert 'incompatible type' in viewer.until('status')['status']
        assert bench.bridge.poll() is None


class Publishing:
    """A robot's node that publishes at a rate, as far as the computer lets it."""

    def __init__(self, bench: Bench) -> None:
        self._small = bench.node.create_publisher(String, '/small', 10)
        self._big = bench.node.create_publisher(String, '/big', 2)
        self._ended = threading.Event()
        self.count = 0
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        small, big = String(data='x' * 20_000), String(data='x' * 1_000_000)
        begin = time.monotonic()
        while not self._ended.wait(max(0.0, begin + self.count / RATE - time.monotonic())):
            self._small.publish(small)
            self._big.publish(big)
            self.count += 1

    def undisturbed(self, seconds: float) -> None:
        """Wait until it publishes at its rate for a while; a busy computer may need several."""
        def steady() -> bool:
            count, begin = self.count, time.monotonic()
            assert not self._ended.wait(seconds)
            return (self.count - count) / (time.monotonic() - begin) > 0.95 * RATE

        wait_until(steady, timeout=60.0, what='messages at their rate')

    def close(self) -> None:
        self._ended.set()
        self._thread.join(60)


def memory(process: subprocess.Popen[str]) -> float:
    """Return a process's memory in MB."""
    status = Path(f'/proc/{process.pid}/status').read_text()
    return int(re.search(r'VmRSS:\s+(\d+)', status)[1]) / 1000


@pytest.mark.parametrize('viewers, seconds', [
    (6, 6.0), pytest.param(20, 30.0, marks=pytest.mark.soak)])
def test_many_viewers_do_not_slow_down_the_robot(bench, viewers, seconds, tmp_path):
    token = tmp_path / 'token'
    token.write_text('sesame\n')
    gate, url = bench.gate(token)
    publishing = Publishing(bench)
    try:
        crowd = bench.run_node('crowd.mjs', f'{url}?token=sesame', str(viewers), '/small',
                               '/big')
        assert crowd.stdout.readline() == 'ready\n'
        # what is kept for the one that doesn't read is full by then
        publishing.undisturbed(seconds / 2)
        before = memory(bench.bridge), memory(gate)
        publishing.undisturbed(seconds / 2)
        after = memory(bench.bridge), memory(gate)
        got = json.loads(crowd.communicate()[0])
    finally:
        publishing.close()
    assert max(after[0] - before[0], after[1] - before[1]) < 30
    assert max(after) < 150
    assert got[0] < min(got[1:])
    # the others have all but what was on its way, and a busy computer drops some
    assert min(got[1:]) > 0.5 * seconds * RATE


def publish_images(bench: Bench) -> None:
    """Publish images 30 times a second, and their stream as ``/camera/h264``."""
    images = bench.node.create_publisher(Image, '/camera', 2)
    shades = itertools.cycle(range(0, 250, 10))
    header = Header(frame_id='camera_link')
    bench.node.create_timer(1 / 30, lambda: images.publish(Image(
        header=header, height=48, width=64, encoding='mono8', step=64,
        data=bytes([next(shades)]) * (48 * 64))))
    bench.run(str(ROOT / 'image_transport_h264/scripts/encoder'), '--ros-args',
              '-r', 'image:=/camera', '-p', 'stream:=/camera/h264', '-p', 'gop:=1000')


# -- services, parameters and assets --------------------------------------------------------------

class Robot:
    """Services and parameters of the bench's node, and a node that answers nobody."""

    def __init__(self, bench: Bench) -> None:
        self.enabled: list[bool] = []
        bench.node.create_service(SetBool, '/enable', self._enable)
        bench.node.create_service(Trigger, '/stop', self._stop)
        bench.node.declare_parameter('speed', 0.5)
        bench.node.declare_parameter('names', ['a', 'b'])
        self._context = bench.make_context()

    def silent(self, service: str) -> Node:
        """Return a node with a service, which answers nobody."""
        node = Node('silent', context=self._context)
        node.create_service(Trigger, service, self._stop)
        return node

    def _enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.enabled.append(request.data)
        response.success, response.message = request.data, 'Grüße'
        return response

    def _stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = 'stopped'
        return response

    def close(self) -> None:
        self._context.try_shutdown()


@pytest.fixture(scope='module')
def served(running: Bench) -> Iterator[Robot]:
    made = Robot(running)
    yield made
    made.close()


@pytest.fixture
def robot(served: Robot, bench: Bench) -> Robot:
    """Return a robot that is as no test has left it."""
    served.enabled.clear()
    bench.node.set_parameters([rclpy.Parameter('speed', value=0.5)])
    return served


def values(told: dict[str, Any]) -> dict[str, Any]:
    return {each['name']: each['value'] for each in told['parameters']}


def parameters(bench: Bench, viewer: viewers.Viewer, *names: str) -> dict[str, Any]:
    """Return parameters once the bridge knows those of the bench's node."""
    def known() -> dict[str, Any]:
        viewer.wish(get=names)
        return values(viewer.until('id', 'get'))

    return bench.until(known, 'parameters')


def test_viewer_with_the_token_uses_all_of_a_robot(robot, bench, tmp_path):
    (tmp_path / 'token').write_text('sesame\n')
    _, url = bench.gate(tmp_path / 'token')
    for wrong in ('', '?token=sesam'):
        stranger = viewers.Viewer(CACHE, url + wrong)
        bench.viewers.append(stranger)
        assert stranger.until('error')['error'] == 'status 401'
    viewer = bench.viewer(f'{url}?token=sesame')
    assert {'clientPublish', 'services', 'parameters', 'parametersSubscribe', 'assets'} <= {
        *viewer.until('capabilities')['capabilities']}

    assert viewer.until('service', '/enable')['request'] == 'bool data\n'
    viewer.wish(call='/enable', request={'data': True})
    assert viewer.until('called', '/enable')['response'] == {'success': True, 'message': 'Grüße'}
    assert robot.enabled == [True]
    viewer.until('service', '/stop')
    viewer.wish(call='/stop', request={})
    assert viewer.until('called', '/stop')['response'] == {'success': False, 'message': 'stopped'}

    told = parameters(bench, viewer)
    assert (told['/bench.speed'], told['/bench.names']) == (0.5, ['a', 'b'])
    assert not [name for name in told if name.startswith('/fogros2_bridge')]
    # JSON has no floating point of its own
    viewer.wish(set=[{'name': '/bench.speed', 'value': 2}])
    assert values(viewer.until('id', 'set')) == {'/bench.speed': 2}
    assert bench.node.get_parameter('speed').value == 2.0

    uri = 'package://arm_description/meshes/arm.STL'
    viewer.wish(fetch=uri)
    told = viewer.until('asset', uri)
    assert (told['status'], base64.b64decode(told['data'])) == (0, MESH)
    for uri in ('package://arm_description/meshes/no.stl', 'file:///etc/passwd'):
        viewer.wish(fetch=uri)
        told = viewer.until('asset', uri)
        assert told['status'] == 1 and told['error']


def test_viewer_follows_parameters(robot, bench):
    viewer = bench.viewer()
    viewer.wish(follow=['/bench.speed', '/late.rate'])
    assert parameters(bench, viewer, '/bench.speed') == {'/bench.speed': 0.5}
    bench.node.set_parameters([rclpy.Parameter('speed', value=3.5)])
    assert values(viewer.until('parameters')) == {'/bench.speed': 3.5}
    late = bench.make_node('late')
    late.declare_parameter('rate', 7)
    assert parameters(bench, viewer, '/late.rate') == {'/late.rate': 7}
    bench.executor.remove_node(late)
    bench.executor.create_task(late.destroy_node)

    def forgotten() -> bool:
        viewer.wish(get=['/late.rate'])
        return not viewer.until('id', 'get')['parameters']

    bench.until(forgotten, 'the end of a node')


def test_node_that_does_not_answer_blocks_no_viewer(robot, bench):
    words = bench.node.create_publisher(String, '/beside', 10)
    silent = robot.silent('/never')
    patient, other = bench.viewer(), bench.viewer()
    other.look('/beside')
    bench.listeners('/beside', 1)
    patient.until('service', '/never')
    # 32 calls of one viewer may wait
    for _ in range(33):
        patient.wish(call='/never', request={})
    assert patient.until('called', '/never')['failure'] == 'Too many requests'
    assert parameters(bench, patient, '/bench.speed') == {'/bench.speed': 0.5}
    patient.wish(set=[{'name': '/bench.speed', 'value': 1.5}])
    patient.until('id', 'set')
    crowd = [patient, *(bench.viewer() for _ in range(WAITING))]
    for viewer in crowd:  # which wait for the node, but one
        viewer.wish(get=[])
    assert 'viewers wait' in other.until('status')['status']
    words.publish(String(data='on'))
    assert other.message('/beside') == {'data': 'on'}
    other.until('service', '/stop')
    other.wish(call='/stop', request={})
    assert other.until('called', '/stop')['response']['message'] == 'stopped'
    silent.destroy_node()
    assert '/never' in patient.until('called', '/never')['failure']
    patient.until('withdrawn', '/never')


def test_bytes_that_are_no_request_are_refused(robot, bench):
    viewer = bench.viewer()
    viewer.until('service', '/enable')
    for payload in (b'', b'\0\1\0\0', b'\xff' * 40, bytes(REQUEST + 1)):
        viewer.wish(call='/enable', payload=base64.b64encode(payload).decode())
        assert viewer.until('called', '/enable')['failure'], payload[:40]
    assert robot.enabled == []


def test_viewer_publishes_only_topics_of_the_bridge(bench):
    bench.run('-m', 'fogros2_monitor.bridge', '--ros-args', '-p', 'port:=0',
              '-p', 'topics:=["/words"]', '-r', '__node:=looker')
    viewer = bench.viewer(bench.serving())
    for topic in ('/cmd_vel', 'cmd_vel', '/words/deep'):
        viewer.wish(publish=topic, schemaName='std_msgs/msg/String', definition='string data',
                    message={'data': 'go'})
        assert 'not among the topics' in viewer.until('status')['status']
        assert not bench.node.count_publishers(topic)
    heard: list[Any] = []
    bench.node.create_subscription(String, '/words', heard.append, LATCHED)

    def publish() -> bool:
        viewer.wish(publish='words', schemaName='std_msgs/msg/String', definition='string data',
                    message={'data': 'said'})
        return bool(heard)

    bench.until(publish, 'what a viewer published')


def test_bridge_that_takes_no_messages_changes_nothing(robot, bench):
    bench.run('-m', 'fogros2_monitor.bridge', '--ros-args', '-p', 'port:=0',
              '-p', 'client_publish:=false', '-p', 'topics:=["/bench.*", "/words"]',
              '-r', '__node:=looker')
    viewer = bench.viewer(bench.serving())
    capabilities = viewer.until('capabilities')['capabilities']
    assert not {'clientPublish', 'services'} & {*capabilities}
    told = parameters(bench, viewer)
    assert told['/bench.speed'] == 0.5 and not [
        name for name in told if not name.startswith('/bench.')]
    viewer.wish(set=[{'name': '/bench.speed', 'value': 9.0}])
    assert 'sets no parameters' in viewer.until('status')['status']
    assert bench.node.get_parameter('speed').value == 0.5


# -- a recording ---------------------------------------------------------------------------------

RECORD = 'import sys; from fogros2_monitor import recorder; {}sys.exit(recorder.main())'


def recorded(folder: Path) -> dict[str, list[Any]]:
    """Return the messages of the one file in a folder, by topic: decoded, and video as it is."""
    path, = folder.glob('*.mcap')
    messages: dict[str, list[Any]] = {}
    with path.open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, decoded in reader.iter_decoded_messages():
            # rosbag2 opens only files that have one serialization
            assert channel.message_encoding == 'cdr'
            messages.setdefault(channel.topic, []).append(decoded.data)
    return messages


def durabilities(folder: Path) -> dict[str, list[str]]:
    """Return what the publishers of each topic offered, as rosbag2 reads it."""
    path, = folder.glob('*.mcap')
    with path.open('rb') as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        profiles = {channel.topic: yaml.safe_load(channel.metadata['offered_qos_profiles'])
                    for channel in summary.channels.values()}
    for each in profiles.values():
        for profile in each:
            assert {*profile} == {
                'history', 'depth', 'reliability', 'durability', 'deadline', 'lifespan',
                'liveliness', 'liveliness_lease_duration', 'avoid_ros_namespace_conventions'}
            assert {*profile['lifespan']} == {'sec', 'nsec'}
    return {topic: [profile['durability'] for profile in each]
            for topic, each in profiles.items()}


def test_recording_and_viewer_have_streams_as_they_came(bench, tmp_path):
    av = pytest.importorskip('av', reason='PyAV (the extra "video") is not installed')
    publish_images(bench)
    latched = bench.node.create_publisher(String, '/plan', LATCHED)
    latched.publish(String(data='all'))
    words, sent = bench.node.create_publisher(String, '/said', 10), list[int]()

    def speak() -> None:
        sent.append(len(sent))
        words.publish(String(data=str(sent[-1])))

    recorder = bench.run('-c', RECORD.format(''), str(tmp_path / 'new'), '/said', '/plan',
                         '/later', '/camera/h264', '--ros-args')
    for topic in ('/said', '/plan', '/camera/h264'):
        bench.listeners(topic, 1)
    bench.node.create_timer(0.02, speak)
    late = bench.node.create_publisher(String, '/later', LATCHED)
    late.publish(String(data='too'))
    bench.listeners('/later', 1)
    unwanted = bench.node.create_publisher(String, '/unwanted', 1)
    # the encoder begins some seconds after its topic is there
    pictures: list[CompressedImage] = []
    bench.node.create_subscription(CompressedImage, '/camera/h264', pictures.append, 10)
    bench.until(lambda: len(pictures) > 60 and len(sent) > 50, 'images and words')
    # a viewer comes in the midst of a stream, and needs a picture that stands alone
    viewer = bench.viewer()
    viewer.until('schema', 'foxglove_msgs/msg/CompressedVideo')
    viewer.wish(subscribe='/camera/h264')
    decoder, frames = av.CodecContext.create('h264', 'r'), []
    while not frames:
        shown = viewer.message('/camera/h264')
        assert (shown['frame_id'], shown['format']) == ('camera_link', 'h264')
        with contextlib.suppress(av.error.InvalidDataError):  # one before the picture
            frames += decoder.decode(av.Packet(bytes(shown['data'])))
    assert (frames[0].width, frames[0].height) == (64, 48)
    recorder.send_signal(signal.SIGINT)
    assert recorder.wait(60) == 0
    bench.processes.remove(recorder)
    got = recorded(tmp_path / 'new')
    assert unwanted.get_subscription_count() == 0
    assert (got['/plan'], got['/later']) == (['all'], ['too'])
    numbers = list(map(int, got['/said']))
    assert len(numbers) > 20 and numbers == sorted({*numbers})
    decoder = av.CodecContext.create('h264', 'r')
    frames: list[Any] = []
    for data in got['/camera/h264']:
        with contextlib.suppress(av.error.InvalidDataError):  # one before the picture
            frames += decoder.decode(av.Packet(bytes(data)))
    assert (frames[0].width, frames[0].height) == (64, 48)
    assert durabilities(tmp_path / 'new') == {
        '/plan': ['transient_local'], '/later': ['transient_local'], '/said': ['volatile'],
        '/camera/h264': ['volatile']}


def test_renamed_topic_is_recorded_and_missing_one_is_named(bench, tmp_path):
    text = secrets.token_hex(1 << 20)  # the file gets a message of this size with the next one
    publisher = bench.node.create_publisher(String, '/fogros2/m/plan', 1)
    bench.node.create_timer(0.2, lambda: publisher.publish(String(data=text)))
    recorder = bench.run('-c', RECORD.format('recorder.PATIENCE = 1.0; '), str(tmp_path), '/plan',
                         '/none', '--ros-args', '-r', '/plan:=/fogros2/m/plan')
    bench.until(lambda: re.search('no topic of the names .*/none yet', ''.join(bench.lines)),
                'the warning')
    bench.until(lambda: any(path.stat().st_size > 1 << 19 for path in tmp_path.glob('*.mcap')),
                'a message in the file')
    recorder.send_signal(signal.SIGINT)
    assert recorder.wait(60) == 0
    bench.processes.remove(recorder)
    got = recorded(tmp_path)
    assert ([*got], {*got['/plan']}) == (['/plan'], {text})


def test_recording_ends_before_the_disk_is_full(bench, tmp_path):
    recorder = bench.run('-c', RECORD.format('recorder.FREE = 1 << 62; '), str(tmp_path), '/quiet')
    bench.processes.remove(recorder)
    assert recorder.wait(60) == 1
    bench.until(lambda: 'GB are free: ' in ''.join(bench.lines), 'the reason')
    assert recorded(tmp_path) == {}


def test_bridge_ends_while_a_call_waits(robot, bench):
    silent = robot.silent('/waits')
    viewer = bench.viewer()
    viewer.until('service', '/waits')
    viewer.wish(call='/waits', request={})
    parameters(bench, viewer, '/bench.speed')
    bench.bridge.send_signal(signal.SIGINT)
    assert bench.bridge.wait(20) == 0
    silent.destroy_node()
