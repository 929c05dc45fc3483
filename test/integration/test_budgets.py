# SPDX-License-Identifier: Apache-2.0
"""Machines with a price: those of a killed launch end when they have spent its budget."""

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

pytestmark = [pytest.mark.usefixtures('nothing_left')]

#: A container costs a cent in a second, and may be made for a short time.
PROVIDER = """
from decimal import Decimal

from fogros2 import ContainerInstance
from fogros2.provider.container import ContainerProvider
from fogros2_features import budget

budget.LEAST, budget.ENDING, budget.INTERVAL = 20.0, 10.0, 0.2


class PricedProvider(ContainerProvider):
    name = 'priced'

    def cost_per_hour(self, spec):
        return Decimal(36)


class Priced(ContainerInstance):
    provider = 'priced'
"""
#: The second machine comes when the first one is up.
LATER = """
from launch.actions import TimerAction

from fogros2 import CloudNode, FogROSLaunchDescription
from fogt_priced import Priced


def generate_launch_description():
    first, second = (CloudNode(
        machine=Priced(name={name!r} + end, network={network!r}, ros_workspace='',
                       robot_timeout=600, **words),
        package='fogros2_examples', executable='talker')
        for end, words in (('-a', {{'launch_budget': '2 USD'}}), ('-b', {{}})))
    return FogROSLaunchDescription([first, TimerAction(period=0.1, actions=[second])])
"""


@pytest.fixture
def name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return how the names of machines begin; the provider 'priced' is installed."""
    site = tmp_path / 'site'
    monkeypatch.setenv('PYTHONPATH', install(
        site, 'fogros2.provider', 'priced', PROVIDER, 'PricedProvider'))
    with open(site / 'fogt_priced-0.dist-info/entry_points.txt', 'a') as points:
        points.write('[fogros2.machine]\npriced = fogt_priced:Priced\n')
    return f'budget-{uuid.uuid4().hex[:6]}'


def podman(*words: str) -> str:
    done = subprocess.run(argv(Command(('podman', *words), sudo=True)), check=True,
                          capture_output=True, text=True, timeout=60)
    return done.stdout


def test_machines_of_a_killed_launch_end_within_its_budget(
    name: str, cloud_network: str, tmp_path: Path,
) -> None:
    """The first machine is alone at first, and has less time when the second one comes."""
    path = tmp_path / 'later.launch.py'
    path.write_text(LATER.format(name=name, network=cloud_network))
    store = Store()

    def ends(which: str) -> float:
        record = store.load(f'{name}-{which}')
        return record.armed + record.spec.lifetime

    with launching() as start:
        run = start(str(path))
        run.wait_for('process started with pid')
        alone = ends('a')
        run.wait_for('process started with pid', times=2)
        together = ends('a')
        assert together < alone - 20.0 and abs(ends('b') - together) < 3.0
        shown = json.loads(ros2('fog', 'status', f'{name}-a', '--json').stdout)
        row = dict(shown['features'])
        assert re.fullmatch(r'\$[01]\.\d\d left of \$2\.00', row['launch budget']), row
        run.wait_for("80% of the launch's budget of $2.00 is spent")
        run.kill()
    wait_until(lambda: name not in podman('ps', '--format', '{{.Names}}'),
               timeout=alone - time.time(), interval=0.5, what='the end of both')
    assert time.time() < together + 10.0
    assert ros2('fog', 'gc').returncode == 0
