# SPDX-License-Identifier: Apache-2.0
"""A network that leads nowhere for simulated clouds, and a look at what a test leaves behind."""

from __future__ import annotations

from collections.abc import Iterator
import ipaddress
import os
from pathlib import Path
import subprocess
import uuid

import pytest

from fogros2.model import Command
from fogros2.process import run, which
from fogros2.testing.traces import nothing_left as nothing_left_of
from fogros2.testing.traces import RUN, Traces

#: Of TEST-NET-2: nobody's, and no route leads out of an internal network. Several, as two runs of
#: the tests may meet on one computer.
SUBNETS = [f'198.51.100.{host}/28' for host in range(0, 256, 16)]


@pytest.fixture(scope='session')
def domain() -> str:
    """Return a ROS domain of this run's own: it meets neither another run nor the user's robot."""
    return str(1 + uuid.uuid4().int % 100)


@pytest.fixture(scope='module', autouse=True)
def no_dds_of_others() -> Iterator[None]:
    """Forget what tests that run nodes in this process have set, for launches of a module too."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ('CYCLONEDDS_URI', 'RMW_IMPLEMENTATION'):
            patch.delenv(name, raising=False)
        yield


@pytest.fixture(autouse=True)
def own_domain(domain: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the tests' nodes among themselves and off the network of this computer."""
    monkeypatch.setenv('ROS_DOMAIN_ID', domain)
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    # by this, a process is known to be this run's
    monkeypatch.setenv(RUN, f'{os.getpid()}-{domain}')


@pytest.fixture
def nothing_left(
    state_home: Path, root: None, own_domain: None, tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[None]:
    """Fail a test after which something is there that wasn't before, and is nobody else's."""
    traces = Traces(state_home, tmp_path_factory.getbasetemp(), os.environ[RUN])
    with nothing_left_of(traces, timeout=10.0):
        yield


@pytest.fixture(scope='session')
def engine(tun: None) -> str:
    """Skip where no podman runs containers."""
    if which('podman') is None:
        pytest.skip('needs podman')
    return 'podman'


@pytest.fixture(scope='session')
def cloud_network(engine: str) -> Iterator[str]:
    """Return a container network without a way out, for the time of the tests."""
    name = f'fogt{uuid.uuid4().hex[:8]}'
    for subnet in SUBNETS:
        made = run(Command((engine, 'network', 'create', '--internal', '--subnet', subnet, name),
                           sudo=True), timeout=60, check=False)
        if made.returncode == 0:
            break
    else:
        pytest.fail(f'no subnet for the tests is free: {made.stderr}')
    yield name
    run(Command((engine, 'network', 'rm', '-f', name), sudo=True), timeout=60)


@pytest.fixture(scope='session')
def nobody(engine: str, cloud_network: str) -> str:
    """Return an address in the cloud's network that no machine has."""
    subnet = run(Command((engine, 'network', 'inspect', cloud_network, '--format',
                          '{{range .Subnets}}{{.Subnet}}{{end}}'), sudo=True), timeout=60).stdout
    # the engine hands addresses out from the other end
    return str(list(ipaddress.ip_network(subnet.strip()).hosts())[-1])


@pytest.fixture
def children() -> Iterator[list[subprocess.Popen[bytes]]]:
    """Return a list; the processes put there are gone after the test."""
    started: list[subprocess.Popen[bytes]] = []
    yield started
    for child in started:
        if child.poll() is None:
            child.kill()
        child.wait(10)
