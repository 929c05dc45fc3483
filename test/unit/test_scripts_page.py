# SPDX-License-Identifier: Apache-2.0
"""What programs may rely on is what ``doc/reference/scripts.md`` says."""

from __future__ import annotations

import ast
import dataclasses
from decimal import Decimal
import functools
import inspect
import json
from pathlib import Path
import re
import sys
from typing import Any, get_type_hints
from unittest.mock import Mock

import pytest
from ros2cli.cli import main

from fogros2 import events, plugin_system
from fogros2.clock import ClockOffset
from fogros2.journal import Step
from fogros2.model import MachineSpec, Volume
from fogros2.provider.machine_types import MachineType
from fogros2.provider.vm.images import Image
from fogros2.store import Record, Store
from fogros2_features.guests.listing import Guest
from fogros2_features.images import baking
from fogros2_features.prices import verbs as price
from fogros2_features.prices.offers import Offer
from fogros2_features.volumes import listing
from fogros2_replicas import figures
from fogros2_testing.fakes import MemoryProvider
from fogros2_testing.plugins import instead
from ros2fog_cli.api import output, shown, watching
from ros2fog_cli.api.doctor import Check
from ros2fog_cli.api.machines import Entry
from ros2fog_cli.api.reach import Link

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / 'doc' / 'reference' / 'scripts.md').read_text()
#: Names that are constants of Python or an alias in sudo's rules.
CONSTANTS = {'FOGROS2_FILE', 'FOGROS2_SOURCE', 'FOGROS2_VPN'}


@pytest.fixture(autouse=True)
def memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MemoryProvider, 'machines', {})
    instead(monkeypatch, 'fogros2.provider', {'memory': MemoryProvider})


def section(heading: str) -> str:
    """Return the text below a heading, up to the next one of its level or above."""
    level = heading.split()[0]
    rest = PAGE.split(f'\n{heading}\n')[1]
    return re.split(rf'^#{{2,{len(level)}}} ', rest, maxsplit=1, flags=re.MULTILINE)[0]


def fields(heading: str, table: int = 0) -> list[str]:
    """Return the names in the first column of a table."""
    tables = re.findall(r'(?:^\|.*\n)+', section(heading), re.MULTILINE)
    return [name for row in tables[table].splitlines()[2:]
            for name in re.findall('`([^`]+)`', row.split(' | ')[0])]


def parts(name: str) -> list[str]:
    """Return the names in the second column of a field of ``status``."""
    row = next(line for line in section('### `ros2 fog status`').splitlines()
               if line.startswith(f'| `{name}` |'))
    return re.findall('`([^`]+)`', row.split(' | ')[1])


def keys(data: Any) -> list[str]:
    return sorted(field.name for field in dataclasses.fields(data))


def test_all_variables_are_on_the_page() -> None:
    folders = [*(path.parent for path in ROOT.glob('*/__init__.py')), ROOT / 'ros2_embedded',
               ROOT / 'tools', ROOT / 'packaging', ROOT / 'launch']
    files = [path for folder in folders for path in folder.rglob('*')
             if path.is_file() and '__pycache__' not in path.parts and path.suffix != '.pyc']
    named = {name for path in [*files, ROOT / 'Makefile', ROOT / 'setup.py', ROOT / 'package.xml']
             for name in re.findall(r'(?<![A-Z_])FOGROS2_[A-Z0-9_]*[A-Z0-9]\b',
                                    path.read_text(errors='replace'))}
    for name in plugin_system.names('fogros2.configured'):
        if plugin_system.load('fogros2.configured', name).__module__.endswith('.login'):
            named.add(f'FOGROS2_{name.upper()}_REGIONS')
    tables = re.findall('`(FOGROS2_[A-Z0-9_]+)`', section('## Variables'))
    assert sorted(tables) == sorted(named - CONSTANTS)


def test_fields_of_list_are_on_the_page() -> None:
    found = Entry('a', 'memory').to_json()
    assert sorted(fields('### `ros2 fog list`')) == sorted(found)


def test_fields_of_status_are_on_the_page(capsys: pytest.CaptureFixture[str]) -> None:
    Store().save(Record('a', 'memory', MachineSpec('a', 'memory')))
    assert main(argv=['fog', 'status', 'a', '--json']) == 1
    found = json.loads(capsys.readouterr().out)
    assert found['version'] == output.JSON_VERSION
    assert sorted([*fields('### `ros2 fog list`'), *fields('### `ros2 fog status`'), 'version']) \
        == sorted(found)
    assert sorted(parts('vpn')) == keys(Link) and sorted(parts('clock')) == keys(ClockOffset)
    assert sorted(parts('guests')) == sorted(get_type_hints(Guest))
    (row,) = figures.rows('a', [figures.Figures('a')])
    assert sorted(parts('replicas')) == sorted(row)


def test_fields_of_streams_are_on_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('rclpy')
    from fogros2_monitor.dashboard.graph import GraphNode
    from fogros2_monitor.dashboard.ways import Stream

    node = Mock(_ears={}, _reports={'/b': (0.0, None)})
    for name in ('_rates', '_share'):
        setattr(node, name, functools.partial(getattr(GraphNode, name), node))
    stream = GraphNode._stream(node, Stream('/image', 'h264', '/b', 'kind', 'a', '', True))
    monkeypatch.setattr(watching, 'TIMEOUT', 0.0)
    monkeypatch.setattr(watching, 'Live', lambda **_: Mock(state=lambda: {
        # graphs.py adds these for the dashboard
        'streams': [{**stream, 'id': 'x /image', 'picture': 0}]}))
    (found,) = watching.streams('a')
    assert sorted(parts('streams')) == sorted(found)


def test_fields_of_the_agent_are_on_the_page() -> None:
    hints = get_type_hints(events.Status)
    assert sorted(fields('### `ros2 fog status`', 1)) == sorted(hints)
    agent = section('### `ros2 fog status`').partition('The fields of `agent`')[2]
    for name, kind in (('nodes', events.NodeStatus), ('kept', events.HealthCheck)):
        row = next(line for line in agent.splitlines() if line.startswith(f'| `{name}`'))
        assert sorted(re.findall('`([^`]+)`', row.split(' | ')[1])) == sorted(get_type_hints(kind))


def test_fields_of_watch_are_on_the_page() -> None:
    found = shown.machine_json('a', shown.Shown(Entry('a', 'memory'), figures={'replicas': []}))
    assert sorted(fields('### `ros2 fog status --watch`')) == sorted(found)
    row = next(line for line in section('### `ros2 fog status --watch`').splitlines()
               if line.startswith('| `steps`'))
    assert sorted(re.findall('`([^`]+)`', row)[1:]) == keys(Step)


def test_fields_of_gc_are_on_the_page(capsys: pytest.CaptureFixture[str]) -> None:
    Store().save(Record('a', 'memory', MachineSpec('a', 'memory'), machine_id='id-a'))
    assert main(argv=['fog', 'gc', '--dry-run', '--json']) == 0
    (cleared,) = json.loads(capsys.readouterr().out)['cleared']
    assert sorted(fields('### `ros2 fog gc`')) == sorted(cleared)


def test_fields_of_price_are_on_the_page() -> None:
    offer = Offer('here', MachineType('small', 2, 1, 4.0, 'x86_64'), Decimal('0.1'), provider='x')
    found = price.to_json(offer)
    assert sorted(fields('### `ros2 fog price`')) == sorted(found)
    assert (found['price'], found['spot_price']) == (0.1, None)


def test_fields_of_regions_are_on_the_page() -> None:
    tree = ast.parse((ROOT / 'ros2fog_cli/verb/regions.py').read_text())
    (found,) = [node for node in ast.walk(tree) if isinstance(node, ast.Dict)]
    assert sorted(fields('### `ros2 fog regions`')) == sorted(map(ast.literal_eval, found.keys))


def test_fields_of_images_volumes_and_checks_are_on_the_page() -> None:
    assert sorted(fields('### `ros2 fog image list`')) == sorted(
        baking.to_json(Image('i', 'n', 'p')))
    assert sorted(fields('### `ros2 fog volume list`')) == sorted(
        listing.to_json(Volume('i', 'n', 'p')))
    assert sorted(fields('### `ros2 fog doctor`')) == keys(Check)


def test_each_verb_with_json_is_on_the_page() -> None:
    modules = {name: sys.modules[plugin_system.load('fogros2.verb', name).__module__]
               for name in plugin_system.names('fogros2.verb')}
    with_json = {name for name, module in modules.items()
                 if 'add_json(' in inspect.getsource(module)}
    assert {heading.split()[0] for heading in re.findall('### `ros2 fog (.*)`', PAGE)} == with_json


def test_verbs_end_with_the_statuses_of_the_page(capsys: pytest.CaptureFixture[str]) -> None:
    said = re.findall(r'^\| (\d) \|', section('## Exit statuses'), re.MULTILINE)
    assert said == ['0', '1', '2']
    for path in (*(ROOT / 'ros2fog_cli' / 'verb').glob('*.py'),
                 *(ROOT / 'fogros2_features').glob('*/verbs.py')):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Return) and isinstance(node.value, ast.Constant) \
                    and type(node.value.value) is int:
                assert str(node.value.value) in said, path.name
    assert main(argv=['fog', 'list']) == 0
    assert isinstance(main(argv=['fog', 'wait', 'a', '--timeout', '0']), str)  # exit status 1
    with pytest.raises(SystemExit) as wrong:
        main(argv=['fog', 'wait'])
    assert wrong.value.code == 2


def test_interrupted_verb_ends_with_the_status_of_the_page(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(MemoryProvider, 'find', lambda self, tags: (
        _ for _ in ()).throw(KeyboardInterrupt))
    Store().save(Record('a', 'memory', MachineSpec('a', 'memory')))
    assert int(main(argv=['fog', 'list'])) == 2
