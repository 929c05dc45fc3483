# SPDX-License-Identifier: Apache-2.0
"""
Machine images for a test's cluster, made on this computer: nothing is downloaded but packages.

``BARE`` is Debian with the few programs that every machine needs, by debootstrap; ``READY`` has
the robot's ROS besides (its wheels, or this computer's ROS 2), put there by the same
bootstrap that a launch uses; ``SANDBOX`` holds a pod's namespaces. They are kept, unpacked as
containerd does it, in the user's cache folder.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import contextlib
import dataclasses
import fcntl
import hashlib
import io
import json
import os
from pathlib import Path
import platform
import sys
import tarfile
import tempfile
import threading
from typing import Any, Optional

from fogros2 import plan, process
from fogros2.errors import PrerequisiteError
from fogros2.host import bootstrap, wheels
from fogros2.model import Command, MachineSpec, Result, SyncReport
from fogros2.provider.container import debian_root
from fogros2.provider.kubernetes.options import IMAGE
from rigs.cluster import ros, services
from rigs.cluster.node_process import run_node

BARE = 'fogros2.test/machine:bare'
READY = 'fogros2.test/machine:ready'
#: ``READY`` under the name that ``KubeInstance()`` asks for if nothing else is said.
DEFAULT = IMAGE
SANDBOX = 'fogros2.test/sandbox:1'
#: Stands for Lichtblick: serves one page at port 8080.
APPLICATION = 'fogros2.test/application:1'
#: What a machine needs before a launch can begin with it, and what tests look at it with.
PACKAGES = ('ca-certificates', 'iproute2', 'iputils-ping', 'nftables', 'procps', 'python3',
            'rsync', 'wireguard-go', 'wireguard-tools')
#: Login user of pods; ``BARE`` has none, which is the machine's to make.
USER, UID = 'fog', 1000
_ARCHITECTURES = {'x86_64': 'amd64', 'aarch64': 'arm64'}
_CONFIG = {'Env': ['PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin'],
           'Cmd': ['/bin/sh']}
_SANDBOX_CONFIG = {**_CONFIG, 'Cmd': ['sleep', 'infinity']}
_APPLICATION_CONFIG = {**_CONFIG, 'Cmd': [
    'sh', '-c', 'echo "the application" >/srv/index.html; '
    # as Lichtblick's server does; the first process of a container has no default handler
    'trap "exit 0" TERM; python3 -m http.server -d /srv 8080 & wait']}
#: In an image folder: why ``READY`` is no more than ``BARE``, if it isn't.
_WHY_NOT = 'why-not-ready'


@dataclasses.dataclass(frozen=True)
class Image:
    """
    An image to be packed.

    :param layers: tar archives, the lowest first.
    :param config: its defaults, in OCI's words (``Env``, ``Cmd``).
    """

    name: str
    layers: tuple[Path, ...]
    config: dict[str, Any]


def base(cache: Path, say: Callable[[str], None]) -> Path:
    """
    Return the bare system's root folder, made by debootstrap unless it is there.

    :param say: gets a line before something slow begins.
    """
    own = debian_root.release()
    if own.system != 'debian':
        raise PrerequisiteError(
            'the machine image is made from Debian, which this computer is not')
    if not debian_root.path(cache / 'roots', own, PACKAGES).is_dir():
        say('making the machine image by debootstrap (a minute)')
    return debian_root.root(cache / 'roots', PACKAGES)


class RootShell:
    """
    A Shell into a folder with a system: what is written goes to another folder.

    :param root: the system.
    :param upper: gets what changes.
    """

    def __init__(self, root: Path, upper: Path) -> None:
        self._root, self._upper = root, upper

    def run(
        self, command: Command, *, timeout: float, check: bool = True,
        cancel: Optional[threading.Event] = None,
    ) -> Result:
        """Run a command with the system as its root, as the login user if not as root."""
        user, home = ('root', '/root') if command.sudo else (USER, f'/home/{USER}')
        words = [f'{name}={value}' for name, value in command.environment.items()]
        return self._inside(
            ('chroot', f'--userspec={user}', '.', 'env', '-i', '-C', home, f'HOME={home}',
             'PATH=/usr/sbin:/usr/bin:/sbin:/bin', *words, *command.argv),
            command, timeout, check, cancel)

    def sync(
        self, source: Path, target: str, *, excludes: Sequence[str], timeout: float,
        cancel: Optional[threading.Event] = None,
    ) -> SyncReport:
        """Copy a folder's contents; what was sent isn't counted."""
        words = [f'--exclude={pattern}' for pattern in excludes]
        self._inside(
            ('rsync', '-a', f'--chown={UID}:{UID}', *words, f'{source}/', f'.{target}/'),
            Command(('rsync',), what='copy files'), timeout, True, cancel)
        return SyncReport(0, 0, 0.0)

    def _inside(
        self, words: Sequence[str], command: Command, timeout: float, check: bool,
        cancel: Optional[threading.Event],
    ) -> Result:
        script = (
            'mkdir -p "$2/files" "$2/work" "$2/seen"; '
            'mount -t overlay -o "lowerdir=$1,upperdir=$2/files,workdir=$2/work" fog "$2/seen"; '
            'mount -t proc proc "$2/seen/proc"; cd "$2/seen"; shift 2; exec "$@"')
        return process.run(Command(
            ('unshare', '--mount', '--pid', '--fork', '--kill-child', 'sh', '-ec', script, 'sh',
             str(self._root), str(self._upper), *words),
            sudo=True, input=command.input, what=command.what), timeout=timeout, check=check,
            cancel=cancel)


def store(cache: Path, binaries: Path) -> Path:
    """
    Return containerd's folder with all images in it, made unless it is there.

    It is named after what is in the images, so the wheels are always today's.

    :param binaries: the cluster's programs.
    """
    packed = wheels.collect()
    its = None if packed.ros else ros.prefix()
    with alone(cache):
        root = base(cache, print)
        system = cache / f'system-{system_key(root)}'
        has = f'{packed.key} {its} {ros.key(its)}' if its else packed.key
        target = cache / f'images-{_checksum(f"4 {system.name} {has}")}'
        for path in (system, target):
            # root's; one who isn't can't say that it was used
            with contextlib.suppress(FileNotFoundError, PermissionError):
                os.utime(path)
        if not target.is_dir():
            print('packing the machine images')
            with tempfile.TemporaryDirectory(dir=cache, prefix='new-images-') as aside:
                _make(Path(aside), root, system, target, its, binaries)
            _forget_old(cache, 'images-', keep=target)
            _forget_old(cache, 'system-', keep=system)
    return target


@contextlib.contextmanager
def alone(cache: Path) -> Iterator[None]:
    """Let one run of tests at a time make images; what one that was killed left half made goes."""
    cache.mkdir(parents=True, exist_ok=True)
    with open(cache / 'images.lock', 'w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        for path in cache.glob('new-*'):
            debian_root.remove(path)
        yield


def _make(
    aside: Path, root: Path, system: Path, target: Path, its: Optional[Path], binaries: Path,
) -> None:
    layers = [aside / name for name in ('system.tar', 'wheels.tar')]
    upper, archive = aside / 'upper', aside / 'images.tar'
    with contextlib.ExitStack() as undo:
        undo.callback(debian_root.remove, upper)
        upper.mkdir()
        pack(layers[0], root)
        if not system.is_dir():
            write_archive(archive, [
                Image(name, tuple(layers[:1]), config) for name, config in (
                    (BARE, _CONFIG), (APPLICATION, _APPLICATION_CONFIG),
                    (SANDBOX, _SANDBOX_CONFIG))])
            _unpack(archive, system, binaries)
        shell = RootShell(root, upper)
        shell.run(Command(('useradd', '-m', '-s', '/bin/bash', '-u', str(UID), USER), sudo=True,
                          what='add the login user'), timeout=30.0)
        why_not = _add_ros(shell, its, root, upper / 'files')
        pack(layers[1], upper / 'files')
        # the lower layer is there already
        write_archive(archive, [
            Image(name, tuple(layers), _CONFIG) for name in (READY, DEFAULT)],
            leave_out=layers[:1])
        _unpack(archive, target, binaries, system, {_WHY_NOT: why_not})


def why_not_ready(store: Path) -> str:
    """Return why ``READY`` has no ROS in it, '' if it has."""
    # the folder is root's alone
    return process.run(Command(('cat', str(store / _WHY_NOT)), sudo=True), timeout=60.0).stdout


def _unpack(
    archive: Path, target: Path, binaries: Path, begin: Optional[Path] = None,
    files: Optional[Mapping[str, str]] = None,
) -> None:
    """
    Have containerd unpack an archive into a folder that has what ``begin`` has.

    :param files: more files for the folder, which is root's: name, contents.
    :raises ClusterError: the folder could not be made.
    """
    first = {'images': str(begin)} if begin else {}
    run_node(target.parent / 'runs', {
        'commands': {'containerd': services.commands(services.NOWHERE)['containerd']},
        'binaries': str(binaries), 'import': [str(archive)], 'keep': str(target), **first,
    }, {'containerd.toml': services.containerd(SANDBOX),
        **{f'containerd/{name}': text for name, text in (files or {}).items()}}).wait()


def _add_ros(shell: RootShell, its: Optional[Path], root: Path, files: Path) -> str:
    """
    Install what a launch of this robot would, and return why that can't be done.

    :param its: the folder of the robot's ROS 2, None where it has wheels.
    """
    # tests may be run by an interpreter whose folder isn't on PATH
    beside = str(Path(sys.executable).with_name('ros2'))
    ros2 = process.which('ros2') or process.which(beside)
    if ros2 is None:
        raise PrerequisiteError('ros2 is not on PATH', 'run this by tools/run.sh')
    if its is not None:
        ros.add(its, root, files)
        runs = shell.run(Command(('sh', '-c', '. "$1/setup.sh" && ros2 --help', 'sh', str(its))),
                         timeout=60.0, check=False)
        if runs.returncode != 0:
            last = runs.stderr.strip().rpartition('\n')[2]
            return f"this computer's ROS 2 can't run in the machine image: {last}"
    under = plan.underlay(dict(os.environ), (), ros2)
    bootstrap.ensure(
        shell, under,  # type: ignore[arg-type]  # nothing there asks for put, open, interactive
        MachineSpec(name='image', provider='', bootstrap='none' if its else 'pip'),
        timeout=300.0)
    # or each pod would compile what it imports, once for each of its processes that begin together
    shell.run(Command(('python3', '-m', 'compileall', '-q', bootstrap.INSTALL_FOLDER),
                      what='compile what was installed'), timeout=300.0)
    return ''


def static_busybox() -> Path:
    """
    Return a busybox that needs no shared library: it is the only program of some images.

    :raises PrerequisiteError: this computer has none, or one that needs libraries.
    """
    found = process.which('busybox')
    if found is None:
        raise PrerequisiteError('busybox not found', 'sudo apt-get install busybox-static')
    # ldd fails for a static program, and has no arrow for a static one that can be relocated
    libraries = process.run(Command(('ldd', found)), timeout=60.0, check=False).stdout
    if '=>' in libraries:
        raise PrerequisiteError(
            f'{found} needs shared libraries, which an image with busybox alone does not have',
            'sudo apt-get install busybox-static')
    return Path(found)


def system_key(root: Path) -> str:
    """
    Return a checksum of what the images of a system without ROS are made of.

    :param root: the system, with dpkg's list of packages and versions.
    """
    packages = _digest(root / 'var/lib/dpkg/status')
    return _checksum(f'3 {root.name} {packages} {_SANDBOX_CONFIG} {_APPLICATION_CONFIG}')


def write_archive(
    target: Path, images: Iterable[Image], *, leave_out: Iterable[Path] = (),
) -> None:
    """
    Write images as one OCI archive (image-spec 1.0, image layout, in a tar file).

    Layers stay as they are, uncompressed: they only go from one folder to another.

    :param leave_out: layers that the reader of the archive has already.
    """
    manifests: list[dict[str, Any]] = []
    written = {_digest(path) for path in leave_out}
    with tarfile.open(target, 'w') as archive:
        def put(name: str, data: bytes) -> None:
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))

        def blob(data: bytes, kind: str) -> dict[str, Any]:
            digest = hashlib.sha256(data).hexdigest()
            if digest not in written:
                put(f'blobs/sha256/{digest}', data)
                written.add(digest)
            return _descriptor(kind, digest, len(data))

        def layer(path: Path) -> dict[str, Any]:
            digest = _digest(path)
            if digest not in written:
                archive.add(path, f'blobs/sha256/{digest}')
                written.add(digest)
            return _descriptor('layer.v1.tar', digest, path.stat().st_size)

        put('oci-layout', b'{"imageLayoutVersion": "1.0.0"}')
        for image in images:
            layers = [layer(path) for path in image.layers]
            config = blob(json.dumps({
                'architecture': _ARCHITECTURES.get(platform.machine(), platform.machine()),
                'os': 'linux', 'config': image.config,
                'rootfs': {'type': 'layers', 'diff_ids': [part['digest'] for part in layers]},
            }).encode(), 'config.v1+json')
            manifest = blob(json.dumps({
                'schemaVersion': 2, 'config': config, 'layers': layers}).encode(),
                'manifest.v1+json')
            manifests.append({**manifest, 'annotations': {
                'io.containerd.image.name': image.name}})
        put('index.json', json.dumps({'schemaVersion': 2, 'manifests': manifests}).encode())


def _descriptor(kind: str, digest: str, size: int) -> dict[str, Any]:
    return {'mediaType': f'application/vnd.oci.image.{kind}', 'digest': f'sha256:{digest}',
            'size': size}


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    with open(path, 'rb') as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def pack(target: Path, folder: Path) -> None:
    """Pack a folder; much of it is root's alone. The same files give the same archive."""
    process.run(Command(
        ('sh', '-ec', 'tar --numeric-owner --one-file-system --sort=name -C "$1" -cf "$2" .; '
         'chown "$3" "$2"', 'sh', str(folder), str(target), str(os.getuid())),
        sudo=True, what='pack an image'), timeout=300.0)


def _forget_old(cache: Path, prefix: str, *, keep: Path, number: int = 2) -> None:
    """Remove all but the last used."""
    others = [path for path in cache.glob(f'{prefix}*') if path != keep]
    for path in sorted(others, key=lambda p: p.stat().st_mtime, reverse=True)[number - 1:]:
        debian_root.remove(path)


def _checksum(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]
