# SPDX-License-Identifier: Apache-2.0
"""
Point clouds from a lidar here to a node on a container machine, which answers each.

Between the two is WireGuard over a relay that limits the link, as in ``streaming``. The scans are
those of ``fogros2_examples.city`` (64 x 1024 points, 1.44 MB), computed beforehand and published
10 times a second, forwards and backwards in turn. The codec is also measured alone, beside
Zstandard, pcodec and Draco. ``--codec`` measures the codec only; ``--short`` takes a tenth of the
scans.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import math
import os
from pathlib import Path
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any

from streaming import answer_of, end, FOLDER, launched, Link, Output, put

HERE = Path(__file__).parent
ROOT = HERE.parent
RATE = 10.0
#: Scans that are computed, scans before those that count, and of those that arrive how many apart
#: are compared.
SCANS, WARM_UP, SAMPLE = 8, 20, 7
RESOLUTION = 0.01
#: A round trip in seconds above which a scan came late.
LATE = 0.2


def scans() -> list[Any]:
    """Return the scans, each an array (64, 1024)."""
    from fogros2_examples.city import City
    city = City()
    return [city.scan(10 * number) for number in range(SCANS)]


def shown(number: int) -> int:
    """Return which scan is cloud ``number``: there and back."""
    at = number % (2 * (SCANS - 1))
    return min(at, 2 * (SCANS - 1) - at)


# --- the nodes, each a process of its own -------------------------------------------------------

def lidar(count: int) -> None:
    """Publish scans and take the time until each is answered; print a JSON line."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import PointCloud2
    from std_msgs.msg import UInt32

    from fogros2_examples.lidar import message

    clouds = [message(scan) for scan in scans()]
    rclpy.init()
    node = rclpy.create_node('lidar')
    publisher = node.create_publisher(PointCloud2, 'points', 2)
    sent: list[float] = []
    answered: dict[int, float] = {}

    def turn() -> None:
        if len(sent) < WARM_UP + count and (sent or publisher.get_subscription_count()):
            cloud = clouds[shown(len(sent))]
            cloud.header.frame_id = str(len(sent))
            sent.append(time.perf_counter())
            publisher.publish(cloud)
            if len(sent) == WARM_UP + 1:
                print(json.dumps({'begin': True}), flush=True)

    node.create_subscription(UInt32, 'answer', lambda message: answered.setdefault(
        message.data, time.perf_counter()), qos_profile_sensor_data)
    node.create_timer(1 / RATE, turn)
    print(json.dumps({'ready': True}), flush=True)
    deadline = time.monotonic() + (WARM_UP + count) / RATE + 30
    while time.monotonic() < deadline and (
            len(sent) < WARM_UP + count or time.perf_counter() < sent[-1] + 1):
        rclpy.spin_once(node, timeout_sec=0.1)
    if len(sent) < WARM_UP + count:
        raise SystemExit(f'{len(sent)} of {WARM_UP + count} scans sent: '
                         f'{publisher.get_subscription_count()} nodes subscribe to them')
    trips = [(when - sent[WARM_UP], answered.get(number, math.inf) - when)
             for number, when in enumerate(sent) if number >= WARM_UP]
    print(json.dumps({'trips': trips, 'seconds': sent[-1] - sent[WARM_UP] + 1 / RATE}), flush=True)


def cloud(topic: str, result: str) -> None:
    """Answer each cloud; when interrupted, leave some of them in a file for :func:`compare`."""
    import numpy
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import PointCloud2
    from std_msgs.msg import UInt32

    rclpy.init()
    node = rclpy.create_node('cloud')
    publisher = node.create_publisher(UInt32, 'answer', qos_profile_sensor_data)
    samples: dict[int, Any] = {}

    def answer(points: Any) -> None:
        number = int(points.header.frame_id)
        publisher.publish(UInt32(data=number))
        if number >= WARM_UP and number % SAMPLE == 0:
            samples[number] = numpy.frombuffer(points.data, numpy.uint8).copy()

    node.create_subscription(PointCloud2, topic, answer, 2)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    with open(result, 'wb') as file:
        numpy.savez(file, numbers=list(samples), data=list(samples.values()))


def compare(result: str) -> None:
    """Compare the clouds that :func:`cloud` left with the originals; print a JSON line."""
    import numpy

    originals = scans()
    errors = []
    exact = True
    with numpy.load(result) as left:
        for number, data in zip(left['numbers'], left['data']):
            before = originals[shown(int(number))]
            after = data.view(before.dtype).reshape(before.shape)
            errors.append(largest_error(before, after))
            exact &= all(bool((before[name] == after[name]).all()) for name in (
                'intensity', 'ring', 'time'))
    print(json.dumps({'error': max(errors, default=math.nan), 'exact': exact,
                      'compared': len(errors)}))


def largest_error(before: Any, after: Any) -> float:
    """Return the largest error of a coordinate in metres; infinite if NaN is elsewhere."""
    import numpy

    pairs = [(before[name].astype(float), after[name].astype(float)) for name in 'xyz']
    if any((numpy.isnan(a) != numpy.isnan(b)).any() for a, b in pairs):
        return math.inf
    return max(float(numpy.nanmax(abs(a - b))) for a, b in pairs)


# --- over the link ------------------------------------------------------------------------------

@dataclasses.dataclass(frozen=True)
class Case:
    """A row: the link's rate in bit/s at the beginning, and after a third of the scans."""

    name: str
    before: float
    after: float


CASES = [Case('30 Mbit/s', 30e6, 30e6), Case('10 Mbit/s', 10e6, 10e6),
         Case('30, then 10 Mbit/s', 30e6, 10e6), Case('30, then 5 Mbit/s', 30e6, 5e6)]


@dataclasses.dataclass
class Outcome:
    """
    What a case came to: round trips in ms, errors in mm.

    :param size: bytes that the robot sent for each scan that arrived, all headers included.
    :param adapted: seconds from the drop of the rate to the last round trip above LATE.
    :param limit: sum of the parts of a round trip, each measured alone, and of the wire, in ms.
    """

    case: Case
    rate: float
    median: float
    p95: float
    size: float
    error: float
    exact: bool
    adapted: float
    limit: float


def words(role: str, points: str, *more: str) -> list[str]:
    """Return the command line of an encoder or decoder."""
    program = f'from point_cloud_stream.{role} import main; main()'
    return [sys.executable, '-c', program, '--ros-args', '-r', f'points:={points}', '-p',
            'stream:=/points/pointcloud', *more]


def run(case: Case, launch: Any, machine: Any, link: Link, output: Output, count: int,
        parts: float) -> Outcome:
    """Run a case to its end."""
    from fogros2.model import Command, NodeSpec
    from fogros2.waiting import wait_until

    environment = {**os.environ, **launch.robot_environment(), 'PYTHONPATH': str(ROOT)}
    result = f'{FOLDER}/points.npz'
    machine.shell.put(b'', result, mode=0o666)
    link.change(rate=case.before)
    decoder, viewer = (f'{what}-{CASES.index(case)}' for what in ('decoder', 'cloud'))
    program = [sys.executable, f'{FOLDER}/point_clouds.py']
    machine.start([
        NodeSpec(node, node, arguments=tuple(each), environment={'PYTHONPATH': FOLDER})
        for node, each in ((decoder, words('decoder', '/decoded')), (viewer, [
            *program, '--cloud', '--topic', '/decoded', '--result', result]))])
    encoder = source = None
    try:
        encoder = subprocess.Popen(
            words('encoder', '/points', '-p', f'resolution:={RESOLUTION}'), env=environment)
        source = subprocess.Popen(
            [sys.executable, __file__, '--lidar', '--count', str(count)], env=environment,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert source.stdout is not None
        for _ in range(2):
            source.stdout.readline()
        begin = time.monotonic()
        drop = count / RATE / 3
        # the scans go on by themselves: the rate drops while they do
        wait_until(lambda: time.monotonic() > begin + drop, timeout=drop + 5,
                   what='a third of the scans')
        link.change(rate=case.after)
        wait_until(lambda: time.monotonic() > begin + drop + 2, timeout=drop + 9,
                   what='the adaptation')
        sent = link.sent()
        told = answer_of(source, 'the lidar', count / RATE + 120)
        size = (link.sent() - sent) / max(1, sum(
            math.isfinite(trip) for when, trip in told['trips'] if when > drop + 2))
    finally:
        end(source)
        end(encoder)
        machine.stop([decoder, viewer])
        wait_until(lambda: {decoder, viewer} <= output.ended, timeout=60.0,
                   what='the nodes on the machine to end')
        link.change(rate=0.0)
    same = json.loads(machine.shell.run(Command(
        (*program, '--compare', '--result', result), environment={'PYTHONPATH': FOLDER},
        what='compare the clouds'), timeout=300).stdout)
    arrived = [trip for _, trip in told['trips'] if math.isfinite(trip)]
    times = sorted(1e3 * trip for when, trip in told['trips']
                   if math.isfinite(trip) and (when > drop + 2 or case.before == case.after))
    late = [when - drop for when, trip in told['trips'] if trip > LATE and drop < when < 2 * drop]
    return Outcome(
        case, len(arrived) / told['seconds'], statistics.median(times),
        times[int(0.95 * len(times))], size, 1e3 * same['error'],
        same['exact'] and same['compared'] > 0,
        max(late, default=0.0) if case.before != case.after else math.nan,
        parts + 1e3 * size * 8 / case.after)


def hop_alone() -> float:
    """Return the median time of a scan over the loopback to a node and its answer, in ms."""
    with tempfile.NamedTemporaryFile() as result:
        environment = {**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
                       'PYTHONPATH': str(ROOT), 'ROS_DOMAIN_ID': '84'}
        node = subprocess.Popen(
            [sys.executable, __file__, '--cloud', '--topic', '/points', '--result', result.name],
            env=environment)
        try:
            told = subprocess.run([sys.executable, __file__, '--lidar', '--count', '50'],
                                  env=environment, check=True, capture_output=True, text=True,
                                  timeout=120).stdout
        finally:
            end(node)
    trips = json.loads(told.splitlines()[-1])['trips']
    return 1e3 * statistics.median(trip for _, trip in trips)


# --- the codec alone ----------------------------------------------------------------------------

def alone() -> list[tuple[str, int, float, float, str]]:
    """Return name, median bytes, ms of encoding and of decoding on one core, and a remark."""
    import DracoPy
    import numpy
    from pcodec import ChunkConfig, standalone
    import zstandard

    from image_transport_h264 import memory
    from point_cloud_stream.cloud import Field, Layout
    from point_cloud_stream.codec import decode, encode

    memory.keep()
    originals = scans()
    kind = originals[0].dtype
    layout = Layout(64, 1024, tuple(
        Field(name, kind.fields[name][1], {'<f4': 7, '<u2': 4}[kind.fields[name][0].str])
        for name in kind.names), kind.itemsize, 1024 * kind.itemsize)
    names = [name for name in kind.names if name not in 'xyz']
    flat = numpy.concatenate([numpy.stack([scan[n] for n in 'xyz'], -1).reshape(-1, 3)
                              for scan in originals])
    extent = float(numpy.nanmax(flat) - numpy.nanmin(flat))
    bits = math.ceil(math.log2(extent / RESOLUTION))
    level, chunks = zstandard.ZstdCompressor(level=3), ChunkConfig()

    def quantised(scan: Any) -> list[bytes]:
        columns = [numpy.rint(numpy.nan_to_num(scan[n].reshape(-1)) / RESOLUTION).astype('i4')
                   for n in 'xyz']
        return [standalone.simple_compress(numpy.ascontiguousarray(column), chunks)
                for column in (*columns, *(scan[n].reshape(-1) for n in names))]

    def draco(scan: Any) -> list[bytes]:
        points = numpy.nan_to_num(numpy.stack([scan[n] for n in 'xyz'], -1).reshape(-1, 3))
        return [DracoPy.encode(points, quantization_bits=bits, preserve_order=True), *(
            level.compress(numpy.ascontiguousarray(scan[n]).tobytes()) for n in names)]

    def ours(resolution: float, rows: int = 64) -> tuple[Any, Any]:
        what = dataclasses.replace(layout, height=rows, width=65536 // rows,
                                   row_step=65536 // rows * kind.itemsize)
        return (lambda scan: [encode(what, scan.tobytes(), resolution).data],
                lambda packed: decode(packed[0]))

    unpack = zstandard.ZstdDecompressor().decompress
    codecs: dict[str, tuple[Any, Any, str]] = {
        'point_cloud_stream, 1 cm': (*ours(0.01), 'error at most 5 mm'),
        'point_cloud_stream, 1 mm': (*ours(0.001), 'error at most 0.5 mm'),
        'point_cloud_stream, unorganised, 1 cm': (*ours(0.01, 1), 'error at most 5 mm'),
        'point_cloud_stream, lossless': (*ours(0.0), 'identical'),
        'Zstandard of the message': (
            lambda scan: [level.compress(scan.tobytes())], lambda packed: unpack(packed[0]),
            'identical'),
        'pcodec of each quantised column, 1 cm': (
            quantised, lambda packed: [standalone.simple_decompress(each) for each in packed],
            'loses NaN'),
        'Draco of x, y, z, 1 cm; Zstandard of the rest': (
            draco, lambda packed: (DracoPy.decode(packed[0]), *map(unpack, packed[1:])),
            'loses NaN')}
    found = []
    for name, (pack, take, remark) in codecs.items():
        sizes, times = [], []
        for number in range(5 * SCANS):
            scan = originals[number % SCANS]
            moments = [time.process_time()]
            packed = pack(scan)
            moments.append(time.process_time())
            take(packed)
            moments.append(time.process_time())
            sizes.append(sum(map(len, packed)))
            times.append((moments[1] - moments[0], moments[2] - moments[1]))
        found.append((name, int(statistics.median(sizes)), *(
            1e3 * statistics.median(each[i] for each in times) for i in (0, 1)), remark))
    return found


# --- all of it ----------------------------------------------------------------------------------

def table(codecs: list[tuple[str, int, float, float, str]], outcomes: list[Outcome],
          note: str) -> str:
    """Return both tables as Markdown."""
    lines = ['# Point clouds', '', note, '',
             '| codec | bytes/scan | encode, ms | decode, ms | |', '|---' * 5 + '|']
    lines += [f'| {name} | {size} | {there:.1f} | {back:.1f} | {remark} |'
              for name, size, there, back, remark in codecs]
    lines += ['', '| link | Hz | round trip, ms: median | p95 | limit | bytes/scan | error, mm | '
              'other fields exact | adapted within, s |', '|---' * 9 + '|']
    lines += [f'| {o.case.name} | {o.rate:.2f} | {o.median:.1f} | {o.p95:.1f} | {o.limit:.1f} | '
              f"{o.size:.0f} | {o.error:.2f} | {'yes' if o.exact else 'no'} | "
              f"{'' if math.isnan(o.adapted) else f'{o.adapted:.1f}'} |" for o in outcomes]
    return '\n'.join([*lines, ''])


def prepare(machine: Any) -> None:
    """Put onto the machine what its nodes need."""
    put(machine, 'image_transport_h264', 'point_cloud_stream', 'fogros2_examples',
        'streaming.py', 'point_clouds.py')


def main() -> None:
    """Measure the codec and all cases, write the figures down."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--short', action='store_true')
    parser.add_argument('--codec', action='store_true')
    parser.add_argument('--count', type=int, default=600)
    for hidden in ('--lidar', '--cloud', '--compare'):
        parser.add_argument(hidden, action='store_true', help=argparse.SUPPRESS)
    for hidden in ('--topic', '--result'):
        parser.add_argument(hidden, default='', help=argparse.SUPPRESS)
    arguments, _ = parser.parse_known_args()
    if arguments.lidar:
        return lidar(arguments.count)
    if arguments.cloud:
        return cloud(arguments.topic, arguments.result)
    if arguments.compare:
        return compare(arguments.result)
    from figures import machine as computer
    from figures import RESULTS, Row, write

    codecs = alone()
    print(table(codecs, [], ''), flush=True)
    if arguments.codec:
        return
    count = arguments.count // 10 if arguments.short else arguments.count
    outcomes: list[Outcome] = []
    # the cloud is handed on twice, the answer crosses once more than measured here
    parts = 2 * hop_alone() + codecs[0][2] + codecs[0][3]
    with launched('bench-points', prepare) as (launch, machine, link, output):
        for case in CASES:
            outcomes.append(run(case, launch, machine, link, output, count, parts))
            print(outcomes[-1], flush=True)
    text = table(codecs, outcomes, f'{computer()}; {count} scans in each row of the second table, '
                 f'at {RATE:.0f} Hz, resolution {100 * RESOLUTION:.0f} cm.')
    print(text)
    if arguments.short:
        return
    rows = [Row('codec: encode + decode', codecs[0][2] + codecs[0][3], 'ms', 10.0),
            Row('codec: bytes per scan', codecs[0][1] / 1e3, 'kB')]
    for o in outcomes[:2]:
        rows += [Row(f'{o.case.name}: rate', o.rate, '1/s', 9.95, 'more', runs=1),
                 Row(f'{o.case.name}: bytes per scan', o.size / 1e3, 'kB',
                     125.0 if o.case.after > 10e6 else 100.0, runs=1),
                 Row(f'{o.case.name}: median', o.median, 'ms',
                     60.0 if o.case.after > 10e6 else None, runs=1, high=o.p95),
                 Row(f'{o.case.name}: median over limit', o.median / o.limit, '', 1.3, runs=1),
                 Row(f'{o.case.name}: error', o.error, 'mm',
                     5.0 if o.case.after > 10e6 else None, runs=1)]
    rows += [Row(f'{o.case.name}: adapted', o.adapted, 's', 1.0, runs=1) for o in outcomes[2:]]
    write('point_clouds', 'Point clouds', rows)
    (RESULTS / 'point_clouds-table.md').write_text(text)


if __name__ == '__main__':
    main()
