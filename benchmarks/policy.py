# SPDX-License-Identifier: Apache-2.0
"""
Observations of a robot here to a policy on a container machine, and its actions back.

Three VGA cameras and the joint state go at 30 Hz over WireGuard and a relay that limits the link
to 20 Mbit/s and delays it by 5 ms each way. The policy is an ONNX model that takes no time, with
chunks of 50 actions. The nodes are those of ``fogros2_examples.policy`` and the streams' own.

The control case loses 2 % of the packets for ten minutes, and then cuts the link for 5 s. The
other cases send the same observations through openpi's client and server, over a WebSocket in the
same VPN: raw, and as JPEG. ``--short`` takes a tenth of everything.
"""

from __future__ import annotations

import argparse
import array
import contextlib
import dataclasses
import json
import math
import os
from pathlib import Path
import statistics
import subprocess
import sys
import time
from typing import Any, Optional

from applications import words
from streaming import (
    answer_of,
    codec_alone,
    end,
    FOLDER,
    frames,
    hop_alone,
    launched,
    Link,
    Output,
    put,
    shown,
)

HERE = Path(__file__).parent
ROOT = HERE.parent
CAMERAS = ('front', 'left', 'wrist')
JOINTS = [f'joint{number}' for number in range(1, 7)]
STEPS = 50
RATE, LINK, DELAY = 30.0, 20e6, 0.005
#: Observations before those that count, and seconds that the link is cut for.
WARM_UP, CUT = 90, 5.0
MODEL = f'{FOLDER}/policy.onnx'
PORT = 8123
JPEG_QUALITY = 80


# --- the programs, each a process of its own ----------------------------------------------------

def robot(count: int) -> None:
    """Publish observations, take what the policy and the client answer; print a JSON line."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import Image, JointState, TimeReference
    from std_msgs.msg import Float64MultiArray
    from trajectory_msgs.msg import JointTrajectory

    from fogros2_examples.slam.messages import nanoseconds

    data = [array.array('B', frame.tobytes()) for frame in frames(640, 480, '')]
    rclpy.init()
    node = rclpy.create_node('robot')
    images = {name: node.create_publisher(Image, f'/{name}/image', 2) for name in CAMERAS}
    states = node.create_publisher(JointState, '/joint_states', qos_profile_sensor_data)
    sent: dict[int, float] = {}
    answered: dict[int, float] = {}
    commands: list[float] = []
    actions: list[tuple[float, float, float]] = []

    def observe() -> None:
        stamp = node.get_clock().now()
        sent[stamp.nanoseconds] = time.monotonic()
        state = JointState(name=JOINTS, position=[0.0] * len(JOINTS))
        state.header.stamp = stamp.to_msg()
        states.publish(state)
        for number, name in enumerate(CAMERAS):
            image = Image(height=480, width=640, encoding='bgr8', step=1920,
                          data=data[shown(len(sent) + 20 * number)])
            image.header.stamp = state.header.stamp
            images[name].publish(image)
        if len(sent) == WARM_UP:
            print(json.dumps({'begin': True}), flush=True)

    node.create_subscription(
        JointTrajectory, '/action_chunk', lambda chunk: answered.setdefault(
            nanoseconds(chunk.header.stamp), time.monotonic()), qos_profile_sensor_data)
    node.create_subscription(
        Float64MultiArray, '/commands', lambda _: commands.append(time.monotonic()), 10)
    node.create_subscription(
        TimeReference, '/action_source', lambda source: actions.append((
            time.monotonic(), 1e-9 * (nanoseconds(source.header.stamp)
                                      - nanoseconds(source.time_ref)),
            1e-9 * nanoseconds(source.header.stamp))), 10)
    node.create_timer(1 / RATE, observe)
    deadline = time.monotonic() + count / RATE + 60
    while len(sent) < WARM_UP + count and time.monotonic() < deadline:
        rclpy.spin_once(node, timeout_sec=0.1)
    after = time.monotonic() + 1
    while time.monotonic() < after:
        rclpy.spin_once(node, timeout_sec=0.1)
    counted = list(sent.items())[WARM_UP:]
    print(json.dumps({
        'trips': [answered.get(stamp, math.inf) - when for stamp, when in counted],
        'commands': commands, 'actions': actions, 'begin': counted[0][1]}), flush=True)


def serve(address: str) -> None:
    """Serve a policy of no time by openpi's own server, for raw images and JPEG."""
    import cv2
    import numpy
    from openpi_server import WebsocketPolicyServer

    class Policy:
        def infer(self, seen: dict[str, Any]) -> dict[str, Any]:
            """Take the images as a policy would, decoded."""
            for name in CAMERAS:
                image = seen[name]
                if image.ndim == 1:
                    image = cv2.imdecode(image, cv2.IMREAD_COLOR)
                assert image.shape == (480, 640, 3)
            return {'actions': numpy.zeros((STEPS, len(JOINTS)))}

    WebsocketPolicyServer(Policy(), address, PORT).serve_forever()


def ask(address: str, count: int, jpeg: bool) -> None:
    """Send observations through openpi's client, one after the other; print a JSON line."""
    import cv2
    import numpy
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    data = frames(640, 480, '')
    deadline = time.monotonic() + 60
    while True:
        try:
            client = WebsocketClientPolicy(address, PORT)
            break
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)
    trips: list[float] = []
    for turn in range(count + 3):
        images = [numpy.ascontiguousarray(data[shown(turn + 20 * number)])
                  for number in range(len(CAMERAS))]
        if turn == 3:
            print(json.dumps({'begin': True}), flush=True)
        begin = time.perf_counter()
        if jpeg:
            images = [cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
                      for image in images]
        client.infer({**dict(zip(CAMERAS, images)), 'state': numpy.zeros(len(JOINTS)),
                      'prompt': 'reach'})
        trips.append(time.perf_counter() - begin)
    print(json.dumps({'trips': trips[3:]}), flush=True)


# --- over the link ------------------------------------------------------------------------------

@dataclasses.dataclass
class Outcome:
    """
    What a case came to: times in ms.

    :param size: bytes that the robot sent for an observation, all headers included.
    :param lost: observations without an answer.
    :param starved: ticks of the control loop without an action, before a cut.
    :param stopped: from the last action in a cut to the first tick without; ``resumed`` from the
        end of the cut to the first action.
    :param limit: sum of the parts of the median, each measured or computed alone.
    """

    name: str
    median: float
    p95: float
    size: float
    count: int
    lost: int = 0
    age: float = math.nan
    starved: int = 0
    ticks: int = 0
    stopped: float = math.nan
    resumed: float = math.nan
    limit: float = math.nan


def at(times: list[float], share: float) -> float:
    """Return a quantile in ms."""
    ordered = sorted(times)
    return 1e3 * ordered[min(len(ordered) - 1, int(share * len(ordered)))]


def model() -> bytes:
    """Return a policy that stays where it is, whatever it sees."""
    import numpy

    from fogros2_examples.policy.onnx_file import perceptron
    layer = numpy.zeros((3 * 192 + len(JOINTS), STEPS * len(JOINTS)), numpy.float32)
    # perceptron writes the number of joints of its own state
    return perceptron({f'observation.images.{name}': (1, 3, 8, 8) for name in CAMERAS},
                      [(layer, layer[0])], STEPS)


def controlled(name: str, launch: Any, machine: Any, link: Link, output: Output, count: int,
               loss: float, cut: bool) -> Outcome:
    """Run the policy's nodes, the robot and the streams to the end of ``count`` observations."""
    from fogros2.model import NodeSpec
    from fogros2.waiting import wait_until

    environment = {**os.environ, **launch.robot_environment(), 'PYTHONPATH': str(ROOT)}
    link.change(rate=LINK, delay=DELAY, loss=loss)

    def coding(role: str, camera: str, topic: str) -> list[str]:
        return [*words(f'image_transport_h264.{role}', f'stream:=/{camera}/image/h264'),
                '-r', f'image:={topic}']

    images = [f'observation.images.{camera}=/decoded/{camera}' for camera in CAMERAS]
    there = {f'decoder-{camera}-{name}': coding('decoder', camera, f'/decoded/{camera}')
             for camera in CAMERAS}
    there[f'server-{name}'] = words(
        'fogros2_examples.policy.policy_server', f'policy:={MODEL}',
        f'images:={json.dumps(images)}', f"states:=['observation.state={','.join(JOINTS)}']")
    machine.start([NodeSpec(node, node, arguments=tuple(each),
                            environment={'PYTHONPATH': FOLDER}) for node, each in there.items()])
    here: list[subprocess.Popen[Any]] = []
    began = ended = math.nan
    try:
        for each in (*(coding('encoder', camera, f'/{camera}/image') for camera in CAMERAS),
                     words('fogros2_examples.policy.policy_client',
                           f'joints:={json.dumps(JOINTS)}',
                           f"images:={json.dumps([f'/{name}/image' for name in CAMERAS])}")):
            here.append(subprocess.Popen(each, env=environment))
        more = round((CUT + 5) * RATE) if cut else 0
        source = subprocess.Popen(
            [sys.executable, __file__, '--robot', '--count', str(count + more)], env=environment,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        here.append(source)
        assert source.stdout is not None
        source.stdout.readline()
        begin, sent = time.monotonic(), link.sent()
        if cut:
            span = count / RATE
            wait_until(lambda: time.monotonic() > begin + span, timeout=span + 5,
                       what='the observations before the cut')
            sent = link.sent() - sent
            began = time.monotonic()
            link.change(cut=True)
            wait_until(lambda: time.monotonic() > began + CUT, timeout=CUT + 5, what='the cut')
            ended = time.monotonic()
            link.change(cut=False)
        told = answer_of(source, 'the robot', (count + more) / RATE + 120)
        if not cut:
            sent = link.sent() - sent
    finally:
        for process in reversed(here):
            end(process)
        machine.stop(list(there))
        wait_until(lambda: set(there) <= output.ended, timeout=60.0,
                   what='the nodes on the machine to end')
        link.change(rate=0.0, delay=0.0, loss=0.0)
    trips = told['trips'][:count]
    arrived = [trip for trip in trips if math.isfinite(trip)]
    if not arrived:
        raise RuntimeError(f'no action came\n{output.last(*there)}')
    last = began if cut else math.inf
    actions = [when for when, *_ in told['actions']]
    # by the clock of the client, which has a tick every 1 / RATE
    stamps = [stamp for when, _, stamp in told['actions'] if told['begin'] < when < last]
    ticks = 1 + round((stamps[-1] - stamps[0]) * RATE)
    done = Outcome(
        name, at(arrived, 0.5), at(arrived, 0.95), sent / count, count, len(trips) - len(arrived),
        1e3 * statistics.median(age for _, age, _ in told['actions']),
        ticks - len(stamps), ticks)
    if cut:
        before = max(when for when in actions if when < ended)
        done.stopped = 1e3 * (min(when for when in told['commands'] if when > before + 1e-3)
                              - before)
        done.resumed = 1e3 * (min((when for when in actions if when > ended), default=math.inf)
                              - ended)
    return done


def websocket(name: str, launch: Any, machine: Any, link: Link, output: Output, count: int,
              jpeg: bool) -> Outcome:
    """Send observations by openpi's client and server, one after the other."""
    from fogros2.model import NodeSpec
    from fogros2.waiting import wait_until

    address = machine.vpn_address
    server = f'openpi-{name.replace(" ", "-")}'
    machine.start([NodeSpec(
        server, server, environment={'PYTHONPATH': FOLDER}, arguments=(
            sys.executable, f'{FOLDER}/policy.py', '--serve', '--address', address))])
    client: Optional[subprocess.Popen[str]] = None
    try:
        link.change(rate=LINK, delay=DELAY, loss=0.0)
        client = subprocess.Popen(
            [sys.executable, __file__, '--ask', '--address', address, '--count', str(count),
             *(['--jpeg'] if jpeg else [])], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, env={**os.environ, 'PYTHONPATH': str(ROOT)})
        assert client.stdout is not None
        client.stdout.readline()
        sent = link.sent()
        trips = answer_of(client, 'the client of openpi', 10 * count + 120)['trips']
        sent = link.sent() - sent
    finally:
        end(client)
        machine.stop([server])
        wait_until(lambda: server in output.ended, timeout=60.0, what='the server to end')
        link.change(rate=0.0, delay=0.0, loss=0.0)
    # whatever it takes besides, these bytes cross the link, and an answer comes back
    return Outcome(name, at(trips, 0.5), at(trips, 0.95), sent / count, count,
                   limit=1e3 * (sent / count * 8 / LINK + 2 * DELAY))


# --- all of it ----------------------------------------------------------------------------------

def table(outcomes: list[Outcome], note: str) -> str:
    """Return the figures as Markdown."""
    lines = ['# Policies on another machine', '', note, '',
             '| observations | to an action, ms: median | p95 | limit | bytes/observation | '
             'unanswered | age of an action, ms | ticks without action | stopped after, ms | '
             'resumed after, ms |', '|---' * 10 + '|']

    def shown_as(value: float) -> str:
        return '' if math.isnan(value) else f'{value:.1f}'

    lines += [f'| {o.name} | {o.median:.1f} | {o.p95:.1f} | {shown_as(o.limit)} | {o.size:.0f} | '
              f'{o.lost} of {o.count} | {shown_as(o.age)} | '
              f"{f'{o.starved} of {o.ticks}' if o.ticks else ''} | {shown_as(o.stopped)} | "
              f'{shown_as(o.resumed)} |' for o in outcomes]
    return '\n'.join([*lines, ''])


def prepare_policy(machine: Any) -> None:
    """Put onto the machine what its nodes need."""
    put(machine, 'image_transport_h264', 'fogros2_examples', 'policy.py', 'applications.py',
        'streaming.py', 'figures')
    machine.shell.put(model(), MODEL, mode=0o644)


def main() -> None:
    """Measure all cases, write the figures down."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--short', action='store_true')
    for hidden in ('--robot', '--serve', '--ask', '--jpeg'):
        parser.add_argument(hidden, action='store_true', help=argparse.SUPPRESS)
    parser.add_argument('--address', default='', help=argparse.SUPPRESS)
    parser.add_argument('--count', type=int, default=1800, help='observations of the first case')
    arguments, _ = parser.parse_known_args()
    if arguments.robot:
        return robot(arguments.count)
    if arguments.serve:
        with contextlib.suppress(KeyboardInterrupt):
            serve(arguments.address)
        return None
    if arguments.ask:
        return ask(arguments.address, arguments.count, arguments.jpeg)
    from figures import machine as computer
    from figures import RESULTS, Row, write

    less = 10 if arguments.short else 1
    outcomes: list[Outcome] = []
    # three cameras share the cores; each image is handed on twice, as in ``streaming``
    share = len(CAMERAS) / min(len(CAMERAS), os.cpu_count() or 1)
    parts = share * (2 * hop_alone('VGA') + sum(codec_alone('VGA')))
    with launched(f'bench-policy-{os.getpid()}', prepare_policy) as (
            launch, machine, link, output):
        for name, count, jpeg in (('WebSocket, JPEG', 300, True), ('WebSocket, raw', 30, False)):
            outcomes.append(websocket(name, launch, machine, link, output, count // less, jpeg))
            print(outcomes[-1], flush=True)
        for name, count, loss, cut in (
                ('H.264', arguments.count, 0.0, False),
                ('H.264, 2 % loss, then a cut of 5 s', round(600 * RATE), 0.02, True)):
            outcomes.append(controlled(name.replace(' ', '-').replace('%', 'percent').replace(
                ',', ''), launch, machine, link, output, count // less, loss, cut))
            outcomes[-1].name = name
            print(outcomes[-1], flush=True)
        for outcome in outcomes[2:]:
            outcome.limit = parts + 1e3 * (outcome.size * 8 / LINK + 2 * DELAY)
    text = table(outcomes, f'{computer()}; three VGA cameras at {RATE:.0f} Hz, '
                 f'{LINK / 1e6:.0f} Mbit/s and {1e3 * DELAY:.0f} ms each way; the policy itself '
                 f'takes no time. openpi sends an observation when the last one is answered.')
    print(text)
    if arguments.short:
        return None
    first, control = outcomes[2:]
    tick = 1e3 / RATE
    rows = [Row('three cameras: observation to action, median', first.median, 'ms', 40.0),
            Row('three cameras: the same, sum of its parts', first.limit, 'ms'),
            Row('three cameras: observation to action, p95', first.p95, 'ms', 60.0),
            Row('2 % loss: ticks without an action', control.starved, '', 0.0),
            Row('cut: from the last action to the stop', control.stopped, 'ms', 200.0),
            Row('cut: the same, one tick', tick, 'ms'),
            Row('cut: control resumes', control.resumed, 'ms', 1000.0),
            # the next observation, its way, the next tick
            Row('cut: the same, sum of its parts', control.limit + 2 * tick, 'ms')]
    for outcome in (first, *outcomes[:2]):
        rows += [Row(f'{outcome.name}: bytes per observation', outcome.size / 1e3, 'kB'),
                 Row(f'{outcome.name}: median', outcome.median, 'ms', high=outcome.p95),
                 Row(f'{outcome.name}: median over limit', outcome.median / outcome.limit, '')]
    write('policy', 'Policies on another machine', rows)
    (RESULTS / 'policy-table.md').write_text(text)
    return None


if __name__ == '__main__':
    main()
