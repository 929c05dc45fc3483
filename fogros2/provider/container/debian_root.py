# SPDX-License-Identifier: Apache-2.0
"""
Make a small Debian or Ubuntu system of this computer's release in a folder, by debootstrap.

The packages come from the sources of the release in this computer's apt.
"""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
import dataclasses
import fcntl
import hashlib
from pathlib import Path
import platform
import re
import tempfile
import threading
from typing import IO, Optional

from fogros2 import process, store
from fogros2.errors import PrerequisiteError
from fogros2.model import Command
from fogros2.waiting import wait_until

#: Packages of the machine itself, of every launch, and of a new cloud machine.
PACKAGES = ('ca-certificates', 'iproute2', 'iputils-ping', 'nftables', 'openssh-server', 'procps',
            'python3', 'rsync', 'sudo', 'wireguard-go', 'wireguard-tools')
#: Time-out of making a system, and of waiting for another launch that makes it, in seconds.
TIMEOUT = 1800.0
#: Documentation and apt's lists are half of a small system. The mounts of debootstrap end with
#: the mount namespace, also after an interruption.
_MAKE = """\
debootstrap --variant=minbase --force-check-gpg --components="$5" --include="$2" "$3" "$1" "$4" >&2
umount "$1/proc" "$1/sys" 2>/dev/null || :
rm -rf "$1"/var/lib/apt/lists/* "$1"/var/cache/apt/* "$1"/usr/share/doc/* \\
    "$1"/usr/share/locale/* "$1"/usr/share/man/* "$1"/var/log/* "$1"/dev/*
mknod -m 666 "$1/dev/null" c 1 3
chown 0:0 "$1"
chmod 755 "$1"
"""
#: apt's settings for the connection to its sources.
_CONNECTION = re.compile(r'Acquire::(http|https|Check-Valid-Until|Retries)\b.*[^:] "[^"]+";')
#: A user and a password in a URL.
_LOGIN = re.compile(r'://[^/\s@]+@')


@dataclasses.dataclass(frozen=True)
class Release:
    """
    This computer's release in apt's sources.

    :param address: URL of the release's packages.
    :param components: such as ``main``.
    :param sources: lines for sources.list: the release, its updates, its security updates.
    """

    system: str
    codename: str
    address: str
    components: tuple[str, ...]
    sources: tuple[str, ...]


def release() -> Release:
    """
    Return this computer's release.

    :raises PrerequisiteError: apt has no sources of the release, or there is no apt.
    """
    try:
        fields = platform.freedesktop_os_release()
        targets = process.run(Command(
            ('apt-get', 'indextargets', '--format',
             '$(ORIGIN) $(RELEASE) $(COMPONENT) $(REPO_URI)', 'Created-By: Packages')),
            timeout=30.0, check=False).stdout
    except (OSError, PrerequisiteError):
        fields, targets = {}, ''
    return parse_release(fields.get('ID', ''), fields.get('VERSION_CODENAME', ''), targets)


def parse_release(system: str, codename: str, targets: str) -> Release:
    """
    Return the release according to apt's sources.

    :param system: ``ID`` of os-release, such as ``debian``.
    :param targets: lines of origin, release, component and address.
    :raises PrerequisiteError: no source has the release's packages.
    """
    pockets = [codename, *(f'{codename}-{name}' for name in ('updates', 'security'))]
    # Sources of another origin may use the release's name too.
    lines = [line.split(' ') for line in targets.splitlines() if line.count(' ') == 3]
    own = [words for words in lines if words[0].lower() == system and words[1] in pockets
           and not _LOGIN.search(words[3])]
    base = [words for words in own if words[1] == codename]
    if not codename or not base:
        raise PrerequisiteError(
            "this computer's apt knows no packages of its own release"
            f"{f' ({system} {codename})' if codename else ''}, which an isolated root is made of",
            "sudo apt-get update, or name an image with image='...'")
    address = base[0][3]
    return Release(
        system, codename, address,
        tuple(dict.fromkeys(words[2] for words in base if words[3] == address)),
        tuple(dict.fromkeys(f'deb {uri} {name} {component}' for _, name, component, uri in own)))


def connection() -> str:
    """Return apt's settings for the connection to its sources, without passwords."""
    settings = process.run(
        Command(('apt-config', 'dump')), timeout=30.0, check=False).stdout.splitlines()
    return ''.join(f'{line}\n' for line in settings
                   if _CONNECTION.match(line) and not _LOGIN.search(line))


def cache_folder() -> Path:
    """Return the folder of the cached roots, below XDG_CACHE_HOME."""
    return store.cache_home() / 'roots'


def path(folder: Path, own: Release, packages: Sequence[str] = PACKAGES) -> Path:
    """Return the path of the root of a release with these packages; it need not exist."""
    recipe = f'{own.codename} {platform.machine()} {sorted(packages)} {_MAKE}'
    digits = hashlib.sha256(recipe.encode()).hexdigest()[:16]
    return folder / f'{own.codename}-{digits}'


def check_programs() -> None:
    """
    Check that the root exists, or that the programs to make it do.

    :raises PrerequisiteError: a program is missing.
    """
    if not path(cache_folder(), release()).is_dir():
        process.require(('debootstrap', 'unshare'), package_of={'unshare': 'util-linux'})


def root(
    folder: Optional[Path] = None, packages: Sequence[str] = PACKAGES, *,
    cancel: Optional[threading.Event] = None,
) -> Path:
    """
    Return a root with some packages; if it does not exist, make it in one or two minutes.

    :param folder: folder of the roots, by default ``cache_folder()``.
    :raises PrerequisiteError: this computer cannot make it.
    :raises CommandError: debootstrap failed.
    """
    folder = folder or cache_folder()
    own = release()
    target = path(folder, own, packages)
    if target.is_dir():
        return target
    # its programs with root's rights may be older than this computer's: no other account runs them
    store.make_folder(folder)
    folder.chmod(0o700)
    with open(folder / 'lock', 'w') as lock:
        wait_until(lambda: _lock(lock), timeout=TIMEOUT, cancel=cancel, longest=0.5,
                   what='another launch to make the root')
        if target.is_dir():
            return target
        for leftover in folder.glob('new-*'):  # of a launch that was killed
            remove(leftover)
        aside = Path(tempfile.mkdtemp(dir=folder, prefix='new-'))
        with contextlib.ExitStack() as undo:
            undo.callback(remove, aside)
            process.run(Command(
                ('env', *process.proxies(), 'unshare', '--mount', '--pid', '--fork',
                 '--kill-child', 'sh', '-ec', _MAKE, 'sh', str(aside), ','.join(packages),
                 own.codename, own.address, ','.join(own.components)),
                sudo=True, what=f'make a {own.system} {own.codename} system'),
                timeout=TIMEOUT, cancel=cancel)
            process.run(Command(('mv', '-T', str(aside), str(target)), sudo=True), timeout=30.0)
    return target


def _lock(file: IO[str]) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def remove(folder: Path) -> None:
    """
    Remove a folder that belongs to root.

    The processes of a killed debootstrap end a moment later and may still write into it.
    """
    command = Command(('rm', '-rf', '--one-file-system', '--', str(folder)), sudo=True)
    wait_until(lambda: process.run(command, timeout=120.0, check=False).returncode == 0,
               timeout=120.0, what=f'{folder} to be removed')
