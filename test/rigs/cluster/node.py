# SPDX-License-Identifier: Apache-2.0
"""
The node of a test's cluster: one program, run as root, standard library only.

    node.py FOLDER            make namespaces, run the node in them, and take everything away again
    node.py FOLDER --inside   the first process of those namespaces

All of a node (services, pods, mounts, bridges, firewall rules) is in process, mount and network
namespaces of its own, so it ends with their first process, whatever happens. That one ends when
its standard input does: when its parent process closes it, or dies. What namespaces don't hold is
control groups, and FOLDER; both are taken away by the outer process, or by ``forget`` at the start
of the next cluster if that was killed too.

FOLDER holds ``node.json`` (see ``Node``), configuration files, and later ``log/``, ``control`` (a
socket for commands, one JSON line each way) and ``ready``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import contextlib
import fcntl
import json
import os
from pathlib import Path
import select
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import time
from typing import Any
import urllib.request

HERE = Path('/run/fog')
CGROUPS = Path('/sys/fs/cgroup')
#: Begins the names of control groups, so that they are known as ours.
MARK = 'fogros2-'
#: The kubelet sets these for the whole computer. In the node they are files that nobody reads.
KERNEL_SETTINGS = (
    'vm/overcommit_memory', 'vm/panic_on_oom', 'kernel/panic', 'kernel/panic_on_oops',
    'kernel/keys/root_maxkeys', 'kernel/keys/root_maxbytes')
#: Seconds that the start of one service may take on a busy computer.
TIMEOUT = 90.0


def call(*words: str) -> None:
    """Run a program and wait for it; what it says goes into the error."""
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    if done.returncode != 0:
        raise OSError(f'{" ".join(words)}: {done.stderr.strip() or done.returncode}')


def wait_until(true: Callable[[], bool], what: str, timeout: float = TIMEOUT) -> None:
    """Wait for a condition; standard library only, so not ``fogros2.waiting``."""
    deadline = time.monotonic() + timeout
    while not true():
        if time.monotonic() > deadline:
            raise OSError(f'{what}: not within {timeout:g} s')
        time.sleep(0.02)


# --- outside ------------------------------------------------------------------------------------

def hierarchies() -> list[Path]:
    """Return the control group trees of this computer: one, or one for each controller."""
    if (CGROUPS / 'cgroup.controllers').exists():
        return [CGROUPS]
    return [path for path in CGROUPS.iterdir() if path.is_dir()]


def make_cgroups(name: str) -> None:
    """Make the node's control group in every tree."""
    for tree in hierarchies():
        group = tree / name
        group.mkdir(exist_ok=True)
        for setting in ('cpuset.cpus', 'cpuset.mems'):
            # a new group of the first version has no processors until it is given some
            if (group / setting).exists() and (tree / setting).exists():
                (group / setting).write_text((tree / setting).read_text())


def remove_cgroups(name: str) -> None:
    """Remove a node's control groups; every process in them has ended."""
    for tree in hierarchies():
        for folder, _, _ in os.walk(tree / name, topdown=False):
            def removed(folder: str = folder) -> bool:
                try:
                    os.rmdir(folder)
                except FileNotFoundError:
                    return True
                except OSError:
                    return False  # a process that has just ended is still counted
                return True

            wait_until(removed, f'control group {folder} to be empty', 10.0)


def forget(folder: Path) -> None:
    """Take away what is left of a node whose processes have all ended."""
    remove_cgroups(MARK + folder.name)

    def removed() -> bool:
        shutil.rmtree(folder, ignore_errors=True)
        return not folder.exists()

    wait_until(removed, f'{folder} to be removable', 20.0)


def forget_others(folder: Path) -> None:
    """Take away what is left of nodes that were killed, all but this one and those that run."""
    for other in sorted(folder.parent.iterdir()):
        with contextlib.suppress(FileNotFoundError):  # another one tidies up as well
            # one without a lock is about to start, or its test ended before it had
            young = time.time() - other.stat().st_mtime < 600
            if other != folder and not (young and not (other / 'lock').exists()):
                with claimed(other) as free:
                    if free:
                        forget(other)


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[bool]:
    """Hold a node's folder; False if another process, or a child of one, holds it."""
    with open(folder / 'lock', 'a') as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        # handed on to the process inside: what ends last lets go
        os.set_inheritable(lock.fileno(), True)
        yield True


def outside(folder: Path) -> int:
    """Run the node until its first process ends, then take everything away."""
    # a Ctrl-C in the terminal is for the parent process; the end of our input is for us. A handler
    # rather than SIG_IGN, which all that is started here would inherit, pods included
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: None)
    forget_others(folder)
    node = json.loads((folder / 'node.json').read_text())
    with claimed(folder) as free:
        if not free:
            raise OSError(f'{folder} is in use')
        try:
            make_cgroups(MARK + folder.name)
            if 'images' in node:
                copy_images(Path(node['images']), folder / 'containerd')
            child = subprocess.Popen(
                ['unshare', '--fork', '--kill-child', '--pid', '--mount', '--net', '--ipc',
                 '--uts', '--mount-proc', sys.executable, '-I', __file__, str(folder),
                 '--inside'], close_fds=False)
            try:
                if node.get('cable'):
                    lay_cable(child, node['cable'])
                status = child.wait()
                if status == 0 and 'keep' in node:
                    os.rename(folder / 'containerd', node['keep'])
                return status
            finally:
                child.kill()
                child.wait()
        finally:
            forget(folder)


def copy_images(source: Path, target: Path) -> None:
    """
    Give the node its own copy of a folder of containerd's.

    Files of images are never written again, so they are linked; databases are copied.
    """
    # the target may be there, with files of its own
    call('cp', '-alT', str(source), str(target))
    for database in target.glob('io.containerd.*/*.db'):
        database.unlink()
        shutil.copy2(source / database.relative_to(target), database)


def lay_cable(child: subprocess.Popen[bytes], cable: Mapping[str, str]) -> None:
    """Connect the computer with the node; the cable is gone with the node's namespace."""
    ours = os.readlink('/proc/self/ns/net')
    first: list[str] = []

    def there() -> bool:
        if child.poll() is not None:
            raise OSError('the node ended before it had begun')
        children = Path(f'/proc/{child.pid}/task/{child.pid}/children').read_text().split()
        with contextlib.suppress(OSError):
            first[:] = [c for c in children if os.readlink(f'/proc/{c}/ns/net') != ours]
        return bool(first)

    wait_until(there, "the node's namespaces")
    call('ip', 'link', 'add', cable['name'], 'type', 'veth', 'peer', 'name', 'uplink',
         'netns', first[0])
    call('ip', 'address', 'add', cable['host'], 'dev', cable['name'])
    call('ip', 'link', 'set', cable['name'], 'up')


# --- inside -------------------------------------------------------------------------------------

class Node:
    """
    The services of the node, their parent the first process of its namespaces.

    :param plan: ``commands`` (service -> words, in the order of their start), ``binaries``,
        ``cable``, ``pods`` (range of addresses that leave the node as its own), ``images``
        (containerd's folder to begin with), how to ask the API server
        (``server``, ``authority``, ``token``) and ``owner`` (uid, gid of the user whose test this
        is). Or, instead of running a cluster, ``import``: image archives; what containerd makes of
        them is moved to ``keep``.
    """

    def __init__(self, folder: Path, plan: Mapping[str, Any]) -> None:
        self.folder, self.plan = folder, plan
        self.running: dict[str, subprocess.Popen[bytes]] = {}

    # -- what is seen from here

    def arrange(self) -> None:
        """Make mounts and network as ``services`` expects them."""
        here, binaries = (os.open(path, os.O_PATH) for path in (
            self.folder, self.plan['binaries']))
        # nothing of the computer's own /run: no sockets, and no locks of its other containers
        mount('tmpfs', Path('/run'))
        bind(f'/proc/{os.getpid()}/fd/{here}', HERE)
        bind(f'/proc/{os.getpid()}/fd/{binaries}', HERE / 'bin')
        for path in (Path('/var/lib'), Path('/var/log')):
            mount('tmpfs', path)
        for name in ('containerd', 'kubelet', 'log', 'opt', 'plugins'):
            (HERE / name).mkdir(exist_ok=True)
        bind(str(HERE / 'kubelet'), Path('/var/lib/kubelet'))
        # containers' mounts are made here and seen there, so this is shared, with nobody else
        call('mount', '--make-rshared', '/')
        for name in KERNEL_SETTINGS:
            real, ours = Path('/proc/sys', name), Path('/run/settings', name)
            if real.exists():
                ours.parent.mkdir(parents=True, exist_ok=True)
                ours.write_text(real.read_text())
                call('mount', '--bind', str(ours), str(real))
        call('ip', 'link', 'set', 'lo', 'up')
        cable = self.plan.get('cable')
        if cable:
            wait_until(Path('/proc/sys/net/ipv4/conf/uplink').exists, 'the cable')
            call('ip', 'address', 'add', cable['node'], 'dev', 'uplink')
            call('ip', 'link', 'set', 'uplink', 'up')
        if 'pods' in self.plan:
            call('iptables', '-w', '-t', 'nat', '-A', 'POSTROUTING', '-s', self.plan['pods'],
                 '!', '-d', self.plan['pods'], '-j', 'MASQUERADE')

    # -- services

    def start(self, name: str) -> None:
        """Start a service; its output goes to a file of its name."""
        with open(HERE / 'log' / f'{name}.log', 'ab') as log:
            self.running[name] = subprocess.Popen(
                self.plan['commands'][name], stdin=subprocess.DEVNULL, stdout=log, stderr=log,
                start_new_session=True, env={
                    'PATH': '/usr/sbin:/usr/bin:/sbin:/bin', 'HOME': '/run', 'LANG': 'C.UTF-8'})

    def stop(self, name: str) -> None:
        """Kill a service, as a crash would, and leave it so."""
        child = self.running.pop(name, None)
        if child is not None:
            child.kill()
            child.wait()

    def check(self) -> None:
        """Bury what has ended here, and notice a service that did."""
        for name, child in list(self.running.items()):
            if child.poll() is not None:
                raise OSError(f'{name} ended with {child.returncode}: {self.last_words(name)}')
        known = {child.pid for child in self.running.values()}
        with contextlib.suppress(ChildProcessError):
            while True:
                # look first: what subprocess has started is subprocess's to wait for
                ended = os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
                if ended is None or ended.si_pid in known:
                    return
                os.waitpid(ended.si_pid, 0)

    def last_words(self, name: str) -> str:
        """Return the end of what a service said, without the stacks that Go adds to an error."""
        log = HERE / 'log' / f'{name}.log'
        said = log.read_text(errors='replace').partition('\ngoroutine ')[0]
        return '\n'.join(said.splitlines()[-15:])

    def await_answer(self, name: str) -> None:
        """Wait until a service answers, if it is one that others need."""
        conditions: dict[str, Callable[[], bool]] = {
            'etcd': lambda: listens(('127.0.0.1', 2379)),
            'kube-apiserver': lambda: self.ask('/readyz') == 'ok',
        }
        if name in conditions:
            self.await_service(conditions[name], name)

    def await_service(self, true: Callable[[], bool], name: str) -> None:
        """Wait for a service, which must not end meanwhile."""
        def there() -> bool:
            self.check()
            return true()

        try:
            wait_until(there, f'{name} to answer')
        except OSError as error:
            raise OSError(f'{error}\n{self.last_words(name)}') from error

    def begin(self) -> None:
        """Start everything, and wait until a pod would be run."""
        for name in self.plan['commands']:
            self.start(name)
            self.await_answer(name)
        if 'kubelet' in self.running:
            self.await_service(self.node_ready, 'kubelet')

    def node_ready(self) -> bool:
        """Whether the node says so, and a namespace has its service account."""
        node = json.loads(self.ask('/api/v1/nodes/fog-node') or '{}')
        conditions = node.get('status', {}).get('conditions', ())
        tainted = any(t['key'].startswith('node.kubernetes.io/')
                      for t in node.get('spec', {}).get('taints', ()))
        return (any(c['type'] == 'Ready' and c['status'] == 'True' for c in conditions)
                and not tainted
                and bool(self.ask('/api/v1/namespaces/default/serviceaccounts/default')))

    def ask(self, path: str) -> str:
        """Return what the API server answers to a GET, '' unless it is a success."""
        context = ssl.create_default_context(cadata=self.plan['authority'])
        request = urllib.request.Request(self.plan['server'] + path, headers={
            'Authorization': f'Bearer {self.plan["token"]}'})
        try:
            with urllib.request.urlopen(request, timeout=60, context=context) as answer:
                return str(answer.read().decode())
        except OSError:
            return ''

    # -- until the end

    def serve(self) -> None:
        """Carry out commands until standard input ends."""
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(str(HERE / 'control'))
            os.chown(HERE / 'control', *self.plan['owner'])
            server.listen()
            print(json.dumps({'ready': True}), flush=True)
            while True:
                readable, _, _ = select.select([sys.stdin.buffer, server], [], [], 0.2)
                if sys.stdin.buffer in readable and not os.read(0, 1000):
                    return
                self.check()
                if server in readable:
                    with server.accept()[0] as caller:
                        self.answer(caller)

    def answer(self, caller: socket.socket) -> None:
        """
        Carry out one command.

        ``{'stop': service}``, ``{'start': service}``, which returns when that answers, or
        ``{'run': words}``, a program in the node's namespaces.
        """
        with caller.makefile('rwb') as stream:
            words = json.loads(stream.readline() or b'{}')
            reply: dict[str, Any] = {}
            if 'stop' in words:
                self.stop(words['stop'])
            elif 'start' in words and words['start'] not in self.running:
                self.start(words['start'])
                self.await_answer(words['start'])
            elif 'run' in words:
                done = subprocess.run(words['run'], capture_output=True, text=True, timeout=60,
                                      stdin=subprocess.DEVNULL)
                reply = {'returncode': done.returncode, 'stdout': done.stdout,
                         'stderr': done.stderr}
            with contextlib.suppress(BrokenPipeError):
                stream.write(json.dumps(reply).encode() + b'\n')
                stream.flush()

    def unpack_images(self) -> None:
        """Import image archives into containerd's folder, which is then kept for clusters."""
        self.start('containerd')
        self.await_service(Path('/run/containerd/containerd.sock').exists, 'containerd')
        for archive in self.plan['import']:
            call('ctr', '-n', 'k8s.io', 'images', 'import', archive)
        self.running['containerd'].terminate()
        self.running.pop('containerd').wait(60)


def mount(kind: str, target: Path) -> None:
    """Mount an empty file system."""
    call('mount', '-t', kind, '-o', 'mode=755', kind, str(target))


def bind(source: str, target: Path) -> None:
    """Show a folder at another place."""
    target.mkdir(parents=True, exist_ok=True)
    call('mount', '--no-canonicalize', '--bind', source, str(target))


def listens(address: tuple[str, int]) -> bool:
    """Whether somebody listens there."""
    with socket.socket() as probe:
        return probe.connect_ex(address) == 0


def inside(folder: Path) -> int:
    """Be the first process of the node."""
    # the kernel keeps from a first process what it has no handler for; services inherit defaults
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_DFL)
    node = Node(folder, json.loads((folder / 'node.json').read_text()))
    node.arrange()
    if 'import' in node.plan:
        node.unpack_images()
    else:
        node.begin()
        node.serve()
    return 0


def main() -> int:
    """Run either part; a failure is one JSON line, as everything else that is said."""
    folder = Path(sys.argv[1])
    try:
        return inside(folder) if '--inside' in sys.argv else outside(folder)
    except (OSError, subprocess.TimeoutExpired) as error:
        print(json.dumps({'failed': str(error)}), flush=True)
        return 1


if __name__ == '__main__':
    sys.exit(main())
