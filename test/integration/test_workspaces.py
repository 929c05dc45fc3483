# SPDX-License-Identifier: Apache-2.0
"""A chain of two sourced workspaces on a machine that has nothing of this computer's."""

from __future__ import annotations

import os
from pathlib import Path
import shutil
import uuid

import pytest

from fogros2.deploy import Launch
from fogros2.host.workspace import find_workspaces, underlays
from fogros2.model import MachineSpec, NodeSpec
from fogros2.report import StepDone
from fogros2.waiting import wait_until
from rigs.colcon_workspace import colcon_workspace

pytestmark = [
    pytest.mark.usefixtures('nothing_left', 'isolated_root'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]


def test_node_imports_from_an_underlay_on_an_isolated_machine(
    cloud_network: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    program = ('from fogt_base.text import said\nfrom fogt_top.text import name\n'
               'print(name, said)\n')
    for name, programs, module in (
            ('base', {}, "said = 'below'"), ('top', {'node': program}, "name = 'top'")):
        for variable, value in colcon_workspace(
                tmp_path / name, f'fogt_{name}', programs=programs, module=module).items():
            monkeypatch.setenv(variable, value)
    chain = find_workspaces(os.environ)
    assert chain == [str(tmp_path / 'top'), str(tmp_path / 'base')]
    monkeypatch.setenv('AMENT_PREFIX_PATH', f"{os.environ['AMENT_PREFIX_PATH']}:/srv/acme")
    spec = MachineSpec(
        f'chain-{uuid.uuid4().hex[:6]}', 'container',
        {'network': cloud_network, 'isolated': True}, workspace=chain[0],
        underlays=underlays(chain[0], chain))
    heard, events = [], []
    launch = Launch(report=events.append)
    try:
        machine = launch.up(spec)
        machine.subscribe(heard.append)
        machine.start([NodeSpec('n-1', 'node', package='fogt_top', executable='node')])
        wait_until(lambda: any(e['event'] == 'exited' and e['node'] == 'n-1' for e in heard),
                   timeout=60, what='the node to end')
    finally:
        assert launch.down() == []
    said = ''.join(e['text'] for e in heard if e['event'] == 'output' and e['node'] == 'n-1')
    assert 'top below' in said
    (detail,) = [e.detail for e in events if isinstance(e, StepDone) and e.step == 'workspace']
    assert '/srv/acme stays here' in detail
