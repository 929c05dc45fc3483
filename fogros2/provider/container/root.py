# SPDX-License-Identifier: Apache-2.0
"""
The root file system of a container without an image: an allow-list of this computer's files.

The container mounts the system's programs, and gets a copy of the settings that an image of the
same system would have and every user may read. It gets nothing else of the computer: no home, no
workspace, no service's data, no key.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping, Sequence
import functools
import glob
import io
import os
from pathlib import Path
import re
import stat
import sys
import tarfile

#: Folders of the system; links (merged /usr) are copied as links.
SYSTEM = ('usr', 'bin', 'sbin', 'lib', 'lib32', 'lib64', 'libx32', 'libexec')

#: The package database; without it, apt would not know the installed packages in /usr.
PACKAGES = '/var/lib/dpkg'

#: Entries of /etc in a new image, without those that may contain a token (environment, pip.conf,
#: npmrc, gitconfig, fstab) or belong to a service.
ETC = (
    'X11', 'OpenCL', 'adduser.conf', 'alternatives', 'apt', 'bash.bashrc', 'bash_completion.d',
    'bindresvport.blacklist', 'ca-certificates', 'ca-certificates.conf', 'crypto-policies',
    'debconf.conf', 'debian_version', 'default/locale', 'default/useradd', 'deluser.conf',
    'dpkg', 'ethertypes', 'fonts', 'gai.conf', 'glvnd', 'groff', 'gss', 'host.conf',
    'inputrc', 'iproute2', 'issue', 'issue.net', 'java-*', 'ld.so.cache', 'ld.so.conf',
    'ld.so.conf.d', 'libaudit.conf', 'libnl-3', 'locale.alias', 'locale.conf', 'locale.gen',
    'localtime', 'login.defs', 'lsb-release', 'magic', 'magic.mime', 'manpath.config',
    'mime.types', 'mke2fs.conf', 'netconfig', 'networks', 'nsswitch.conf', 'os-release',
    'pam.conf', 'pam.d', 'perl', 'pki/tls/certs', 'pki/ca-trust', 'profile', 'profile.d',
    'protocols', 'python3', 'python3.*', 'rmt', 'ros', 'rpc', 'security', 'selinux',
    'services', 'sgml', 'shells', 'skel', 'ssl/certs', 'ssl/openssl.cnf', 'terminfo',
    'timezone', 'ucf.conf', 'vim', 'vulkan', 'xattr.conf', 'xdg', 'xml',
)

#: A folder of settings with at least so many entries is mounted instead of copied: creating 400
#: links takes longer than a mount.
MANY = 40

#: Paths that are never copied, whatever their permissions.
_SECRET = re.compile(
    r'/auth\.conf|/opasswd|/private(/|$)|_key$|\.key$|/id_(rsa|ecdsa|ed25519)'
    r'|credential|secret|htpasswd|(\.bak|\.old|\.orig|-)$', re.IGNORECASE)

#: A user and a password in a URL, as in apt's sources.
_URL_LOGIN = re.compile(rb'://[^/\s:@]+:[^/\s@]+@')

#: The mounts of this computer, in the order of mounting.
_MOUNTS = Path('/proc/self/mountinfo')

_FOLDERS: Mapping[str, int] = {
    'dev': 0o755, 'etc/init.d': 0o755, 'home': 0o755, 'media': 0o755, 'mnt': 0o755,
    'opt': 0o755, 'proc': 0o555, 'root': 0o711, 'run': 0o755, 'run/lock': 0o1777,
    'run/sshd': 0o755, 'srv': 0o755, 'sys': 0o555, 'tmp': 0o1777, 'var': 0o755,
    'var/cache/apt/archives/partial': 0o755, 'var/cache/debconf': 0o755, 'var/lib': 0o755,
    'var/lib/apt/lists/partial': 0o755, 'var/lib/dpkg': 0o755, 'var/lib/misc': 0o755,
    'var/log/apt': 0o755, 'var/mail': 0o2775, 'var/opt': 0o755, 'var/spool': 0o755,
    'var/tmp': 0o1777,
}


class Archive:
    """A tar archive in memory; files belong to root by default."""

    def __init__(self) -> None:
        self._buffer = io.BytesIO()
        self._tar = tarfile.open(fileobj=self._buffer, mode='w', format=tarfile.GNU_FORMAT)
        self._folders: set[str] = {''}

    def _info(self, path: str, mode: int, owner: int) -> tarfile.TarInfo:
        info = tarfile.TarInfo(path)
        info.mode = mode
        info.uid = info.gid = owner
        info.mtime = 0
        return info

    def folder(self, path: str, mode: int = 0o755, owner: int = 0) -> None:
        """Add a folder (relative path), and its parents with mode 755 for root."""
        if path in self._folders:
            return
        self.folder(os.path.dirname(path))
        self._folders.add(path)
        info = self._info(path, mode, owner)
        info.type = tarfile.DIRTYPE
        self._tar.addfile(info)

    def file(self, path: str, data: bytes, mode: int = 0o644, owner: int = 0) -> None:
        """Add a file (relative path) and the folders above it."""
        self.folder(os.path.dirname(path))
        info = self._info(path, mode, owner)
        info.size = len(data)
        self._tar.addfile(info, io.BytesIO(data))

    def link(self, path: str, target: str) -> None:
        """Add a symbolic link (relative path)."""
        self.folder(os.path.dirname(path))
        info = self._info(path, 0o777, 0)
        info.type = tarfile.SYMTYPE
        info.linkname = target
        self._tar.addfile(info)

    def data(self, *, last: bool = True) -> bytes:
        """Return the archive; without its end mark if another one follows."""
        end = self._tar.offset
        if last:
            self._tar.close()
            return self._buffer.getvalue()
        return self._buffer.getvalue()[:end]


@functools.lru_cache(maxsize=4)
def system_mounts(base: str = '') -> tuple[str, ...]:
    """
    Return the system's folders, which containers mount below writable layers; outer ones first.

    :param base: folder with a system; '' for this computer's.
    """
    mounts = [f'/{name}' for name in SYSTEM if _is_folder(Path(f'{base}/{name}'))]
    if base:
        mounts.append('/var/lib')  # it has no data of this computer's services
    else:
        mounts += [PACKAGES] if os.path.isdir(PACKAGES) else []
        # An overlay does not show other file systems that are mounted in it.
        mounts += [point for point, _ in _mounts(_MOUNTS) if point.startswith('/usr/')]
    return (*mounts, *(path[len(base):] for path in many_settings(f'{base}/etc')))


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


@functools.lru_cache(maxsize=4)
def allowed_settings(etc: str = '/etc') -> Mapping[str, tuple[str, ...]]:
    """Return the paths of the allow-list in ``etc``, with all paths below each."""
    allowed = {}
    for pattern in ETC:
        for path in sorted(glob.glob(f'{etc}/{pattern}')):
            below: list[str] = []
            if not os.path.islink(path):
                for top, folders, files in os.walk(path):
                    below += [f'{top}/{name}' for name in (*folders, *files)]
            allowed[path] = tuple(sorted(below))
    return allowed


@functools.lru_cache(maxsize=4)
def many_settings(etc: str = '/etc') -> tuple[str, ...]:
    """Return the folders of the allow-list with many entries, all of which may be shown."""
    return tuple(path for path, below in allowed_settings(etc).items()
                 if len(below) >= MANY and all(_fit(entry) for entry in (path, *below)))


def _fit(path: str) -> bool:
    """Return whether a setting may be shown: no secret by name, mode or content."""
    if _SECRET.search(path):
        return False
    mode = os.lstat(path).st_mode
    if stat.S_ISREG(mode) and mode & 0o4:
        with open(path, 'rb') as file:
            return not _URL_LOGIN.search(file.read())
    return stat.S_ISLNK(mode) or stat.S_ISDIR(mode) and mode & 0o5 == 0o5


def file_system(path: Path, table: Path = _MOUNTS) -> str:
    """Return the type of the file system of ``path``, which need not exist."""
    name = os.path.realpath(path)
    kind, longest = '', -1
    for point, type_ in _mounts(table):
        inside = name == point or name.startswith(point.rstrip('/') + '/')
        if inside and len(point) >= longest:
            kind, longest = type_, len(point)
    return kind


def _mounts(table: Path) -> Iterator[tuple[str, str]]:
    for line in table.read_text(errors='surrogateescape').splitlines():
        words = line.split(' ')
        yield re.sub(r'\\([0-7]{3})', lambda m: chr(int(m[1], 8)), words[4]), \
            words[words.index('-') + 1]


def settings(archive: Archive, etc: str = '/etc') -> None:
    """Add the settings in ``etc`` that are on the allow-list, readable for all, and no secret."""
    for path, below in allowed_settings(etc).items():
        if path in many_settings(etc):
            archive.folder(f'etc{path[len(etc):]}')
            continue
        hidden: list[str] = []
        for entry in (path, *below):
            if any(entry.startswith(f'{folder}/') for folder in hidden):
                continue
            try:
                if _fit(entry):
                    _add(archive, entry, f'etc{entry[len(etc):]}')
                else:
                    hidden.append(entry)
            except FileNotFoundError:
                continue  # a package manager has removed it meanwhile


def _add(archive: Archive, path: str, name: str) -> None:
    mode = os.lstat(path).st_mode
    if stat.S_ISLNK(mode):
        archive.link(name, os.readlink(path))
    elif stat.S_ISDIR(mode):
        archive.folder(name)
    else:
        with open(path, 'rb') as file:
            archive.file(name, file.read(), 0o755 if mode & 0o111 else 0o644)


def accounts(archive: Archive, user: str, number: int, etc: Path = Path('/etc')) -> None:
    """
    Add the system's accounts and the login ``user``, all without a password.

    :param number: id of the login user and its group, if the user is not root.
    """
    home, own = ('/root', '0') if user == 'root' else (f'/home/{user}', str(number))

    def system(name: str, columns: int) -> list[list[str]]:
        lines = (etc / name).read_text(errors='surrogateescape').splitlines()
        rows = (line.split(':') for line in lines)
        return [row for row in rows
                if len(row) == columns and _system(row[2]) and row[0] != user]

    people = [*system('passwd', 7), [user, 'x', own, own, '', home, '/bin/bash']]
    groups = [*([*row[:3], ''] for row in system('group', 4)), [user, 'x', own, '']]

    def text(rows: Iterable[Sequence[str]]) -> bytes:
        return os.fsencode(''.join(':'.join(row) + '\n' for row in rows))

    archive.file('etc/passwd', text(people))
    archive.file('etc/group', text(groups))
    archive.file('etc/shadow', text([p[0], '*', '', '', '', '', '', '', ''] for p in people),
                 0o600)
    archive.file('etc/gshadow', text([g[0], '*', '', ''] for g in groups), 0o600)
    archive.file('etc/sudoers', (
        'Defaults env_reset\n'
        'Defaults secure_path="/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"\n'
        'root ALL=(ALL:ALL) ALL\n'
        f'{user} ALL=(ALL:ALL) NOPASSWD: ALL\n').encode(), 0o440)
    if user != 'root':
        archive.folder(f'home/{user}', 0o750, number)
        for name in ('.bashrc', '.profile'):
            path = etc / 'skel' / name
            if path.is_file() and _fit(str(path)):
                archive.file(f'home/{user}/{name}', path.read_bytes(), 0o644, number)


def _system(number: str) -> bool:
    return number.isdigit() and (int(number) < 1000 or int(number) == 65534)


@functools.lru_cache(maxsize=4)
def skeleton(base: str = '') -> bytes:
    """
    Return the part of the root that all machines share, as an archive without end mark.

    The accounts are missing: see :func:`accounts`.

    Each process reads /etc only once for all machines of a launch.

    :param base: folder with a system; '' for this computer's.
    """
    archive = Archive()
    for name, mode in _FOLDERS.items():
        archive.folder(name, mode)
    for name in SYSTEM:
        path = Path(f'{base}/{name}')
        if path.is_symlink():
            archive.link(name, os.readlink(path))
        elif path.is_dir():
            archive.folder(name)
    archive.link('var/run', '/run')
    archive.link('var/lock', '/run/lock')
    archive.link('etc/mtab', '../proc/self/mounts')
    settings(archive, f'{base}/etc')
    return archive.data(last=False)


def environment_mounts(*workspaces: str | None) -> list[str]:
    """
    Return the folders of this Python environment and of ROS 2's underlays.

    A custom image would contain them: the environment of this process, its editable installs, and
    the folders in AMENT_PREFIX_PATH without ``workspaces``, which are sent.
    """
    folders = [sys.prefix, sys.base_prefix]
    for prefix in {sys.prefix, sys.base_prefix}:
        for site in Path(prefix).glob('lib/python3*/site-packages'):
            folders += editable(site)
    for entry in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        if entry and os.path.isdir(entry) and not any(
                _inside(entry, workspace) for workspace in workspaces):
            folders.append(entry)
    return outermost(folders)


def editable(site: Path) -> list[str]:
    """Return the packages that ``site`` refers to in other folders (editable installs)."""
    paths: list[str] = []
    for path in site.glob('*.pth'):
        for line in path.read_text(errors='replace').splitlines():
            if line.startswith('/') and os.path.isdir(line):
                packages = [str(child) for child in Path(line).iterdir()
                            if (child / '__init__.py').is_file()
                            or child.suffix == '.py' and child.name != 'setup.py']
                # One mount for each, unless the folder contains little else.
                paths += packages if len(packages) <= 8 else [line]
    for path in site.glob('__editable__*_finder.py'):
        match = re.search(r'^MAPPING[^=]*= *(\{.*\})', path.read_text(), re.MULTILINE)
        if match:
            paths += [str(target) for target in ast.literal_eval(match[1]).values()]
    return [path for path in paths if os.path.exists(path)]


def outermost(paths: Iterable[str]) -> list[str]:
    """Return the paths that are neither below another one, nor below the system's folders."""
    kept: list[str] = []
    for path in sorted({os.path.abspath(path) for path in paths}):
        top = path.split('/')[1]
        if path != '/' and top not in SYSTEM and not any(_inside(path, other) for other in kept):
            kept.append(path)
    return kept


def _inside(path: str, folder: str | None) -> bool:
    return bool(folder) and (path == folder or path.startswith(str(folder).rstrip('/') + '/'))
