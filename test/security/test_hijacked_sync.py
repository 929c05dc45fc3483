# SPDX-License-Identifier: Apache-2.0
"""Nothing that another computer names reaches the remote shell of rsync as an option."""

from __future__ import annotations

from pathlib import Path

import pytest

from fogros2 import process
from fogros2.model import Endpoint
from fogros2.shell import relay, sync


@pytest.mark.parametrize('name', [
    "x' -o ProxyCommand='touch {file};", '-oProxyCommand=touch {file}',
    'x -oProxyCommand=touch\t{file}'])
@pytest.mark.parametrize('where', ['user', 'host', 'key_file'])
def test_no_name_becomes_an_option_of_openssh(name: str, where: str, tmp_path: Path) -> None:
    (tmp_path / 'source').mkdir()
    file = tmp_path / 'pwned'
    endpoint = Endpoint(**{'kind': 'ssh', 'host': '127.0.0.1', 'port': 9,  # type: ignore
                           'host_key': 'ssh-ed25519 AA', where: name.format(file=file)})
    with sync.open_ssh(endpoint) as (remote, files, _):
        done = process.run(sync.rsync(tmp_path / 'source', '/nowhere', excludes=(), includes=(),
                                      rsh=remote), timeout=30.0, check=False, inherited=files)
    assert done.returncode != 0 and not file.exists(), done.stderr


def test_the_remote_shell_of_rsync_is_constant() -> None:
    """Its words are split, so a part could end a word and begin an option."""
    with sync.open_ssh(Endpoint('ssh', 'a', 9, 'b', 'ssh-ed25519 AA', '/c')) as (remote, _, _):
        first = sync.rsync(Path('/d'), '/e', excludes=(), includes=(), rsh=remote).argv
    with relay.remote_shell(lambda *_: 0) as (remote, _, _):
        other = sync.rsync(Path('/d'), '/e', excludes=(), includes=(), rsh=remote).argv
    assert first == other
