# SPDX-License-Identifier: Apache-2.0
"""
Several robots: one joins another's machine, and ten share a host.

- How long a second robot needs from ``ros2 fog join`` to the first message of a machine's node.
  Two robots and a machine are in network namespaces, the second robot behind a NAT. The reference
  is the same node on the first robot, whose VPN is up, in the same run.
- Ten robots in network namespaces have a container machine each on one host, by one launch file:
  which topics of others they see, and how many of the shared messages arrive.
- How long a shared message takes from node to node, with two relays between two ROS domains. The
  reference is a bare relay of rclpy in one process with both domains, in the same run.

``--only join``, ``host`` or ``relay`` takes one of them, and prints its figures alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import contextlib
import json
import os
from pathlib import Path
import statistics
import subprocess
import sys
import tempfile
import time

from figures import markdown, Row, write
from rclpy.executors import ExternalShutdownException
from rclpy.serialization import serialize_message

from fogros2.model import Command
from fogros2.plan import DEFAULT_RMW
from fogros2.process import run
from fogros2.store import Store
from fogros2_features.guests import invitation
from fogros2_features.guests.invitation import Invitation
from fogros2_share.node import OWN, TOPICS

sys.path.insert(0, str(Path(__file__).parents[1] / 'test'))
from rigs.domains import taken
from rigs.fleet import fleet as on_host
from rigs.fleet import heard
from rigs.launched import launching
from rigs.second_robot import SecondRobot
from rigs.vpn_guest import GUEST, Guest, OUTSIDE
from rigs.vpn_lab import Child, Lab, MACHINE, NETWORK, NODE, PORT

ROOT = Path(__file__).parents[1]
RUNS = 15
#: Robots on the host; messages and turns of the relays.
ROBOTS, MESSAGES, TURNS = 10, 300, 3
LISTEN = (sys.executable, str(NODE), 'from:/map')


@contextlib.contextmanager
def fleet(folder: Path) -> Iterator[Guest]:
    """Have both robots and the machine, whose node publishes each 10 ms."""
    lab = Lab(folder)
    try:
        lab.open()
        lab.connect()
        guest = Guest(lab)
        lab.node('machine', 'to:/map', '--period', '0.01')
        yield guest
    finally:
        lab.close()


def first(child: Child, begin: float) -> float:
    """Return the seconds until a node hears its first message, and end the node."""
    arrival = child.wait('topic', '/map', timeout=30.0)[0]['arrival']
    child.stop()
    return float(arrival) - begin


def invited(guest: Guest, store: Store) -> str:
    """Admit the second robot, with the key of its state folder, and return the invitation."""
    guest.key = invitation.public_text(invitation.own_key(store))
    guest.admit(3600.0)
    return invitation.seal(Invitation(
        'planner', guest.machine_key, MACHINE, f'{OUTSIDE}:{PORT}', GUEST, NETWORK,
        DEFAULT_RMW, 0, time.time() + 3600), guest.key)


def join() -> list[Row]:
    """Take both in turn."""
    joined, alone, reference = [], [], []
    with tempfile.TemporaryDirectory() as folder, fleet(Path(folder)) as guest:
        lab, state = guest.lab, f'{folder}/second'
        text = invited(guest, Store(Path(state)))
        environment = {'FOGROS2_STATE_HOME': state}
        # compiled modules are there, as on a robot
        os.environ.pop('PYTHONDONTWRITEBYTECODE', None)
        for number in range(RUNS + 1):
            begin = time.monotonic()
            child = lab.start('guest', [
                'sh', '-ec', f'eval "$(ros2 fog join {text})"; exec "$@"', 'sh', *LISTEN],
                **environment)
            seconds = first(child, begin)
            lab.start('guest', ['ros2', 'fog', 'leave', 'planner'], **environment).process.wait(30)
            begin = time.monotonic()
            lab.start('guest', ['ros2', 'fog', 'join', text], **environment).process.wait(30)
            only = time.monotonic() - begin
            lab.start('guest', ['ros2', 'fog', 'leave', 'planner'], **environment).process.wait(30)
            begin = time.monotonic()
            there = first(lab.node('robot', 'from:/map'), begin)
            if number:  # the first fills caches
                joined.append(seconds)
                alone.append(only)
                reference.append(there)
    return [
        Row.of('ros2 fog join to the first message', joined, 's', 1.0),
        Row.of('ros2 fog join alone', alone, 's'),
        Row.of('the same node on the first robot, whose VPN is up', reference, 's'),
        Row.of('joining, more than that node',
               [one - other for one, other in zip(joined, reference)], 's')]


def host() -> list[Row]:
    """Have ten robots on one host, with one launch file and one shared topic."""
    with contextlib.ExitStack() as undo:
        folder = Path(undo.enter_context(tempfile.TemporaryDirectory()))
        robots = [SecondRobot(folder / f'r{number}', number) for number in range(ROBOTS)]
        for robot in robots:
            undo.callback(robot.close)
            robot.open()
            run(Command.script(f'echo 1 >/proc/sys/net/ipv4/conf/{robot.spaces[0]}/forwarding',
                               sudo=True), timeout=10.0)
        shared = undo.enter_context(on_host(folder / 'host', robots[0].host))
        start, path = undo.enter_context(launching()), shared.launch_file()
        launches = [start(
            str(path), f'robot:=r{number}', environment=robot.environment,
            prefix=['ip', 'netns', 'exec', robot.spaces[1]])
            for number, robot in enumerate(robots)]
        for one in launches:
            for other in range(ROBOTS):
                one.wait_for(f'heard map of r{other}', timeout=1800.0)
        for one in launches:
            one.wait_for('sees ', times=one.text.count('sees ') + 20, timeout=300.0)
        foreign = sum(len(heard(one, 'sees') - {'', f'/of_r{number}'}) + len(
            heard(one, 'heard') - {f'count of r{number}', *(
                f'map of r{other}' for other in range(ROBOTS))})
                      for number, one in enumerate(launches))
        maps = sum(line.startswith('map of') for one in launches for line in heard(one, 'heard'))
        for one in launches:
            one.interrupt()
        for one in launches:
            one.ended(300.0)
    return [
        Row('10 robots on a host: topics and messages of another robot', foreign, 'seen', 0.0),
        Row('10 robots on a host: shared messages that arrive, of 100', maps, 'messages', 100.0,
            'more')]


def latency(folder: Path, domains: Sequence[str], size: int, bare: bool) -> float:
    """Return the median of the seconds from a node of one domain to a node of another one."""
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node
    from std_msgs.msg import ByteMultiArray

    with contextlib.ExitStack() as undo:
        nodes = []
        for number, domain in enumerate(domains):
            context = Context()
            rclpy.init(context=context, domain_id=int(domain))
            undo.callback(context.try_shutdown)
            node = Node(f'end{number}', context=context)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)
            nodes.append((node, executor))
            undo.callback(node.destroy_node)
        for number, words in enumerate([[str(Path(__file__)), '--bare', *domains]] if bare else [[
                str(ROOT / 'fogros2_share/scripts/share'), json.dumps({
                    'topics': ['/data'], 'folders': [str(folder / domain / OWN), str(folder)]})]
                for domain in domains]):
            (folder / domains[number] / OWN).mkdir(parents=True, exist_ok=True)
            (folder / domains[number] / TOPICS).write_text('/data\n')
            child = subprocess.Popen([sys.executable, *words], env={
                **os.environ, 'ROS_DOMAIN_ID': domains[number]})
            undo.callback(child.wait)
            undo.callback(child.terminate)
        (source, _), (target, executor) = nodes
        heard_at: list[float] = []
        target.create_subscription(
            ByteMultiArray, '/data', lambda _: heard_at.append(time.perf_counter()), 10, raw=True)
        publisher = source.create_publisher(ByteMultiArray, '/data', 10)
        data = serialize_message(ByteMultiArray(data=[bytes(1)] * size))
        took: list[float] = []
        deadline = time.monotonic() + 120
        while len(took) < MESSAGES + 20 and time.monotonic() < deadline:
            heard_at.clear()
            begin = time.perf_counter()
            publisher.publish(data)
            while not heard_at and time.perf_counter() - begin < 0.5:
                executor.spin_once(timeout_sec=0.05)
            took += [one - begin for one in heard_at[:1]]
            time.sleep(0.002)
        return statistics.median(took[20:])


def bare_relay(domains: Sequence[str]) -> None:
    """Pass a topic from one domain to another, with rclpy alone."""
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node
    from std_msgs.msg import ByteMultiArray

    contexts = [Context(), Context()]
    for context, domain in zip(contexts, domains):
        rclpy.init(context=context, domain_id=int(domain))
    source, target = (Node('bare', context=context) for context in contexts)
    publisher = target.create_publisher(ByteMultiArray, '/data', 10)
    source.create_subscription(ByteMultiArray, '/data', publisher.publish, 10, raw=True)
    executor = SingleThreadedExecutor(context=contexts[0])
    executor.add_node(source)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        executor.spin()


def relay() -> list[Row]:
    """Take both ways in turn, for small and large messages."""
    rows = []
    with contextlib.ExitStack() as undo:
        folder = Path(undo.enter_context(tempfile.TemporaryDirectory(prefix='fogb')))
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        for size, label in ((1000, '1 kB'), (1_000_000, '1 MB')):
            times: dict[bool, list[float]] = {True: [], False: []}
            for turn in range(TURNS):
                for bare in (True, False):
                    sockets = folder / f'{size}-{turn}'
                    sockets.mkdir(exist_ok=True)
                    with taken() as first_domain, taken() as second_domain:
                        times[bare].append(latency(
                            sockets, [first_domain, second_domain], size, bare))
            ours, theirs = ([1e3 * time for time in times[bare]] for bare in (False, True))
            rows += [
                Row.of(f'shared message of {label}, node to node', ours, 'ms'),
                Row.of(f'the same by a bare relay of rclpy, {label}', theirs, 'ms'),
                Row.of(f'shared messages of {label}, of the bare relay',
                       [one / other for one, other in zip(ours, theirs)], 'times', 1.3)]
    return rows


def main() -> None:
    """Measure all, or what ``--only`` names."""
    if sys.argv[1:2] == ['--bare']:
        bare_relay(sys.argv[2:])
    elif sys.argv[1:2] == ['--only']:
        found = {'join': join, 'host': host, 'relay': relay}[sys.argv[2]]()
        print(markdown('A part', found, ''))
    else:
        write('fleet', 'Several robots', [*join(), *host(), *relay()])


if __name__ == '__main__':
    main()
