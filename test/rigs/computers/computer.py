# SPDX-License-Identifier: Apache-2.0
"""
The computer behind an instance: a container from this computer's root, its disk in folders.

A disk is a folder with the root and what has been written over the system's folders, so that it
outlives a stop, and an image is a copy of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import contextlib
import dataclasses
import json
import os
from pathlib import Path
import select
import signal
import threading
from typing import Any, Optional

from fogros2 import process
from fogros2.model import Command
from fogros2.provider.container import engine as container_engine
from fogros2.provider.container import root as container_root
from fogros2.provider.container.engine import Engine
from rigs.computers import guest

#: Roots of all boxes; the file systems of /tmp and /run may not take an overlay's layer.
DISKS = Path('/var/lib/fogros2-ec2')
#: On every container of a box, with the box's mark.
LABEL = 'fogros2-ec2'
USER = 'ubuntu'
_GUEST = 'opt/ec2/guest.py'
_ENTRY = ('/usr/bin/python3', '-IS', f'/{_GUEST}')
#: Programs of an Ubuntu image that end the computer, or stand for systemd.
_PROGRAMS = ('shutdown', 'poweroff', 'reboot', 'systemctl')
_SSHD = """\
Include /etc/ssh/sshd_config.d/*.conf
PasswordAuthentication no
KbdInteractiveAuthentication no
PermitRootLogin prohibit-password
UsePAM no
UseDNS no
PrintMotd no
PrintLastLog no
X11Forwarding yes
MaxSessions 100
MaxStartups 100:30:200
AcceptEnv LANG LC_*
Subsystem sftp internal-sftp
SetEnv LANG=C.UTF-8 PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
"""

_NEW = """\
umask 022
mkdir -p "$1/root" "$1/layers"
for layer in $2; do mkdir -p "$1/layers$layer/upper" "$1/layers$layer/work"; done
tar -xpf - --numeric-owner -C "$1"
"""
#: An overlay's work folders belong to a mount; only what was written is a disk.
_COPY = """\
umask 022
mkdir -p "$2"
cp -a --reflink=auto "$1/root" "$2/root"
for layer in $3; do
    mkdir -p "$2/layers$layer/work"
    cp -a --reflink=auto "$1/layers$layer/upper" "$2/layers$layer/upper"
done
"""


#: Show a file as a block device, whose number the program prints.
_ATTACH = """\
[ -e "$1" ] || truncate -s "$2G" "$1"
losetup --show -f "$1"
"""
_DETACH = """\
losetup -nl -O NAME,BACK-FILE | while read -r device file; do
    case $file in "$1"*) losetup -d "$device" ;; esac
done
"""


@dataclasses.dataclass(frozen=True)
class Boot:
    """
    What a computer starts with.

    :param space: network namespace it lives in.
    :param plan: what its first process has to do; see ``guest``.
    """

    name: str
    hostname: str
    space: str
    plan: Mapping[str, Any]


def new_disk(folder: Path) -> None:
    """
    Make the disk of a fresh Ubuntu-like image.

    :raises FogError: this computer's root doesn't serve.
    """
    layers = container_root.system_mounts()
    archive = container_root.Archive()
    archive.folder(f'{_root("opt")}/ec2')
    archive.file(_root(_GUEST), Path(guest.__file__).read_bytes(), 0o755)
    archive.file(_root('etc/ssh/sshd_config'), _SSHD.encode())
    archive.folder(_root('etc/ssh/sshd_config.d'))
    bin_folder = 'usr/sbin' if Path('/sbin').is_symlink() else 'sbin'
    for program in _PROGRAMS:
        text = f'#!/bin/sh\nexec {" ".join(_ENTRY)} {program} "$@"\n'
        for place in dict.fromkeys((bin_folder, 'usr/bin')):
            top, _, below = place.partition('/')
            archive.file('/'.join(filter(None, ('layers', top, 'upper', below, program))),
                         text.encode(), 0o755)
    skeleton, people = container_root.skeleton(), container_root.Archive()
    container_root.accounts(people, USER, 1000)
    process.run(
        Command(('sh', '-ec', _NEW, 'sh', str(folder), ' '.join(layers)), sudo=True,
                input=archive.data(), what='make a disk'), timeout=60.0)
    process.run(
        Command(('tar', '-xpf', '-', '--numeric-owner', '-C', str(folder / 'root')), sudo=True,
                input=skeleton + people.data(), what='make a disk'),
        timeout=60.0)


def _root(path: str) -> str:
    return f'root/{path}'


def put_files(folder: Path, files: Mapping[str, str]) -> None:
    """Put programs on a disk: absolute path there, and text."""
    archive = container_root.Archive()
    layers = sorted(container_root.system_mounts(), key=len, reverse=True)
    for path, text in files.items():
        layer = next((top for top in layers if path.startswith(f'{top}/')), '')
        place = f'layers{layer}/upper{path[len(layer):]}' if layer else _root(path[1:])
        archive.file(place, text.encode(), 0o755)
    process.run(
        Command(('tar', '-xpf', '-', '--numeric-owner', '-C', str(folder)), sudo=True,
                input=archive.data(), what='put files on a disk'), timeout=60.0)


def copy_disk(source: Path, target: Path) -> None:
    """
    Copy a disk, aside first: ``target`` is there as a whole or not at all.

    :raises FogError: it can't be copied.
    """
    aside = target.with_name(f'.{target.name}')
    process.run(
        Command(('sh', '-ec', _COPY, 'sh', str(source), str(aside),
                 ' '.join(container_root.system_mounts())), sudo=True, what='copy a disk'),
        timeout=300.0)
    os.rename(aside, target)


def remove_disk(folder: Path) -> None:
    """Remove a disk."""
    process.run(Command(('rm', '-rf', '--', str(folder)), sudo=True), timeout=120.0, check=False)


class Computer:
    """
    One instance's computer.

    :param mark: the box it belongs to.
    :param disk: folder of its disk.
    :param mounts: folders of this computer that it sees, read-only.
    :param volumes: it may mount disks.
    """

    def __init__(
        self, mark: str, disk: Path, mounts: Sequence[str] = (), *, volumes: bool = False,
    ) -> None:
        self.disk = disk
        self._mark = mark
        self._mounts = mounts
        self._volumes = volumes
        self._attached: list[Path] = []
        self._name = ''
        self._handle: Optional[int] = None
        self._lock = threading.Lock()

    @property
    def _engine(self) -> Engine:
        return container_engine.named('podman')

    def start(self, boot: Boot) -> None:
        """
        Start it; returns when its first process runs.

        :raises FogError: it can't be started.
        """
        plan = self.disk / 'root/opt/ec2/plan.json'
        plan.write_text(json.dumps(boot.plan))
        plan.chmod(0o600)
        words = [
            '--name', boot.name, '--hostname', boot.hostname, '--network',
            f'ns:/run/netns/{boot.space}', '--no-hosts', '--device', '/dev/net/tun',
            '--tmpfs', '/run:rw,exec,mode=755',
            '--label', f'{LABEL}={self._mark}', *container_engine.limits()]
        for right in ('NET_ADMIN', 'NET_RAW', 'AUDIT_WRITE', 'MKNOD'):
            words += ['--cap-add', right]
        if self._volumes:
            # loop devices have the number 7
            words += ['--cap-add', 'SYS_ADMIN', '--device-cgroup-rule', 'b 7:* rwm']
        for path in container_root.system_mounts():
            layer = f'{self.disk}/layers{path}'
            words += ['-v', f'{path}:{path}:O,upperdir={layer}/upper,workdir={layer}/work']
        for path in container_root.outermost(self._mounts):
            words += ['-v', f'{path}:{path}:ro']
        self._name = boot.name
        container_engine.tried(self._engine, lambda engine: engine.call(
            'run', '-d', '--replace', *words, '--rootfs', str(self.disk / 'root'), *_ENTRY,
            what='start an instance'))
        (entry,) = self._engine.inspect([boot.name])
        pid = int(entry['State']['Pid'])
        if pid:
            with self._lock:
                self._handle = os.pidfd_open(pid)

    def wait(self) -> None:
        """Wait until its first process has ended."""
        self._look(None)

    def ended(self) -> bool:
        """Return whether its first process has ended."""
        return self._look(0)

    def _look(self, milliseconds: Optional[int]) -> bool:
        with self._lock:
            handle = self._handle
        if handle is None:
            return True
        poll = select.poll()
        poll.register(handle, select.POLLIN)
        return bool(poll.poll(milliseconds))

    def exit_status(self) -> int:
        """Return how its first process ended."""
        # the engine learns of it a little after the kernel
        told = self._engine.call('wait', '-i', '20ms', self._name, what='see an instance end',
                                 check=False).stdout.split()
        return int(told[0]) if told else 0

    def ask_to_end(self) -> None:
        """Press its power button: the first process goes down in order."""
        self._signal(signal.SIGTERM)

    def cut(self) -> None:
        """Take its power away."""
        self._signal(signal.SIGKILL)

    def _signal(self, number: signal.Signals) -> None:
        with self._lock:
            if self._handle is not None:
                try:
                    signal.pidfd_send_signal(self._handle, number)
                except ProcessLookupError:
                    return

    def run(self, script: str, *, check: bool) -> str:
        """Run a script on it as root, not by SSH, and return what it printed."""
        return self._engine.call(
            'exec', self._name, 'sh', '-ec', script, what=f'run {script!r} on an instance',
            timeout=60.0, check=check).stdout

    def attach(self, file: Path, size_gb: int, path: str) -> None:
        """Let it have a disk, in a file of this computer, as a block device."""
        device = process.run(
            Command(('sh', '-ec', _ATTACH, 'sh', str(file), str(size_gb)), sudo=True),
            timeout=30.0).stdout.strip()
        self._attached.append(file)
        number = device.removeprefix('/dev/loop')
        self.run(f'[ -e {device} ] || mknod {device} b 7 {number}\n'
                 f'mkdir -p {os.path.dirname(path)}; ln -sf {device} {path}', check=True)

    def detach(self, file: Path) -> None:
        """Take a disk from it, which it does not use any more."""
        if file in self._attached:
            self._attached.remove(file)
            process.run(Command(('sh', '-c', _DETACH, 'sh', str(file)), sudo=True), timeout=30.0)

    @contextlib.contextmanager
    def still(self) -> Iterator[None]:
        """Hold it for the time of the block, as a snapshot is of one moment."""
        held = self._engine.call('pause', self._name, what='hold an instance', check=False)
        try:
            yield
        finally:
            if held.returncode == 0:
                self._engine.call('unpause', self._name, what='let an instance go on')

    def remove(self) -> None:
        """Remove the container; the disk stays."""
        with self._lock:
            if self._handle is not None:
                os.close(self._handle)
                self._handle = None
        if self._name:
            self._engine.call('rm', '-f', '-t', '0', self._name, what='remove an instance',
                              check=False)
        for file in list(self._attached):
            self.detach(file)


def sweep(mark: str) -> None:
    """
    Remove the containers and disks of the box ``mark``.

    :raises FogError: podman doesn't answer.
    """
    engine = container_engine.named('podman')
    found = engine.call('ps', '-aq', f'--filter=label={LABEL}={mark}',
                        what='list containers', check=False).stdout.split()
    if found:
        engine.call('rm', '-f', '-t', '0', *found, what='remove instances', check=False)
    process.run(Command(('sh', '-c', _DETACH, 'sh', f'{DISKS / mark}/'), sudo=True), timeout=30.0,
                check=False)
    remove_disk(DISKS / mark)


def left_over() -> list[str]:
    """Return the marks of boxes whose process has gone without a word."""
    found = []
    for folder in DISKS.glob('*'):
        try:
            pid, _, begun = (folder / 'owner').read_text().partition(' ')
            if started(int(pid)) != begun:
                found.append(folder.name)
        except (OSError, ValueError):  # another box is about to write it
            continue
    return found


def started(pid: int) -> str:
    """Return when a process was started, in the kernel's ticks, '' if it has ended."""
    try:
        words = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    except OSError:
        return ''
    return '' if words[0] in 'ZX' else words[19]
