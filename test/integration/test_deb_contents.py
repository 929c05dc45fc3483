# SPDX-License-Identifier: Apache-2.0
"""What is in the Debian package, and what it says of itself, read back by dpkg-deb."""

from __future__ import annotations

import csv
import email
from email.message import Message
import gzip
import hashlib
import importlib.util
import io
from pathlib import Path
import re
import shutil
import subprocess
import sys
import tarfile
from types import ModuleType

import pytest

from fogros2.plugin_system import own_packages

ROOT = Path(__file__).resolve().parents[2]
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
    if shutil.which('dpkg-deb') is None:
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


def test_documents_are_what_debian_looks_for(
    files: dict[str, tuple[tarfile.TarInfo, bytes]],
) -> None:
    folder = 'usr/share/doc/ros-jazzy-fogros2/'
    assert b'License: Apache-2.0' in files[f'{folder}copyright'][1]
    assert gzip.decompress(files[f'{folder}changelog.gz'][1]) == \
        (ROOT / 'CHANGELOG.rst').read_bytes()


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


def test_checksums_cover_every_file(
    built: Path, files: dict[str, tuple[tarfile.TarInfo, bytes]],
) -> None:
    text = subprocess.run(['dpkg-deb', '--info', str(built), 'md5sums'], check=True,
                          capture_output=True, text=True).stdout
    listed = dict(reversed(line.split('  ', 1)) for line in text.splitlines())
    assert listed == {
        name: hashlib.md5(data, usedforsecurity=False).hexdigest()
        for name, (info, data) in files.items() if info.isfile()}


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
