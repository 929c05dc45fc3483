# SPDX-License-Identifier: Apache-2.0
"""Check the direction of imports, module by module, and the calls that no part may make."""

from __future__ import annotations

import ast
from collections.abc import Iterator
import functools
from graphlib import TopologicalSorter
from importlib import util
from pathlib import Path
import re
import subprocess
import sys

import pytest

from fogros2.describe import features, keywords
from fogros2.describe.machines import ContainerInstance

ROOT = Path(__file__).resolve().parents[2]
CORE = ROOT / 'fogros2'
EMBEDDED = ROOT / 'ros2_embedded'
PACKAGES = ('fogros2_features', 'fogros2_replicas', 'fogros2_share', 'image_transport_h264',
            'point_cloud_stream', 'fogros2', 'fogros2_monitor', 'ros2fog_cli')

#: The parts of the core, lowest first; a module imports only its own part and those before it.
#: Inside a package the order is the one in which the docstring of its ``__init__`` names the
#: modules (``name``), lowest first. All imports count, also late ones and those for types.
ORDER = """
    model untrusted errors events clock python_module
    ros_names
    waiting report process
    agent ros_types
    plugin_system store journal ros2_daemon
    kubernetes_client
    shell vpn dds
    agent_client
    provider
    plan
    host
    feature
    deploy
    describe launch_internals runtime actions
    __init__
""".split()
#: Plugins that are named by others: (importing module, plugin). Only ever remove lines.
NAMED_PLUGINS = {
    ('fogros2.deploy.robot', 'fogros2.vpn.helped'),
    ('fogros2.deploy.robot_vpn', 'fogros2.vpn.helped'),
    ('fogros2_features.guests.membership', 'fogros2.vpn.helped'),
    ('fogros2_features.hosts.hosted', 'fogros2.provider.container'),
    ('fogros2_features.hosts.served', 'fogros2.provider.container'),
    ('fogros2_features.images.pods', 'fogros2.provider.kubernetes'),
    ('fogros2_monitor.application', 'fogros2.provider.container'),
    ('ros2fog_cli.api.doctor', 'fogros2.dds.cyclonedds'),
    ('ros2fog_cli.api.doctor', 'fogros2.provider.container'),
    ('ros2fog_cli.api.doctor', 'fogros2.vpn.helped'),
}
#: Packages whose docstring does not name all modules in order yet. Only ever remove names.
UNLISTED = {
    'fogros2_monitor', 'fogros2_monitor.dashboard', 'ros2fog_cli', 'ros2fog_cli.api',
}
#: Where plugins live: each plugin is one module or package below one of these.
INTERFACES = ('provider', 'shell', 'vpn', 'dds')
#: Only these may import launch or rclpy; the last is for programs of ROS 2.
ROS_ALLOWED = ('describe', 'launch_internals', 'runtime', 'actions', 'ros_types')
ROS = ('launch', 'launch_ros', 'rclpy', 'ros2cli', 'ament_index_python')
#: SDKs belong to one plugin each.
SDKS = {'boto3': 'provider', 'botocore': 'provider', 'kubernetes': 'kubernetes_client',
        'google': 'provider', 'paramiko': 'shell', 'av': '',
        'foxglove': 'fogros2_monitor'}
#: Found by their entry points, or started by the user: the core imports none of them.
ABOVE = ('fogros2_features', 'fogros2_monitor', 'fogros2_replicas', 'fogros2_share',
         'fogros2_testing', 'ros2fog_cli', 'rigs')
#: Names of features that the core had, and clouds may have. Only ever add some.
MOVED = (
    'StreamTopic', 'image_transport', 'republish(ers)?', r'[Cc]heckpoint\w*', r'[Rr]eplacer\w*',
    r'Replacement\w*', 'drained', r'\w*[Gg]uest\w*', '[Ii]nvit(e|ed|ations?)', 'JoinedMachine',
    r'[Ff]oxglove\w*', r'\w*[Mm]onitor(ed|_\w+)?', '[Dd]ashboard',
    r'[Rr]eplic\w*', 'first_answer', 'HostedProvider', 'served', 'shared topics',
    r'\w*docker_(containers?|lines)', 'container_scripts', 'has_image',
    r'Cheapest\w*', r'find_cheapest\w*', 'Market', 'Wants', 'Offers?', 'bake', 'delete_image',
    r'(Image|Volume)Keeper')
CLOUDS = {'aws', 'azure', 'gcp', 'kubernetes'}
#: All of the core but the import of types.
BUT_TYPES = r'fogros2(?! import ros_types$)'


def python_files(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.rglob('*.py')) if '__pycache__' not in path.parts]


def part(path: Path) -> str:
    """Return the name of the part of the core that a file belongs to."""
    return path.relative_to(CORE).parts[0].removesuffix('.py')


@functools.cache
def text(path: Path) -> str:
    return path.read_text()


@functools.cache
def imports(path: Path) -> list[tuple[str, bool]]:
    """Return what a file imports, and whether that is when it is itself imported."""
    root = EMBEDDED if EMBEDDED in path.parents else ROOT
    return list(_imports(ast.parse(text(path), str(path)),
                         '.'.join(path.relative_to(root).parts[:-1])))


def _imports(
    block: ast.AST, package: str, early: bool = True,
) -> Iterator[tuple[str, bool]]:
    early = early and not isinstance(block, (ast.FunctionDef, ast.AsyncFunctionDef)) and not (
        isinstance(block, ast.If) and 'TYPE_CHECKING' in ast.unparse(block.test))
    for node in ast.iter_child_nodes(block):
        if isinstance(node, ast.Import):
            for name in node.names:
                yield name.name, early
        elif isinstance(node, ast.ImportFrom):
            base = util.resolve_name('.' * node.level + (node.module or ''), package)
            for name in node.names:
                yield f'{base}.{name.name}', early
        elif not isinstance(node, ast.expr):
            yield from _imports(node, package, early)


@functools.cache
def modules(root: Path = ROOT, packages: tuple[str, ...] = PACKAGES) -> dict[str, Path]:
    """Return the file of each module of the packages."""
    return {'.'.join(path.relative_to(root).with_suffix('').parts).removesuffix('.__init__'): path
            for package in packages for path in python_files(root / package)}


@functools.cache
def graph(root: Path = ROOT, packages: tuple[str, ...] = PACKAGES) -> dict[str, set[str]]:
    """Return the modules of ours that each module imports."""
    known = modules(root, packages)
    found: dict[str, set[str]] = {}
    for name, path in known.items():
        named = {other for other, _ in imports(path)}
        found[name] = {
            other if other in known else other.rpartition('.')[0] for other in named} & {*known}
        found[name].discard(name)
    return found


def packages() -> list[str]:
    return [name for name, path in modules().items() if path.name == '__init__.py']


def inside(package: str) -> list[str]:
    """Return the names of a package's modules and subpackages."""
    return [name.rpartition('.')[2] for name in modules() if name.rpartition('.')[0] == package]


def child(package: str, module: str) -> str:
    """Return what of a package a module belongs to: its own name there, '' for nothing."""
    if module == package:
        return '__init__'
    return module[len(package) + 1:].partition('.')[0] if module.startswith(package + '.') else ''


def upward(package: str, order: list[str]) -> set[tuple[str, str]]:
    """Return the imports inside a package that contradict an order: (module, imported module)."""
    return {(name, other) for name, others in graph().items() for other in others
            if (own := child(package, name)) in order and (below := child(package, other)) in order
            and order.index(below) > order.index(own)}


def test_imports_follow_the_order() -> None:
    assert {*inside('fogros2')} <= {*ORDER}
    assert upward('fogros2', ORDER) == set()


@pytest.mark.parametrize('package', [name for name in packages() if name != 'fogros2'])
def test_package_lists_modules_in_order(package: str) -> None:
    """No order is needed where no module imports another."""
    names = inside(package)
    docstring = ast.get_docstring(ast.parse(modules()[package].read_text())) or ''
    order = [n for n in dict.fromkeys(re.findall(r'``(\w+)``', docstring)) if n in names]
    any_import = upward(package, names) | upward(package, names[::-1])
    wrong = any_import and ({*names} - {*order} or upward(package, order))
    assert bool(wrong) == (package in UNLISTED), wrong or 'remove it from the list'


@pytest.mark.parametrize('package', packages())
def test_no_circle_of_imports(package: str) -> None:
    """Between the modules of a package, where a subpackage is one module."""
    between: dict[str, set[str]] = {}
    for name, others in graph().items():
        own = child(package, name)
        if own:
            between.setdefault(own, set()).update(
                below for other in others if (below := child(package, other)) not in ('', own))
    TopologicalSorter(between).prepare()


def test_no_circle_of_imports_in_the_embedded_default() -> None:
    """Between modules, whatever an import is for."""
    embedded = graph(EMBEDDED, ('launch', 'launch_ros', 'launch_xml', 'launch_yaml', 'ros2cli'))
    assert 'launch._base' in embedded['launch.actions._simple']
    TopologicalSorter(embedded).prepare()


@pytest.mark.parametrize(('folder', 'above'), [
    ('fogros2', ABOVE),
    # a feature may have verbs
    *((own, tuple(n for n in ABOVE if n not in (own, 'ros2fog_cli')))
      for own in ('fogros2_features', 'fogros2_monitor')),
    ('ros2fog_cli', ('fogros2_features', 'fogros2_monitor', 'fogros2_testing', 'rigs')),
    ('fogros2_replicas', (BUT_TYPES, 'fogros2_monitor', 'ros2fog_cli', 'rigs')),
    ('fogros2_share', (BUT_TYPES, 'fogros2_monitor', 'ros2fog_cli', 'rigs')),
    ('point_cloud_stream', (*ABOVE, 'fogros2')),
    ('image_transport_h264', (*ABOVE, 'fogros2', 'point_cloud_stream'))])
def test_package_imports_nothing_above_it(folder: str, above: tuple[str, ...]) -> None:
    pattern = rf"^\s*(from|import) ({'|'.join(above)})\b"
    for path in python_files(ROOT / folder):
        assert not re.search(pattern, path.read_text(), re.MULTILINE), path


def test_core_names_no_keyword_of_a_feature() -> None:
    lists = features.node_lists()
    # words such as fetch have other uses
    machines = features.machine_lists()
    pattern = '|'.join(rf'{keyword}\b' if '_' in keyword else f'{keyword}=' for keyword in {
        *features.keywords(), *features.keywords('node_options'), *lists, *lists.values(),
        *machines} - {*keywords.keywords(ContainerInstance)} | {*features.keywords()})
    for path in python_files(CORE):
        assert not re.search(rf'\b({pattern})', text(path)), path


def test_core_names_nothing_that_has_moved_to_a_feature() -> None:
    for path in python_files(CORE):
        if not CLOUDS & {*path.parts}:
            assert not re.search(rf"\b({'|'.join(MOVED)})\b", text(path)), path


def plugin(module: str) -> str:
    """Return the plugin that a module belongs to, '' for none."""
    unit = '.'.join(module.split('.')[:3])
    below = child('fogros2', module) in INTERFACES and unit.count('.') == 2
    return unit if below and re.search(rf'\b{unit}[.:]', (ROOT / 'setup.py').read_text()) else ''


def test_plugins_are_found_by_name() -> None:
    """A plugin is imported by its own modules alone: the rest finds it by its entry point."""
    named = {(name, unit) for name, others in graph().items() for other in others
             if (unit := plugin(other)) and plugin(name) != unit}
    assert named == NAMED_PLUGINS, 'load these by their entry points, or shorten the list'


def test_ros_and_sdks_are_imported_by_their_parts() -> None:
    for path in python_files(CORE):
        own = part(path)
        for name, _ in imports(path):
            words = name.split('.')
            assert words[0] not in ROS or own in ROS_ALLOWED, f'{path} imports {name}'
            if words[0] in SDKS:
                assert own == SDKS[words[0]], f'{path} imports {name}'


def test_verb_imports_nothing_slow_before_it_runs() -> None:
    """``ros2 fog -h`` loads all verbs; one of them must not bring an SDK or the core with it."""
    for path in (*python_files(ROOT / 'ros2fog_cli' / 'verb'),
                 *(ROOT / 'fogros2_features').glob('*/verbs.py'),
                 ROOT / 'fogros2_monitor' / 'verbs.py'):
        for name, early in imports(path):
            if early:
                assert name.split('.')[0] in (
                    'ros2fog_cli', 'ros2cli', '__future__', 'abc', 'argparse', 'dataclasses',
                    'json', 'shlex', 'sys', 'time', 'typing'), f'{path.name} imports {name}'
                assert 'ros2fog_cli.api' not in name, f'{path.name} imports {name}'


def test_agent_imports_the_standard_library_only() -> None:
    for path in python_files(CORE / 'agent'):
        for name, early in imports(path):
            allowed = name.startswith('fogros2.agent.') or name.split('.')[0] in (
                sys.stdlib_module_names)
            assert allowed or name.startswith('fogros2.events.') and not early, name


#: The places that open WireGuard's port to everybody, and rules of clouds in a box.
OPEN = (CORE / 'provider' / 'aws' / 'network.py', CORE / 'provider' / 'gcp' / 'firewall.py',
        ROOT / 'test' / 'rigs' / 'gce' / 'catalogue.py',
        ROOT / 'test' / 'rigs' / 'azure' / 'cloud.py')
FORBIDDEN = {
    r'^\s*(import|from) (pickle|marshal|shelve|dill)\b': 'nothing executable is deserialised',
    r'AutoAddPolicy|WarningPolicy': 'host keys are pinned',
    r'StrictHostKeyChecking[= ](no|off|accept-new)': 'host keys are pinned',
    r'UserKnownHostsFile[= ]/dev/null': 'host keys are pinned',
    r'shell=True': 'no shell reads our words',
    r'\bos\.(system|popen)\(': 'no shell reads our words',
    r'\byaml\.(load|unsafe_load|full_load)\(': 'yaml.safe_load',
    r"sys\.executable, '-m', '?(fogros2|worker|pip)": 'RUN_MODULE looks in no current folder',
    r'0\.0\.0\.0/0': 'nothing is open to the world',
}


@pytest.mark.parametrize('pattern', FORBIDDEN)
def test_forbidden_words(pattern: str) -> None:
    for folder in ('fogros2', 'fogros2_monitor', 'ros2fog_cli', 'fogros2_examples', 'launch',
                   'tools', 'test/rigs'):
        for path in python_files(ROOT / folder):
            found = re.search(pattern, text(path), re.MULTILINE)
            if found and path in OPEN and found[0] == '0.0.0.0/0':
                # its one occurrence; WireGuard answers nobody it doesn't know
                assert text(path).count(found[0]) == 1
                found = None
            assert not found, f'{path.relative_to(ROOT)}: {found[0]!r}: {FORBIDDEN[pattern]}'


def test_nodes_have_only_steady_timers() -> None:
    """A timer of the system clock or of ``/clock`` stands still while that clock does."""
    found = [name for name, path in modules().items() if '.create_timer(' in text(path)]
    assert found == ['image_transport_h264.lazy']


def test_only_one_module_starts_processes() -> None:
    """A command that is waited for goes through ``process``; streams and daemons are few."""
    # relocation is a program for machines
    allowed = {'process.py', 'relocation.py', 'serve.py'}
    for path in (*python_files(CORE), *python_files(ROOT / 'fogros2_monitor')):
        if path.name not in allowed and 'subprocess' in text(path):
            names = {name for name, _ in imports(path)}
            place = path.relative_to(ROOT)
            assert not names & {'subprocess'} or place.parts[1] in (
                'agent', 'shell', 'provider'), \
                f'{place} imports subprocess'


def test_every_source_file_names_its_licence() -> None:
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
