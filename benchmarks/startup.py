# SPDX-License-Identifier: Apache-2.0
"""
How long a launch on a rented machine takes from ``ros2 launch`` to the first message.

Against a cloud in a box (``rigs.clouds``), whose machines boot as slowly as configured.
*Our share* is what is left without the boot (from the request for a machine until the SSH server
answers) and without the installation of ROS 2 on an image that has none. The machines are this
computer's own containers: where many boot at once they share its cores, as a cloud's wouldn't.
The robot's CPU is that of its launch and of what that runs.

    python benchmarks/startup.py [--provider aws|azure|gcp|kubernetes|all] [--runs 3]

For pods see ``startup_kubernetes``. ``all`` takes the time of ``ros2 fog list`` for a user with
accounts at all three clouds.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Mapping
import contextlib
import os
from pathlib import Path
import re
import statistics
import tempfile
import time

from figures import paper, Row, write
import startup_kubernetes

from fogros2.plugin_system import load
from rigs.clouds import Cloud, CLOUDS
from rigs.computers.box import Box
from rigs.launched import launching, ros2

DELAYS = (0.0, 20.0)
MANY = 8
BOXES = {'aws': 'EC2', 'azure': 'Azure', 'gcp': 'Compute Engine'}
#: What the paper has for AWS, by image.
PUBLISHED = {'default': f"{paper.STARTUP['AWS default']} s (real EC2, ROS 2 installed)",
             'custom': f"{paper.STARTUP['AWS custom']} s (real EC2)"}

LAUNCH = """\
from fogros2 import {machine}, CloudNode, FogROSLaunchDescription


def generate_launch_description():
    machines = [{machine}(name=f'bench-{{n}}') for n in range({number})]
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  output='screen') for machine in machines])
"""


class Robot:
    """A robot beside a cloud in a box, with a home of its own."""

    def __init__(self, cloud: Cloud, box: Box, home: Path) -> None:
        self.cloud = cloud
        self.box = box
        self.home = home
        self.environment: Mapping[str, str] = {
            **os.environ, **cloud.variables(box, home), 'FOGROS2_AWS_CHECKIP': box.checkip,
            'HOME': str(home), 'FOGROS2_STATE_HOME': str(home / 'state'),
            'ROS_LOG_DIR': str(home / 'log'), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}

    def fog(self, *words: str) -> float:
        """Run ``ros2 fog`` and return how long it took (s)."""
        begin = time.perf_counter()
        done = ros2('fog', *words, environment=self.environment, timeout=120.0,
                    prefix=self.box.on_robot([]))
        if done.returncode != 0:
            raise SystemExit(f'ros2 fog {" ".join(words)} failed:\n{done.stdout}{done.stderr}')
        return time.perf_counter() - begin

    def talker(self, *words: str) -> tuple[float, float, float, str, int]:
        """
        Launch the talker until the first message is heard.

        :returns: seconds in all, of the boot, of the installation; what ROS 2 is installed from;
            requests, the end too.
        """
        self.box.forget_calls()
        with launching() as launch:
            begin = time.perf_counter()
            run = launch('fogros2_examples', f'talker.{self.cloud.name}.launch.py', 'count:=1',
                         *words, environment=self.environment, prefix=self.box.on_robot([]))
            run.wait_for('I heard: ', timeout=300.0)
            total = time.perf_counter() - begin
            if run.ended(120.0) != 0:
                raise SystemExit(f'the launch failed:\n{run.text}')
        newest = self.box.instances()[-1]
        found = re.search(r'ROS 2 +([0-9.]+) s \((.*)\)', run.text)
        installed = float(found[1]) if found and 'installed' in found[2] else 0.0
        how = 'apt' if found and 'from packages' in found[2] else 'its wheels'
        return (total, newest.ready - newest.asked, installed, how,
                len(self.cloud.asked(self.box)))

    def machines(self, number: int) -> tuple[float, float]:
        """Return the seconds until the nodes of ``number`` machines run, and the launch's CPU."""
        path = self.home / 'many.launch.py'
        path.write_text(LAUNCH.format(machine=self.cloud.machine, number=number))
        with launching() as launch:
            begin = time.perf_counter()
            run = launch(str(path), environment=self.environment, prefix=self.box.on_robot([]))
            run.wait_for('process started with pid', times=number, timeout=300.0)
            total = time.perf_counter() - begin
            spent = cpu(run.child.pid)
            run.interrupt()
            if run.ended(120.0) != 0:
                raise SystemExit(f'the launch failed:\n{run.text}')
        return total, spent


def cpu(pid: int) -> float:
    """Return the CPU seconds of a process and of those that it has waited for."""
    words = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return sum(map(int, words[11:15])) / os.sysconf('SC_CLK_TCK')


@contextlib.contextmanager
def robot(provider: str = 'aws', *, bare: bool) -> Iterator[Robot]:
    """
    Yield a robot beside a new box.

    :param provider: name of the cloud.
    :param bare: the box's Ubuntu has no ROS 2; else it has the robot's, as a made image would.
    """
    cloud = CLOUDS[provider]()
    with tempfile.TemporaryDirectory() as home, cloud.open(mounts=() if bare else None) as box:
        yield Robot(cloud, box, Path(home))


def start(provider: str, runs: int) -> Iterator[Row]:
    """Yield what it takes to start on a fresh image, and on one that was baked of the first."""
    calls = []
    with robot(provider, bare=True) as here:
        for image in ('default', 'custom'):
            for delay in DELAYS:
                here.box.set_boot_delay(delay)
                taken = [here.talker() for _ in range(runs)]
                calls += [asked for *_, asked in taken]
                installed = [i for _, _, i, _, _ in taken]
                how = taken[-1][3]
                what = f'simulated {BOXES[provider]}, {image} image, boot delay {delay:g} s'
                yield Row.of(f'{what}: to the first message', [t for t, *_ in taken], 's',
                             published=PUBLISHED[image] if provider == 'aws' else '')
                if any(installed):
                    yield Row.of(f'{what}: of it ROS 2 installed from {how}', installed, 's')
                yield Row.of(f'{what}: our share', [t - b - i for t, b, i, _, _ in taken], 's',
                             6.0 if image == 'default' else 4.0)
            if image == 'default':
                here.box.set_boot_delay(0.0)
                here.talker('name:=baked', 'on_exit:=keep')
                here.fog('image', 'baked')
                here.fog('delete', '--yes', 'baked')
        yield Row('requests to the cloud in a launch, at most', max(calls), 'requests', 25.0,
                  runs=len(calls))
        yield from listing(here, runs)


def listing(here: Robot, runs: int) -> Iterator[Row]:
    """Yield what it takes to look for machines in all regions."""
    here.fog('list')
    taken = []
    for _ in range(runs):
        here.box.forget_calls()
        taken.append(here.fog('list'))
    calls = [call for call in here.box.calls() if call.service]
    # AWS is asked in each region, and the others once for all
    regions = Counter(call.region for call in calls) if here.cloud.listing > 2 \
        else Counter(dict.fromkeys(load('fogros2.provider', here.cloud.name).region_names(), 0))
    yield Row.of(f'ros2 fog list, {len(regions)} regions', taken, 's', 2.0)
    yield Row('ros2 fog list, a region', max(*regions.values(), 0) or len(calls), 'requests', 2.0,
              runs=runs)


def several(provider: str, runs: int) -> Iterator[Row]:
    """Yield how much longer many machines take than one."""
    with robot(provider, bare=False) as here:
        here.machines(1)
        for delay in DELAYS:
            here.box.set_boot_delay(delay)
            one, spent = zip(*(here.machines(1) for _ in range(runs)))
            many, spent_by_many = zip(*(here.machines(MANY) for _ in range(runs)))
            box = f'simulated {BOXES[provider]}'
            what = f'{box}, {MANY} instances, boot delay {delay:g} s'
            yield Row.of(f'{box}, 1 instance, boot delay {delay:g} s', one, 's')
            yield Row.of(what, many, 's')
            yield Row(what, statistics.median(many) / statistics.median(one), 'times one', 1.5,
                      runs=runs, published='not published; its code: one after another')
            yield Row.of(f"{what}: the robot's CPU", spent_by_many, 's')
            yield Row(f"{what}: the robot's CPU", statistics.median(spent_by_many)
                      / statistics.median(spent), 'times one', runs=runs)


def list_all(runs: int) -> Iterator[Row]:
    """Yield what it takes to look for machines in all regions of all clouds."""
    with contextlib.ExitStack() as stack:
        home = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        boxes = []
        environment = {**os.environ, 'HOME': str(home), 'FOGROS2_STATE_HOME': str(home / 'state')}
        for cloud in (kind() for kind in CLOUDS.values()):
            boxes.append(stack.enter_context(cloud.open()))
            # this computer reaches all boxes; the robot beside a box reaches that box alone
            environment.update(cloud.variables(boxes[-1], home, here=True))
        taken = []
        for _ in range(runs + 1):
            for box in boxes:
                box.forget_calls()
            begin = time.perf_counter()
            done = ros2('fog', 'list', environment=environment, timeout=120.0)
            taken.append(time.perf_counter() - begin)
            if done.returncode != 0 or done.stderr:
                raise SystemExit(f'ros2 fog list failed:\n{done.stdout}{done.stderr}')
        requests = sum(sum(bool(call.service) for call in box.calls()) for box in boxes)
    regions = sum(len(load('fogros2.provider', name).region_names()) for name in CLOUDS)
    yield Row.of(f'ros2 fog list, {regions} regions of {len(CLOUDS)} clouds', taken[1:], 's',
                 2.0)
    yield Row('requests', requests, 'requests', 2.0 * regions, runs=1)


def main() -> None:
    """Take the figures of a provider."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--provider', choices=[*CLOUDS, 'kubernetes', 'all'], default='aws')
    parser.add_argument('--runs', type=int, default=3)
    arguments = parser.parse_args()
    if arguments.provider == 'kubernetes':
        startup_kubernetes.measure(arguments.runs)
        return
    if arguments.provider == 'all':
        write('startup_list', 'ros2 fog list over all clouds', list(list_all(arguments.runs)))
        return
    write(f'startup_{arguments.provider}',
          f'From ros2 launch to the first message, {BOXES[arguments.provider]} in a box',
          [*start(arguments.provider, arguments.runs),
           *several(arguments.provider, arguments.runs)])


if __name__ == '__main__':
    main()
