# SPDX-License-Identifier: Apache-2.0
"""
Pack the robot's installed distributions as wheels that can be sent to a machine.

Nothing is downloaded: the list of files of an installed distribution is enough to make a wheel.
What colcon installs has no list of files; only this project's packages, whose files are known, can
be packed then. The list of a distribution that is installed for development has no modules.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Iterator, Mapping
import dataclasses
import hashlib
from importlib import metadata
import json
import os
from pathlib import Path
import platform
import re
import shutil
import sys
import tempfile
import threading
import time
from typing import Optional
import zipfile

from fogros2 import process, store
from fogros2.errors import CommandError, ConfigurationError, PrerequisiteError
from fogros2.host import locked
from fogros2.model import Command
from fogros2.python_module import RUN_MODULE

OWN, EMBEDDED, PIP = 'fogros2', 'ros2-embedded', 'pip'
#: Distributions that only the robot uses.
_ROBOT_ONLY = frozenset({'catkin-pkg', 'cryptography', 'packaging', 'paramiko', 'setuptools'})
#: Folders of ROS 2's distributions that no node needs, half of their size.
_BUILD = frozenset({'cmake', 'include'})
#: Seconds for which a result is reused without a check.
FRESH = 5.0
#: Date of all files in a wheel, so that equal files give equal wheels.
_DATE = (1980, 1, 1, 0, 0, 0)


@dataclasses.dataclass(frozen=True)
class Wheels:
    """
    The wheels of FogROS2 and its dependencies on the robot.

    :param folder: their folder on the robot.
    :param key: hash of their contents, which names the folder on the machine.
    :param python: version of the interpreter they are for, with ``architecture`` and ``libc``.
    :param fogros2: file name of our own wheel, for any Python.
    :param pip: file name of pip's wheel.
    :param ros: whether they contain ROS 2; a robot with an installation of ROS 2 has no wheels.
    :param hashes: SHA-256 of each wheel in hexadecimal digits, by file name.
    """

    folder: str
    key: str
    python: tuple[int, int]
    architecture: str
    libc: str
    fogros2: str
    pip: str = ''
    ros: bool = True
    hashes: Mapping[str, str] = dataclasses.field(default_factory=dict)


def cache_folder() -> Path:
    """Return the folder of the cached wheels, below XDG_CACHE_HOME."""
    return store.cache_home() / 'wheels'


def collect(folder: Optional[Path] = None) -> Wheels:
    """
    Return the wheels of this interpreter's FogROS2; pack them if their contents have changed.

    The first call takes a few seconds, later ones some milliseconds. A result is reused for
    ``FRESH`` seconds, because all machines of a launch need it at the same time.

    :param folder: the cache, by default ``cache_folder()``.
    :raises ConfigurationError: fogros2 is not installed, but only found on the path.
    :raises PrerequisiteError: a distribution cannot be packed.
    """
    folder = folder or cache_folder()
    with _collecting:
        when, wheels = _collected.get(folder, (-FRESH, None))
        if wheels is None or time.monotonic() - when > FRESH \
                or not Path(wheels.folder, 'wheels.json').exists():
            wheels = _collect(folder)
            _collected[folder] = time.monotonic(), wheels
    return wheels


_collecting = threading.Lock()
_collected: dict[Path, tuple[float, Wheels]] = {}


def _collect(folder: Path) -> Wheels:
    distributions = list(_closure())
    names = [locked.name_of(d.name) for d in distributions]
    key = _key(distributions)
    target = folder / key
    if not (target / 'wheels.json').exists():
        # Two launches may pack at the same time, so move the complete folder.
        store.make_folder(folder)
        with tempfile.TemporaryDirectory(dir=folder, prefix='.new-') as aside:
            packed = {name: _wheel(d, Path(aside)) for name, d in zip(names, distributions)}
            digests = hashes(Path(aside))
            Path(aside, 'wheels.json').write_text(json.dumps({
                name: [file, digests[file]] for name, file in packed.items()}))
            try:
                os.rename(aside, target)
            except OSError:
                if not (target / 'wheels.json').exists():
                    raise
            else:
                os.mkdir(aside)
        _forget_old(folder, keep=target)
    os.utime(target)
    listed = json.loads((target / 'wheels.json').read_text())
    files = {name: file for name, (file, _) in listed.items()}
    return Wheels(
        str(target), key, (sys.version_info.major, sys.version_info.minor), platform.machine(),
        libc_for(files.values()), files[OWN], files.get(PIP, ''), EMBEDDED in files,
        dict(listed.values()))


def hashes(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each wheel in a folder in hexadecimal digits, by file name."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest()
            for path in folder.glob('*.whl')}


def fetch(
    names: Iterable[str], python: tuple[int, int], *, timeout: float,
    cancel: Optional[threading.Event] = None, folder: Optional[Path] = None,
) -> Path:
    """
    Fetch pinned wheels for another Python from FOGROS2_WHEELS or the index; return their folder.

    pip compares the hashes, also of the files that an earlier call has left in the cache.

    :param timeout: seconds.
    :param folder: the cache, by default ``cache_folder()``.
    :raises PrerequisiteError: a distribution is not pinned, or cannot be fetched.
    :raises Cancelled: ``cancel`` was set meanwhile.
    """
    lines = locked.requirements(names, python)
    key = hashlib.sha256(json.dumps([python, lines]).encode()).hexdigest()[:16]
    target = store.make_folder((folder or cache_folder()) / f'fetched-{key}')
    source = os.environ.get('FOGROS2_WHEELS', '')
    version = '{}{}'.format(*python)
    with tempfile.NamedTemporaryFile('w', suffix='.txt') as file:
        file.write('\n'.join(lines))
        file.flush()
        try:
            process.run(Command((
                *RUN_MODULE, 'pip', 'download', '--quiet',
                '--disable-pip-version-check', *locked.OPTIONS,
                *(('--no-index', '--find-links', source) if source else ()),
                '--find-links', str(target), '--dest', str(target),
                '--python-version', version, '--implementation', 'cp', '--abi', f'cp{version}',
                '--abi', 'abi3', '--abi', 'none',
                *(word for one in _PLATFORMS for word in ('--platform', one)),
                '--requirement', file.name), what='fetch ROS 2 for a machine',
                environment={'PIP_REQUIRE_VIRTUALENV': '0'}),
                timeout=timeout, cancel=cancel)
        except CommandError as error:
            raise PrerequisiteError(
                "neither the machine nor this computer could fetch ROS 2's packages: "
                f'{error.result.stderr.strip()[-300:]}',
                'FOGROS2_WHEELS names a folder with them; or use an image that has ROS 2'
            ) from error
    return target


#: Platforms of wheels that a machine can use, see ``bootstrap.WHEELS_LIBC``.
_PLATFORMS = ('manylinux_2_28_x86_64', 'manylinux_2_27_x86_64', 'manylinux_2_24_x86_64',
              'manylinux_2_17_x86_64', 'manylinux2014_x86_64', 'manylinux_2_12_x86_64',
              'manylinux2010_x86_64', 'manylinux_2_5_x86_64', 'manylinux1_x86_64')


def names() -> list[str]:
    """
    Return the names of the distributions that ``collect`` packs.

    :raises ConfigurationError: fogros2 is not installed, but only found on the path.
    """
    return [locked.name_of(distribution.name) for distribution in _closure()]


def runs_on(needed: str, libc: str) -> bool:
    """Return whether a C library (such as ``glibc 2.36``) is at least the needed one."""
    def parts(text: str) -> tuple[str, tuple[int, ...]]:
        kind, _, version = text.partition(' ')
        return kind, tuple(map(int, re.findall('[0-9]{1,9}', version)))

    return parts(needed)[0] == parts(libc)[0] and parts(needed) <= parts(libc)


def libc_for(files: Iterable[str]) -> str:
    """Return the oldest C library for some wheels, according to their file names."""
    newest = (0, 0)
    for file in files:
        platforms = file.removesuffix('.whl').rpartition('-')[2]
        versions = re.findall(r'manylinux_(\d+)_(\d+)', platforms)
        if versions:
            newest = max(newest, min((int(a), int(b)) for a, b in versions))
        elif platforms != 'any':
            # built on this computer
            return ' '.join(platform.libc_ver())
    return f'glibc {newest[0]}.{newest[1]}'


def _closure() -> Iterator[metadata.Distribution]:
    """
    Yield the distributions to send: ours, ROS 2, pip, and their dependencies.

    A robot with an installation of ROS 2 sends only this package, to machines that have one too.
    """
    ros = locked.ros()
    todo, seen = [OWN, EMBEDDED, PIP, *ros], set(_ROBOT_ONLY)
    try:
        metadata.distribution(EMBEDDED)
    except metadata.PackageNotFoundError:
        yield _own()
        return
    while todo:
        name = todo.pop(0)
        # ROS 2's distributions ask for others that only builds need
        if name in seen or name.startswith(locked.ROS) and name not in ros:
            continue
        seen.add(name)
        try:
            distribution = _own() if name == OWN else metadata.distribution(name)
        except metadata.PackageNotFoundError:
            continue  # of an extra, or for another platform
        yield distribution
        for requirement in distribution.requires or []:
            words, _, marker = requirement.partition(';')
            if 'extra' not in marker:
                todo.append(locked.name_of(words))


def _own() -> metadata.Distribution:
    try:
        return metadata.distribution(OWN)
    except metadata.PackageNotFoundError:
        raise ConfigurationError(
            'fogros2 is not installed in this interpreter, so it has no wheel to send',
            'build it with colcon, pip install it, or use `make setup`') from None


def _by_colcon(distribution: metadata.Distribution) -> bool:
    return locked.name_of(distribution.name) == OWN and distribution.read_text('WHEEL') is None


def _key(distributions: list[metadata.Distribution]) -> str:
    """Return a hash over the contents of all distributions and over the interpreter."""
    digest = hashlib.sha256(repr(sys.version_info[:2]).encode() + platform.machine().encode())
    for distribution in distributions:
        digest.update(f'{distribution.name} {distribution.version}\n'.encode())
        if _by_colcon(distribution):
            for name, path in _installed_by_colcon(distribution, ''):
                digest.update(name.encode() + path.read_bytes())
        # RECORD contains the hash of each file.
        digest.update((distribution.read_text('RECORD') or '').encode())
    return digest.hexdigest()[:16]


def _wheel(distribution: metadata.Distribution, target: Path) -> str:
    """Write the wheel of an installed distribution to a folder; return its file name."""
    stem = f'{distribution.name.replace("-", "_")}-{distribution.version}'
    if _by_colcon(distribution):
        info = f'{stem}.dist-info'
        return _pack(target / f'{stem}-py3-none-any.whl',
                     _installed_by_colcon(distribution, f'{stem}.data'), info, {
            f'{info}/METADATA': distribution.read_text('PKG-INFO') or '',
            f'{info}/WHEEL': 'Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n',
            f'{info}/entry_points.txt': distribution.read_text('entry_points.txt') or '',
        })
    url = json.loads(distribution.read_text('direct_url.json') or '{}')
    if not distribution.files or distribution.read_text('WHEEL') is None \
            or url.get('dir_info', {}).get('editable'):
        raise PrerequisiteError(
            f'{distribution.name} {distribution.version} was installed for development, or not '
            'by pip, and has no list of its files',
            'install it again from the folder that it came from, without -e'
            if locked.name_of(distribution.name) in (OWN, EMBEDDED) else
            f'pip install --force-reinstall {distribution.name}')
    tags = re.findall(r'^Tag: (\S+)$', distribution.read_text('WHEEL') or '', re.MULTILINE)
    pythons, abis, platforms = ('.'.join(dict.fromkeys(t.split('-')[i] for t in tags))
                                for i in range(3))
    path = target / f'{stem}-{pythons}-{abis}-{platforms}.whl'
    # Use the existing spelling of the folder's name.
    info = next(f.parts[0] for f in distribution.files if f.parts[0].endswith('.dist-info'))
    return _pack(path, _contents(distribution, f'{stem}.data', info), info)


def _pack(
    path: Path, contents: Iterable[tuple[str, Path]], info: str, texts: Mapping[str, str] = {},
) -> str:
    """Write a wheel with files and texts; return its file name."""
    record = []
    with zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED) as archive:
        def add(name: str, data: bytes, mode: int) -> None:
            entry = zipfile.ZipInfo(name, _DATE)
            entry.external_attr = (0o100000 | mode & 0o777) << 16
            # the libraries of ROS 2 take 10 s at the default level, for a tenth less
            archive.writestr(entry, data, zipfile.ZIP_DEFLATED, 1)
            digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b'=')
            record.append(f'{name},sha256={digest.decode()},{len(data)}')

        for name, source in contents:
            add(name, source.read_bytes(), source.stat().st_mode)
        for name, text in texts.items():
            add(name, text.encode(), 0o644)
        record.append(f'{info}/RECORD,,')
        archive.writestr(zipfile.ZipInfo(f'{info}/RECORD', _DATE), '\n'.join(record) + '\n')
    return path.name


def _contents(
    distribution: metadata.Distribution, data: str, info: str,
) -> Iterator[tuple[str, Path]]:
    """Yield the files of a wheel: name in the wheel, path on this computer."""
    prefix = _prefix(distribution)
    scripts = {point.name for point in distribution.entry_points
               if point.group in ('console_scripts', 'gui_scripts')}
    left_out = {f'{info}/{name}' for name in
                ('RECORD', 'INSTALLER', 'REQUESTED', 'direct_url.json')}
    for file in distribution.files or []:
        source = Path(os.path.normpath(str(distribution.locate_file(file))))
        if str(file) in left_out or file.suffix == '.pyc' or not source.is_file() \
                or (distribution.name.startswith(locked.ROS) and _BUILD.intersection(file.parts)):
            continue
        if file.parts[0] != '..':
            yield str(file), source
            continue
        relative = source.relative_to(prefix)
        if relative.parts[0] != 'bin':
            yield f'{data}/data/{relative}', source
        elif source.name not in scripts:
            # The installer creates the scripts of entry points.
            yield f'{data}/scripts/{source.name}', source


def _prefix(distribution: metadata.Distribution) -> Path:
    """Return the prefix of a distribution in ``lib/python3.x/site-packages``."""
    return Path(os.path.abspath(str(distribution.locate_file('')))).parents[2]


def _installed_by_colcon(
    distribution: metadata.Distribution, data: str,
) -> Iterator[tuple[str, Path]]:
    """Yield the files that colcon installed: name in a wheel, path on this computer."""
    marker = Path('share', 'ament_index', 'resource_index', 'packages')
    prefixes = [_prefix(distribution), *map(Path, filter(
        None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)))]
    prefix = next((p for p in prefixes if (p / marker / OWN).is_file()), None)
    if prefix is None:
        raise PrerequisiteError('fogros2 is on the path, but in no ament prefix',
                                "source the workspace's setup.bash")
    site = Path(str(distribution.locate_file('')))
    names = sorted((distribution.read_text('top_level.txt') or OWN).split())
    for name in names:
        for path in sorted((site / name).rglob('*')):
            if path.is_file() and path.suffix != '.pyc':
                yield str(path.relative_to(site)), path
    for folder in (marker, *(Path(top, name) for top in ('lib', 'share') for name in names)):
        for path in sorted((prefix / folder).rglob('*')):
            if path.is_file() and path.suffix != '.pyc' and (
                    folder != marker or path.name in names):
                yield f'{data}/data/{path.relative_to(prefix)}', path


def _forget_old(folder: Path, *, keep: Path) -> None:
    """Delete the sets of wheels that were not used lately; three stay."""
    sets = [p for p in folder.iterdir() if p.is_dir() and not p.name.startswith('.') and p != keep]
    for path in sorted(sets, key=lambda p: p.stat().st_mtime, reverse=True)[2:]:
        shutil.rmtree(path, ignore_errors=True)
