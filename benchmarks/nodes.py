# SPDX-License-Identifier: Apache-2.0
"""
Nodes of ``rclpy`` from the wheels, and beside them from ROS 2 where that is installed.

Both run as they come, with Fast DDS, on this computer. ``ROS2_SETUP`` names the set-up script of a
ROS 2 that isn't in ``/opt/ros/jazzy``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
import contextlib
import json
import os
from pathlib import Path
import statistics
import subprocess
import sys
import time
from typing import Any

from figures import Row, write

ROOT = Path(__file__).parents[1]
SETUP = Path(os.environ.get('ROS2_SETUP', '/opt/ros/jazzy/setup.sh'))
LIMIT = 60.0  # seconds until something that should happen hasn't

WIDTH, HEIGHT, RATE, IMAGES = 1920, 1080, 30.0, 300
ROUNDS = 400  # round trips, after as many to warm up
IMPORTS = 15
PROCESSES, NODES, TOPICS = 20, 50, 200
MESSAGES, EARLY = 100_000, 10_000


# --- what the processes do ----------------------------------------------------------------------

def say(**values: float) -> None:
    """Tell the process that started this one."""
    print(json.dumps(values), flush=True)


def until(node: Any, happened: Callable[[], object]) -> None:
    """Spin until something has happened."""
    import rclpy

    deadline = time.monotonic() + LIMIT
    while not happened():
        rclpy.spin_once(node, timeout_sec=0.02)
        if time.monotonic() > deadline:
            raise SystemExit('it did not happen')


def resident() -> float:
    """Return this process's resident memory in MiB."""
    for line in Path('/proc/self/status').read_text().splitlines():
        if line.startswith('VmRSS'):
            return int(line.split()[1]) / 1024
    raise SystemExit('no VmRSS')


def importing() -> None:
    """Time ``import rclpy``."""
    begin = time.perf_counter()
    import rclpy
    imported = time.perf_counter() - begin
    rclpy.init()
    rclpy.create_node('first')
    say(imported=imported * 1e3, node=(time.perf_counter() - begin) * 1e3)


def echo() -> None:
    """Send back each String; tell the memory early and at the end."""
    import rclpy
    from std_msgs.msg import String

    rclpy.init()
    node = rclpy.create_node('echo')
    publisher = node.create_publisher(String, 'pong', 10)
    count = 0

    def back(message: Any) -> None:
        nonlocal count
        count += 1
        if count in (EARLY, MESSAGES):
            say(resident=resident())
        publisher.publish(message)

    node.create_subscription(String, 'ping', back, 10)
    rclpy.spin(node)


def pings(number: int) -> Iterator[float]:
    """Send Strings to who echoes and yield how long each took, in seconds."""
    import rclpy
    from std_msgs.msg import String

    rclpy.init()
    node = rclpy.create_node('ping')
    publisher = node.create_publisher(String, 'ping', 10)
    came: list[str] = []
    node.create_subscription(String, 'pong', lambda message: came.append(message.data), 10)
    until(node, lambda: publisher.get_subscription_count() and node.count_publishers('pong'))
    for index in range(number):
        text = str(index)
        begin = time.perf_counter()
        publisher.publish(String(data=text))
        until(node, lambda: came)
        yield time.perf_counter() - begin
        if came != [text]:
            raise SystemExit(f'sent {text}, and {came} came back')
        came.clear()


def trips() -> None:
    """Time round trips of a String."""
    times = list(pings(2 * ROUNDS))[ROUNDS:]
    say(median=statistics.median(times) * 1e3)


def many() -> None:
    """Send many Strings and tell the memory early and at the end."""
    for index, _ in enumerate(pings(MESSAGES), 1):
        if index in (EARLY, MESSAGES):
            say(resident=resident())


def camera() -> None:
    """Publish images."""
    import array

    import rclpy
    from sensor_msgs.msg import Image

    rclpy.init()
    node = rclpy.create_node('camera')
    publisher = node.create_publisher(Image, 'image', 10)
    image = Image(height=HEIGHT, width=WIDTH, encoding='bgr8', step=3 * WIDTH)
    image.data = array.array('B', os.urandom(3 * WIDTH * HEIGHT))
    until(node, lambda: node.count_publishers('viewing'))
    begin = time.monotonic()
    for index in range(IMAGES):
        time.sleep(max(begin + index / RATE - time.monotonic(), 0.0))
        image.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(image)
    until(node, lambda: not publisher.get_subscription_count())


def viewer() -> None:
    """Receive images; tell how many came, and how late."""
    import rclpy
    from sensor_msgs.msg import Image

    rclpy.init()
    node = rclpy.create_node('viewer')
    late: list[float] = []
    last = time.monotonic()

    def take(image: Any) -> None:
        nonlocal last
        last = time.monotonic()
        stamp = image.header.stamp
        late.append(time.time() - stamp.sec - stamp.nanosec / 1e9)

    subscription = node.create_subscription(Image, 'image', take, 10)
    until(node, subscription.get_publisher_count)
    node.create_publisher(Image, 'viewing', 1)  # says that from now on no image may be lost
    until(node, lambda: late)
    until(node, lambda: len(late) == IMAGES or time.monotonic() - last > 2.0)
    say(came=len(late), late=statistics.median(late) * 1e3)


def crowd(index: int) -> None:
    """Be one of the processes that find each other; tell when this one knew all."""
    import rclpy
    from std_msgs.msg import String

    begin = float(sys.stdin.readline())
    rclpy.init()
    own = range(index, NODES, PROCESSES)
    nodes = [rclpy.create_node(f'node_{number}', namespace='/crowd') for number in own]
    publishers = [node.create_publisher(String, f'topic_{number}_{part}', 1)
                  for number, node in zip(own, nodes) for part in range(TOPICS // NODES)]

    def all_known() -> bool:
        names = [name for name, space in nodes[0].get_node_names_and_namespaces()
                 if space == '/crowd']
        topics = [name for name, _ in nodes[0].get_topic_names_and_types()
                  if name.startswith('/crowd/topic_')]
        return len(names) >= NODES and len(topics) >= TOPICS

    until(nodes[0], all_known)
    say(known=time.monotonic() - begin)
    sys.stdin.readline()  # stay until all know all
    assert publishers


# --- measuring ----------------------------------------------------------------------------------

class Ros:
    """An interpreter with ``rclpy``."""

    def __init__(self, name: str, command: list[str]) -> None:
        self.name, self.command = name, command
        keep = ('HOME', 'LANG', 'PATH', 'FOGROS2_VENV')
        self.environment = {key: os.environ[key] for key in keep if key in os.environ}
        self.environment.update(
            ROS_DOMAIN_ID='87',
            ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST', PYTHONUNBUFFERED='1')

    @contextlib.contextmanager
    def role(self, *words: str, **environment: str) -> Iterator[subprocess.Popen[str]]:
        """Run this script in one of its roles, until the block ends."""
        with subprocess.Popen(
                [*self.command, __file__, *words], env={**self.environment, **environment},
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
            try:
                yield process
            finally:
                process.terminate()

    def ask(self, *words: str) -> dict[str, float]:
        """Run this script in a role that says one thing."""
        with self.role(*words) as process:
            return hear(process)

    def imports(self) -> list[Row]:
        """Measure how long importing takes."""
        runs = [self.ask('importing') for _ in range(IMPORTS + 1)][1:]
        return [
            self.row('import rclpy', statistics.median(run['imported'] for run in runs), 'ms',
                     250, IMPORTS),
            self.row('import rclpy until there is a node',
                     statistics.median(run['node'] for run in runs), 'ms', None, IMPORTS)]

    def round_trips(self) -> list[Row]:
        """Measure round trips between two processes."""
        with self.role('echo'):
            said = self.ask('trips')
        return [self.row('String round trip, median', said['median'], 'ms', 0.5, ROUNDS)]

    def images(self) -> list[Row]:
        """Measure images between two processes."""
        with self.role('viewer') as viewing, self.role('camera'):
            seen = hear(viewing)
        return [
            self.row(f'{IMAGES} images of {WIDTH}x{HEIGHT}: lost', IMAGES - seen['came'], 'images',
                     None, IMAGES),
            self.row('an image, published to callback', seen['late'], 'ms', None,
                     int(seen['came']))]

    def discovery(self) -> list[Row]:
        """Measure how long many nodes take to find each other."""
        with contextlib.ExitStack() as stack:
            crowd = [stack.enter_context(self.role('crowd', str(index)))
                     for index in range(PROCESSES)]
            time.sleep(3.0)  # until the interpreters wait for the word
            begin = time.monotonic()
            for process in crowd:
                assert process.stdin is not None
                process.stdin.write(f'{begin}\n')
                process.stdin.flush()
            known = [hear(process)['known'] for process in crowd]
        return [self.row(f'{NODES} nodes, {TOPICS} topics in {PROCESSES} processes: all know all',
                         max(known), 's', 5, 1)]

    def memory(self) -> list[Row]:
        """Measure how memory grows over many messages."""
        with self.role('echo') as echoing, self.role('many') as sending:
            grown = [(-hear(process)['resident'] + hear(process)['resident'])
                     for process in (sending, echoing)]
        return [self.row(f'memory more after {MESSAGES} Strings than after {EARLY}', max(grown),
                         'MiB', 1, 1)]

    def row(self, what: str, value: float, unit: str, target: float | None, runs: int) -> Row:
        """Make a row; targets are for the wheels."""
        return Row(f'{what}: {self.name}', value, unit,
                   target if self.name == WHEELS else None, runs=runs)


WHEELS = 'wheels'


def hear(process: subprocess.Popen[str]) -> dict[str, float]:
    """Wait for the next thing that a process says."""
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise SystemExit(f'{process.args!r} ended without a word')
    said: dict[str, float] = json.loads(line)
    return said


def main() -> None:
    """Measure on both, one figure after the other."""
    both = []
    if Path(os.environ.get('FOGROS2_VENV', ROOT / '.venv')).is_dir():
        both.append(Ros(WHEELS, [str(ROOT / 'tools/run.sh'), 'embedded', '--', 'python']))
    if SETUP.is_file():
        both.append(Ros('ROS 2', ['sh', '-c', f'. "{SETUP}" && exec python3 "$@"', 'sh']))
    rows = [row for measure in (Ros.imports, Ros.round_trips, Ros.images, Ros.discovery,
                                Ros.memory)
            for ros in both for row in measure(ros)]
    write('nodes', 'Nodes of rclpy, from the wheels and from ROS 2', rows)


ROLES = {role.__name__: role for role in (echo, trips, many, camera, viewer)}

if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('role', nargs='?')
    parser.add_argument('index', nargs='?', type=int, default=0)
    arguments = parser.parse_args()
    if arguments.role == 'crowd':
        crowd(arguments.index)
    elif arguments.role == 'importing':
        importing()
    elif arguments.role:
        from rclpy.executors import ExternalShutdownException
        with contextlib.suppress(ExternalShutdownException):  # it isn't needed any more
            ROLES[arguments.role]()
    else:
        main()
