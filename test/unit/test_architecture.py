# SPDX-License-Identifier: Apache-2.0
"""Holds the direction of imports and the calls that no part may make."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
import re
import subprocess

import pytest

ROOT = Path(__file__).resolve().parents[2]
CORE = ROOT / 'fogros2'

#: Who may import whom: a module's layer imports its own and lower ones.
LAYERS = [
    {'model'},
    {'errors', 'clock'},
    {'waiting', 'report', 'process', 'plugin_system'},
    {'kubernetes_client'},
    {'store', 'journal', 'plan', 'host', 'provider', 'shell', 'vpn', 'dds', 'image_transport',
     'agent_client', 'agent', 'cloud_launch', 'monitor_addresses', 'workspace', 'wheels', 'locked',
     'modules', 'dependencies', 'undeclared', 'bootstrap', 'container_scripts', 'containers',
     'ros2_daemon'},
    {'deploy', 'testing'},
    {'actions'},
]
SEAMS = ('provider', 'shell', 'vpn', 'dds', 'image_transport')
#: Only these may import launch or rclpy; the second runs on the machine.
ROS_ALLOWED = ('actions', 'cloud_launch')
ROS = ('launch', 'launch_ros', 'rclpy', 'ros2cli', 'ament_index_python')
#: SDKs belong to one plugin each.
SDKS = {'boto3': 'provider', 'botocore': 'provider', 'kubernetes': 'kubernetes_client',
        'paramiko': 'shell', 'av': 'image_transport', 'foxglove': 'fogros2_monitor'}
#: Found by their entry points, or started by the user: the core imports none of them.
ABOVE = ('fogros2_monitor', 'ros2fog_cli', 'rigs')


def python_files(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.rglob('*.py')) if '__pycache__' not in path.parts]


def part(path: Path) -> str:
    """Return the name of the part of the core that a file belongs to."""
    return path.relative_to(CORE).parts[0].removesuffix('.py')


def imports(path: Path) -> Iterator[tuple[str, bool]]:
    """Yield what a file imports, and whether that is when it is itself imported."""
    tree = ast.parse(path.read_text(), str(path))
    late = {id(node) for function in ast.walk(tree)
            if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef))
            for node in ast.walk(function)}
    typing_only = {id(node) for block in ast.walk(tree)
                   if isinstance(block, ast.If) and 'TYPE_CHECKING' in ast.unparse(block.test)
                   for node in ast.walk(block)}
    for node in ast.walk(tree):
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.Import):
            for name in node.names:
                yield name.name, id(node) not in late
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for name in node.names:
                yield f'{node.module}.{name.name}', id(node) not in late


def rank(name: str) -> int:
    for number, layer in enumerate(LAYERS):
        if name in layer:
            return number
    raise AssertionError(f'fogros2.{name} has no layer yet: give it one in this test')


@pytest.mark.parametrize('path', python_files(CORE), ids=lambda p: str(p.relative_to(CORE)))
def test_imports_point_downwards(path: Path) -> None:
    own = part(path)
    if own == '__init__':
        return
    for name, _ in imports(path):
        words = name.split('.')
        if words[0] == 'fogros2' and len(words) > 1:
            other = words[1]
            if not (CORE / other).is_dir() and not (CORE / f'{other}.py').is_file():
                continue  # a name of the package itself
            assert rank(other) <= rank(own), f'{own} imports {name}'
        assert words[:2] != ['fogros2', 'testing'] or own == 'testing', f'{own} imports {name}'
        assert words[0] not in ROS or own in ROS_ALLOWED, f'{own} imports {name}'
        if words[0] in SDKS:
            assert own == SDKS[words[0]], f'{own} imports {name}'


@pytest.mark.parametrize(('folder', 'above'), [
    ('fogros2', ABOVE), ('fogros2_monitor', ABOVE[1:]), ('image_transport_h264', ABOVE)])
def test_package_imports_nothing_above_it(folder: str, above: tuple[str, ...]) -> None:
    pattern = rf"^\s*(from|import) ({'|'.join(above)})\b"
    for path in python_files(ROOT / folder):
        assert not re.search(pattern, path.read_text(), re.MULTILINE), path


@pytest.mark.parametrize('seam', SEAMS)
def test_a_plugin_imports_no_other_plugin(seam: str) -> None:
    for path in python_files(CORE / seam):
        for name, _ in imports(path):
            words = name.split('.')
            if words[:1] == ['fogros2'] and len(words) > 2 and words[1] in SEAMS:
                plugin = (CORE / words[1] / f'{words[2]}.py').is_file()
                assert words[1] == seam or not plugin, f'{path.name} imports {name}'
            assert words[:2] not in (['fogros2', 'deploy'], ['fogros2', 'actions']), \
                f'{path.name} imports {name}'


def test_a_verb_imports_nothing_slow_before_it_runs() -> None:
    """``ros2 fog -h`` loads all verbs; one of them must not bring an SDK or the core with it."""
    for path in python_files(ROOT / 'ros2fog_cli' / 'verb'):
        for name, early in imports(path):
            if early:
                assert name.split('.')[0] in (
                    'ros2fog_cli', 'ros2cli', '__future__', 'abc', 'argparse', 'dataclasses',
                    'json', 'shlex', 'sys', 'time', 'typing'), f'{path.name} imports {name}'
                assert 'ros2fog_cli.api' not in name, f'{path.name} imports {name}'


def test_the_agent_is_one_file_of_the_standard_library() -> None:
    import sys
    for name, _ in imports(CORE / 'agent.py'):
        assert name.split('.')[0] in sys.stdlib_module_names, name


#: The one place that opens a port to everybody.
WIREGUARD_OPEN = CORE / 'provider' / 'aws' / 'network.py'
FORBIDDEN = {
    r'^\s*(import|from) (pickle|marshal|shelve|dill)\b': 'nothing executable is deserialised',
    r'AutoAddPolicy|WarningPolicy': 'host keys are pinned',
    r'StrictHostKeyChecking[= ](no|off|accept-new)': 'host keys are pinned',
    r'UserKnownHostsFile[= ]/dev/null': 'host keys are pinned',
    r'shell=True': 'no shell reads our words',
    r'\bos\.(system|popen)\(': 'no shell reads our words',
    r'\byaml\.(load|unsafe_load|full_load)\(': 'yaml.safe_load',
    r'0\.0\.0\.0/0': 'nothing is open to the world',
}


@pytest.mark.parametrize('pattern', FORBIDDEN)
def test_forbidden_words(pattern: str) -> None:
    for folder in ('fogros2', 'fogros2_monitor', 'ros2fog_cli', 'fogros2_examples', 'launch',
                   'tools', 'test/rigs'):
        for path in python_files(ROOT / folder):
            found = re.search(pattern, path.read_text(), re.MULTILINE)
            if found and path.name == 'agent.py' and 'shell=True' in found[0]:
                found = None
            if found and path == WIREGUARD_OPEN and found[0] == '0.0.0.0/0':
                # its one occurrence: WireGuard's port, which answers nobody it doesn't know
                assert path.read_text().count(found[0]) == 1
                found = None
            assert not found, f'{path.relative_to(ROOT)}: {found[0]!r}: {FORBIDDEN[pattern]}'


def test_no_process_is_started_but_by_its_module() -> None:
    """A command that is waited for goes through ``process``; streams and daemons are few."""
    allowed = {'process.py', 'agent.py', 'cloud_launch.py', 'serve.py'}
    for path in (*python_files(CORE), *python_files(ROOT / 'fogros2_monitor')):
        if path.name not in allowed and 'subprocess' in path.read_text():
            names = {name for name, _ in imports(path)}
            place = path.relative_to(ROOT)
            assert not names & {'subprocess'} or place.parts[1] in ('shell', 'provider'), \
                f'{place} imports subprocess'


def test_every_source_file_says_its_licence() -> None:
    tracked = subprocess.run(['git', 'ls-files', '-co', '--exclude-standard'], cwd=ROOT, text=True,
                             capture_output=True).stdout.split()
    if not tracked:
        pytest.skip('not a git checkout')
    for name in tracked:
        path = ROOT / name
        if path.suffix in ('.py', '.sh') and path.is_file() and path.stat().st_size:
            head = path.read_text().splitlines()[:2]
            assert any('SPDX-License-Identifier: Apache-2.0' in line for line in head), name


@pytest.mark.parametrize('name', ['launch', 'test', 'test/launch'])
def test_no_package_shadows_ros(name: str) -> None:
    assert not (ROOT / name / '__init__.py').exists()
