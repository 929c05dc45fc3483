# SPDX-License-Identifier: Apache-2.0
"""A container machine's log, which the machine writes, is not read as a whole."""

from __future__ import annotations

import os
from pathlib import Path
import time

import pytest

from fogros2 import process
from fogros2.errors import ProviderError
from fogros2.provider.container import ContainerProvider
from fogros2.provider.container.engine import Engine
from rigs.memory import measure

#: An engine whose machine has reported its key, and then writes without end or a lot.
PODMAN = """\
#!/bin/sh
case $* in
*--tail*) yes {word} | head -c 400000000; echo; echo 'fogros2-error: no space' ;;
*logs*) echo 'fogros2-host-key: ssh-ed25519 AAAA fogros2'; exec yes {word} ;;
esac
"""
ENTRY = {'Id': '0123456789ab', 'State': {'ExitCode': 1}, 'Config': {
    'Image': 'ros', 'Labels': {'fogros2-token': '0123-token'}}}
ENGINE = Engine('podman', sudo=False)


@pytest.fixture
def podman(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    program = tmp_path / 'podman'
    program.write_text(PODMAN.format(word='x' * 500))
    program.chmod(0o755)
    path = f'{tmp_path}:{os.environ["PATH"]}'
    monkeypatch.setitem(process._ENVIRONMENT, 'PATH', path)
    monkeypatch.setenv('PATH', path)
    return tmp_path


def test_key_is_read_from_the_beginning_of_an_endless_log(podman: Path) -> None:
    """As ``ros2 fog list`` does for machines with an image, each time."""
    begin = time.monotonic()
    assert ContainerProvider()._host_key(ENGINE, ENTRY) == 'ssh-ed25519 AAAA'
    assert time.monotonic() - begin < 60


def test_reason_of_an_end_is_read_from_the_end_of_a_long_log(podman: Path) -> None:
    with pytest.raises(ProviderError, match='could not start: no space'):
        ContainerProvider()._check_exit(ENGINE, ENTRY)
    taken, said = measure(f"""\
from fogros2.errors import ProviderError
from fogros2.provider.container import ContainerProvider
from fogros2.provider.container.engine import Engine
# attack
try:
    ContainerProvider()._check_exit(Engine('podman', sudo=False), {ENTRY!r})
except ProviderError as error:
    print(error.args[0])
""", podman)
    assert taken < 100e6 and said[-1].endswith('no space')
