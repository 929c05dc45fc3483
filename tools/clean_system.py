# SPDX-License-Identifier: Apache-2.0
"""
A newly installed Debian or Ubuntu, apart from all else on this computer, to run commands in.

The system is a folder with what debootstrap puts there, ``sudo``, ``git``, ``make`` and a user. It
runs in namespaces of its own (processes, mounts, names, network, control groups), so several run
at once, and each one's leftovers are its own. slirp4netns connects it to the package indices:
Debian's podman brings it, its addresses do not depend on this computer's, and it lets no
connection in (pasta would open this computer's ports inside).

The mirror, the connection settings of apt and pip, and additional certificates are this
computer's.
Root there is root of this computer's kernel: run nothing that you would not run here as root.
"""

from __future__ import annotations

import codecs
from collections.abc import Iterable, Iterator, Mapping, Sequence
import configparser
import contextlib
import dataclasses
import fcntl
import hashlib
import os
from pathlib import Path
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from typing import IO, Optional

USER, PASSWORD = 'robot', 'typed by hand'
#: What a person has installed before the first command of the README.
PACKAGES = ('sudo', 'git', 'make')
#: Programs that this needs, and their packages.
NEEDS = {'debootstrap': 'debootstrap', 'slirp4netns': 'slirp4netns', 'git': 'git',
         'ip': 'iproute2', 'unshare': 'util-linux', 'setpriv': 'util-linux',
         'nsenter': 'util-linux'}
#: The folder of the sources, in the user's home.
PROJECT = 'FogROS2'
OWN_CERTIFICATES = Path('/usr/local/share/ca-certificates')
#: apt's settings of how a mirror is reached. Others would make the system another one.
_CONNECTION = re.compile(r'Acquire::((http|https)::|Check-|Retries)')
_PROMPT = re.compile(r'\[sudo\] password for [^\n]*: $')

#: Joins the $1 control groups that follow, then runs the rest.
_JOIN = ('n=$1; shift; while [ $n -gt 0 ]; do echo $$ >"$1/cgroup.procs"; shift; n=$((n - 1)); '
         'done; exec "$@"')
#: The first process of the system: $1 is the root, $2 the name, the rest are control groups as
#: FOLDER=OPTIONS, the input names folders to mount. The shell collects orphans when they end.
_FIRST = r"""
set -e
root=$1 name=$2
shift 2
hostname "$name"
ip link set lo up
mount --bind "$root" "$root"
cd "$root"
mount -t proc -o nosuid,nodev,noexec proc proc
mount -t sysfs -o nosuid,nodev,noexec sysfs sys
# as systemd sets it at boot: Debian 13's ping has no rights of its own
echo '0 2147483647' >proc/sys/net/ipv4/ping_group_range
mount -t tmpfs -o nosuid,nodev,noexec,mode=755 cgroup sys/fs/cgroup
for each in "$@"; do
    folder=sys/fs/cgroup/${each%%=*} options=${each#*=}
    mkdir -p "$folder"
    if [ -n "$options" ]; then
        mount -t cgroup -o "$options" cgroup "$folder"
    else
        mount -t cgroup2 cgroup2 "$folder"
    fi
done
mount -t tmpfs -o nosuid,mode=755 dev dev
mkdir dev/pts dev/shm dev/net
mount -t devpts -o newinstance,nosuid,noexec,gid=5,mode=620,ptmxmode=666 devpts dev/pts
mount -t tmpfs -o nosuid,nodev,mode=1777 shm dev/shm
ln -s pts/ptmx dev/ptmx
ln -s /proc/self/fd dev/fd
ln -s fd/0 dev/stdin
ln -s fd/1 dev/stdout
ln -s fd/2 dev/stderr
for each in null:1:3 zero:1:5 full:1:7 random:1:8 urandom:1:9 tty:5:0 fuse:10:229 net/tun:10:200
do
    numbers=${each#*:}
    mknod -m 666 "dev/${each%%:*}" c "${numbers%:*}" "${numbers#*:}"
done
# the kubelet reads it; the user may not write there
mknod -m 644 dev/kmsg c 1 11
mount -t tmpfs -o nosuid,nodev,mode=755 run run
mkdir -m 1777 run/lock
while read -r folder; do
    mkdir -p "$root$folder"
    mount --bind "$folder" "$root$folder"
    mount -o remount,bind,ro "$root$folder"
done
mkdir .outside
pivot_root . .outside
umount -l /.outside
rmdir /.outside
echo ready
sleep infinity &
wait
"""


class CleanSystemError(Exception):
    """A system can't be made or used; the message says why, and what to do."""


@dataclasses.dataclass(frozen=True)
class Suite:
    """
    A release to install.

    :param name: the distribution's own, such as ``bookworm``.
    :param mirror: where its packages are; this computer's own mirror if it is empty.
    """

    name: str
    title: str
    distribution: str = 'debian'
    mirror: str = ''

    @property
    def keys(self) -> Path:
        """Return the file with the keys that its packages are signed with."""
        return Path(f'/usr/share/keyrings/{self.distribution}-archive-keyring.gpg')


class System:
    """
    A running system.

    :param first: its first process, as this computer numbers it.
    :param groups: control groups that its processes belong to.
    :param kept: sizes of the package files that it had from the start, in bytes.
    """

    def __init__(self, first: int, groups: Sequence[Path], kept: Mapping[str, int]) -> None:
        self.first = first
        self._groups = groups
        self._kept = kept

    @property
    def files(self) -> Path:
        """Return its root with everything that is mounted there."""
        return Path(f'/proc/{self.first}/root')

    @property
    def project(self) -> Path:
        """Return the folder of the sources."""
        return self.files / 'home' / USER / PROJECT

    def words(self, command: Sequence[str]) -> list[str]:
        """Return a command of this computer that runs one in the system, as root."""
        return _joined(self._groups, [
            'nsenter', '--target', str(self.first), '--all', '--root', '--wd', 'env', '-i',
            'PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin', 'TERM=xterm',
            *command])

    def run(self, *command: str, check: bool = True) -> str:
        """Run a command as root and return its output."""
        return _run(self.words(command), check=check)

    def type(self, line: str, output: Sequence[IO[str]], *, password: bool) -> int:
        """
        Run a command line at a terminal, as the user, in the project's folder.

        :param output: files that get what the terminal shows.
        :param password: whether the user has one, and types it when sudo asks.
        :return: the exit status.
        """
        shell = f'stty cols 100 rows 40; cd ~/{PROJECT}; {line}'
        terminal = subprocess.Popen(
            self.words(['su', '-l', USER, '-c', shlex.join(
                ['script', '-q', '-e', '-c', shell, '/dev/null'])]),
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
        assert terminal.stdin is not None and terminal.stdout is not None
        decoder = codecs.getincrementaldecoder('utf-8')('replace')
        seen = ''
        while data := os.read(terminal.stdout.fileno(), 65536):
            text = decoder.decode(data).replace('\r\n', '\n')
            for file in output:
                file.write(text)
                file.flush()
            seen = (seen + text)[-200:]
            if _PROMPT.search(seen):
                if not password:
                    raise CleanSystemError(f'{line}: sudo asked for a password, and there is none')
                terminal.stdin.write(f'{PASSWORD}\n'.encode())
                terminal.stdin.flush()
                seen = ''
        terminal.stdin.close()
        return terminal.wait()

    def received(self) -> int:
        """Return how many bytes came by the network."""
        return int(Path(self.files, 'sys/class/net/tap0/statistics/rx_bytes').read_text())

    def saved(self, packages: Iterable[str]) -> int:
        """Return how many bytes of these package files an earlier run had downloaded."""
        return sum(self._kept.get(file, 0) for file in packages)

    def packages(self) -> dict[str, str]:
        """Return the file names of all installed packages, as apt caches them, by package."""
        lines = self.run('dpkg-query', '-W', '-f',
                         '${binary:Package} ${Package}_${Version}_${Architecture}.deb\n')
        return dict(_package(line) for line in lines.splitlines())


def _package(line: str) -> tuple[str, str]:
    name, _, file = line.partition(' ')
    return name, file.replace(':', '%3a')


@contextlib.contextmanager
def clean_system(
    folder: Path, suite: Suite, repository: Path, commit: str, *, password: bool,
    kubernetes: str = '',
) -> Iterator[System]:
    """
    Run a new system for the time of the block, with a checkout in its user's home.

    :param folder: keeps everything, also what the next run uses again: systems, packages.
    :param commit: the id of one of ``repository``.
    :param password: whether sudo asks the user for one.
    :param kubernetes: a folder with built programs of Kubernetes for the user's cache, or ''.
    :raises CleanSystemError: it can't be made here.
    """
    check_needs(suite)
    folder.mkdir(parents=True, exist_ok=True)
    _remove_stale(folder)
    base = _base(folder, suite)
    with contextlib.ExitStack() as undo:
        run = Path(tempfile.mkdtemp(dir=folder, prefix='run-'))
        lock = undo.enter_context(open(run / 'lock', 'w'))
        fcntl.flock(lock, fcntl.LOCK_EX)
        undo.callback(_remove, run)
        root = run / 'root'
        root.mkdir()
        _run(['tar', '-C', str(root), '--numeric-owner', '-xpf', str(base)])
        _configure(root, suite, password)
        archives, kept = root / 'var/cache/apt/archives', folder / f'packages-{suite.name}'
        kept.mkdir(exist_ok=True)
        _link(kept, archives)
        undo.callback(_link, archives, kept)
        sizes = {path.name: path.stat().st_size for path in kept.glob('*.deb')}
        system = undo.enter_context(_running(root, run.name, sizes))
        system.run('useradd', '-m', '-s', '/bin/bash', '-G', 'sudo', USER)
        system.run('sh', '-c', f"echo '{USER}:{PASSWORD}' | chpasswd")
        if _own_certificates():
            system.run('update-ca-certificates')
        _check_out(repository, commit, root / 'home' / USER / PROJECT)
        for built in Path(kubernetes).glob('*/built') if kubernetes else ():
            shutil.copytree(built.parent, Path(
                root, 'home', USER, '.cache/fogros2/kubernetes', built.parent.name))
        system.run('chown', '-R', f'{USER}:{USER}', f'/home/{USER}')
        yield system


def check_needs(suite: Suite) -> None:
    """
    Check that this computer can make such a system.

    :raises CleanSystemError: it can't.
    """
    missing = sorted({package for program, package in NEEDS.items()
                      if shutil.which(program) is None})
    if not suite.keys.exists():
        missing.append({'debian': 'debian-archive-keyring', 'ubuntu': 'ubuntu-keyring'}[
            suite.distribution])
    if missing:
        raise CleanSystemError('a clean system needs packages that are missing here: '
                               f'sudo apt-get install {" ".join(missing)}')
    if os.geteuid() != 0:
        raise CleanSystemError('a clean system needs root: run this with sudo')


def _own_certificates() -> list[Path]:
    return sorted(OWN_CERTIFICATES.glob('**/*.crt'))


def _sources(suite: Suite) -> list[str]:
    """Return apt's lines for a release: this computer's own with another name, or its mirror's."""
    if suite.mirror:
        return [f'deb {suite.mirror} {suite.name}{pocket} main universe'
                for pocket in ('', '-updates', '-security')]
    system = platform.freedesktop_os_release()
    own = system.get('VERSION_CODENAME', '')
    lines = _run(['apt-get', 'indextargets', '--format', '$(REPO_URI) $(RELEASE) $(COMPONENT)',
                  'Created-By: Packages']).splitlines()
    sources = []
    for line in lines:
        address, release, component = line.split(' ')
        pocket = release.removeprefix(own)
        if component == 'main' and release.startswith(own) and pocket in (
                '', '-updates', '-security'):
            sources.append(f'deb {address} {suite.name}{pocket} main')
    if system.get('ID') != suite.distribution or not sources:
        raise CleanSystemError(f"this computer's apt knows no mirror of {suite.title}")
    # the release itself comes first: debootstrap asks its mirror
    return sorted(set(sources), key=lambda line: (not line.endswith(f' {suite.name} main'), line))


def _base(folder: Path, suite: Suite) -> Path:
    """Return the archive of a release with our packages; debootstrap makes it once."""
    packages = [*PACKAGES, *(['ca-certificates'] if _own_certificates() else [])]
    key = hashlib.sha256(f'1 {suite.name} {packages}'.encode()).hexdigest()[:16]
    target = folder / f'base-{suite.name}-{key}.tar'
    with open(folder / 'base.lock', 'w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not target.exists():
            say(f'making {suite.title} with debootstrap')
            with tempfile.TemporaryDirectory(dir=folder, prefix='new-') as aside:
                # its mounts end with its mount namespace
                _run(['setpriv', '--pdeathsig', 'KILL', 'unshare', '--mount', '--pid', '--fork',
                      '--kill-child', 'sh', '-ec',
                      'debootstrap --variant=minbase --keyring="$1" --include="$2" "$3" "$4/root" '
                      '"$5" >&2; umount "$4/root/proc" "$4/root/sys" 2>/dev/null || :; '
                      'rm -f "$4"/root/var/cache/apt/archives/*.deb; '
                      'tar -C "$4/root" --one-file-system --numeric-owner -cf "$4/base.tar" .',
                      'sh', str(suite.keys), ','.join(packages), suite.name, aside,
                      _sources(suite)[0].split(' ')[1]])
                os.rename(Path(aside, 'base.tar'), target)
    return target


def _configure(root: Path, suite: Suite, password: bool) -> None:
    """Write what an installer and the network's administrator would have."""
    def write(path: str, text: str, mode: int = 0o644) -> None:
        Path(root, path).parent.mkdir(parents=True, exist_ok=True)
        Path(root, path).write_text(text)
        Path(root, path).chmod(mode)

    write('etc/apt/sources.list', '\n'.join(_sources(suite)) + '\n')
    settings = _run(['apt-config', 'dump']).splitlines()
    write('etc/apt/apt.conf.d/90connection', ''.join(
        f'{line}\n' for line in settings if _CONNECTION.match(line)))
    write('etc/hosts', '127.0.0.1 localhost\n127.0.1.1 fresh\n::1 localhost ip6-localhost\n')
    write('etc/hostname', 'fresh\n')
    # slirp4netns's own, which asks this computer's
    write('etc/resolv.conf', 'nameserver 10.0.2.3\n')
    write('etc/pip.conf', '[global]\n' + ''.join(
        f'{name} = {value}\n' for name, value in pip_settings().items()))
    if not password:
        write(f'etc/sudoers.d/{USER}', f'{USER} ALL=(ALL) NOPASSWD: ALL\n', 0o440)
    # Node has certificates of its own, without this computer's
    write('etc/skel/.npmrc', 'cafile = /etc/ssl/certs/ca-certificates.crt\n')
    for path in _own_certificates():
        write(str(path).lstrip('/'), path.read_text())


def pip_settings() -> dict[str, str]:
    """Return this computer's settings of pip: configuration files, then variables."""
    files: list[str | Path] = [os.environ.get('PIP_CONFIG_FILE') or '/etc/pip.conf',
             *(Path.home() / name for name in ('.pip/pip.conf', '.config/pip/pip.conf'))]
    parser = configparser.RawConfigParser()
    parser.read(files)
    settings = dict(parser['global']) if parser.has_section('global') else {}
    settings |= {name[4:].lower().replace('_', '-'): value for name, value in os.environ.items()
                 if name.startswith('PIP_') and name != 'PIP_CONFIG_FILE'}
    settings.pop('cache-dir', None)
    return {name: value.replace('\n', ' ') for name, value in sorted(settings.items())}


def package_folders(settings: Mapping[str, str]) -> list[Path]:
    """Return the folders of this computer that pip takes packages from."""
    words = ' '.join(settings.get(name, '') for name in (
        'index-url', 'extra-index-url', 'find-links')).split()
    paths = (Path(word.removeprefix('file://')) for word in words
             if word.startswith(('/', 'file:///')))
    # an index names files beside itself
    return sorted({path.parent if path.name == 'simple' else path for path in paths
                   if path.is_dir()})


def commit_of(repository: Path, name: str) -> str:
    """Return the id of a commit that git knows by a name."""
    return _git('-C', str(repository), 'rev-parse', '--verify', f'{name}^{{commit}}')


def _check_out(repository: Path, commit: str, target: Path) -> None:
    _git('clone', '-q', '--no-checkout', f'file://{repository.resolve()}', str(target))
    _git('-C', str(target), 'checkout', '-q', '--detach', commit)
    _git('-C', str(target), 'remote', 'remove', 'origin')


def _git(*words: str) -> str:
    # root reads a repository of somebody else's
    environment = {**os.environ, 'GIT_CONFIG_COUNT': '1', 'GIT_CONFIG_KEY_0': 'safe.directory',
                   'GIT_CONFIG_VALUE_0': '*'}
    return _run(['git', *words], environment=environment).strip()


@contextlib.contextmanager
def _running(root: Path, name: str, kept: Mapping[str, int]) -> Iterator[System]:
    """Start a system's first process and its network; end everything after the block."""
    hierarchies = _hierarchies()
    with contextlib.ExitStack() as undo:
        for path in hierarchies:
            undo.callback(_remove_group, path / name)
            _make_group(path / name)
        groups = [path / name for path in hierarchies]
        first = subprocess.Popen(
            _joined(groups, ['setpriv', '--pdeathsig', 'KILL', 'unshare', '--mount', '--pid',
                             '--fork', '--kill-child', '--uts', '--ipc', '--net', '--cgroup', 'sh',
                             '-c', _FIRST, 'sh', str(root), 'fresh',
                             *(f'{path.name if path != _CGROUP else "."}={options}'
                               for path, options in hierarchies.items())]),
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True)
        undo.callback(_end, first)
        assert first.stdin is not None and first.stdout is not None
        first.stdin.writelines(f'{path}\n' for path in package_folders(pip_settings()))
        first.stdin.close()
        if first.stdout.readline() != 'ready\n':
            raise CleanSystemError('its first process failed (see above): may root make '
                                   'namespaces and mounts here?')
        for number, options in enumerate(hierarchies.values()):
            if not options:
                groups[number] = _leaf(groups[number])
        undo.enter_context(_network(first.pid))
        children = Path(f'/proc/{first.pid}/task/{first.pid}/children').read_text().split()
        yield System(int(children[0]), groups, kept)


_CGROUP = Path('/sys/fs/cgroup')


def _hierarchies() -> dict[Path, str]:
    """Return where control groups are mounted, with their options; none means version 2."""
    named = [line.split(':')[1] for line in Path('/proc/self/cgroup').read_text().splitlines()]
    found = {}
    for line in Path('/proc/self/mounts').read_text().splitlines():
        _, folder, kind, options = line.split(' ')[:4]
        if kind == 'cgroup2':
            found[Path(folder)] = ''
        elif kind == 'cgroup':
            found[Path(folder)] = next(name for name in named if name and set(
                name.split(',')) <= set(options.split(',')))
    return found


def _make_group(path: Path) -> None:
    path.mkdir()
    # version 1's cpuset takes no process before it has these
    for name in ('cpuset.cpus', 'cpuset.mems'):
        if (path / name).exists() and not (path / 'cgroup.controllers').exists():
            (path / name).write_text((path.parent / name).read_text())


def _leaf(group: Path) -> Path:
    """Make room for groups below one of version 2: with processes it would give them nothing."""
    leaf = group / 'first'
    leaf.mkdir()
    for process in (group / 'cgroup.procs').read_text().split():
        (leaf / 'cgroup.procs').write_text(process)
    for controller in (group / 'cgroup.controllers').read_text().split():
        (group / 'cgroup.subtree_control').write_text(f'+{controller}')
    return leaf


def _remove_group(path: Path) -> None:
    """Remove a control group and those below it, when their processes have ended."""
    deadline = time.monotonic() + 20.0
    while path.exists():
        try:
            for folder, _, _ in os.walk(path, topdown=False):
                os.rmdir(folder)
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


@contextlib.contextmanager
def _network(process: int) -> Iterator[None]:
    """Connect the network namespace of a process to the outside, again when slirp4netns dies."""
    namespace = f'/proc/{process}/ns/net'
    # made by slirp4netns it would go with it, and so would the count of bytes
    for words in ('tuntap add tap0 mode tap', 'address add 10.0.2.100/24 dev tap0',
                  'link set tap0 mtu 1500 up', 'route add default via 10.0.2.2'):
        _run(['nsenter', f'--net={namespace}', 'ip', *words.split()])
    # slirp4netns ends when the other end is closed, by us or because we are gone
    watched, held = os.pipe()
    ended = threading.Event()

    def keep(slirp: subprocess.Popen[bytes]) -> None:
        while True:
            slirp.wait()
            if ended.is_set():
                return
            # libslirp 4.7.0, Debian 12's, segfaults now and then
            say(f'slirp4netns ended with status {slirp.returncode}; it is started again')
            try:
                slirp = _slirp4netns(namespace, watched)
            except CleanSystemError as error:
                say(str(error))
                return

    keeper = threading.Thread(
        target=keep, args=[_slirp4netns(namespace, watched)], daemon=True)
    keeper.start()
    try:
        yield
    finally:
        ended.set()
        os.close(held)
        keeper.join(10.0)
        os.close(watched)


def _slirp4netns(namespace: str, watched: int) -> subprocess.Popen[bytes]:
    """
    Return slirp4netns when it serves tap0 of a network namespace.

    :param watched: the end of a pipe; slirp4netns ends with the other end.
    :raises CleanSystemError: it ended.
    """
    ready, told = os.pipe()
    with open(ready, 'rb') as line, tempfile.TemporaryFile() as words:
        try:
            slirp = subprocess.Popen(
                ['slirp4netns', '--mtu=1500', '--disable-host-loopback', f'--ready-fd={told}',
                 f'--exit-fd={watched}', '--netns-type=path', namespace, 'tap0'],
                pass_fds=(told, watched), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                stderr=words, start_new_session=True)
        finally:
            os.close(told)
        if line.read(1) != b'1':
            status = slirp.wait()
            words.seek(0)
            raise CleanSystemError(f'slirp4netns ended with status {status}: '
                                   f'{words.read().decode(errors="replace")[-2000:].strip()}')
    return slirp


def _joined(groups: Sequence[Path], words: Sequence[str]) -> list[str]:
    return ['sh', '-c', _JOIN, 'sh', str(len(groups)), *map(str, groups), *words]


def _end(process: subprocess.Popen[str] | subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


def _run(
    words: Sequence[str], *, check: bool = True, environment: Optional[Mapping[str, str]] = None,
) -> str:
    done = subprocess.run(words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True,
                          stderr=subprocess.PIPE, env=environment)
    if check and done.returncode:
        raise CleanSystemError(f'{shlex.join(words)[:300]} failed:\n{done.stderr[-2000:].strip()}')
    return done.stdout


def _link(source: Path, target: Path) -> None:
    """Give a folder those packages of another that it lacks."""
    for path in source.glob('*.deb'):
        if not (target / path.name).exists():
            os.link(path, target / path.name)


def _remove_stale(folder: Path) -> None:
    """Remove what runs left that were killed."""
    for run in folder.glob('run-*'):
        with contextlib.suppress(FileNotFoundError, BlockingIOError), open(run / 'lock') as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            for path in _hierarchies():
                _remove_group(path / run.name)
            _remove(run)


def _remove(run: Path) -> None:
    """Remove a run's folder, unless something is mounted there."""
    mounted = [line.split(' ')[4] for line in Path('/proc/self/mountinfo').read_text().splitlines()
               if line.split(' ')[4].startswith(f'{run}/')]
    if mounted:
        raise CleanSystemError(f'{run} stays, as this is mounted there: {" ".join(mounted)}')
    _run(['rm', '-rf', '--one-file-system', '--', str(run)])


def say(text: str) -> None:
    """Tell the person at the terminal."""
    print(f'-- {text}', file=sys.stderr, flush=True)
