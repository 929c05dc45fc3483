# SPDX-License-Identifier: Apache-2.0
"""Containers beside nodes, with the engine of this computer, as on a machine reached by SSH."""

from __future__ import annotations

from collections.abc import Iterator
import io
import os
import secrets
import shutil
import signal
import subprocess
import tarfile

import pytest

from fogros2 import containers
from fogros2.containers import Container
from fogros2.errors import CommandError
from fogros2.model import Command, Endpoint
from fogros2.process import run
from fogros2.provider import container_engine
from fogros2.shell.local import LocalShell
from fogros2.waiting import wait_until


@pytest.fixture(scope='module')
def image(engine: str) -> Iterator[str]:
    """Import an image that holds busybox alone."""
    busybox = shutil.which('busybox')
    if busybox is None:
        pytest.skip('needs busybox')
    name = f'localhost/fogt-{secrets.token_hex(4)}:1'
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode='w') as archive:
        archive.add(busybox, 'bin/busybox')
        link = tarfile.TarInfo('bin/sh')
        link.type, link.linkname = tarfile.SYMTYPE, 'busybox'
        archive.addfile(link)
    run(Command((engine, 'import', '-', name), sudo=True, input=packed.getvalue()), timeout=60)
    yield name
    run(Command((engine, 'rmi', '-f', name), sudo=True), timeout=60)


@pytest.fixture
def launch(engine: str) -> Iterator[str]:
    """Return the id of a launch, of which no container is left after."""
    name = secrets.token_hex(3)
    yield name
    shell = LocalShell(Endpoint('local'), name='here')
    shell.run(containers.remove(name), timeout=60)
    assert there(name) == []


def there(launch: str) -> list[str]:
    return run(Command(('podman', 'ps', '-a', '--format', '{{.Names}} {{.State}}', '--filter',
                        f'label={containers.LABEL}={launch}'), sudo=True), timeout=60,
               ).stdout.splitlines()


def started(container: Container, launch: str) -> subprocess.Popen[str]:
    """Start a container as a deployment does, and follow it as the agent does."""
    shell = LocalShell(Endpoint('local'), name='here')
    assert shell.run(containers.find(), timeout=60).stdout.strip() == 'podman'
    shell.run(containers.run(container, 0, launch), timeout=60)
    words = containers.follow(container, 0, launch).arguments
    return subprocess.Popen(
        [str(word) for word in words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))


def limited(image: str, *command: str) -> Container:
    return Container(image, (*container_engine.limits(), '--net', 'none'), command)


def test_what_it_says_and_how_it_ends_is_told(image, launch):
    follower = started(limited(image, 'sh', '-c', 'echo hello; exit 3'), launch)
    said = follower.communicate(timeout=60)[0]
    assert (said.splitlines(), follower.returncode) == (['hello'], 3)
    assert there(launch) == []


def test_it_stops_with_the_process_that_follows_it(image, launch):
    follower = started(limited(
        image, 'sh', '-c', "trap 'echo bye; exit 0' TERM; echo up; while :; do "
        'busybox sleep 0.1; done'), launch)
    assert follower.stdout.readline() == 'up\n'
    assert [line.split()[1].lower() for line in there(launch)] in (['up'], ['running'])
    follower.send_signal(signal.SIGINT)
    assert follower.communicate(timeout=60)[0].strip() == 'bye'
    assert follower.returncode == 0
    assert there(launch) == []


def test_what_nobody_follows_any_more_is_removed(image, launch):
    follower = started(limited(image, 'busybox', 'sleep', '1000'), launch)
    os.kill(follower.pid, signal.SIGKILL)
    follower.wait(60)
    assert there(launch) != []
    shell = LocalShell(Endpoint('local'), name='here')
    shell.run(containers.remove(launch), timeout=60)
    wait_until(lambda: not there(launch) or None, timeout=20, what='the container to be gone')
    follower.stdout.close()


def test_an_image_that_is_not_there_is_told(engine, launch):
    shell = LocalShell(Endpoint('local'), name='here')
    with pytest.raises(CommandError, match='no-such-image'):
        shell.run(containers.run(
            Container('localhost/no-such-image:1'), 0, launch), timeout=60)
