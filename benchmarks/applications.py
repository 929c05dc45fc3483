# SPDX-License-Identifier: Apache-2.0
"""
The paper's Tables II, III and IV: applications on the robot alone, and with the cloud's help.

The cloud is a container machine on this computer, over WireGuard and a relay that limits the link
to 10 Mbit/s both ways. The robot is simulated, and is this computer too: the kernel's CPU
controller holds the node that computes to a share of what the cloud may use. The share is the
ratio of the paper's own times of computing, each scenario's own. So a row's speed-up can come near
that ratio, and what it lacks is the network's.

``--short`` takes few trials and is done in three minutes; ``--only`` measures some scenarios and
leaves the other rows as they are; ``--ompl-app`` adds two problems of OMPL.app; ``--again`` writes
the tables from the figures of ``results/applications-table.json``. With an account at AWS, the
lines that are printed last run the same applications there.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
import contextlib
import dataclasses
import functools
import importlib
import json
import os
from pathlib import Path
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any, Optional, TYPE_CHECKING

from figures import paper

if TYPE_CHECKING:
    from trajectories import Errors

HERE = Path(__file__).parent
ROOT = HERE.parent
FOLDER = '/tmp/fogros2-bench'
sys.path[:0] = [str(ROOT), str(HERE)]
#: One core for what has one thread: libraries must not take another.
ONE_THREAD = dict.fromkeys(
    ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'OPENCV_FOR_THREADS_NUM'), '1')


@dataclasses.dataclass(frozen=True)
class Scenario:
    """
    What a table has rows of.

    :param table: the paper's, such as 'III'.
    :param module: of the node that computes, ``client`` of the one that asks it; ``parameters``
        and ``asks`` are theirs.
    :param ratio: of what the cloud may compute to what the robot may.
    :param cores: that the computing node uses in the cloud.
    :param count: the client's parameter for the number of trials.
    :param ready: what the computing node says when it is about to be asked.
    :param image: a topic of images for the computing node, '' for none.
    :param codecs: how the images cross.
    :param period: of the robot's share of a core, see :class:`Held`.
    """

    name: str
    table: str
    module: str
    client: str
    ratio: float
    parameters: tuple[str, ...] = ()
    asks: tuple[str, ...] = ()
    cores: int = 1
    count: str = 'count'
    ready: str = ''
    image: str = ''
    codecs: tuple[str, ...] = ('',)
    trials: int = 10
    held_trials: int = 3
    period: float = 0.1


SCENARIOS = [
    Scenario('grasp planning', 'III', 'fogros2_examples.grasp.grasp_planner',
             'fogros2_examples.grasp.grasp_camera', paper.GRASPS['h264'].ratio, count='trials',
             ready=' grasps, ', image='/depth', codecs=('raw', 'png', 'h264')),
    Scenario('motion planning: Apartment', 'IV', 'fogros2_examples.planning.motion_planner',
             'fogros2_examples.planning.planning_client', paper.PLANS['Apartment'].ratio,
             ('seed:=3', 'workers:=2', 'time:=900.0'), ('environment:=apartment',), 2,
             ready="environment '", trials=6, held_trials=6),
    Scenario('motion planning: Cubicles', 'IV', 'fogros2_examples.planning.motion_planner',
             'fogros2_examples.planning.planning_client', paper.PLANS['Cubicles'].ratio,
             ('seed:=3', 'workers:=2', 'time:=900.0'), ('environment:=cubicles',), 2,
             ready="environment '", trials=10, held_trials=10),
]
#: Problems of OMPL.app that are in the paper as well, each with the seed of its first search. With
#: these seeds, the simulated robot plans in minutes.
APP_PROBLEMS = {'Home': 27, 'TwistyCool': 7}
#: Bytes of an answer with grasps, and what headers of WireGuard, UDP and DDS add to each byte.
ANSWER, PACKETS = 4000, 1.08
#: How the tables were made.
NOTE = ('The cloud is a container on this computer with all cores, behind WireGuard and a relay '
        'of 10 Mbit/s without delay. The robot is simulated: its node is held to a share of the '
        'same cores, smaller by "ratio of compute". Times are medians; those of the paper are '
        'means.')
#: What the codecs are called in the paper.
NAMES = {'': '', 'raw': 'raw', 'png': 'compressed (PNG)', 'jpeg': 'compressed (JPEG)',
         'h264': 'H.264', 'grey': 'H.264, grey'}
#: Our transport "h264" is lossless for depth; the paper calls both H.264.
DEPTH_NAMES = {**NAMES, 'h264': 'FFV1, lossless'}


def app_scenarios(folder: Path) -> list[Scenario]:
    """Return the scenarios of OMPL.app's problems, whose files are in ``folder``."""
    like = next(scenario for scenario in SCENARIOS if scenario.table == 'IV')
    return [dataclasses.replace(
        like, name=f'motion planning: {name}', trials=2, held_trials=2, period=1.0,
        ratio=paper.PLANS[name].ratio, parameters=(f'seed:={seed}', *like.parameters[1:]),
        asks=(f'environment:={folder / name.capitalize()}.cfg',))
        for name, seed in APP_PROBLEMS.items()]


@dataclasses.dataclass(frozen=True)
class Result:
    """
    A row; times in s, medians over trials but for ``speed_up``, which is of the same trials.

    :param robot: of a trial with the robot's share of a core, all in all.
    :param compute: of that in the cloud, ``network`` the rest of its ``total``.
    :param speed_up: of all trials that both did.
    :param ratio: of compute that was given to the cloud and to the robot.
    :param limit: what the network's part takes at the least: the bytes at the link's rate, the
        codec and the hops, each measured alone; 0 where it goes on beside the computing.
    :param errors: of trajectories; None where there are none.
    :param computer: that it was measured on, ``date`` the day.
    """

    scenario: str
    table: str
    codec: str
    robot: float
    compute: float
    network: float
    total: float
    speed_up: float
    ratio: float
    limit: float
    sent: float
    trials: int
    held_trials: int
    errors: Optional[Errors] = None
    computer: str = ''
    date: str = ''


# --- the robot ----------------------------------------------------------------------------------

class Held:
    """
    Processes held to a share of a core, by the kernel's CPU controller, version 1 or 2.

    :param period: seconds after which they may compute again. After a pause their data must come
        from memory, which made large problems up to 1.5 times as slow in periods of 0.1 s.
    """

    def __init__(self, share: float, period: float = 0.1) -> None:
        root = Path('/sys/fs/cgroup')
        name = f'fogros2-bench-{os.getpid()}'
        every = round(1e6 * period)
        quota = max(1000, round(share * every))
        if (root / 'cgroup.controllers').exists():
            self.folder = root / name
            (root / 'cgroup.subtree_control').write_text('+cpu')
            self.folder.mkdir()
            (self.folder / 'cpu.max').write_text(f'{quota} {every}')
        else:
            self.folder = next(path for path in (root / 'cpu', root / 'cpu,cpuacct')
                               if path.is_dir()) / name
            self.folder.mkdir()
            (self.folder / 'cpu.cfs_period_us').write_text(str(every))
            (self.folder / 'cpu.cfs_quota_us').write_text(str(quota))

    def take(self, process: int) -> None:
        """Hold a process and its children, those to come as well."""
        (self.folder / 'cgroup.procs').write_text(str(process))
        for path in Path(f'/proc/{process}/task').glob('*/children'):
            for child in path.read_text().split():
                self.take(int(child))

    def close(self) -> None:
        """Let go; the processes must have ended."""
        for _ in range(50):
            try:
                self.folder.rmdir()
            except OSError:
                time.sleep(0.1)
            else:
                return


def favour(text: str) -> None:
    """
    Let the container in which a command line has a text go before what else wants this computer.

    A container counts as one among all processes otherwise, however many run in it.
    """
    own = Path('/proc/self/cgroup').read_text().splitlines()
    for path in Path('/proc').glob('[0-9]*'):
        try:
            if text not in (path / 'cmdline').read_bytes().decode(errors='replace'):
                continue
            groups = (path / 'cgroup').read_text().splitlines()
        except OSError:
            continue
        for line in groups:
            _, controllers, group = line.split(':', 2)
            folder = Path('/sys/fs/cgroup', controllers, group.lstrip('/'))
            weight, most = (('cpu.shares', '100000') if 'cpu' in controllers.split(',')
                            else ('cpu.weight', '10000'))
            if line not in own and (folder / weight).exists():
                (folder / weight).write_text(most)


def words(module: str, *parameters: str) -> list[str]:
    """Return the command line of a node."""
    return [sys.executable, '-c', f'from {module} import main; main()', '--ros-args',
            *(word for parameter in parameters for word in ('-p', parameter))]


@contextlib.contextmanager
def running(command: Sequence[str], environment: dict[str, str],
            hear: Callable[[str], None] = lambda line: None) -> Iterator[subprocess.Popen[str]]:
    """Run a node until the block ends; ``hear`` gets its lines."""
    from streaming import end

    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE,
                               stderr=subprocess.STDOUT, text=True)

    def read() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            hear(line)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        yield process
    finally:
        end(process)
        reader.join(10)


def asked(scenario: Scenario, environment: dict[str, str], trials: int,
          sent: Callable[[], int] = lambda: 0) -> list[dict[str, Any]]:
    """
    Run a scenario's client to its end; return its figures, a dictionary for each trial.

    :param sent: what the link has carried so far, bytes; each trial has what it was then.
    """
    said: list[str] = []
    counts: list[int] = []
    with tempfile.TemporaryDirectory() as folder:
        figures = Path(folder, 'figures')
        figures.touch()
        with running(words(scenario.client, f'{scenario.count}:={trials}', f'figures:={figures}',
                           'wait:=900.0', *scenario.asks), environment, said.append) as client:
            deadline = time.monotonic() + 1200
            while time.monotonic() < deadline:
                ended = client.poll() is not None
                lines = figures.read_text().splitlines()
                counts += [sent()] * (len(lines) - len(counts))
                if ended:
                    break
                time.sleep(0.01)
        if client.returncode:
            raise RuntimeError(f'{scenario.client} ended with {client.returncode}:\n'
                               f'{"".join(said[-20:])}')
        return [{**json.loads(line), 'sent': count} for line, count in zip(lines, counts)]


def robot_environment(launch: Any) -> dict[str, str]:
    """
    Return the variables of nodes on the robot, whether or not the cloud helps.

    A launch's filter lets the robot's processes reach only the launch's own domain.
    """
    return {**os.environ, **launch.robot_environment(), **ONE_THREAD, 'PYTHONPATH': str(ROOT)}


def here(scenario: Scenario, trials: int, share: Optional[float],
         launch: Any) -> list[dict[str, Any]]:
    """Run a scenario on the robot; ``share`` of a core is what computes held to, None for not."""
    environment = robot_environment(launch)
    held = None if share is None else Held(share, scenario.period)
    try:
        def hear(line: str) -> None:
            # not before it has started: loading libraries is no part of the figures
            if held is not None and scenario.ready in line:
                held.take(node.pid)

        with running(words(scenario.module, *scenario.parameters), environment, hear) as node:
            return asked(scenario, environment, trials)
    finally:
        if held is not None:
            held.close()


# --- the cloud ----------------------------------------------------------------------------------

def there(scenario: Scenario, codec: str, trials: int, launch: Any, machine: Any,
          link: Any) -> tuple[list[dict[str, Any]], float]:
    """Run a scenario with the cloud; return its figures, and bytes on the link for each trial."""
    from streaming import end, LINK

    from fogros2.model import NodeSpec

    environment = robot_environment(launch)
    # a name is for one node, once
    mark = f'{scenario.name.rpartition(" ")[2]}-{codec}'
    computing = words(scenario.module, *scenario.parameters)
    link.change(rate=LINK, delay=0.0, loss=0.0)
    nodes, encoder = [], None
    if codec:
        image, stream = scenario.image, f'{scenario.image}/stream'

        def coding(role: str, topic: str) -> list[str]:
            return [*words(f'image_transport_h264.{role}', f'codec:={codec}',
                           f'stream:={stream}'), '-r', f'image:={topic}']

        nodes.append(('decoder', coding('decoder', '/decoded')))
        computing += ['-r', f'{image}:=/decoded']
        encoder = subprocess.Popen(coding('encoder', image), env=environment,
                                   stdout=subprocess.DEVNULL)
    nodes.append(('computing', computing))
    try:
        machine.start([NodeSpec(f'{what}-{mark}', what, arguments=tuple(command),
                                environment={'PYTHONPATH': FOLDER, **ONE_THREAD})
                       for what, command in nodes])
        favour(f'from {scenario.module} import')
        figures = asked(scenario, environment, trials, lambda: _bytes(link))
        sent = statistics.median(
            b['sent'] - a['sent'] for a, b in zip(figures, figures[1:]))
    finally:
        end(encoder)
        machine.stop([f'{what}-{mark}' for what, _ in nodes])
        link.change(rate=0.0, delay=0.0, loss=0.0)
    return figures, sent


def _bytes(link: Any) -> int:
    folder = Path(f'/sys/class/net/{link.interface}/statistics')
    return sum(int((folder / f'{way}_bytes').read_text()) for way in ('tx', 'rx'))


@functools.cache
def coded_alone(codec: str) -> tuple[float, float]:
    """Return the seconds to encode and decode a depth image, and its bytes: medians of some."""
    import cv2
    import numpy

    from fogros2_examples.grasp.bins import camera, depth_image, thrown
    times, sizes = [], []
    for seed in range(5):
        depth = numpy.rint(1000 * depth_image(thrown(seed), camera(), seed)).astype('<u2')
        begin = time.perf_counter()
        if codec == 'raw':
            size = depth.nbytes
        elif codec == 'png':
            coded = cv2.imencode('.png', depth)[1]
            size = len(coded)
            cv2.imdecode(coded, cv2.IMREAD_UNCHANGED)
        else:
            from image_transport_h264.codec import Decoder, Encoder, Picture

            coder, decoder = Encoder(), Decoder()
            picture = Picture(depth.shape[1], depth.shape[0], '16UC1', 2 * depth.shape[1],
                              memoryview(depth.tobytes()))
            begin = time.perf_counter()
            packet = coder.encode(picture, seconds=0.0).data
            size = len(packet)
            decoder.decode(packet)
        times.append(time.perf_counter() - begin)
        sizes.append(size)
    return statistics.median(times), statistics.median(sizes)


# --- all of it ----------------------------------------------------------------------------------

def measured(scenario: Scenario, short: bool, launch: Any, machine: Any,
             link: Any) -> Iterator[Result]:
    """Yield a scenario's rows, one for each way that images cross."""
    from streaming import LINK

    trials = min(scenario.trials, 4) if short else scenario.trials
    held_trials = min(scenario.held_trials, 2, trials) if short else scenario.held_trials
    alone = here(scenario, held_trials, scenario.cores / scenario.ratio, launch)
    hops = statistics.median(
        f['total'] - f['seconds'] for f in here(scenario, trials, None, launch))
    for codec in scenario.codecs:
        figures, sent = there(scenario, codec, trials, launch, machine, link)
        coding = 0.0
        if codec:
            # what was counted has packets twice that the relay's queue had dropped
            coding, size = coded_alone(codec)
            sent = PACKETS * (size + ANSWER)
        yield Result(
            scenario.name, scenario.table, codec,
            statistics.median(f['total'] for f in alone),
            statistics.median(f['seconds'] for f in figures),
            statistics.median(f['total'] - f['seconds'] for f in figures),
            statistics.median(f['total'] for f in figures),
            sum(f['total'] for f in alone) / sum(f['total'] for f in figures[:held_trials]),
            scenario.ratio,
            # an image is handed on once more on either side of the link
            sent * 8 / LINK + coding + hops * (3 if codec else 1),
            sent, trials, held_trials)


def table(results: Sequence[Result], note: str) -> str:
    """Return the tables as Markdown: our rows, each beside the paper's own row if it has one."""
    lines = ['# Applications on the robot alone, and with the cloud', '', note]
    for name, title, unit in (
            ('II', 'Visual SLAM', 's a frame'), ('III', 'Grasp planning', 's a grasp'),
            ('IV', 'Motion planning', 's a plan')):
        own = [r for r in results if r.table == name]
        if not own:
            continue
        # where there is no limit of the network, the time is not one of a frame
        paced = [r for r in own if not r.limit]
        lines += ['', f'## Table {name}: {title}, {unit}', '',
                  *_rows([r for r in own if r.limit])]
        if paced:
            lines += ['', 'Seconds from one frame to the next with two under way, a throughput. '
                      'The paper has no such figure.', '', *_rows(paced)]
        if name == 'III':
            lines += ['', 'Depth crosses as FFV1, which is lossless, where the paper has H.264, '
                      'which it calls lossy.']
        if name == 'II':
            lines += ['', 'The paper, as printed: ORB-SLAM2 on sequences of TUM with 36 cores. It '
                      'has no column of compute, so the ratio of compute is at least the '
                      'speed-up; ours is held to that of fr2/loop.', '',
                      '| sequence | robot only | FogROS1, compressed | compressed | H.264 | '
                      'speed-up |', '|---' * 6 + '|']
            lines += [f'| {sequence} | {times[0]} | {times[1]} | {times[2]} | {times[3]} | '
                      f'{times[0] / times[3]:.1f}x |' for sequence, times in paper.SLAM.items()]
    return '\n'.join([*lines, ''])


def _rows(results: Sequence[Result]) -> Iterator[str]:
    heads = ['scenario', 'images', 'robot only, simulated', 'compute', 'network', 'total',
             'speed-up', 'ratio of compute', 'limit of network', 'network / limit', 'bytes']
    if published(results[0]):
        heads += ['the paper: robot only', 'compute', 'network', 'total', 'speed-up',
                  'ratio of compute']
    yield f"| {' | '.join(heads)} |"
    yield '|---' * len(heads) + '|'
    for r in results:
        cells = [f'{r.scenario}{_errors(r)}', _names(r)[r.codec], f'{r.robot:.2f}',
                 f'{r.compute:.2f}', f'{r.network:.3f}', f'{r.total:.2f}', f'{r.speed_up:.1f}x',
                 f'{r.ratio:.1f}x', *_limit(r), f'{r.sent:.0f}']
        if row := published(r):
            cells += [f'{row.robot:g}', f'{row.compute:g}', f'{row.network:g}', f'{row.total:g}',
                      f'{row.robot / row.total:.1f}x', f'{row.ratio:.1f}x']
        yield f"| {' | '.join(cells)} |"


def published(result: Result) -> Optional[paper.Offloaded]:
    """Return the paper's row of a result, None where it has none (Table II has other columns)."""
    rows = {'III': (paper.GRASPS, result.codec),
            'IV': (paper.PLANS, result.scenario.rpartition(' ')[2])}
    if result.table not in rows:
        return None
    found, name = rows[result.table]
    return found.get(name)


def _names(r: Result) -> dict[str, str]:
    return DEPTH_NAMES if r.table == 'III' else NAMES


def _limit(r: Result) -> tuple[str, str]:
    return (f'{r.limit:.3f}', f'{r.network / r.limit:.2f}') if r.limit else ('', '')


def _errors(r: Result) -> str:
    return '' if r.errors is None else (
        f': ATE {r.errors.ate:.2f} cm, RPE {r.errors.rpe:.2f} cm/m')


def rows(results: Sequence[Result]) -> Iterator[Any]:
    """Yield the figures that have targets."""
    from figures import Row

    slam = ', '.join(f'{times[3]:g}' for times in paper.SLAM.values())
    for r in results:
        name = _names(r)[r.codec]
        what = f'{r.scenario}{f", {name}" if name else ""}'
        best = r.codec in ('', 'h264', 'grey')
        if row := published(r):
            beside = f"{row.total:g} s ({'Dex-Net' if r.table == 'III' else 'MPT, 96 cores'})"
        else:
            # the paper has no throughput, and no frames that are raw
            beside = f'{slam} s (ORB-SLAM2, TUM)' if r.codec == 'h264' and r.limit else ''
        yield Row(f"{what}: {'total' if r.limit else 'from frame to frame'}", r.total, 's',
                  published=beside, runs=r.trials)
        if r.limit:
            yield Row(f'{what}: network over its limit', r.network / r.limit, '', 1.5,
                      runs=r.trials)
        yield Row(f'{what}: speed-up over ratio of compute', r.speed_up / r.ratio, '',
                  0.9 if best else None, 'more', runs=r.held_trials)
        if r.errors is not None and r.codec != 'raw':
            yield Row(f'{what}: ATE over that of raw, 95 % between {r.errors.low:.2f} and '
                      f'{r.errors.high:.2f}', r.errors.ratio, '', 1.2 if best else None,
                      runs=r.errors.rooms)


def before() -> Iterator[Result]:
    """Yield the rows that were written down last."""
    from figures import RESULTS
    from trajectories import Errors

    path = RESULTS / 'applications-table.json'
    written = json.loads(path.read_text()) if path.exists() else {'rows': []}
    for row in written['rows']:
        errors = row.pop('errors')
        yield Result(**row, errors=errors and Errors(**errors))


def write_down(results: Sequence[Result]) -> None:
    """Write the tables, and the figures that have targets."""
    from figures import origin, RESULTS, write

    computer, date = origin((r.scenario, r.computer, r.date) for r in results)
    note = f'{computer}; {date}. {NOTE}'
    write('applications', 'Applications with the cloud', list(rows(results)), RESULTS, computer,
          date)
    (RESULTS / 'applications-table.md').write_text(table(results, note))
    (RESULTS / 'applications-table.json').write_text(json.dumps(
        {'rows': [dataclasses.asdict(r) for r in results]}, indent=1) + '\n')


def others() -> Iterator[Callable[..., Iterator[Result]]]:
    """Yield what measures the other tables: modules beside this one named applications_*."""
    for path in sorted(HERE.glob('applications_*.py')):
        yield importlib.import_module(path.stem).measured


def main() -> None:
    """Measure all scenarios, write the figures down."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--short', action='store_true')
    parser.add_argument('--only', default='', help='scenarios whose name has this in it')
    parser.add_argument('--ompl-app', type=Path, metavar='FOLDER',
                        help="of OMPL.app's Home.cfg, Twistycool.cfg and their meshes")
    parser.add_argument('--again', action='store_true',
                        help='measure nothing, write the tables from the figures that were stored')
    arguments = parser.parse_args()
    if arguments.again:
        write_down(list(before()))
        return
    scenarios = SCENARIOS + (app_scenarios(arguments.ompl_app) if arguments.ompl_app else [])
    from figures import machine as computer
    from figures import today
    from streaming import launched, prepare

    if os.geteuid():
        raise SystemExit('holding a node to a share of a core takes root')
    results: list[Result] = []
    failed: list[str] = []
    begin = time.monotonic()
    with launched(f'bench-applications-{os.getpid()}', prepare) as (launch, machine, link, _):
        jobs = [measured(scenario, arguments.short, launch, machine, link)
                for scenario in scenarios if arguments.only in scenario.name and not (
                    arguments.short and scenario.name.endswith('Apartment'))]
        jobs += [other(arguments.only, arguments.short, launch, machine, link)
                 for other in others()]
        for job in jobs:
            try:
                for result in job:
                    results.append(result)
                    print(result, flush=True)
            except RuntimeError as error:
                # what was measured before counts all the same
                failed.append(str(error))
    print(table(results, f'{computer()}. {NOTE}'))
    print(f'took {(time.monotonic() - begin) / 60:.1f} min\n')
    for name in ('slam', 'grasp', 'planning'):
        print(f'ros2 launch fogros2_examples {name}.launch.py machine:=aws')
    if results and not arguments.short:
        measured_now = {(result.scenario, result.codec) for result in results}
        results = [dataclasses.replace(one, computer=computer(), date=today())
                   for one in results]
        results += [one for one in before() if (one.scenario, one.codec) not in measured_now]
        write_down(sorted(results, key=lambda one: one.table))
    if failed:
        raise SystemExit('without a result: ' + '; '.join(failed))


if __name__ == '__main__':
    main()
