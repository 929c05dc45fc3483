# SPDX-License-Identifier: Apache-2.0
"""
Replicas whose first answer wins: calls that are lost, long waits, and what each failure costs.

Replicas are processes of this computer, except for the row of a node that dies, which takes
machines. They do not plan: they sleep for times that the planner took before, at ten times the
speed, since three planners would share this computer's cores. The times of a single replica are
not measured but computed from the same recording.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
import contextlib
import json
import os
from pathlib import Path
import random
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any

from figures import RESULTS, Row, write

NAMES = ('a', 'b', 'c')
FIRST = Path(__file__).parents[1] / 'fogros2_replicas/scripts/first_answer'
#: Recorded times of plans in seconds, each with another seed.
TIMES = RESULTS / 'planning-times.json'
#: Seconds that a replica takes for a call, number of calls, and of those that compare hops.
TAKES, CALLS, HOPS = 0.010, 10_000, 300
#: The recorded times are replayed so many times faster, in so many rounds.
FASTER, ROUNDS = 10, 200
REPLAYED = f'recorded planning times slept at {FASTER}x speed'
#: Milliseconds after which the next replica is asked, where one is lost; number of losses.
HEDGE, LOSSES = 50.0, 10
#: Nodes that die.
DEATHS = 10
#: Calls in whose midst all machines are cut off; seconds after which the robot's copy is asked.
CUT, DEADLINE = 1000, 0.2


def record(number: int) -> None:
    """Plan with so many seeds, and keep how long each plan took."""
    from fogros2_examples.planning import scene, search

    problem = scene.apartment()
    space = search.Space(problem)
    TIMES.write_text(json.dumps([
        round(space.search(problem.start, problem.goal, seconds=60.0, seed=seed).seconds, 4)
        for seed in range(1, number + 1)]) + '\n')


def waits() -> dict[str, list[float]]:
    """Return what each replica waits for in each round: recorded times in another order."""
    times = json.loads(TIMES.read_text())
    return {name: random.Random(name).choices([one / FASTER for one in times], k=ROUNDS)
            for name in NAMES}


# -- processes ----------------------------------------------------------------------------------

def serve(name: str) -> None:
    """
    Answer with the ``depth`` of a request, after TAKES seconds if its prefix is '0'.

    With '1', it is after the recorded time of that round, with '2' at once. A service of ROS 2's
    own stands for one of the user's, which would have to be built first.

    SIGUSR1 makes all waits ten times longer.
    """
    from rcl_interfaces.srv import ListParameters
    import rclpy
    from rclpy.callback_groups import ReentrantCallbackGroup
    from rclpy.executors import MultiThreadedExecutor

    recorded = waits()[name] if TIMES.exists() else []
    factor = [1]
    signal.signal(signal.SIGUSR1, lambda *_: factor.append(10))

    def answer(request: Any, response: Any) -> Any:
        (kind,) = request.prefixes
        seconds = {'0': TAKES, '1': recorded[request.depth] if kind == '1' else 0, '2': 0.0}[kind]
        time.sleep(seconds * factor[-1])
        response.result.names = [str(request.depth)]
        return response

    rclpy.init()
    node = rclpy.create_node('planner')
    node.create_service(ListParameters, f'/fogros2/{name}/plan', answer,
                        callback_group=ReentrantCallbackGroup())
    executor = MultiThreadedExecutor(24)
    executor.add_node(node)
    executor.spin()


def relay() -> None:
    """Serve ``/relayed`` by one replica, as plainly as rclpy does it."""
    from rcl_interfaces.srv import ListParameters
    import rclpy
    from rclpy.callback_groups import ReentrantCallbackGroup

    rclpy.init()
    node = rclpy.create_node('relay')
    client = node.create_client(ListParameters, '/fogros2/a/plan')

    async def answer(request: Any, response: Any) -> Any:
        return await client.call_async(request)

    node.create_service(ListParameters, '/relayed', answer,
                        callback_group=ReentrantCallbackGroup())
    rclpy.spin(node)


class Bench:
    """Replicas, ``first_answer`` and a client."""

    def __init__(
        self, hedge_after: object, stack: contextlib.ExitStack, **settings: object,
    ) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        self.folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        os.mkfifo(self.folder / 'first_answer.events')
        self._stack = stack
        self.replicas = {name: self.run('--serve', name) for name in NAMES}
        self.run('--relay')
        self._start(str(FIRST), json.dumps({
            'name': 'first_answer', 'services': ['/plan'], 'topics': [],
            'replicas': {name: f'/fogros2/{name}' for name in NAMES},
            'hedge_after': hedge_after, 'folder': str(self.folder), **settings}))
        rclpy.init()
        stack.callback(rclpy.try_shutdown)
        self._node = rclpy.create_node('bench')
        executor = SingleThreadedExecutor()
        executor.add_node(self._node)
        # rclpy's ``spin_until_future_complete`` becomes slower with each call
        spinning = threading.Thread(target=executor.spin)
        spinning.start()
        stack.callback(spinning.join)
        stack.callback(executor.shutdown)
        self._clients: dict[str, Any] = {}
        for name in ('/plan', '/relayed', *(f'/fogros2/{name}/plan' for name in NAMES)):
            self.ready(name)

    def run(self, *words: str) -> subprocess.Popen[bytes]:
        """Start a process of this file."""
        return self._start(__file__, *words)

    def _start(self, *words: str) -> subprocess.Popen[bytes]:
        process = subprocess.Popen([sys.executable, *words], stderr=subprocess.DEVNULL)
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        return process

    def ready(self, service: str) -> None:
        """Wait until a service answers."""
        from rcl_interfaces.srv import ListParameters
        self._clients[service] = self._node.create_client(ListParameters, service)
        if not self._clients[service].wait_for_service(30.0):
            raise SystemExit(f'{service} does not answer')
        for _ in range(5):
            self.call(service, 0, 2)
        time.sleep(0.5)

    def call(self, service: str, number: int, kind: int = 0, limit: float = 30.0) -> float:
        """Return the seconds that a call took; infinity if it was lost."""
        client = self._clients[service]
        answered = threading.Event()
        begin = time.perf_counter()
        future = client.call_async(client.srv_type.Request(depth=number, prefixes=[str(kind)]))
        future.add_done_callback(lambda _: answered.set())
        kept = answered.wait(limit) and future.result().result.names == [str(number)]
        return time.perf_counter() - begin if kept else float('inf')

    def tell(self, event: str) -> None:
        """Write an event, as the launch does."""
        (self.folder / 'first_answer.events').write_text(event + '\n')

    def won(self) -> dict[str, int]:
        """Return how many answers each replica gave, by the figures that are written."""
        time.sleep(2.5)
        return {row['machine']: row['won'] for row in json.loads(
            (self.folder / 'first_answer.json').read_text())}

    def nearest(self) -> str:
        """Return the replica that answers the next call, by the figures of two looks."""
        before = self.won()
        for number in range(5):
            self.call('/plan', number)
        after = self.won()
        return max(after, key=lambda name: after[name] - before[name])


@contextlib.contextmanager
def bench(hedge_after: object = None, **settings: object) -> Iterator[Bench]:
    """Start a bench, and end all of its processes."""
    with contextlib.ExitStack() as stack:
        yield Bench(hedge_after, stack, **settings)


def percentile(times: list[float], share: float = 0.99) -> float:
    """Return a percentile."""
    return sorted(times)[min(len(times) - 1, int(share * len(times)))]


# -- rows ---------------------------------------------------------------------------------------

def failures() -> list[Row]:
    """Kill one of three replicas and slow another one while calls go on."""
    times, healthy = [], []
    with bench() as there:
        for number in range(CALLS):
            if number == CALLS // 3:
                there.replicas['b'].kill()
                there.tell('died b')
            elif number == 2 * CALLS // 3:
                there.replicas['c'].send_signal(signal.SIGUSR1)
            times.append(there.call('/plan', number))
            if number % 5 == 0:
                healthy.append(there.call('/fogros2/a/plan', number))
    kept = [one for one in times if one < float('inf')]
    return [
        Row(f'{CALLS} calls, one replica killed and one slowed 10 times: lost',
            len(times) - len(kept), 'calls', 0),
        Row('the same: P99 of the healthy one, asked directly', 1e3 * percentile(healthy), 'ms'),
        Row('the same: P99', 1e3 * percentile(kept), 'ms'),
        Row('the same: P99 over that of the healthy one', percentile(kept) / percentile(healthy),
            'times', 1.2)]


def planning() -> list[Row]:
    """Replay recorded times of plans as waits, on one replica and on three."""
    recorded = waits()
    least = [min(recorded[name][number] for name in NAMES) for number in range(ROUNDS)]
    with bench() as there:
        three = [there.call('/plan', number, 1) for number in range(ROUNDS)]
        beyond = [there.call('/fogros2/a/plan', number) - TAKES for number in range(ROUNDS)]
    one = percentile([seconds for times in recorded.values() for seconds in times])
    limit = 1.05 * percentile(least) + 0.002
    return [
        Row('a call to one replica, beyond its wait: P99', 1e3 * percentile(beyond), 'ms'),
        Row(f'{REPLAYED}, one replica: P99, computed', 1e3 * one, 'ms'),
        Row(f'{REPLAYED}, three replicas: P99, computed', 1e3 * percentile(least), 'ms'),
        Row(f'{REPLAYED}, three replicas as processes: P99, measured', 1e3 * percentile(three),
            'ms', 1e3 * limit, runs=ROUNDS),
        Row(f'{REPLAYED}: P99 of one, computed, over that of three, measured',
            one / percentile(three), 'times',
            published='up to 5.53 times (FogROS2-FT, motion planning)')]


def hops() -> list[Row]:
    """Compare a call through ``first_answer`` with one through a plain relay."""
    def medians(there: Bench, services: tuple[str, ...]) -> list[float]:
        times: dict[str, list[float]] = {name: [] for name in services}
        for number in range(HOPS):
            for name in services:
                times[name].append(there.call(name, number, 2))
        return [1e3 * statistics.median(one) for one in times.values()]

    with bench(HEDGE) as there:
        bare, hedged = medians(there, ('/relayed', '/plan'))
    with bench() as there:
        again, every = medians(there, ('/relayed', '/plan'))
    return [
        Row('call through a bare rclpy relay', bare, 'ms', runs=HOPS),
        Row('call through first_answer, one replica asked', hedged, 'ms', runs=HOPS),
        Row('first_answer over the relay, one replica asked', hedged / bare, 'times', 1.3),
        Row('first_answer over the relay, three replicas asked', every / again, 'times')]


def losses() -> list[Row]:
    """Stop the replica that is asked, as if its machine were cut off; later let it go on."""
    more, normal = [], []
    with bench(HEDGE) as there:
        for number in range(200):
            normal.append(there.call('/plan', number))
        for number in range(LOSSES):
            asked = there.replicas[there.nearest()]
            asked.send_signal(signal.SIGSTOP)
            more.append(there.call('/plan', number) - statistics.median(normal))
            asked.send_signal(signal.SIGCONT)
    return [
        Row('call, nothing is lost', 1e3 * statistics.median(normal), 'ms', runs=200),
        Row('the machine that was asked is lost: more than a call, median',
            1e3 * statistics.median(more), 'ms', HEDGE + 20, runs=LOSSES),
        Row('the machine that was asked is lost: more than a call, worst', 1e3 * max(more), 'ms',
            HEDGE + 20, runs=LOSSES)]


def robot() -> list[Row]:
    """Stop both machines in the midst of calls, as if they were cut off; c is the robot's copy."""
    with bench(last='c', deadline=DEADLINE) as there:
        own = [there.call('/fogros2/c/plan', number) for number in range(CUT)]
        begin = there.won()['c']
        times = [there.call('/plan', number) for number in range(CUT // 2)]
        before = there.won()['c'] - begin
        for name in 'ab':
            there.replicas[name].send_signal(signal.SIGSTOP)
        after = [there.call('/plan', number) for number in range(CUT // 2)]
        for name in 'ab':
            there.replicas[name].send_signal(signal.SIGCONT)
    what = f'{CUT} calls, both machines stopped in the midst, the robot answers last'
    kept = [one for one in times + after if one < float('inf')]
    return [
        Row(f'{what}: lost', CUT - len(kept), 'calls', 0),
        Row('robot as last replica: its answers before the stop', before, 'calls', 0),
        Row('robot as last replica: the slowest call', 1e3 * max(kept), 'ms',
            1e3 * (DEADLINE + max(own)) + 10),
        Row('robot as last replica: median after the stop, over its copy asked directly',
            statistics.median(after) / statistics.median(own), 'times')]


def deaths() -> list[Row]:
    """Let nodes on container machines die in the middle of a call; their agents report it."""
    from rigs import replicated
    from rigs.launched import launching

    with tempfile.TemporaryDirectory() as folder, launching() as launch:
        run = launch(str(replicated.write(
            Path(folder) / 'replicated.launch.py', [f'bench-{n}' for n in range(3)], None)))
        run.wait_for('death of', times=DEATHS, timeout=300)
        run.interrupt()
        run.ended()
    normal = statistics.median(map(float, re.findall(r'call \d+ by \d: ([\d.]+) ms', run.text)))
    costs = [float(cost) - normal for cost in re.findall(
        r'death of \d: ([\d.]+) ms from then', run.text)]
    return [
        Row('call to a container machine', normal, 'ms', runs=len(costs) * replicated.BETWEEN),
        Row('the node that was asked dies: more than a call, median', statistics.median(costs),
            'ms', 50, runs=len(costs)),
        Row('the node that was asked dies: more than a call, worst', max(costs), 'ms', 50,
            runs=len(costs))]


def main(parts: list[str]) -> None:
    """Measure all rows, or those of some parts; the rows of other parts stay."""
    known: dict[str, Callable[[], list[Row]]] = {
        'failures': failures, 'planning': planning, 'hops': hops, 'losses': losses,
        'robot': robot, 'deaths': deaths}
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_DOMAIN_ID', str(os.getpid() % 90 + 1))
    rows: list[Row] = []
    for name in parts or known:
        for row in known[name]():
            rows.append(row)
            print(f'{row.what}: {row.value:.4g} {row.unit}', row.reached, flush=True)
    path = RESULTS / 'resilience.json'
    if parts and path.exists():
        new = {row.what for row in rows}
        rows += [Row(**row) for row in json.loads(path.read_text())['rows']
                 if row['what'] not in new]
    write('resilience', 'Replicas, the first answer wins', rows)


if __name__ == '__main__':
    parser = argparse.ArgumentParser()
    parser.add_argument('--record', type=int, metavar='N')
    parser.add_argument('--serve', metavar='NAME')
    parser.add_argument('--relay', action='store_true')
    parser.add_argument('parts', nargs='*')
    arguments = parser.parse_args()
    if arguments.record:
        record(arguments.record)
    elif arguments.serve:
        serve(arguments.serve)
    elif arguments.relay:
        relay()
    else:
        main(arguments.parts)
