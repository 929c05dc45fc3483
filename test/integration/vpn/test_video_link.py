# SPDX-License-Identifier: Apache-2.0
"""H.264 over a VPN whose link gets slow, loses packets, and recovers."""

from __future__ import annotations

from collections.abc import Iterator
import math
import os
from pathlib import Path
import sys
import time
from typing import Any

import pytest

pytest.importorskip('av', reason='PyAV (the extra "video") is not installed')
pytest.importorskip('cv2', reason='OpenCV (the extra "video") is not installed')
from fogros2.waiting import wait_until
from fogros2_examples.scene import Scene
from image_transport_h264.picture import Picture
from image_transport_h264.stills import encode
from ros2fog_cli.api.doctor import WIREGUARD_BUFFER

HERE = Path(__file__).parent
ROOT = HERE.parents[2]


@pytest.fixture
def middleware() -> str:
    return 'fastdds'


def start(vpn: Any, host: str, *words: str) -> Any:
    """Start a Python program on a host, configured as a launch's nodes are."""
    path = ':'.join([str(ROOT), *filter(None, [os.environ.get('PYTHONPATH')])])
    return vpn.start(host, [sys.executable, *words], group=vpn.interfaces[host].name,
                     ROS_LOG_DIR=str(vpn.folder),
                     **{**vpn.configure(host), 'PYTHONPATH': path})


def stream(
    vpn: Any, *parameters: str, codec: str = 'h264', topic: str = '/camera', links: str = '',
) -> Any:
    """Start camera and encoder on the robot, decoder and viewer on the machine; return that."""
    common = ['-p', f'codec:={codec}', '-p', f'stream:={topic}/{codec}']
    scripts = ROOT / 'image_transport_h264/scripts'
    start(vpn, 'robot', str(scripts / 'encoder'), '--ros-args', '-r', f'image:={topic}', *common,
          *parameters)
    start(vpn, 'machine', str(scripts / 'decoder'), '--ros-args', '-r', f'image:=/seen{topic}',
          *(('-p', f'links:="{links}"') if links else ()), *common)
    viewer = start(vpn, 'machine', str(HERE / 'video_node.py'), 'viewer', f'/seen{topic}')
    start(vpn, 'robot', str(HERE / 'video_node.py'), 'camera', topic).wait('ready', timeout=60.0)
    viewer.wait('image', count=30, timeout=90.0)
    return viewer


def during(viewer: Any, begin: float, seconds: float) -> list[dict[str, Any]]:
    """Return what arrived in a stretch of time that may not be over yet."""
    wait_until(lambda: time.monotonic() > begin + seconds, timeout=seconds + 30.0,
               what='the stretch to be over')
    return [line for line in viewer.lines('image')
            if begin <= line['arrival'] < begin + seconds]


def test_the_link_drops_from_5_megabit_to_a_half_and_returns(vpn: Any) -> None:
    """A second later the stream fits, nothing waits in a queue, and it recovers."""
    vpn.bad(rate=5e6, queue=1.0)
    # a quality that takes about 1.5 Mbit/s
    viewer = stream(vpn, '-p', 'quality:=11.0')

    def stretch() -> tuple[int, float]:
        latencies = sorted(line['latency'] for line in during(viewer, time.monotonic(), 2.0))
        return len(latencies), latencies[len(latencies) // 2] if latencies else math.inf

    # 60 on an idle computer, within 0.05 s
    images, latency = stretch()
    vpn.bad(rate=5e5)
    begin = time.monotonic()

    def squeezed() -> bool:
        lines = during(viewer, max(begin + 2.0, time.monotonic()), 4.0)
        latencies = sorted(line['latency'] for line in lines)
        # about 40 images on an idle computer, half of them within 0.3 to 0.4; the queue takes 1.0
        return len(lines) > 10 and latencies[len(lines) // 2] < 0.6 and latencies[-1] < 1.2

    def recovered() -> bool:
        again, late = stretch()
        return again > 0.75 * images and late < latency + 0.1

    # in the first stretch on an idle computer; a busy one's encoder adapts late
    wait_until(squeezed, timeout=60.0, what='a stream that fits')
    vpn.bad(rate=5e6)
    # after about 5 s on an idle computer
    wait_until(recovered, timeout=60.0, what='the stream of before')


def test_late_subscriber_of_a_budget_spoils_no_stream(vpn: Any) -> None:
    """Each camera would take 1.5 of 2 Mbit/s: together they stay within, and both go on."""
    vpn.bad(rate=2.5e6, queue=1.0)
    words = ('-p', 'quality:=11.0')
    links = '/fogros2/machine/link_in=2e6'

    def sent() -> int:
        name = vpn.interfaces['robot'].name
        return int(vpn.shell('robot', f'cat /sys/class/net/{name}/statistics/tx_bytes'))

    left = stream(vpn, *words, topic='/left', links=links)
    begin, before = time.monotonic(), sent()
    right = stream(vpn, *words, topic='/right', links=links)
    # the starts of the second pair are in this stretch, and the first seconds of its stream
    both = during(left, begin, time.monotonic() - begin + 4.0)
    seconds, size = time.monotonic() - begin, sent() - before
    # the right stream begins before it knows the left one; without a budget it is 2.5 Mbit/s all
    # the time, and the queue of the link fills up
    assert 8 * size / seconds < 2.25e6
    assert len(both) > seconds

    def gap(lines: list[dict[str, Any]]) -> float:
        arrivals = [line['arrival'] for line in lines]
        return max(after - one for one, after in zip(arrivals, arrivals[1:]))

    # the start of the right stream may cost the left one a key picture
    assert gap(both) < 15.0

    def flow() -> bool:
        begin = time.monotonic()
        lines = during(left, begin, 4.0), during(right, begin, 4.0)
        # 30 images a second on an idle computer, 0.1 s apart at the most; a busy one has fewer
        return all(len(one) > 20 and gap(one) < 1.0 for one in lines)

    wait_until(flow, timeout=60.0, what='two streams that flow')


def wire_seconds(rate: float) -> float:
    """Return how long a JPEG image of the camera is on a link of ``rate`` bit/s, at the least."""
    pixels = Scene(320, 240, 30.0).frame(0)
    picture = Picture(320, 240, 'bgr8', 3 * 320, pixels.reshape(-1).data)
    return len(encode(picture, 'jpeg')[1]) * 8 / rate


def test_jpeg_fills_link_and_never_queues(vpn: Any) -> None:
    """A long link takes several images at a time; the queue would hold a second of them."""
    rate, delay = 2e6, 0.1
    vpn.bad(rate=rate, delay=delay, queue=1.0)
    viewer = stream(vpn, codec='jpeg')
    wire = wire_seconds(rate)

    def full() -> bool:
        lines = during(viewer, time.monotonic() + 2.0, 5.0)
        numbers = [line['image'] for line in lines]
        assert numbers == sorted(set(numbers))
        assert all(line.get('psnr', 99.0) > 30 for line in lines)
        latencies = sorted(line['latency'] - delay for line in lines)
        # twice as many as one at a time, whose receipts take a fifth of a second; a latency is an
        # image's own time on the wire, twice: before it leaves, it waits for the one before
        return len(lines) >= 0.45 * 5.0 / wire \
            and latencies[len(latencies) // 2] < 3 * wire + 1 / 30 and latencies[-1] < 0.8

    # a busy computer may have no time for that many images at first
    wait_until(full, timeout=90.0, what='a full link without a queue')


@pytest.fixture
def receive_buffers() -> Iterator[None]:
    """As ``ros2 fog doctor`` says where the kernel has no WireGuard."""
    setting = Path('/proc/sys/net/core/rmem_default')
    before = setting.read_text()
    try:
        setting.write_text(str(max(int(before), WIREGUARD_BUFFER)))
    except OSError as error:
        pytest.skip(f'{setting} can not be set: {error.strerror}')
    try:
        yield
    finally:
        setting.write_text(before)


def test_raw_best_effort_images_arrive_whole(receive_buffers: None, lab: Any) -> None:
    """Each has 800 packets in one burst; not one may be lost, as none comes again."""
    lab.link('robot', 'e9', '192.0.2.10/24', 'machine', 'e9', '192.0.2.11/24')
    lab.connect(f"192.0.2.11:{lab.interfaces['machine'].port}")
    viewer = start(lab, 'machine', str(HERE / 'video_node.py'), 'viewer', 'best_effort')
    viewer.wait('ready', timeout=60.0)
    start(lab, 'robot', str(HERE / 'video_node.py'), 'camera', 'best_effort')
    viewer.wait('image', count=10, timeout=60.0)

    def whole() -> bool:
        lines = during(viewer, time.monotonic(), 5.0)
        expected = lines[-1]['image'] - lines[0]['image'] + 1 if lines else 0
        return len(lines) >= 0.8 * expected and expected > 25

    wait_until(whole, timeout=60.0, what='images without a loss')


def test_losses_cost_neither_pictures_nor_pixels(vpn: Any) -> None:
    """2 % of the packets lost and 20 ms each way, against the same link without a loss."""
    vpn.bad(rate=4e6, delay=0.02)
    viewer = stream(vpn)

    pictures: list[float] = []

    def stretch(loss: float) -> list[dict[str, Any]]:
        vpn.bad(loss=loss)
        return during(viewer, time.monotonic() + 1.0, 4.0)

    def median(lines: list[dict[str, Any]]) -> float:
        return sorted(line['latency'] for line in lines)[len(lines) // 2]

    def compared() -> Any:
        whole, lossy = stretch(0.0), stretch(0.02)
        pictures.extend(line['psnr'] for line in lossy if 'psnr' in line)
        return len(whole) > 20 and len(lossy) > 0.9 * len(whole) \
            and median(lossy) < median(whole) + 0.05

    # 120 images on an idle computer; a busy one encodes fewer, and not always as many
    wait_until(compared, timeout=90.0, what='two stretches with as many images')
    # smears would show at once: they cost tens of decibels
    assert len(pictures) > 2
    assert min(pictures) > 30
