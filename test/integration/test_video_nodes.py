# SPDX-License-Identifier: Apache-2.0
"""Encoder and decoder as processes of their own, seen through ROS topics alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading
from typing import Any, Optional

import pytest

pytest.importorskip('av', reason='PyAV (the extra "video") is not installed')
pytest.importorskip('rclpy', reason='rclpy is not installed')
import numpy
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.qos import ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Empty, UInt8MultiArray, UInt64MultiArray

from image_transport_h264 import annexb, message
from image_transport_h264.acknowledgement import wait_for_all_acked
from image_transport_h264.codec import Encoder, peek, Settings
from rigs.bench import Bench, BEST_EFFORT, made, RELIABLE

ROOT = Path(__file__).parents[2]
WIDTH, HEIGHT = 96, 64


def image(
    number: int, encoding: str = 'bgr8', pixel: int = 3, width: int = WIDTH,
    height: int = HEIGHT, pad: int = 0, big: int = 0,
) -> Image:
    """Return image ``number`` of a sequence: soft, so that any codec keeps it."""
    y, x = numpy.mgrid[0:height, 0:width * pixel]
    waves = (128 + 60 * numpy.sin((x // pixel + number) / 19) * numpy.cos(y / 23))
    rows = numpy.pad(waves.astype(numpy.uint8), ((0, 0), (0, pad)))
    made = Image(height=height, width=width, encoding=encoding, step=rows.shape[1],
                 is_bigendian=big, data=message.octets(rows.tobytes()))
    made.header.frame_id = f'frame {number}'
    made.header.stamp.sec, made.header.stamp.nanosec = 1000 + number, 7 * number
    return made


def source(bench: Bench, **options: Any) -> Callable[[], None]:
    """Return what publishes the next image on /camera."""
    publisher = bench.node.create_publisher(Image, '/camera', RELIABLE)
    count = iter(range(1_000_000))
    return lambda: publisher.publish(image(next(count), **options))


@pytest.fixture(scope='module')
def running() -> Iterator[tuple[Bench, list[str], list[str]]]:
    """Have an encoder and a decoder, and the lines that each writes."""
    with pytest.MonkeyPatch.context() as patch, made(patch.setenv) as bench:
        yield bench, *bench.pair('-r', '__node:=encoder', '-p', 'gop:=1000000')


@pytest.fixture
def pair(running: tuple[Bench, list[str], list[str]]) -> Iterator[Bench]:
    """Return a bench with an encoder and a decoder that other tests use, too."""
    bench, *_ = running
    yield bench
    bench.renew()


def test_what_goes_in_comes_out(pair: Bench) -> None:
    """All fields of header and image, and nearly the same pixels; depth to the bit."""
    bench = pair
    seen = bench.heard(Image, '/seen/camera')
    kinds: dict[str, dict[str, int]] = {
        'rgba8': {'pixel': 4, 'width': 97, 'height': 63, 'pad': 5, 'big': 1},
        '32FC1': {'pixel': 4, 'width': 31}}
    for encoding, options in kinds.items():
        bench.until(lambda kind=encoding: [got.encoding for got in seen].count(kind) >= 5,
                    'an image', meanwhile=source(bench, encoding=encoding, **options))
    for got in seen:
        sent = image(got.header.stamp.sec - 1000, got.encoding, **kinds[got.encoding])
        assert got.header == sent.header
        assert (got.height, got.width, got.step, got.is_bigendian) == (
            sent.height, sent.width, sent.step, sent.is_bigendian)
        a, b = (numpy.frombuffer(m.data, numpy.uint8).astype(int) for m in (got, sent))
        assert numpy.abs(a - b).mean() < (0.01 if got.encoding == '32FC1' else 4)


def test_how_packets_are_taken(root: None, bench: Bench) -> None:
    """
    A deep picture of many datagrams comes over a link that loses every fifth one.

    Parameters are numbers of either type.
    """
    with bench.lossy():
        lines, _ = bench.pair('-p', 'max_rate:=15', '-p', 'quality:=28', '-p', 'bitrate:=2e6')
        seen = bench.heard(Image, '/seen/camera')
        for encoding, options, reliability in (
                ('16UC1', {'pixel': 2, 'width': 640, 'height': 480}, ReliabilityPolicy.RELIABLE),
                ('bgr8', {}, ReliabilityPolicy.BEST_EFFORT)):
            camera = source(bench, encoding=encoding, **options)
            bench.until(lambda kind=encoding: [got.encoding for got in seen].count(kind) >= 3,
                        f'an image: {lines}', meanwhile=camera)
            bench.until(lambda wanted=reliability: [info.qos_profile.reliability for info in
                                 bench.node.get_subscriptions_info_by_topic('/camera/h264')
                                 ] == [wanted], 'the subscription', meanwhile=camera)


def test_mistyped_topic_and_unknown_codec_are_reported(bench: Bench) -> None:
    bench.node.create_publisher(Image, '/camera/image_raw', RELIABLE)
    lines = bench.start('encoder', '-r', 'image:=/fogros2/m/camera/imge_raw',
                        '-p', 'topic:=/camera/imge_raw')
    wrong = bench.start('encoder', '-p', 'codec:=vhs')
    process = bench.processes.pop()[0]
    assert process.wait(60) != 0
    for text, output in (("'vhs' is not one of h264, jpeg, png, raw", wrong), (
            'no images on /camera/imge_raw (did you mean /camera/image_raw?)', lines)):
        bench.until(lambda text=text, output=output: text in ''.join(output), text)


def test_no_subscriber_no_work(pair: Bench) -> None:
    """The raw topic and the stream are subscribed to while someone sees the images."""
    bench = pair
    node, publish = bench.node, source(bench)
    bench.until(lambda: len(node.get_publishers_info_by_topic('/seen/camera')) == 1,
                'the decoder', meanwhile=publish)
    bench.until(lambda: len(node.get_publishers_info_by_topic('/camera/h264')) == 1,
                'the encoder', meanwhile=publish)
    # those for the viewers of other tests end, too
    bench.until(lambda: node.count_subscribers('/camera')
                == node.count_subscribers('/camera/h264') == 0, 'no work', meanwhile=publish)
    seen: list[Any] = []
    subscription = node.create_subscription(Image, '/seen/camera', seen.append, RELIABLE)
    bench.until(lambda: seen, 'an image', meanwhile=publish)
    assert node.count_subscribers('/camera') == node.count_subscribers('/camera/h264') == 1
    # camera info goes along
    infos, info = bench.heard(CameraInfo, '/seen/camera_info'), CameraInfo(width=WIDTH)
    camera = node.create_publisher(CameraInfo, '/camera_info', 10)
    info.header.stamp.sec, info.distortion_model, info.k[0] = 77, 'plumb_bob', 123.5
    bench.until(lambda: infos, 'camera info', meanwhile=lambda: camera.publish(info))
    assert infos[0] == info
    node.destroy_subscription(subscription)
    bench.until(lambda: node.count_subscribers('/camera') == 0
                and node.count_subscribers('/camera/h264') == 0, 'the end of the work')


def test_late_viewer_and_a_request_get_a_keyframe(pair: Bench) -> None:
    """Hours of P-pictures away from the next key, it comes at once."""
    bench = pair
    publish = source(bench)
    seen = bench.heard(Image, '/seen/camera')
    bench.until(lambda: len(seen) >= 10, 'images', meanwhile=publish)
    packets = bench.heard(CompressedImage, '/camera/h264', BEST_EFFORT)

    def key() -> bool:
        tags = [peek(bytes(packet.data)) for packet in packets]
        return any(tag is not None and tag.key for tag in tags)

    bench.until(key, 'a key', meanwhile=publish)
    # and the one that was there already has missed nothing
    before = len(seen)
    bench.until(lambda: len(seen) >= before + 5, 'images', meanwhile=publish)
    numbers = [one.header.stamp.sec for one in seen[-5:]]
    assert numbers == sorted(numbers)
    ask = bench.node.create_publisher(Empty, '/camera/h264/keyframe', RELIABLE)
    bench.until(ask.get_subscription_count, 'the encoder', meanwhile=publish)
    begin = len(packets)
    ask.publish(Empty())
    bench.until(lambda: any(annexb.IDR in annexb.kinds(bytes(p.data)) for p in packets[begin:]),
                'a key', meanwhile=publish)
    assert {packet.format for packet in packets} == {'h264'}
    assert packets[-1].header.frame_id.startswith('frame ')


def test_ffmpeg_image_transport_decodes_our_packets(bench: Bench) -> None:
    """What rviz does for an Image display with the transport 'ffmpeg', in republish."""
    from ament_index_python.packages import get_package_prefix, PackageNotFoundError

    try:
        prefix, _ = map(get_package_prefix, ('image_transport', 'ffmpeg_image_transport'))
    except PackageNotFoundError:
        pytest.skip('ffmpeg_image_transport is not installed')
    bench.start('encoder', '-r', 'image:=/camera')
    bench.run(f'{prefix}/lib/image_transport/republish', '--ros-args',
              '-p', 'in_transport:=ffmpeg', '-p', 'out_transport:=raw',
              '-r', 'in/ffmpeg:=/camera/h264/ffmpeg', '-r', 'out:=/shown')
    shown = bench.heard(Image, '/shown')
    bench.until(lambda: len(shown) >= 5, 'an image', meanwhile=source(bench, encoding='rgb8'))
    for got in shown:
        sent = image(got.header.stamp.sec - 1000, 'rgb8')
        assert got.header == sent.header
        assert (got.height, got.width, got.encoding) == (HEIGHT, WIDTH, 'rgb8')
        a, b = (numpy.frombuffer(m.data, numpy.uint8).astype(int) for m in (got, sent))
        assert numpy.abs(a - b).mean() < 8


def test_after_a_loss_nothing_is_shown_until_a_key(pair: Bench) -> None:
    """The decoder asks for the key by itself, and acknowledges what comes."""
    bench = pair
    seen = bench.heard(Image, '/seen/camera')
    asked = bench.heard(Empty, '/camera/h264/keyframe')
    feedback = bench.heard(UInt64MultiArray, '/camera/h264/feedback', BEST_EFFORT)
    publisher = bench.node.create_publisher(CompressedImage, '/camera/h264', RELIABLE)
    bench.until(publisher.get_subscription_count, 'the decoder')
    encoder, sent = Encoder(Settings(gop=1000)), iter(range(1000))

    def packet(key: bool = False) -> bytes:
        header, picture = message.picture(serialize_message(image(next(sent))))
        made = encoder.encode(picture, key=key)
        return message.compressed(header, made.format, made.data)

    bench.until(lambda: len(seen) >= 3, 'images',
                meanwhile=lambda: publisher.publish(packet(key=not seen)))
    bench.until(lambda: len(feedback) >= 3, 'acknowledgements',
                meanwhile=lambda: publisher.publish(packet()))
    packet()  # lost
    asked.clear()
    lost = next(sent) - 1
    bench.until(lambda: asked, 'a request', meanwhile=lambda: publisher.publish(packet()))
    assert all(one.header.stamp.sec - 1000 < lost for one in seen)
    bench.until(lambda: seen[-1].header.stamp.sec - 1000 > lost, 'an image after the key',
                meanwhile=lambda: publisher.publish(packet(key=True)))
    assert feedback[-1].data[2] >= 1


def bad(**fields: Any) -> bytes:
    """Return a serialized image with other fields."""
    made = image(0)
    for name, value in fields.items():
        setattr(made, name, value)
    return bytes(serialize_message(made))


def test_malformed_messages_are_dropped_with_a_warning(
    pair: Bench, running: tuple[Bench, list[str], list[str]],
) -> None:
    """Images, packets and pieces: one warning for each kind, then good images go on."""
    bench, encoder, decoder = running
    seen = bench.heard(Image, '/seen/camera')
    camera = source(bench)
    bench.until(lambda: seen, 'an image', meanwhile=camera)
    noise = CompressedImage(format='h264', data=message.octets(b'\0\0\1\x65' + bytes(range(256))))
    kinds = ((Image, '/camera', b'\0\1\0\0\1', encoder, 'not sent: a message that ends'),
             (Image, '/camera', bad(step=0), encoder, 'step 0'),
             (Image, '/camera', bad(data=message.octets(bytes(100))), encoder, 'bytes of data'),
             (Image, '/camera', bad(encoding='bayer_rggb8'), encoder, 'bayer_rggb8'),
             (Image, '/camera', bad(height=0), encoder, 'no pixels'),
             (CompressedImage, '/camera/h264', bytes(serialize_message(noise)), decoder,
              'not shown: H.264'),
             (CompressedImage, '/camera/h264', b'\0\1\0\0\1', decoder,
              'not shown: a message that ends'),
             (UInt8MultiArray, '/camera/h264/pieces', b'\0\1\0\0\1' + bytes(20), decoder,
              'not shown: a piece of a packet with dimensions'))

    def damage(kind: Any, topic: str, data: bytes, lines: list[str], text: str) -> None:
        publisher = bench.node.create_publisher(kind, topic, RELIABLE)
        bench.until(lambda: any(text in line for line in lines), f'a warning about {topic}',
                    meanwhile=lambda: publisher.publish(data))

    for each in kinds:
        damage(*each)
    after = len(seen)
    bench.until(lambda: len(seen) >= after + 5, 'good images', meanwhile=camera)
    for *_, lines, text in kinds:
        assert sum(text in line for line in lines) == 1, lines


def test_parameters_change_while_it_runs(pair: Bench) -> None:
    """This is the last test of the pair, whose images then are lossless."""
    bench = pair
    seen, publish = bench.heard(Image, '/seen/camera'), source(bench)
    bench.until(lambda: len(seen) >= 3, 'images', meanwhile=publish)
    client = bench.node.create_client(SetParameters, '/encoder/set_parameters')
    bench.until(client.service_is_ready, 'the service', meanwhile=publish)

    def ask(name: str, **value: Any) -> Any:
        kinds = {'integer_value': ParameterType.PARAMETER_INTEGER,
                 'double_value': ParameterType.PARAMETER_DOUBLE,
                 'string_value': ParameterType.PARAMETER_STRING,
                 'bool_value': ParameterType.PARAMETER_BOOL}
        kind = kinds[next(iter(value))]
        future = client.call_async(SetParameters.Request(parameters=[
            ParameterMessage(name=name, value=ParameterValue(type=kind, **value))]))
        bench.until(future.done, 'the answer', meanwhile=publish)
        return future.result().results[0]

    for name, value in (
            ('bitrate', {'integer_value': 400_000}), ('quality', {'double_value': 35.0}),
            ('preset', {'string_value': 'ultrafast'}), ('gop', {'integer_value': 10}),
            ('max_rate', {'double_value': 15.0}), ('encoder', {'string_value': 'libx264'}),
            ('lossless', {'bool_value': True})):
        assert ask(name, **value).successful, name
    for name, value in (('bitrate', {'integer_value': 0}), ('quality', {'double_value': 99.0}),
                        ('preset', {'string_value': 'warp'}),
                        ('bitrate', {'double_value': float('inf')}),
                        ('lossless', {'string_value': 'no'}),
                        ('max_rate', {'double_value': -1.0})):
        answer = ask(name, **value)
        assert not answer.successful
        assert str(next(iter(value.values()))) in answer.reason
    after = len(seen)
    bench.until(lambda: len(seen) >= after + 5, 'images', meanwhile=publish)
    sent = image(seen[-1].header.stamp.sec - 1000)
    assert bytes(seen[-1].data) == bytes(sent.data)


def test_reader_that_hangs_holds_up_no_thread_and_no_end(bench: Bench) -> None:
    """
    The wait for its acknowledgement lets threads run, and ends with the node.

    ROS 2's own method holds the interpreter: one image per round trip would leave. Launch
    interrupts once more what a terminal has interrupted already.
    """
    lines, _ = bench.pair(codec='raw')
    encoder, decoder = (process for process, _, _ in bench.processes)
    seen = bench.heard(Image, '/seen/camera')
    publish = source(bench, width=640, height=480)
    bench.until(lambda: seen, 'an image', meanwhile=publish)
    sent = image(seen[0].header.stamp.sec - 1000, width=640, height=480)
    assert seen[0].header == sent.header and bytes(seen[0].data) == bytes(sent.data)
    publisher = bench.node.create_publisher(Image, '/camera/raw', RELIABLE)
    bench.until(publisher.get_subscription_count, 'the decoder')
    answers: list[bool] = []
    waiting = threading.Thread(
        target=lambda: answers.append(wait_for_all_acked(publisher, 2.0)))
    decoder.send_signal(signal.SIGSTOP)
    # the signal takes effect later: until then, the decoder acknowledges
    os.waitpid(decoder.pid, os.WUNTRACED)
    try:
        publisher.publish(Image())
        waiting.start()
        # with the lock held, this thread would continue after the answer only
        turns = 0
        while waiting.is_alive():
            waiting.join(0.05)
            turns += 1
        assert turns > 3 and answers == [False]
        # what it doesn't acknowledge the encoder waits for, two seconds long
        for _ in range(5):
            publish()
        encoder.send_signal(signal.SIGINT)
        bench.until(lambda: ignores_interrupts(encoder.pid), 'the beginning of the end')
        encoder.send_signal(signal.SIGINT)
        assert encoder.wait(60) == 0, lines
    finally:
        decoder.send_signal(signal.SIGCONT)
    assert wait_for_all_acked(publisher, 20.0)


#: A node whose callback raises an error: as rclpy does after a signal, or without one.
FAILING = """
import sys
import threading
from image_transport_h264.lazy import LazyNode, run


class Failing(LazyNode):
    def __init__(self):
        super().__init__('failing')
        self.ended = threading.Event()
        self.context.on_shutdown(self.ended.set)
        self.create_timer(0.001, self.fail_once)

    def fail_once(self):
        print('begins', flush=True)
        if len(sys.argv) > 1:
            self.ended.wait()
        print('goes on', file=sys.stderr)
        raise TypeError('Unable to convert call argument')


run(Failing)
"""


@pytest.mark.parametrize('number', [signal.SIGINT, None])
def test_signal_ends_node_after_its_callback(
    bench: Bench, number: Optional[signal.Signals],
) -> None:
    with subprocess.Popen([sys.executable, '-c', FAILING, *['signal'] * bool(number)],
                          env=bench.environment, text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE) as node:
        assert node.stdout is not None
        assert node.stdout.readline() == 'begins\n'
        if number:
            node.send_signal(number)
        try:
            _, output = node.communicate(timeout=60)
        finally:
            node.kill()
        assert 'goes on' in output
        assert ('Traceback' in output) is (number is None), output
        assert node.returncode == (number is None)


#: A node that is interrupted, or fails, before it is there.
STARTING = """
import sys
import rclpy
from image_transport_h264.lazy import LazyNode, run


class Starting(LazyNode):
    def __init__(self):
        if len(sys.argv) > 1:
            rclpy.shutdown()  # as the thread of rclpy's signal handler does
        super().__init__('starting')
        raise TypeError('a defect')


run(Starting)
"""


@pytest.mark.parametrize('interrupted', [True, False])
def test_interrupt_of_a_node_that_starts_is_no_failure(bench: Bench, interrupted: bool) -> None:
    done = subprocess.run(
        [sys.executable, '-c', STARTING, *['interrupted'] * interrupted], env=bench.environment,
        capture_output=True, text=True, timeout=60)
    assert done.returncode == (not interrupted)
    assert ('a defect' in done.stderr) is (not interrupted) and (
        not interrupted or 'Traceback' not in done.stderr), done.stderr


#: Asks how many subscribers there are, before the executor can tell that one has come.
ASKS = """
import time
import rclpy
from image_transport_h264.lazy import LazyNode, STREAM_QOS
from std_msgs.msg import Empty

rclpy.init()
node = LazyNode('asks')
told = []
publisher = node.offer(Empty, 'news', STREAM_QOS, lambda: told.append(node.subscribers(publisher)))
reader = node.create_subscription(Empty, 'news', lambda _: None, 1)
deadline = time.monotonic() + 50
while reader.get_publisher_count() == 0 and time.monotonic() < deadline:
    node.subscribers(publisher)
node.subscribers(publisher)
while not told and time.monotonic() < deadline:
    rclpy.spin_once(node, timeout_sec=0.1)
print(told, node.subscribers(publisher))
"""


def test_no_subscriber_is_missed_by_a_node_that_asks(bench: Bench) -> None:
    done = subprocess.run([sys.executable, '-c', ASKS], env=bench.environment, text=True,
                          capture_output=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, '[1] 1\n'), done.stderr


def ignores_interrupts(process: int) -> bool:
    """Return whether a process that runs ignores SIGINT; see proc(5)."""
    for line in Path(f'/proc/{process}/status').read_text().splitlines():
        name, _, value = line.partition(':')
        if name == 'SigIgn':
            return bool(int(value, 16) & 1 << signal.SIGINT - 1)
    raise AssertionError('the process has ended')
