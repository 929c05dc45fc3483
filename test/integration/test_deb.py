# SPDX-License-Identifier: Apache-2.0
"""
The Debian package in a clean system: installed by apt, looked at, used, removed.

The system is Debian's by debootstrap, the first whose Python is not older than that of Ubuntu
24.04; it is kept in the user's cache folder. ROS 2 and three heavy libraries are stubs, packages
without files, which apt finds in a folder; the rest is real. No network is there meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import dataclasses
import fcntl
import hashlib
import importlib.util
import os
from pathlib import Path
import platform
import re
import tempfile

import pytest

from fogros2.errors import CommandError, PrerequisiteError
from fogros2.model import Command, Result
from fogros2.process import run, which
from fogros2.provider.container import debian_root

ROOT = Path(__file__).resolve().parents[2]
NAME, PREFIX = 'ros-jazzy-fogros2', '/opt/ros/jazzy'
SITE = f'{PREFIX}/lib/python3.12/site-packages'
SUITE = 'trixie'
#: What the package depends on and is there for real.
REAL = ('iproute2', 'openssh-client', 'python3', 'python3-cryptography', 'python3-packaging',
        'python3-paramiko', 'python3-requests', 'python3-yaml', 'rsync', 'wireguard-tools')
#: Too large for what they would add to this test.
HEAVY = ('python3-boto3', 'python3-google-auth', 'python3-numpy', 'python3-opencv',
         'python3-catkin-pkg-modules')  # of ROS's own repository
#: debootstrap finds no package by what it provides, as python3-cryptography asks for this one.
INCLUDE = (*REAL, 'python3-cffi-backend')
#: A system that lives for a minute needs nothing synced to the disk.
MAKE = ('mkdir -p "$1/etc/dpkg/dpkg.cfg.d"; '
        'echo force-unsafe-io >"$1/etc/dpkg/dpkg.cfg.d/unsafe-io"; '
        'debootstrap --variant=minbase --include="$2" "$3" "$1" "$4" >&2; '
        'umount "$1/proc" "$1/sys" 2>/dev/null || :; cd "$1"; '
        'rm -rf var/lib/apt/lists/* var/cache/apt/* usr/share/doc/* usr/share/locale/* '
        'usr/share/man/* var/log/* dev/*; '
        'tar --numeric-owner --one-file-system --sort=name -cf "$5" .; chown "$6" "$5"')
#: Enters a system ($1) as a user ($3), with a folder of ours ($2) as its /mnt.
ENTER = ('mount -t proc proc "$1/proc"; mount -t tmpfs tmpfs "$1/dev"; '
         'for device in null zero urandom; do touch "$1/dev/$device"; '
         'mount --bind "/dev/$device" "$1/dev/$device"; done; '
         'mount --bind "$2" "$1/mnt"; root=$1; user=$3; shift 3; '
         'exec chroot --userspec="$user" "$root" "$@"')
NAMESPACES = ('unshare', '--mount', '--pid', '--net', '--fork', '--kill-child')
#: Whatever is there, but what changes as systems run.
ALL_FILES = ('find / -xdev "(" -path /var -o -path /proc -o -path /dev -o -path /mnt -o '
             '-path /tmp ")" -prune -o -print')

pytestmark = pytest.mark.timeout(1200)  # the first run makes the system


@dataclasses.dataclass(frozen=True)
class System:
    """
    A system in a folder.

    :param shared: a folder of this computer, seen there as ``/mnt``.
    """

    root: Path
    shared: Path

    def run(self, *words: str, user: str = 'root', check: bool = True) -> Result:
        """Run a command there, without a network."""
        return run(Command((
            *NAMESPACES, 'sh', '-ec', ENTER, 'sh', str(self.root), str(self.shared),
            f'{user}:{"nogroup" if user == "nobody" else user}', 'env', '-i',
            'PATH=/usr/sbin:/usr/bin:/sbin:/bin', 'HOME=/tmp', 'LC_ALL=C.UTF-8',
            'DEBIAN_FRONTEND=noninteractive', *words), sudo=True), timeout=120.0, check=check)

    def apt(self, repository: str, *words: str, check: bool = True) -> Result:
        """Run apt-get, which knows one folder of packages and no other source."""
        return self.run(
            'apt-get', '-o', f'Dir::Etc::SourceList=/mnt/{repository}/sources.list',
            '-o', 'Dir::Etc::SourceParts=-', '-o', 'APT::Sandbox::User=root', '--yes', '--quiet',
            *words, check=check)

    def simulate(self, repository: str, package: str) -> Result:
        """Have apt say what it would do in the system as it was made."""
        self.apt(repository, 'update')
        return self.apt(repository, '-o', 'Dir::State::status=/mnt/status', '--simulate',
                        'install', package, check=False)

    def python(self, script: str, *, user: str = 'nobody') -> str:
        """Run a script where ``setup.bash`` has been sourced, and return what it prints."""
        return self.run('env', f'PYTHONPATH={SITE}', f'AMENT_PREFIX_PATH={PREFIX}', 'python3',
                        '-c', script, user=user).stdout

    def has_package(self) -> bool:
        return self.run('dpkg-query', '--show', '--showformat=${Status}', NAME,
                        check=False).stdout == 'install ok installed'


@pytest.fixture(scope='module')
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the package of this tree."""
    if which('dpkg-deb') is None:
        pytest.skip('needs dpkg-deb')
    if run(Command(('git', '-C', str(ROOT), 'rev-parse')), timeout=60.0,
           check=False).returncode != 0:
        pytest.skip('this tree is under no version control, which says what goes in')
    spec = importlib.util.spec_from_file_location('deb', ROOT / 'packaging' / 'deb.py')
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    path: Path = module.build(tmp_path_factory.mktemp('deb'))
    return path


def make(target: Path) -> None:
    """Make a system by debootstrap and keep it as an archive."""
    if which('debootstrap') is None:
        pytest.skip('needs debootstrap')
    try:
        own = debian_root.release()
    except PrerequisiteError as error:
        pytest.skip(f'needs a computer whose packages come from Debian: {error}')
    aside = Path(tempfile.mkdtemp(dir=target.parent, prefix='new-'))
    try:
        # in a mount namespace of its own: an interrupted one leaves no mount
        run(Command((
            'unshare', '--mount', '--pid', '--fork', '--kill-child', 'sh', '-ec', MAKE, 'sh',
            str(aside / 'root'), ','.join(INCLUDE), SUITE, own.address, str(aside / 'root.tar'),
            str(os.getuid())), sudo=True, what='make a Debian system'), timeout=1000.0)
        (aside / 'root.tar').rename(target)
    except CommandError as error:
        if 'Failed getting release file' not in str(error.result.stderr):
            raise
        pytest.skip(f'no packages of Debian {SUITE} can be had here')
    finally:
        run(Command(('rm', '-rf', '--one-file-system', str(aside)), sudo=True), timeout=60.0)


@pytest.fixture(scope='module')
def archive(root: None) -> Path:
    """Return a packed system, made unless it is in the cache."""
    if run(Command((*NAMESPACES, 'true'), sudo=True), timeout=60.0, check=False).returncode != 0:
        pytest.skip('root may make no namespaces here, as in a container without privileges')
    cache = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache', 'fogros2', 'deb')
    cache.mkdir(parents=True, exist_ok=True)
    recipe = f'1 {SUITE} {platform.machine()} {INCLUDE} {MAKE}'
    target = cache / f'root-{hashlib.sha256(recipe.encode()).hexdigest()[:16]}.tar'
    with open(cache / 'lock', 'w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        for left in cache.glob('new-*'):  # half made by one that was killed
            run(Command(('rm', '-rf', '--one-file-system', str(left)), sudo=True), timeout=60.0)
        if not target.exists():
            make(target)
            for path in cache.glob('root-*.tar'):
                if path != target:
                    path.unlink()
    return target


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
    depends = run(Command(('dpkg-deb', '--field', str(built), 'Depends')), timeout=60.0).stdout
    found = {}
    for word in depends.strip().split(', '):
        match = re.fullmatch(r'(\S+)(?: \(>= (\S+)\))?', word)
        assert match, word
        if match[1].startswith('ros-jazzy-') or match[1] in HEAVY:
            found[match[1]] = match[2] or '1.0.0'
    return found


@pytest.fixture(scope='module')
def system(
    archive: Path, built: Path, tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[System]:
    """Unpack the system, and lay stubs out for apt: all of them, too old ones, none."""
    folder = tmp_path_factory.mktemp('system')
    shared = folder / 'shared'
    shared.mkdir(mode=0o755)
    stubs = stubs_for(built)
    write_repository(shared / 'stubs', stubs)
    write_repository(shared / 'old', {**stubs, 'python3-boto3': '1.33.13'})
    write_repository(shared / 'none', {})
    os.link(built, shared / 'fogros2.deb')
    root = folder / 'root'
    try:
        run(Command(('sh', '-ec', 'mkdir "$1"; tar --numeric-owner -C "$1" -xpf "$2"; '
                     'cat "$1/var/lib/dpkg/status" >"$3"', 'sh', str(root), str(archive),
                     str(shared / 'status')), sudo=True, what='unpack the system'), timeout=120.0)
        yield System(root, shared)
    finally:
        run(Command(('rm', '-rf', '--one-file-system', str(root)), sudo=True), timeout=60.0)


@pytest.fixture(scope='module')
def files_before(system: System) -> frozenset[str]:
    """Return the paths of all files before anything was installed."""
    return frozenset(system.run('sh', '-c', ALL_FILES).stdout.splitlines())


@pytest.fixture
def installed(system: System, files_before: frozenset[str]) -> System:
    """Have the package installed as its user would."""
    if not system.has_package():
        system.apt('stubs', 'update')
        system.apt('stubs', 'install', '/mnt/fogros2.deb')
    return system


def test_apt_installs_it_with_what_it_depends_on(installed: System, built: Path) -> None:
    assert installed.has_package()
    there = installed.run('dpkg-query', '--show', '--showformat=${Package}\n').stdout.split()
    assert {*stubs_for(built), *REAL} <= set(there)
    assert installed.run('dpkg', '--audit').stdout == ''
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
        f'{SITE}/fogros2/__init__.py {version}',
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
    assert installed.run('sh', '-c', f'echo "{{}}" | {helper} check').stdout == '4\n'
    assert 'by sudo' in installed.run(helper, 'check', user='nobody', check=False).stderr
    assert installed.run('stat', '-c', '%a %u', '/etc/sudoers.d/fogros2-vpn').stdout == '440 0\n'


def test_nothing_stays_after_it_is_purged(
    installed: System, files_before: frozenset[str],
) -> None:
    # root's Python leaves compiled modules beside the sources
    installed.python('import fogros2.shell.ssh, fogros2_examples', user='root')
    installed.run('sh', '-c', f'ls {SITE}/fogros2/shell/__pycache__/ssh.*.pyc')
    installed.apt('stubs', 'purge', NAME)
    assert not installed.has_package()
    assert installed.run('getent', 'group', 'fogros2', check=False).returncode != 0
    after = frozenset(installed.run('sh', '-c', ALL_FILES).stdout.splitlines())
    assert after <= files_before
    # which no package owns, so the package that leaves it empty removes it
    assert files_before - after <= {'/opt'}


def test_others_compiled_modules_stay(installed: System) -> None:
    others = f'{SITE}/__pycache__/other.cpython-312.pyc'
    installed.run('sh', '-ec', f'mkdir -p {SITE}/__pycache__; echo >{others}')
    try:
        installed.apt('stubs', 'purge', NAME)
        assert installed.run('find', PREFIX, '-type', 'f').stdout == f'{others}\n'
    finally:
        installed.run('rm', '-r', '/opt/ros')
