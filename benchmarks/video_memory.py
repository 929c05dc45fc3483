# SPDX-License-Identifier: Apache-2.0
"""Memory of encoder and decoder over 100,000 images, small ones in quick succession."""

from __future__ import annotations

import argparse
import array
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from figures import Row, write

ROOT = Path(__file__).parents[1]
WIDTH, HEIGHT, RATE = 160, 120, 400.0
sys.path.insert(0, str(ROOT))


def memory(process: subprocess.Popen[bytes]) -> float:
    """Return a process's resident memory in MiB."""
    for line in Path(f'/proc/{process.pid}/status').read_text().splitlines():
        if line.startswith('VmRSS'):
            return int(line.split()[1]) / 1024
    return 0.0


def main() -> None:
    """Send images through both nodes; compare their memory early with that at the end."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--count', type=int, default=100_000)
    count = parser.parse_args().count
    os.environ.update(ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST', ROS_DOMAIN_ID='84',
                      PYTHONPATH=os.pathsep.join(
                          [str(ROOT), os.environ.get('PYTHONPATH', '')]))
    scripts = ROOT / 'image_transport_h264/scripts'
    nodes = {
        'encoder': subprocess.Popen(
            [sys.executable, str(scripts / 'encoder'), '--ros-args', '-r', 'image:=/camera',
             '-p', 'adapt:=false']),
        'decoder': subprocess.Popen(
            [sys.executable, str(scripts / 'decoder'), '--ros-args', '-r', 'image:=/seen',
             '-p', 'stream:=/camera/h264'])}
    try:
        early, late, seen = through(nodes, count)
    finally:
        for node in nodes.values():
            node.send_signal(signal.SIGINT)
            node.wait(15)
    rows = [Row('images through both nodes', float(seen), '')]
    for name in nodes:
        rows.append(Row(f'{name}: memory after a tenth', early[name], 'MiB'))
        rows.append(Row(f'{name}: memory at the end', late[name], 'MiB', early[name] + 4))
    if count >= 100_000:
        write('video_memory', 'Memory over 100,000 images', rows)
    for row in rows:
        print(row.what, row.value, row.unit)


def through(
    nodes: dict[str, subprocess.Popen[bytes]], count: int,
) -> tuple[dict[str, float], dict[str, float], int]:
    """Publish images until so many have come; return the memory early, late, and their number."""
    import rclpy
    from sensor_msgs.msg import Image

    from fogros2_examples.scene import Scene

    scene = Scene(WIDTH, HEIGHT)
    data = [array.array('B', scene.frame(number).tobytes()) for number in range(60)]
    rclpy.init()
    node = rclpy.create_node('source')
    publisher = node.create_publisher(Image, '/camera', 2)
    seen = sent = 0

    def count_image(_: Image) -> None:
        nonlocal seen
        seen += 1

    node.create_subscription(Image, '/seen', count_image, 5)
    early: dict[str, float] = {}
    begin = time.monotonic()
    deadline = begin + 60 + count / RATE * 3
    while seen < count and time.monotonic() < deadline:
        if time.monotonic() - begin > sent / RATE:
            publisher.publish(Image(width=WIDTH, height=HEIGHT, encoding='bgr8', step=3 * WIDTH,
                                    data=data[sent % len(data)]))
            sent += 1
        rclpy.spin_once(node, timeout_sec=0.001)
        if not early and seen > count // 10:
            early = {name: memory(process) for name, process in nodes.items()}
    late = {name: memory(process) for name, process in nodes.items()}
    node.destroy_node()
    rclpy.shutdown()
    return early or late, late, seen


if __name__ == '__main__':
    main()
