# SPDX-License-Identifier: Apache-2.0
"""Machines with a price: all of a launch end when they have spent its budget."""

from __future__ import annotations

import json
from pathlib import Path
import re
import subprocess
import time
import uuid

import pytest

from fogros2.model import Command
from fogros2.process import argv
from fogros2.store import Store
from fogros2.waiting import wait_until
from fogros2_testing.plugins import install
from rigs.launched import launching, ros2

pytestmark = [pytest.mark.usefixtures('nothing_left', 'engine')]

#: A container costs a cent in a second, and may be made for a short time.
PROVIDER = """
from decimal import Decimal

from fogros2.provider.container import ContainerProvider
from fogros2_features import budget

budget.LEAST, budget.INTERVAL = 20.0, 0.2


class PricedProvider(ContainerProvider):
    name = 'priced'

    def cost_per_hour(self, spec):
        return Decimal(36)
"""
LAUNCH = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription
from launch.actions import TimerAction


class Priced(ContainerInstance):
    provider = 'priced'


def node(name, **words):
    machine = Priced(name=name, network={network!r}, ros_workspace='', **words)
    return CloudNode(machine=machine, package='fogros2_examples', executable='talker')


def generate_launch_description():
    return FogROSLaunchDescription([
        node({name!r} + '-a', launch_budget={budget!r}, {words}), {second}])
"""
TOGETHER, LATER = "node({name!r} + '-b')", "TimerAction(period=0.1, actions=[node({name!r} + '-b')])"


def write(folder: Path, network: str, name: str, budget: str, second: str, words: str) -> str:
    path = folder / 'budget.launch.py'
    path.write_text(LAUNCH.format(network=network, name=name, budget=budget, words=words,
                                  second=second.format(name=name)))
    return str(path)


@pytest.fixture
def priced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv('PYTHONPATH', install(
        tmp_path / 'site', 'fogros2.provider', 'priced', PROVIDER, 'PricedProvider'))


def machines(engine: str, name: str) -> list[str]:
    done = subprocess.run(argv(Command((
        engine, 'ps', '--format', '{{.Names}}', '--filter', f'name=fogros2-{name}'), sudo=True)),
        check=True, capture_output=True, text=True, timeout=60)
    return done.stdout.split()


def test_launch_with_a_replacement_ends_within_its_budget(
    tmp_path: Path, cloud_network: str, engine: str, priced: None,
) -> None:
    name = f'budget-{uuid.uuid4().hex[:6]}'
    path = write(tmp_path, cloud_network, name, '1.60', TOGETHER,
                 "on_interrupt='replace', max_replacements=1, robot_timeout=10")
    with launching() as start:
        run = start(path)
        run.wait_for('process started with pid', times=2)
        subprocess.run(argv(Command((engine, 'rm', '-f', '-t', '0', f'fogros2-{name}-a'),
                                    sudo=True)), check=True, capture_output=True, timeout=60)
        run.wait_for('a new machine runs the nodes')
        shown = json.loads(ros2('fog', 'status', f'{name}-b', '--json').stdout)
        (what, text), = shown['features']
        assert what == 'launch budget' and re.fullmatch(r'\$[01]\.\d\d left of \$1\.60', text)
        run.wait_for("80% of the launch's budget of $1.60 is spent")
        run.wait_for('the agent ends everything: lifetime', times=2)
        assert run.ended() != 0, run.text
    assert run.text.count("80% of the launch's") == 1
    total = re.search(r'all machines: \$([\d.]+)', run.text)
    # they end themselves; the launch counts until it notices
    assert total is not None and 1.4 < float(total[1]) < 1.7, run.text


def test_machines_of_a_killed_launch_end_within_its_budget(
    tmp_path: Path, cloud_network: str, engine: str, priced: None,
) -> None:
    """The first machine is alone at first, and its time is shorter when the second one comes."""
    name = f'budget-{uuid.uuid4().hex[:6]}'
    path = write(tmp_path, cloud_network, name, '2', LATER, 'robot_timeout=600')
    store = Store()

    def ends(which: str) -> float:
        record = store.load(f'{name}-{which}')
        return record.armed + record.spec.lifetime

    with launching() as start:
        run = start(path)
        run.wait_for('process started with pid', times=1)
        alone = ends('a')
        run.wait_for('process started with pid', times=2)
        shared = ends('a')
        assert shared < alone - 20.0 and abs(ends('b') - shared) < 3.0
        run.kill()
    wait_until(lambda: not machines(engine, name), timeout=alone - time.time(),
               what='the end of both')
    assert time.time() < shared + 10.0
    assert ros2('fog', 'gc').returncode == 0
