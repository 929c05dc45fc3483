# SPDX-License-Identifier: Apache-2.0
"""Container machines of a test, in a network of the tests that leads nowhere."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import dataclasses
from pathlib import Path
import uuid

import pytest

from fogros2.errors import ShellError
from fogros2.model import Command, CreateRequest, Machine, MachineSpec
from fogros2.process import run, which
from fogros2.provider.container import ContainerProvider
from fogros2.provider.container import machine as container_machine
from fogros2.shell.ssh import SSHShell
from fogros2.waiting import wait_until
from rigs.networks import network

#: Of TEST-NET-2: nobody's, and no route leads out of an internal network. Several, as two runs of
#: the tests may meet on one computer.
SUBNETS = [f'198.51.100.{host}/27' for host in range(0, 256, 32)]


@pytest.fixture(scope='session')
def engine(tun: None) -> str:
    """Skip where no podman runs containers."""
    if which('podman') is None:
        pytest.skip('needs podman')
    return 'podman'


@pytest.fixture(scope='session')
def cloud_network(engine: str) -> Iterator[str]:
    """Return a container network without a way out, for the time of the tests."""
    # machines get the lower half in turn; tests take addresses for others from the upper one
    with network(SUBNETS, lambda subnet: (
            '--internal', '--ip-range', subnet.replace('/27', '/28'))) as (name, _):
        yield name


def key_in(folder: Path) -> Path:
    """Return a new private key in a folder."""
    path = folder / 'id'
    run(Command(('ssh-keygen', '-q', '-t', 'ed25519', '-N', '', '-f', str(path))), timeout=60.0)
    return path


@pytest.fixture
def key(tmp_path: Path) -> Path:
    return key_in(tmp_path)


@dataclasses.dataclass
class Cloud:
    """What the tests do with machines."""

    provider: ContainerProvider
    key: Path
    options: dict[str, object]
    ids: list[str]
    names: list[str]

    def traces(self) -> list[str]:
        """Return what is left of the machines on this computer."""
        def lines(*words: str) -> list[str]:
            return run(Command(words, sudo=True), timeout=30.0,
                               check=False).stdout.split()

        mounts = Path('/proc/self/mountinfo').read_text()
        parts = [machine_id.split(':') for machine_id in self.ids]
        folders = [container_machine.directory(p[2]).name for p in parts]
        return [
            *(n for n in lines('podman', 'ps', '-a', '--format', '{{.Names}}')
              if n in [f'fogros2-{name}' for name in self.names]),
            *(t for t in lines('ls', str(container_machine.ROOTS)) if t in folders),
            *(t for t in lines('nft', 'list', 'tables')
              if t in [f'fogros2-{name}' for name in folders]),
            *(p[1] for p in parts if p[1] in mounts)]

    def create(self, spec: MachineSpec, **changes: object) -> str:
        request = CreateRequest(**{
            'token': str(uuid.uuid4()), 'authorized_key': self.key.with_suffix('.pub').read_text(),
            'tags': {'fogros2-name': spec.name}, 'vpn_port': 51820, **changes})  # type: ignore
        self.ids.append(self.provider.create(spec, request))
        return self.ids[-1]

    def spec(self, **changes: object) -> MachineSpec:
        name = f't{uuid.uuid4().hex[:6]}'
        self.names.append(name)
        options = {**self.options, **changes.pop('options', {})}  # type: ignore
        return MachineSpec(name, 'container', options, **changes)  # type: ignore

    def reached(self, machine_id: str) -> Machine:
        def look() -> Machine | None:
            machine = self.provider.describe(machine_id)
            return machine if machine.endpoint else None
        return wait_until(look, timeout=60.0, what='the machine')

    @contextlib.contextmanager
    def shell(self, machine: Machine, user: str = '') -> Iterator[SSHShell]:
        assert machine.endpoint is not None
        endpoint = dataclasses.replace(machine.endpoint, key_file=str(self.key))
        if user:
            endpoint = dataclasses.replace(endpoint, user=user)
        shell = SSHShell(endpoint, name=machine.name, timeout=20.0)

        def answers() -> bool:
            with contextlib.suppress(ShellError):
                return shell.run(Command(('true',)), timeout=20.0).returncode == 0
            return False

        try:
            if not user:
                wait_until(answers, timeout=60.0, what='the SSH server')
            yield shell
        finally:
            shell.close()

    @contextlib.contextmanager
    def machine(self, **changes: object) -> Iterator[tuple[Machine, SSHShell]]:
        machine = self.reached(self.create(self.spec(**changes)))
        with self.shell(machine) as shell:
            yield machine, shell


@contextlib.contextmanager
def cloud_in(network: str, key: Path) -> Iterator[Cloud]:
    """Have machines in a network for the time of the block, and check that nothing is left."""
    made = Cloud(ContainerProvider(), key, {'network': network}, [], [])
    yield made
    for machine_id in made.ids:
        made.provider.destroy(machine_id)
    wait_until(lambda: not made.traces(), timeout=60.0, what='all traces to be gone')


@pytest.fixture
def cloud(cloud_network: str, key: Path) -> Iterator[Cloud]:
    with cloud_in(cloud_network, key) as made:
        yield made


@pytest.fixture(scope='module')
def clouds(
    cloud_network: str, tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Cloud]:
    """Return what ``cloud`` returns, for machines that several tests look at."""
    with cloud_in(cloud_network, key_in(tmp_path_factory.mktemp('clouds'))) as made:
        yield made
