# SPDX-License-Identifier: Apache-2.0
"""
Containers beside nodes and nodes in images: with the engine of this computer, as on a machine that
is reached by SSH, and with one of its own on a container machine.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import io
import os
from pathlib import Path
import secrets
import shutil
import signal
import subprocess
import tarfile

import pytest

from fogros2 import container_scripts, containers
from fogros2.containers import Container
from fogros2.errors import CommandError
from fogros2.model import Command, Endpoint, NodeSpec
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


def begun(words: Sequence[str], folder: Path, **variables: str) -> subprocess.Popen[str]:
    """Start what the agent would start."""
    return subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env={**os.environ, 'FOGROS2_AGENT_DIRECTORY': str(folder), **variables})


def started(container: Container, launch: str, folder: Path) -> subprocess.Popen[str]:
    """Start a container as a deployment does, and follow it as the agent does."""
    shell = LocalShell(Endpoint('local'), name='here')
    assert shell.run(containers.find(), timeout=60).stdout.strip() == 'podman'
    image = shell.run(containers.fetch(container.image), timeout=60).stdout.strip()
    shell.run(containers.run(container, 0, launch, image), timeout=60)
    (folder / containers.FOLLOWER).write_text(container_scripts.FOLLOW)
    words = containers.follow(container, 0, launch).arguments
    return begun([str(word) for word in words], folder)


def limited(image: str, *command: str, restart: str = '') -> Container:
    return Container(
        image, (*container_engine.limits(), '--net', 'none'), command, restart=restart)


def node(image: str, launch: str, folder: Path, *command: str, **variables: str,
         ) -> subprocess.Popen[str]:
    """Start a node in an image as the agent does."""
    made = containers.inside(
        NodeSpec('1', 'n-1', arguments=command, image=image, sigkill_timeout=1.5,
                 image_options=container_engine.limits()),
        image, launch, str(folder), ('COLOUR',))
    for key, text in made.files.items():
        (folder / key).write_text(str(text))
    return begun([word if isinstance(word, str) else str(folder / word[0]['file'])
                  for word in made.arguments], folder, **variables)


def test_what_it_says_and_how_it_ends_is_told(image, launch, tmp_path):
    follower = started(limited(image, 'sh', '-c', 'echo hello; exit 3'), launch, tmp_path)
    said = follower.communicate(timeout=60)[0]
    assert (said.splitlines(), follower.returncode) == (['hello'], 3)
    assert there(launch) == []


def test_it_stops_with_the_process_that_follows_it(image, launch, tmp_path):
    follower = started(limited(
        image, 'sh', '-c', "trap 'echo bye; exit 0' TERM; echo up; while :; do "
        'busybox sleep 0.1; done'), launch, tmp_path)
    assert follower.stdout.readline() == 'up\n'
    assert [line.split()[1].lower() for line in there(launch)] in (['up'], ['running'])
    follower.send_signal(signal.SIGINT)
    assert follower.communicate(timeout=60)[0].strip() == 'bye'
    assert follower.returncode == 0
    assert there(launch) == []


def test_what_nobody_follows_any_more_is_removed(image, launch, tmp_path):
    follower = started(limited(image, 'busybox', 'sleep', '1000'), launch, tmp_path)
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
        shell.run(containers.fetch('localhost/no-such-image:1'), timeout=60)


def test_one_that_fails_is_started_again_as_often_as_it_may(image, launch, tmp_path):
    follower = started(
        limited(image, 'sh', '-c', 'echo up; exit 3', restart='on-failure:2'), launch, tmp_path)
    said = follower.communicate(timeout=60)[0].splitlines()
    assert (said.count('up'), follower.returncode) == (3, 3)
    assert sum('is started again' in line for line in said) == 2
    assert there(launch) == []


def test_one_that_was_told_to_end_is_not_started_again(image, launch, tmp_path):
    follower = started(limited(
        image, 'sh', '-c', "trap 'exit 7' TERM; echo up; while :; do busybox sleep 0.1; done",
        restart='always'), launch, tmp_path)
    assert follower.stdout.readline() == 'up\n'
    follower.send_signal(signal.SIGINT)
    follower.communicate(timeout=60)
    assert follower.returncode == 7
    assert there(launch) == []


# --- nodes in images -----------------------------------------------------------------------------

def test_a_node_in_an_image_has_the_machine_s_variables_files_and_user(image, launch, tmp_path):
    settings = tmp_path / 'dds.xml'
    settings.write_text('settings of DDS\n')
    process = node(
        image, launch, tmp_path, 'sh', '-c',
        'echo $RMW_IMPLEMENTATION "$COLOUR" $HOME ${SECRET-none}; '
        'busybox cat ${CYCLONEDDS_URI##*file://}; busybox id -u; busybox hostname; '
        f'busybox touch {tmp_path}/dds.xml; exit 5',
        CYCLONEDDS_URI=f'<a/>,file://{settings}', RMW_IMPLEMENTATION='rmw', COLOUR='dark red',
        SECRET='s')
    said = process.communicate(timeout=60)[0].splitlines()
    assert said[:4] == [
        'rmw dark red /tmp none', 'settings of DDS', str(os.geteuid()), os.uname().nodename]
    assert 'Read-only' in said[4]
    assert process.returncode == 5
    assert there(launch) == []
    assert not list(tmp_path.glob('variables-*'))


@pytest.mark.parametrize(('asked', 'command', 'returncode'), [
    (signal.SIGINT, "trap 'exit 4' INT; echo up; while :; do busybox sleep 0.1; done", 4),
    (signal.SIGINT, 'echo up; exec busybox sleep 1000', -signal.SIGINT),
    (signal.SIGTERM, "trap '' TERM; echo up; while :; do busybox sleep 0.1; done",
     -signal.SIGKILL),
])
def test_a_node_in_an_image_takes_signals_as_any_node(
        image, launch, tmp_path, asked, command, returncode):
    process = node(image, launch, tmp_path, 'sh', '-c', command)
    assert process.stdout.readline() == 'up\n'
    process.send_signal(asked)
    process.communicate(timeout=60)
    assert process.returncode == returncode
    assert there(launch) == []


def test_a_node_in_an_image_that_is_killed_there_ended_so(image, launch, tmp_path):
    process = node(image, launch, tmp_path, 'sh', '-c', 'kill -KILL $$')
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGKILL
    assert there(launch) == []


def test_one_that_is_told_to_end_before_it_began_ends(image, launch, tmp_path):
    process = node(image, launch, tmp_path, 'sh', '-c', 'exec busybox sleep 1000')
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode != 0
    assert there(launch) == []
