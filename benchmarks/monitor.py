# SPDX-License-Identifier: Apache-2.0
"""
What watching costs: the bridge to Foxglove with its gate, rosbridge's JSON, and the dashboard.

Everything is on this computer, so no VPN is in the figures; ``round_trip`` has what that adds.
A node publishes, the bridge and the gate before it serve, viewers that don't draw read. Latency is
from ``publish()`` until a viewer has the message's bytes: for rosbridge, that is after its JSON
and base64 were decoded. CPU is that of bridge and gate, or of the rosbridge server, in hundredths
of a processor; ``figures/rosbridge.py`` is a server of that protocol of our own. ``--short`` takes
a quarter of the time.
"""

from __future__ import annotations

import argparse
import asyncio
import base64
from collections.abc import Callable, Iterator
import contextlib
import dataclasses
import itertools
import json
import os
from pathlib import Path
import signal
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from typing import Any

from figures import RESULTS, Row, write

from fogros2.dds.fastdds import FastDds
from fogros2.model import DdsInterface

ROOT = Path(__file__).parents[1]
SECONDS = 12.0
#: Messages of the beginning that don't count.
WARM_UP = 10
TIMEOUT = 30.0
VIEWERS = 5
RATE = 30.0
JSON_SERVER = "rosbridge's JSON by a server of our own"
#: A packet's stand-in for the frames of a stream: so many, over and over.
FRAMES = 60
#: What the node publishes: name, topic, messages a second.
TEXT, VGA, VIDEO, PACKETS, RAW = 'text', 'vga', 'video', 'packets', 'raw'
RATES = {TEXT: 100.0, VGA: 15.0, VIDEO: RATE, PACKETS: RATE, RAW: RATE}


# --- the node -----------------------------------------------------------------------------------

def stamp(header: Any) -> None:
    """Write the time into a header: the clock is the same for all processes here."""
    header.stamp.sec, header.stamp.nanosec = divmod(time.monotonic_ns(), 10**9)


def publish(what: str) -> None:
    """Publish until interrupted."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CompressedImage, Image
    from std_msgs.msg import Empty, String

    rclpy.init()
    node = rclpy.create_node('source')
    turn = itertools.cycle(packets() if what in (VIDEO, PACKETS) else [b''])
    if what == TEXT:
        publisher = node.create_publisher(String, f'/{what}', 10)
    elif what in (VIDEO, PACKETS):
        publisher = node.create_publisher(CompressedImage, f'/{what}', qos_profile_sensor_data)
    else:
        publisher = node.create_publisher(Image, f'/{what}', qos_profile_sensor_data)
    if what == VIDEO:
        # by this topic beside it, the bridge knows a stream
        node.create_subscription(Empty, f'/{what}/keyframe', lambda _: None, 1)
    width, height = (640, 480) if what == VGA else (1920, 1080)
    image = Image(width=width, height=height, encoding='bgr8', step=3 * width,
                  data=os.urandom(3 * width * height) if what in (VGA, RAW) else b'')
    image.header.frame_id = 'camera'

    def shoot() -> None:
        if what == TEXT:
            publisher.publish(String(data=str(time.monotonic_ns())))
            return
        message = image
        if what in (VIDEO, PACKETS):
            message = CompressedImage(format='h264', data=next(turn))
            message.header.frame_id = 'camera'
        stamp(message.header)
        publisher.publish(message)

    node.create_timer(1 / RATES[what], shoot)
    with contextlib.suppress(KeyboardInterrupt):
        rclpy.spin(node)


def packets() -> list[bytes]:
    """Return the packets of some frames at 1080p."""
    from fogros2_examples.scene import Scene
    from image_transport_h264.codec import Encoder, Picture
    scene, encoder = Scene(1920, 1080, RATE), Encoder()
    return [bytes(encoder.encode(
        Picture(1920, 1080, 'bgr8', 3 * 1920, scene.frame(number).reshape(-1).data),
        seconds=number / RATE).data) for number in range(FRAMES)]


def decoding() -> float:
    """Return how long (ms) decoding one frame takes, for what the bridge doesn't do."""
    from image_transport_h264.codec import Decoder
    decoder, times = Decoder(), []
    for packet in packets():
        begin = time.perf_counter()
        decoder.decode(packet)
        times.append(time.perf_counter() - begin)
    return 1e3 * statistics.median(times)


# --- viewers ------------------------------------------------------------------------------------

@dataclasses.dataclass
class Seen:
    """What one viewer has got: latencies (s), bytes, and the time from first to last (s)."""

    latencies: list[float] = dataclasses.field(default_factory=list)
    sizes: list[int] = dataclasses.field(default_factory=list)
    begin: float = 0.0
    end: float = 0.0

    def add(self, sent: int, size: int) -> None:
        """Count a message that was published at ``sent`` (ns)."""
        self.end = time.monotonic()
        self.begin = self.begin or self.end
        self.latencies.append(time.monotonic_ns() / 1e9 - sent / 1e9)
        self.sizes.append(size)

    @property
    def rate(self) -> float:
        """Messages a second."""
        return (len(self.sizes) - 1) / (self.end - self.begin) if len(self.sizes) > 1 else 0.0


def sent_at(what: str, payload: bytes) -> int:
    """Return when a message was published (ns), by what the bridge sends of it."""
    if what == TEXT:
        return int(payload[8:].split(b'\0')[0])
    seconds, nanoseconds = struct.unpack_from('<iI', payload, 4)
    return seconds * 10**9 + nanoseconds


async def foxglove(url: str, what: str, seen: Seen) -> None:
    """Watch a topic by Foxglove's protocol."""
    from websockets.asyncio.client import connect
    async with connect(url, subprotocols=['foxglove.sdk.v1'], max_size=None,
                       compression=None) as link:
        async for message in link:
            if isinstance(message, bytes):
                if message[0] == 1:
                    seen.add(sent_at(what, message[13:]), len(message))
                continue
            told = json.loads(message)
            for channel in told.get('channels', ()):
                if told['op'] == 'advertise' and channel['topic'] == f'/{what}':
                    await link.send(json.dumps({'op': 'subscribe', 'subscriptions': [
                        {'id': 1, 'channelId': channel['id']}]}))


async def rosbridge(url: str, what: str, seen: Seen) -> None:
    """Watch a topic by rosbridge's protocol."""
    from websockets.asyncio.client import connect
    async with connect(url, max_size=None, compression=None) as link:
        await link.send(json.dumps({'op': 'subscribe', 'topic': f'/{what}'}))
        async for message in link:
            told = json.loads(message)['msg']
            if what == TEXT:
                seen.add(int(told['data']), len(message))
            else:
                base64.b64decode(told['data'])
                at = told['header']['stamp']
                seen.add(at['sec'] * 10**9 + at['nanosec'], len(message))


async def watch(
    viewer: Callable[..., Any], url: str, what: str, count: int, seconds: float,
    processes: list[subprocess.Popen[bytes]],
) -> tuple[list[Seen], float]:
    """Return what viewers have got, and the servers' CPU (%)."""
    crowd = [Seen() for _ in range(count)]
    tasks = [asyncio.ensure_future(viewer(url, what, seen)) for seen in crowd]
    try:
        deadline = time.monotonic() + TIMEOUT
        while not all(len(seen.sizes) > WARM_UP for seen in crowd):
            for task in tasks:
                if task.done():
                    task.result()
            if time.monotonic() > deadline:
                raise SystemExit(f'{what}: viewers got {[len(seen.sizes) for seen in crowd]}')
            await asyncio.sleep(0.1)
        for seen in crowd:
            seen.__init__()
        spent, begin = cpu(processes), time.monotonic()
        await asyncio.sleep(seconds)
        share = 100 * (cpu(processes) - spent) / (time.monotonic() - begin)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    return crowd, share


def cpu(processes: list[subprocess.Popen[bytes]]) -> float:
    """Return the seconds that processes and their children have spent so far."""
    total = 0.0
    for process in processes:
        children = Path(f'/proc/{process.pid}/task/{process.pid}/children').read_text().split()
        for pid in (process.pid, *children):
            fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
            total += (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')
    return total


# --- what is measured ---------------------------------------------------------------------------

@contextlib.contextmanager
def process(*words: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a Python program for the block."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get('PYTHONPATH', '')]))
    with tempfile.TemporaryFile() as said:
        started = subprocess.Popen([sys.executable, *words], stdout=said, stderr=said,
                                   env={**os.environ, 'PYTHONPATH': path})
        try:
            yield started
        except BaseException:
            said.seek(0)
            sys.stderr.write(said.read().decode())
            raise
        finally:
            started.send_signal(signal.SIGINT)
            try:
                started.wait(TIMEOUT)
            except subprocess.TimeoutExpired:
                started.kill()
                started.wait()


def free_port() -> int:
    """Return a port that is free now."""
    with socket.create_server(('127.0.0.1', 0)) as probe:
        return int(probe.getsockname()[1])


def listens(port: int) -> None:
    """Wait until somebody listens at a port."""
    deadline = time.monotonic() + TIMEOUT
    while True:
        with contextlib.suppress(OSError), socket.create_connection(('127.0.0.1', port), 1):
            return
        if time.monotonic() > deadline:
            raise SystemExit(f'nobody listens at {port}')
        time.sleep(0.05)


def by_bridge(what: str, count: int, seconds: float) -> tuple[list[Seen], float]:
    """Watch what a node publishes through the bridge and its gate."""
    port = free_port()
    with tempfile.TemporaryDirectory() as folder, \
            process(__file__, '--publish', what), process(
                '-m', 'fogros2_monitor.serve', '--listen', f'127.0.0.1:{port}',
                '--secrets', folder) as served:
        listens(port)
        time.sleep(1.0)  # the bridge itself, behind the gate
        token = Path(folder, 'token').read_text().strip()
        return asyncio.run(watch(foxglove, f'ws://127.0.0.1:{port}/?token={token}', what, count,
                                 seconds, [served]))


def by_rosbridge(what: str, seconds: float) -> tuple[list[Seen], float]:
    """Watch the same through rosbridge's protocol."""
    port = free_port()
    kind = ('std_msgs', 'String') if what == TEXT else ('sensor_msgs', 'Image')
    with process(__file__, '--publish', what), process(
            str(ROOT / 'benchmarks/figures/rosbridge.py'), f'/{what}', *kind,
            str(port)) as served:
        listens(port)
        return asyncio.run(watch(rosbridge, f'ws://127.0.0.1:{port}', what, 1, seconds, [served]))


def delays(crowd: list[Seen]) -> list[float]:
    """Return the latencies of all messages in ms, sorted."""
    return sorted(1e3 * each for seen in crowd for each in seen.latencies)


def dashboard(seconds: float) -> list[Row]:
    """Return what the dashboard takes where no launch runs: its first paint, and its idling."""
    from rigs.browser import Browser, program
    if program() is None:
        raise SystemExit('needs Chromium: sudo apt-get install chromium')
    with tempfile.TemporaryDirectory() as folder:
        started = subprocess.Popen(
            [sys.executable, '-c', 'from ros2cli.cli import main; main()', 'fog', 'dashboard',
             '--no-browser'], stdout=subprocess.PIPE,
            env={**os.environ, 'FOGROS2_STATE_HOME': folder})
        try:
            assert started.stdout is not None
            url = next(word for word in started.stdout.readline().decode().split()
                       if word.startswith('http'))
            with contextlib.closing(Browser()) as browser:
                paints = []
                for _ in range(5):
                    browser.open('about:blank')
                    browser.open(url)
                    paints.append(float(browser.until(
                        "(performance.getEntriesByName('first-contentful-paint')[0] || {})"
                        '.startTime')))
                time.sleep(2.0)
                spent, begin = cpu([started]), time.monotonic()
                time.sleep(seconds)
                share = 100 * (cpu([started]) - spent) / (time.monotonic() - begin)
        finally:
            started.send_signal(signal.SIGINT)
            started.wait(TIMEOUT)
    return [
        Row.of("dashboard: the page's first content is seen after", paints, 'ms', 1000.0),
        Row('dashboard: its process, idle, with the page open', share, '% CPU', 2.0)]


def configure(profile: Path) -> None:
    """Configure Fast DDS as a launch does: by default, it loses every third large image here."""
    vendor = FastDds()
    profile.write_text(vendor.render([DdsInterface('127.0.0.1')], ['127.0.0.1']))
    os.environ.update(vendor.environment(str(profile), {}))


def main(seconds: float, with_dashboard: bool, results: Path) -> None:
    """Measure one after the other."""
    os.environ.setdefault('ROS_DOMAIN_ID', '84')
    text = delays(by_bridge(TEXT, 1, seconds)[0])
    texts = delays(by_rosbridge(TEXT, seconds)[0])
    rows = [
        Row.of('bridge: a text, publish to viewer, median', text, 'ms', 5.0),
        Row('bridge: a text, 99 of 100 come within', text[int(0.99 * (len(text) - 1))], 'ms',
            runs=len(text)),
        Row.of(f'{JSON_SERVER}: a text, publish to viewer, median', texts, 'ms')]
    image, image_cpu = by_bridge(VGA, 1, seconds)
    json_image, json_cpu = by_rosbridge(VGA, seconds)
    for name, crowd, share in (('bridge', image, image_cpu), (JSON_SERVER, json_image, json_cpu)):
        rows += [
            Row.of(f'{name}: raw VGA at {RATES[VGA]:g} Hz, publish to viewer, median',
                   delays(crowd), 'ms'),
            Row(f'{name}: raw VGA, one viewer', share, '% CPU'),
            Row(f'{name}: raw VGA, an image on the wire',
                statistics.median(crowd[0].sizes) / 1e3, 'kB'),
            Row(f'{name}: raw VGA, images that come', crowd[0].rate, 'Hz')]
    video, video_cpu = by_bridge(VIDEO, VIEWERS, seconds)
    _, opaque_cpu = by_bridge(PACKETS, VIEWERS, seconds)
    raw, raw_cpu = by_bridge(RAW, 1, seconds)
    decode = decoding()
    rows += [
        Row(f'bridge: 1080p H.264 to {VIEWERS} viewers, images that come to each',
            min(seen.rate for seen in video), 'Hz', 0.98 * RATE, 'more'),
        Row.of('bridge: 1080p H.264, publish to viewer, median', delays(video), 'ms'),
        Row(f'bridge: 1080p H.264 to {VIEWERS} viewers', video_cpu, '% CPU'),
        Row('bridge: the same packets as a topic that is no video', opaque_cpu, '% CPU'),
        Row('decoding them once would take', decode * RATE / 10, '% CPU'),
        # a tenth of what decoding takes is no decoding
        Row('bridge: what being video adds', max(0.0, video_cpu - opaque_cpu), '% CPU',
            decode * RATE / 100),
        Row('bridge: raw 1080p to one viewer', raw_cpu, '% CPU'),
        Row('bridge: raw 1080p to one viewer, images that come', raw[0].rate, 'Hz')]
    if with_dashboard:
        rows += dashboard(seconds)
    write('monitor', 'Watching: the bridge to Foxglove, JSON as by rosbridge, the dashboard',
          rows, results)


if __name__ == '__main__':
    parser = argparse.ArgumentParser()
    parser.add_argument('--publish', choices=sorted(RATES))
    parser.add_argument('--short', action='store_true')
    parser.add_argument('--without-dashboard', action='store_true')
    parser.add_argument('--results', type=Path, default=RESULTS)
    arguments = parser.parse_args()
    if arguments.publish:
        publish(arguments.publish)
    else:
        with tempfile.TemporaryDirectory() as folder:
            configure(Path(folder, 'fastdds.xml'))
            main(SECONDS / 4 if arguments.short else SECONDS, not arguments.without_dashboard,
                 arguments.results)
