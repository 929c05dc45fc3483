# SPDX-License-Identifier: Apache-2.0
"""
Machines that end when idle: which ones end, and how fast the next launch starts.

Each launch has a container machine whose node waits, and ``WORKING`` whose nodes work all the
time or now and then. Each of these is a trial: it must not end in ``WATCH`` time-outs. The starts
are of EC2 in a box: of a new machine, of one that was stopped, and of one that was kept. They are
taken with the argument ``starts``, on a computer that has nothing else to do.
"""

from __future__ import annotations

from collections.abc import Iterator
import sys
import time

from figures import Row, write
from figures.places import Place, place
from figures.robots import Robot, robot

from rigs.launched import Launched, ros2

LAUNCHES, WORKING, STARTS = 5, 4, 3
#: Seconds of the time-out, and for how many of them a trial goes on.
TIMEOUT, WATCH = 10.0, 3.0
LAUNCH = """\
from fogros2 import CloudGroup, {kind}, FogROSLaunchDescription
from launch.actions import ExecuteProcess
from launch_ros.actions import Node


def generate_launch_description():
    return FogROSLaunchDescription([
        CloudGroup(machine={kind}(name=name, ros_workspace='', {options}), actions=[
            Node(package='fogros2_examples', executable=program, output='screen')
            if program in ('talker', 'listener') else
            ExecuteProcess(cmd=['python3', '-c', program], output='screen')])
        for name, program in {programs!r}])
"""
#: What a node does that is idle: listen, sleep, say a word a second.
WAITS = ('listener', 'import time; time.sleep(1e6)', 'talker')
#: What a node does that works: all the time, every two seconds, and by sending as much as a video.
_SEND = ('import os, socket, time\n'
         'to = os.environ["FOGROS2_VPN_ADDRESS"].rpartition(".")[0] + ".1", 9\n'
         'link = socket.socket(type=socket.SOCK_DGRAM)\n'
         'while True:\n    link.sendto(bytes(1200), to); time.sleep(0.02)')
WORKS = ('while True: pass',
         'import time\nwhile True:\n    end = time.process_time() + 0.15\n'
         '    while time.process_time() < end: pass\n    time.sleep(2)',
         _SEND)


def started(its: Robot, options: str, *programs: tuple[str, str]) -> Launched:
    """Start a launch of machines with these names and programs."""
    path = its.home / 'idle.launch.py'
    path.write_text(LAUNCH.format(
        kind=its.place.kind, options=options, programs=programs))
    return Launched(str(path), environment=its.environment, prefix=its.place.prefix)


def trials(here: Place) -> Iterator[Row]:
    """Yield how many waiting and working machines ended."""
    ended = {'waits': 0, 'works': 0}
    for number in range(LAUNCHES):
        programs = [('waits', WAITS[number % len(WAITS)]), *(
            (f'works{each}', WORKS[(number + each) % len(WORKS)]) for each in range(WORKING))]
        with robot(here, f'idle{number}') as its:
            run = started(its, f'idle_timeout={TIMEOUT}', *programs)
            try:
                run.wait_for('process started with pid', times=len(programs), timeout=300.0)
                time.sleep(TIMEOUT * WATCH)
                for name, _ in programs:
                    ended[name[:5]] += f'{name}: nobody has used it' in run.text
                run.interrupt()
                assert run.ended(120.0) == 0, run.text
            finally:
                run.kill()
        print(number, ended, flush=True)
    yield Row('working machines that ended', ended['works'], 'machines', 0.0,
              runs=LAUNCHES * WORKING)
    yield Row('waiting machines that ended', ended['waits'], 'machines', float(LAUNCHES),
              better='more', runs=LAUNCHES)


def starts(here: Place) -> Iterator[Row]:
    """Yield the seconds from ``ros2 launch`` to a node's first line."""
    for on_exit, what in (('delete', 'new'), ('stop', 'stopped'), ('keep', 'kept')):
        taken = []
        with robot(here, 'starts') as its:
            for number in range(STARTS + 1):
                begin = time.monotonic()
                run = started(its, f'on_exit={on_exit!r}', ('starts', 'talker'))
                try:
                    run.wait_for('Publishing', timeout=180.0)
                    if number:  # the first makes the machine
                        taken.append(time.monotonic() - begin)
                    run.interrupt()
                    assert run.ended(120.0) == 0, run.text
                finally:
                    run.kill()
            ros2('fog', 'delete', 'starts', '--yes', environment=its.environment,
                 prefix=here.prefix, timeout=120.0)
        yield Row.of(f'EC2 in a box, a {what} machine: to the first line', taken, 's')


def main() -> None:
    """Take the figures."""
    if 'starts' in sys.argv[1:]:
        with place('aws', short=False) as here:
            write('idle_starts', 'Starts of new, stopped and kept machines', list(starts(here)))
    else:
        with place('container', short=False) as here:
            write('idle', 'Machines that end when idle', list(trials(here)))


if __name__ == '__main__':
    main()
