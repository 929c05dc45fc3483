# SPDX-License-Identifier: Apache-2.0
"""
What transforms cost a link as they are, with a limit of their rate, and where they are denied.

A robot and a machine in network namespaces, userspace WireGuard between them. The robot publishes
``/tf`` 200 times a second with 20 child frames, a node on the machine subscribes. Bytes are those
of the robot's VPN interface, both ways. It needs ROS 2 with ``tf2_msgs``, which the wheels do not
have; middlewares that are not on this computer are left out.
"""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
import sys
import time
from typing import Any

from discovery import laboratory
from figures import machine, Row, write

from fogros2.dds import DdsVendor
from fogros2.dds.cyclonedds import CycloneDds
from fogros2.dds.fastdds import FastDds
from fogros2_features.streams.policy import Policy

ROOT = Path(__file__).parents[1]
RATE, FRAMES, LIMIT = 200.0, 20, 20.0
#: Seconds until the nodes know each other, and of the measurement.
SETTLE, SPAN = 8.0, 10.0
#: Bytes of a second at the limit: a transform has 108 in CDR with these names; 15 % are headers.
BOUND = 1.15 * LIMIT * FRAMES * 108 + 4000


def publish() -> None:
    """Publish transforms until a signal, serialized once: the processors are few."""
    from geometry_msgs.msg import TransformStamped
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from rclpy.serialization import serialize_message
    from tf2_msgs.msg import TFMessage

    rclpy.init()
    node = rclpy.create_node('state')
    publisher = node.create_publisher(TFMessage, '/tf', 100)
    message = TFMessage(transforms=[
        TransformStamped(child_frame_id=f'link_{number:02}') for number in range(FRAMES)])
    for one in message.transforms:
        one.header.frame_id = 'base_link'
    data = serialize_message(message)
    node.create_timer(1 / RATE, lambda: publisher.publish(data))
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)


def listen(topic: str) -> None:
    """Print the number of messages so far and the frames of the last one, again and again."""
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from rclpy.serialization import deserialize_message
    from tf2_msgs.msg import TFMessage

    rclpy.init()
    node = rclpy.create_node('listener')
    heard: list[bytes] = []
    node.create_subscription(TFMessage, topic, heard.append, 100, raw=True)

    def tell() -> None:
        frames = {one.child_frame_id for data in heard[-1:]
                  for one in deserialize_message(data, TFMessage).transforms}
        print(json.dumps({'count': len(heard), 'frames': len(frames)}), flush=True)

    node.create_timer(0.1, tell)
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)


def measured(vendor: DdsVendor, name: str, policy: Policy) -> tuple[float, float, float]:
    """Return bytes, messages on the machine, and processor time of the robot's end, by second."""
    with laboratory(vendor) as lab:
        def start(host: str, *words: str) -> Any:
            return lab.start(host, [sys.executable, *words], ROS_LOG_DIR=str(lab.folder),
                             **lab.configure(host))

        ends = [start(host or 'robot', str(ROOT / 'fogros2_share/scripts/limits'),
                      str(node.arguments[0])) for host, node in policy.ends('machine')]
        me = str(Path(__file__).resolve())
        listener = start('machine', me, 'listen', policy.names('machine').get('/tf', '/tf'))
        start('robot', me, 'publish')
        time.sleep(SETTLE)
        before = lab.carried('robot'), count(listener), processor(ends)
        time.sleep(SPAN)
        after = lab.carried('robot'), count(listener), processor(ends)
    carried, heard, busy = ((new - old) / SPAN for old, new in zip(before, after))
    print(f'{name}: {carried / 1e3:.1f} kB/s, {heard:.1f}/s, {100 * busy:.1f} %')
    return carried, heard, busy


def count(listener: Any) -> int:
    """Return how many messages the listener has, of which the last has all frames."""
    lines = listener.lines('count')
    return int(lines[-1]['count']) if lines and lines[-1]['frames'] == FRAMES else 0


def processor(ends: list[Any]) -> float:
    """Return the processor seconds of the robot's end, the first."""
    if not ends:
        return 0.0
    fields = Path(f'/proc/{ends[0].process.pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def main() -> None:
    """Measure each middleware."""
    rows = []
    for name, make in (('Fast DDS', FastDds), ('Cyclone DDS', CycloneDds)):
        plain, heard, _ = measured(make(), f'{name}, as it is', Policy())
        if not heard:
            print(f'{name} is not on this computer')
            continue
        limited, passed, busy = measured(
            make(), f'{name}, limited', Policy(limits={'/tf': LIMIT}))
        denied, none, _ = measured(make(), f'{name}, denied', Policy(denied=('/tf',)))
        rows += [
            Row(f'{name}: /tf as it is', plain / 1e3, 'kB/s'),
            Row(f'{name}: limited to {LIMIT:g} Hz', limited / 1e3, 'kB/s', BOUND / 1e3),
            Row(f'{name}: denied', denied / 1e3, 'kB/s', 4.0),
            Row(f'{name}: messages as they are', heard, '1/s'),
            Row(f'{name}: messages, limited', passed, '1/s', 0.95 * LIMIT, 'more'),
            Row(f'{name}: messages, denied', none, '1/s', 0.0),
            Row(f"{name}: processor of the robot's end", 100 * busy, '% of a core', 30.0)]
    write('link_policy', f'Transforms at {RATE:g} Hz with {FRAMES} child frames over the VPN',
          rows, computer=f"{machine().rpartition(', ')[0]}, ROS 2 {os.environ['ROS_DISTRO']}")


if __name__ == '__main__':
    {'publish': publish, 'listen': lambda: listen(sys.argv[2])}.get(
        ''.join(sys.argv[1:2]), main)()
