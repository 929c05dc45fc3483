# SPDX-License-Identifier: Apache-2.0
"""
The Debian package: read back by dpkg-deb, and installed and removed by apt in a clean system.

The system is Debian's by debootstrap, the first whose Python is not older than that of Ubuntu
24.04; it is kept in the user's cache folder. ROS 2 and three heavy libraries are stubs, packages
without files, which apt finds in a folder; the rest is real.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import csv
import dataclasses
import email
from email.message import Message
import gzip
import hashlib
import importlib.util
import io
import os
from pathlib import Path
import re
import subprocess
import sys
import tarfile
from types import ModuleType

import pytest

from fogros2.errors import CommandError, PrerequisiteError
from fogros2.model import Command, Result
from fogros2.plugin_system import own_packages
from fogros2.process import run, which
from fogros2.provider.container import debian_root
from fogros2.vpn.helped import PROTOCOL
from rigs.cluster.images import RootShell

ROOT = Path(__file__).resolve().parents[2]
NAME, PREFIX = 'ros-jazzy-fogros2', '/opt/ros/jazzy'
SITE = 'opt/ros/jazzy/lib/python3.12/site-packages'
VPN = 'usr/libexec/fogros2/vpn'
#: ROS packages, and the folders whose scripts are their executables.
SCRIPTS = {'fogros2': ('fogros2_monitor', 'fogros2_replicas', 'fogros2_share'),
           'fogros2_examples': ('fogros2_examples',),
           'image_transport_h264': ('image_transport_h264',),
           'point_cloud_stream': ('point_cloud_stream',)}
NODES = {package: {path.name for folder in folders
                   for path in (ROOT / folder / 'scripts').iterdir() if path.is_file()}
         for package, folders in SCRIPTS.items()}
SUITE = 'trixie'
#: What the package depends on and is there for real.
REAL = ('iproute2', 'openssh-client', 'python3', 'python3-cryptography', 'python3-packaging',
        'python3-paramiko', 'python3-requests', 'python3-yaml', 'rsync', 'wireguard-tools')
#: Too large for what they would add to this test.
HEAVY = ('python3-boto3', 'python3-google-auth', 'python3-numpy', 'python3-opencv',
         'python3-catkin-pkg-modules')  # of ROS's own repository
#: debootstrap finds no package by what it provides, as python3-cryptography asks for this one.
INCLUDE = (*REAL, 'python3-cffi-backend')
#: Whatever is there, but what changes as systems run.
ALL_FILES = ('find / -xdev "(" -path /var -o -path /proc -o -path /dev -o -path /mnt -o '
             '-path /tmp ")" -prune -o -print')

pytestmark = pytest.mark.timeout(1200)  # the first run makes the system


@pytest.fixture(scope='module')
def deb() -> ModuleType:
    """Return the script as a module; its folder is no package."""
    spec = importlib.util.spec_from_file_location('deb', ROOT / 'packaging' / 'deb.py')
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope='module')
def built(deb: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    if which('dpkg-deb') is None:
        pytest.skip('needs dpkg-deb')
    if subprocess.run(['git', 'rev-parse'], cwd=ROOT, capture_output=True).returncode != 0:
        pytest.skip('this tree is under no version control, which says what goes in')
    path: Path = deb.build(tmp_path_factory.mktemp('deb'))
    return path


@pytest.fixture(scope='module')
def files(built: Path) -> dict[str, tuple[tarfile.TarInfo, bytes]]:
    """Return all that the package brings: path -> what tar says of it, contents."""
    packed = subprocess.run(['dpkg-deb', '--fsys-tarfile', str(built)], check=True,
                            capture_output=True).stdout
    found = {}
    with tarfile.open(fileobj=io.BytesIO(packed)) as archive:
        for info in archive:
            data = archive.extractfile(info)
            found[info.name.removeprefix('./')] = info, data.read() if data else b''
    return found


def field(built: Path, name: str) -> str:
    return subprocess.run(['dpkg-deb', '--field', str(built), name], check=True,
                          capture_output=True, text=True).stdout.strip()


def test_depends_on_what_the_manifests_say(built: Path) -> None:
    found = set(field(built, 'Depends').split(', '))
    assert {
        'python3 (>= 3.12)', 'python3-boto3 (>= 1.34)', 'python3-google-auth (>= 2.0)',
        'python3-numpy (>= 1:1.26)', 'python3-opencv (>= 4.6)',
        'python3-paramiko (>= 2.12)', 'python3-yaml (>= 6.0)',
        'iproute2', 'openssh-client', 'rsync', 'wireguard-tools',
        'ros-jazzy-launch-ros', 'ros-jazzy-rclpy', 'ros-jazzy-rmw-fastrtps-cpp',
        'ros-jazzy-ros2launch', 'ros-jazzy-ros-workspace', 'ros-jazzy-sensor-msgs'} <= found
    own = ('fogros2', 'image-transport-h264')
    assert not [name for name in found if name.startswith(tuple(f'ros-jazzy-{o}' for o in own))]
    # what only tests or pip bring
    assert not [name for name in found if 'pytest' in name or name.endswith('-pip')]


def test_provides_the_other_packages_of_the_tree(built: Path) -> None:
    version = field(built, 'Version')
    assert field(built, 'Provides').split(', ') == [
        f'ros-jazzy-fogros2-examples (= {version})',
        f'ros-jazzy-image-transport-h264 (= {version})',
        f'ros-jazzy-point-cloud-stream (= {version})']


def test_brings_our_packages_without_the_rigs(
    files: dict[str, tuple[tarfile.TarInfo, bytes]],
) -> None:
    modules = {Path(name).relative_to(SITE) for name in files
               if name.startswith(f'{SITE}/') and name.endswith('.py')}
    assert {path.parts[0] for path in modules} == {*own_packages()}
    assert f'{SITE}/fogros2_monitor/dashboard/page.html' in files


def test_refuses_a_key_it_has_no_version_for(deb: ModuleType, tmp_path: Path) -> None:
    manifest = tmp_path / 'package.xml'
    manifest.write_text('<package><exec_depend>python3-attr</exec_depend></package>')
    with pytest.raises(LookupError, match=r'package\.xml names python3-attr'):
        deb.dependencies([manifest])


def test_files_are_where_bloom_puts_them(
    files: dict[str, tuple[tarfile.TarInfo, bytes]],
) -> None:
    paths = {name for name, (info, _) in files.items() if info.isfile()}
    places = (f'{SITE}/', 'opt/ros/jazzy/lib/', 'opt/ros/jazzy/share/',
              'usr/share/doc/ros-jazzy-fogros2/', 'usr/libexec/fogros2/')
    assert {name for name in paths if not name.startswith(places)} == {
        'etc/sudoers.d/fogros2-vpn', 'usr/lib/systemd/system/fogros2-vpn-tidy.service',
        'usr/lib/systemd/system/fogros2-vpn-tidy.timer'}
    documents = 'usr/share/doc/ros-jazzy-fogros2/'
    assert b'License: Apache-2.0' in files[f'{documents}copyright'][1]
    assert gzip.decompress(files[f'{documents}changelog.gz'][1]) == \
        (ROOT / 'CHANGELOG.rst').read_bytes()
    for package, nodes in NODES.items():
        assert f'opt/ros/jazzy/share/ament_index/resource_index/packages/{package}' in paths
        assert f'opt/ros/jazzy/share/{package}/package.xml' in paths
        assert f'{SITE}/{package}/__init__.py' in paths
        folder = f'opt/ros/jazzy/lib/{package}/'
        assert {name.removeprefix(folder) for name in paths if name.startswith(folder)} == nodes
    launch = 'opt/ros/jazzy/share/fogros2_examples/launch/'
    assert {name.removeprefix(launch) for name in paths if name.startswith(launch)} == {
        path.name for path in (ROOT / 'fogros2_examples' / 'launch').glob('*.launch.*')}
    assert f'{SITE}/fogros2/py.typed' in paths
    assert not [name for name in paths if '__pycache__' in name or '.data/' in name]
    assert not [name for name in paths if name.startswith((f'{SITE}/test', f'{SITE}/rclpy'))]


def test_owners_and_modes(files: dict[str, tuple[tarfile.TarInfo, bytes]]) -> None:
    nodes = {f'opt/ros/jazzy/lib/{package}/{name}' for package, names in NODES.items()
             for name in names}
    for name, (info, _) in files.items():
        assert (info.uid, info.gid) == (0, 0), name
        if info.issym():
            assert name.endswith('timers.target.wants/fogros2-vpn-tidy.timer')
            continue
        wanted = 0o755 if info.isdir() or name in nodes or name == VPN else \
            0o440 if 'sudoers' in name else 0o644
        assert info.mode == wanted, f'{name}: {info.mode:o}'
    assert all(files[name][1].startswith(b'#!/usr/bin/env python3\n') for name in nodes)


def metadata_of(files: dict[str, tuple[tarfile.TarInfo, bytes]], name: str) -> bytes:
    (found,) = (data for path, (_, data) in files.items()
                if path.endswith(f'.dist-info/{name}'))
    return found


def test_python_knows_each_file(files: dict[str, tuple[tarfile.TarInfo, bytes]]) -> None:
    """What goes to a machine is packed after this list, which a wheel has in other words."""
    rows = list(csv.reader(io.StringIO(metadata_of(files, 'RECORD').decode())))
    top = SITE.count('/') - 2
    listed = {path.replace('../' * top, 'opt/ros/jazzy/') if path.startswith('../')
              else f'{SITE}/{path}' for path, _, _ in rows}
    assert listed == {name for name, (info, _) in files.items()
                      if info.isfile() and name.startswith('opt/')}
    assert metadata_of(files, 'INSTALLER') == b'debian\n'
    about: Message = email.message_from_bytes(metadata_of(files, 'METADATA'))
    assert about['Name'] == 'fogros2'


def test_the_helper_has_all_that_it_imports(
    files: dict[str, tuple[tarfile.TarInfo, bytes]], tmp_path: Path,
) -> None:
    top = 'usr/libexec/'
    for name, (info, data) in files.items():
        if name.startswith(top) and info.isfile():
            target = tmp_path / name.removeprefix(top)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(data)
    # the interpreter of the tests, without their packages
    said = subprocess.run([sys.executable, '-IS', str(tmp_path / 'fogros2/vpn'), 'nothing'],
                          capture_output=True, text=True)
    assert said.returncode == 2 and said.stderr.startswith('fogros2 vpn: ')
    # the other way to install it brings the same
    listed = (ROOT / 'packaging/vpn_helper/install').read_text()
    (names,) = re.findall('for name in (.*); do', listed)
    assert {f'{top}fogros2/vpn', *(f'{top}fogros2/fogros2/{name}.py' for name in names.split())} \
        == {name for name, (info, _) in files.items()
            if name.startswith(top) and info.isfile()}


# --- in a system ---------------------------------------------------------------------------------

@dataclasses.dataclass(frozen=True)
class System:
    """A system, with the folder that is its ``/mnt``."""

    shell: RootShell
    shared: Path

    def run(self, *words: str, user: str = 'root', check: bool = True) -> Result:
        """Run a command there."""
        as_user = () if user == 'root' else ('chroot', '--userspec=nobody:nogroup', '/')
        return self.shell.run(Command((*as_user, *words), sudo=True, environment={
            'HOME': '/tmp', 'LC_ALL': 'C.UTF-8', 'DEBIAN_FRONTEND': 'noninteractive'}),
            timeout=120.0, check=check)

    def apt(self, repository: str, *words: str, check: bool = True) -> Result:
        """Run apt-get, which knows one folder of packages and no other source."""
        return self.run(
            'apt-get', '-o', f'Dir::Etc::SourceList=/mnt/{repository}/sources.list',
            '-o', 'Dir::Etc::SourceParts=-', '-o', 'APT::Sandbox::User=root',
            # a system that lives for a minute needs nothing synced to the disk
            '-o', 'Dpkg::Options::=--force-unsafe-io', '--yes', '--quiet', *words, check=check)

    def simulate(self, repository: str, package: str) -> Result:
        """Have apt say what it would do in the system as it was made."""
        self.apt(repository, 'update')
        return self.apt(repository, '-o', 'Dir::State::status=/mnt/status', '--simulate',
                        'install', package, check=False)

    def python(self, script: str, *, user: str = 'nobody') -> str:
        """Run a script where ``setup.bash`` has been sourced, and return what it prints."""
        return self.run('env', f'PYTHONPATH=/{SITE}', f'AMENT_PREFIX_PATH={PREFIX}', 'python3',
                        '-c', script, user=user).stdout

    def has_package(self) -> bool:
        return self.run('dpkg-query', '--show', '--showformat=${Status}', NAME,
                        check=False).stdout == 'install ok installed'


@pytest.fixture(scope='module')
def base(root: None) -> Path:
    """Return a system of the suite, made unless it is in the cache."""
    try:
        own = debian_root.release()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                debian_root, 'release', lambda: dataclasses.replace(own, codename=SUITE))
            return debian_root.root(packages=INCLUDE)
    except (CommandError, PrerequisiteError) as error:
        pytest.skip(f'no packages of Debian {SUITE} can be had here: {error}')


def write_package(folder: Path, name: str, version: str) -> None:
    """Add a package without files to a folder and to its index, which apt reads."""
    stage = folder / 'stage' / name
    (stage / 'DEBIAN').mkdir(parents=True)
    control = (f'Package: {name}\nVersion: {version}\nArchitecture: all\n'
               f'Maintainer: nobody <nobody@example.org>\nDescription: for a test\n')
    (stage / 'DEBIAN' / 'control').write_text(control)
    target = folder / f'{name}.deb'
    run(Command(('dpkg-deb', '--build', '--root-owner-group', '-Znone', str(stage), str(target))),
        timeout=30.0)
    with open(folder / 'Packages', 'a') as index:
        index.write(f'{control}Filename: ./{target.name}\nSize: {target.stat().st_size}\n'
                    f'SHA256: {hashlib.sha256(target.read_bytes()).hexdigest()}\n\n')


def write_repository(folder: Path, packages: Mapping[str, str]) -> None:
    """Fill a folder from which apt can install stubs: name -> version."""
    folder.mkdir()
    (folder / 'Packages').touch()
    (folder / 'sources.list').write_text(f'deb [trusted=yes] file:/mnt/{folder.name} ./\n')
    for name, version in packages.items():
        write_package(folder, name, version)


def stubs_for(built: Path) -> dict[str, str]:
    """Return what the package depends on and isn't real: name -> the oldest version it takes."""
    found = {}
    for word in field(built, 'Depends').split(', '):
        match = re.fullmatch(r'(\S+)(?: \(>= (\S+)\))?', word)
        assert match, word
        if match[1].startswith('ros-jazzy-') or match[1] in HEAVY:
            found[match[1]] = match[2] or '1.0.0'
    return found


@pytest.fixture(scope='module')
def system(
    base: Path, built: Path, tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[System]:
    """Return the system, and lay stubs out for apt: all of them, too old ones, none."""
    folder = tmp_path_factory.mktemp('system')
    shared = folder / 'files/mnt'
    shared.mkdir(parents=True)
    stubs = stubs_for(built)
    write_repository(shared / 'stubs', stubs)
    write_repository(shared / 'old', {**stubs, 'python3-boto3': '1.33.13'})
    write_repository(shared / 'none', {})
    os.link(built, shared / 'fogros2.deb')
    (shared / 'status').write_bytes((base / 'var/lib/dpkg/status').read_bytes())
    yield System(RootShell(base, folder), shared)
    debian_root.remove(folder / 'files')


@pytest.fixture(scope='module')
def files_before(system: System) -> frozenset[str]:
    """Return the paths of all files before anything was installed."""
    return frozenset(system.run('sh', '-c', ALL_FILES).stdout.splitlines())


@pytest.fixture(scope='module')
def installed(system: System, files_before: frozenset[str]) -> System:
    """Have the package installed as its user would."""
    system.apt('stubs', 'update')
    system.apt('stubs', 'install', '/mnt/fogros2.deb')
    return system


def test_apt_installs_it_with_what_it_depends_on(
    installed: System, built: Path, files: dict[str, tuple[tarfile.TarInfo, bytes]],
) -> None:
    assert installed.has_package()
    there = installed.run('dpkg-query', '--show', '--showformat=${Package}\n').stdout.split()
    assert {*stubs_for(built), *REAL} <= set(there)
    assert installed.run('dpkg', '--audit').stdout == ''
    checksums = installed.run('cat', f'/var/lib/dpkg/info/{NAME}.md5sums').stdout
    assert len(checksums.splitlines()) == sum(info.isfile() for info, _ in files.values())
    assert installed.run('dpkg', '--verify', NAME).stdout == ''
    installed.apt('stubs', 'check')


@pytest.mark.parametrize(('repository', 'missing'), [
    ('none', 'ros-jazzy-rclpy'), ('old', 'python3-boto3 (>= 1.34)')])
def test_apt_refuses_it_without_what_it_needs(
    system: System, repository: str, missing: str,
) -> None:
    refused = system.simulate(repository, '/mnt/fogros2.deb')
    assert refused.returncode == 100
    assert missing in refused.stdout + refused.stderr


def test_anybody_can_import_it_and_has_its_plugins(installed: System) -> None:
    said = installed.python(
        'import fogros2, importlib.metadata as m\n'
        'print(fogros2.__file__, m.version("fogros2"))\n'
        'for group in ("provider", "shell", "vpn", "dds", "image_transport"):\n'
        '    print(group, *sorted(p.name for p in m.entry_points(group="fogros2." + group)\n'
        '                         if p.load()))\n').splitlines()
    version = installed.run('dpkg-query', '--show', '--showformat=${Version}', NAME).stdout
    assert said == [
        f'/{SITE}/fogros2/__init__.py {version}',
        'provider aws azure cheapest container gcp hosted joined kubernetes ssh',
        'shell guest kubernetes local ssh', 'vpn wireguard',
        'dds rmw_cyclonedds_cpp rmw_fastrtps_cpp rmw_zenoh_cpp',
        'image_transport compressed draco ffmpeg h264 pointcloud raw republished_compressed '
        'theora zlib zstd']


def test_what_goes_to_a_machine_has_the_nodes_in_it(installed: System) -> None:
    names = installed.python(
        'from pathlib import Path; import zipfile; from fogros2.host import wheels\n'
        'found = wheels.collect(Path("/tmp/wheels"))\n'
        'archive = zipfile.ZipFile(Path(found.folder, found.fogros2))\n'
        'print(*archive.namelist(), sep="\\n")').splitlines()
    version = installed.run('dpkg-query', '--show', '--showformat=${Version}', NAME).stdout
    data = f'fogros2-{version}.data/data'
    assert {'fogros2/__init__.py', f'{data}/lib/fogros2_examples/talker',
            f'{data}/share/ament_index/resource_index/packages/fogros2_examples',
            f'{data}/share/fogros2_examples/launch/talker.container.launch.py'} <= set(names)


def test_group_member_may_create_vpn_interfaces(installed: System) -> None:
    helper = '/usr/libexec/fogros2/vpn'
    assert 'fogros2:' in installed.run('getent', 'group', 'fogros2').stdout
    assert installed.run('sh', '-c', f'echo "{{}}" | {helper} check').stdout == f'{PROTOCOL}\n'
    assert 'by sudo' in installed.run(helper, 'check', user='nobody', check=False).stderr
    assert installed.run('stat', '-c', '%a %u', '/etc/sudoers.d/fogros2-vpn').stdout == '440 0\n'


def test_purge_leaves_only_what_others_made(
    installed: System, files_before: frozenset[str],
) -> None:
    # root's Python leaves compiled modules beside the sources
    installed.python('import fogros2.shell.ssh, fogros2_examples', user='root')
    installed.run('sh', '-c', f'ls /{SITE}/fogros2/shell/__pycache__/ssh.*.pyc')
    others = f'/{SITE}/__pycache__/other.cpython-312.pyc'
    installed.run('sh', '-ec', f'mkdir -p /{SITE}/__pycache__; echo >{others}')
    installed.apt('stubs', 'purge', NAME)
    assert not installed.has_package()
    assert installed.run('getent', 'group', 'fogros2', check=False).returncode != 0
    after = frozenset(installed.run('sh', '-c', ALL_FILES).stdout.splitlines())
    assert files_before <= after
    assert after - files_before <= {others, *map(str, Path(others).parents)}
