# SPDX-License-Identifier: Apache-2.0
"""
A computer that has an SSH server and this computer's system, and nothing of FogROS2.

For tests of machines that exist already: it is a podman container made from this computer's root,
as a container machine is, but without the Python environment, the agent and the tags. To FogROS2
it is somebody's computer at an address.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import contextlib
import dataclasses
from pathlib import Path

from fogros2 import process
from fogros2.model import Command, Endpoint, Result
from fogros2.provider.container import engine as container_engine
from fogros2.provider.container import entry as container_entry
from fogros2.provider.container import root as container_root
from fogros2.provider.container.engine import Engine
from fogros2.waiting import wait_until

USER = 'fog'


@dataclasses.dataclass(frozen=True)
class BareComputer:
    """
    A running computer.

    :param name: its host name, and what the engine calls it.
    :param key: private key file that its user ``fog``, who may use sudo, takes.
    :param host_key: its public host key, ``ssh-ed25519 AAAA...``.
    """

    name: str
    address: str
    key: Path
    host_key: str
    engine: Engine
    user: str = USER

    @property
    def endpoint(self) -> Endpoint:
        """Return how a Shell reaches it, the host key pinned."""
        return Endpoint('ssh', self.address, 22, self.user, self.host_key, str(self.key))

    @property
    def process(self) -> int:
        """Return its first process, as this computer numbers it."""
        (entry,) = self.engine.inspect([self.name])
        return int(entry['State']['Pid'])

    def run(self, script: str, *, check: bool = True) -> Result:
        """Run a script there as root, not by SSH."""
        return process.run(
            Command(self.engine.argv('exec', self.name, 'sh', '-ec', script),
                    sudo=self.engine.sudo, what=f'run {script!r} on {self.name}'),
            timeout=60.0, check=check)

    def leftovers(self) -> list[str]:
        """Return what is there of a launch: interfaces, the agents' folders, processes."""
        return self.run(
            'ls /sys/class/net | grep ^fog || :; ls -d /run/fogros2 2>/dev/null || :; '
            'for p in /proc/[0-9]*; do '
            'tr "\\0" " " <$p/cmdline 2>/dev/null | grep -E "agent.py|talker|wireguard-go|ros2 " '
            '| grep -v "^sh " || :; done').stdout.splitlines()


@contextlib.contextmanager
def bare_computer(
    name: str, folder: Path, network: str, *, mounts: Sequence[str] = (),
    options: Sequence[str] = (), base: str = '',
) -> Iterator[BareComputer]:
    """
    Run a computer for the time of the block.

    :param name: one that no other container has.
    :param folder: an empty folder for its files.
    :param network: the container network it is in.
    :param mounts: folders of this computer that it sees, read-only.
    :param options: more words for ``podman run``.
    :param base: a folder with the programs of another system, '' for this computer's own.
    """
    folder.mkdir(parents=True, exist_ok=True)
    key, root = folder / 'id', folder / 'root'
    process.run(Command(('ssh-keygen', '-q', '-t', 'ed25519', '-N', '', '-C', 'test',
                         '-f', str(key))), timeout=30.0)
    archive = container_entry.archive(
        user=USER, number=1000, authorized_key=key.with_suffix('.pub').read_text(),
        agent_config={})
    container_root.accounts(archive, USER, 1000)
    engine = container_engine.named('podman')
    words = [
        '--rm', '--name', name, '--hostname', name, '--network', network, '--no-hosts',
        '--device', '/dev/net/tun', *container_engine.limits(), *options]
    for right in ('NET_ADMIN', 'NET_RAW', 'AUDIT_WRITE', 'MKNOD'):
        words += ['--cap-add', right]
    for path in container_root.system_mounts():
        other = f'{base}{path}' if path.startswith(('/usr', '/var')) else path
        words += ['-v', f'{other}:{path}:O']
    for path in container_root.outermost(mounts):
        words += ['-v', f'{path}:{path}:ro']
    with contextlib.ExitStack() as undo:
        undo.callback(process.run, Command(('rm', '-rf', '--', str(root)), sudo=True), timeout=60)
        process.run(Command(
            ('sh', '-ec', 'mkdir "$1"; tar -xpf - --numeric-owner -C "$1"', 'sh', str(root)),
            sudo=True, input=container_root.skeleton() + archive.data(),
            what='make a root'), timeout=60.0)
        undo.callback(engine.call, 'rm', '-f', '-t', '0', name, what='remove a computer',
                      check=False)
        engine.call('run', '-d', *words, '--rootfs', str(root), '/bin/sh',
                    f'/{container_entry.FOLDER}/entry.sh', what='start a computer')
        public = Path(root, f'{container_entry.HOST_KEY}.pub')
        shown = Command(('cat', str(public)), sudo=True)

        def host_key() -> str | None:
            text = process.run(shown, timeout=60.0, check=False).stdout
            return ' '.join(text.split()[:2]) or None

        pinned = wait_until(host_key, timeout=60.0, what=f"{name}'s SSH server")
        (entry,) = engine.inspect([name])
        address = str(entry['NetworkSettings']['Networks'][network]['IPAddress'])
        yield BareComputer(name, address, key, pinned, engine)
