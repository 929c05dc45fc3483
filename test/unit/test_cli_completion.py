# SPDX-License-Identifier: Apache-2.0
"""What a shell offers for words of ``ros2``, by argcomplete's protocol."""

from __future__ import annotations

from collections.abc import Callable
from importlib import util
import os
from pathlib import Path
import sys

import pytest
from ros2cli.cli import main

from fogros2.model import MachineSpec, OtherVpn, Peer, to_json, VpnInterface
from fogros2.store import OTHER_VPN, Record, Store, write_private

pytestmark = pytest.mark.skipif(
    util.find_spec('argcomplete') is None, reason='needs argcomplete')

Complete = Callable[[str], list[str]]


@pytest.fixture
def complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Complete:
    """Return what completes a line, on a computer that has two machines and no network."""
    monkeypatch.setenv('FOGROS2_STATE_HOME', str(tmp_path / 'state'))
    for name in ('planner', 'mapper'):
        Store().save(Record(name, 'container', MachineSpec(name, 'container')))
    own = VpnInterface('foga1b2c3', '198.18.7.224', '198.18.7.0/24', 0, '')
    write_private(Store().launch_folder('a1b2c3') / OTHER_VPN, to_json(
        OtherVpn(Peer('slam', '', '198.18.7.2'), own, own, 7224)).encode())

    def complete(line: str) -> list[str]:
        answer = tmp_path / 'answer'
        environment = {
            **os.environ, '_ARGCOMPLETE': '1', '_ARGCOMPLETE_IFS': '\n', 'COMP_LINE': line,
            'COMP_POINT': str(len(line)), 'COMP_TYPE': '9',
            '_ARGCOMPLETE_STDOUT_FILENAME': str(answer),
            # any request would have to go through here, where nobody listens
            'https_proxy': 'http://127.0.0.1:9', 'http_proxy': 'http://127.0.0.1:9'}
        child = os.fork()
        if child == 0:
            try:
                os.environ.update(environment)
                sys.argv = ['ros2']
                main()
            finally:
                os._exit(99)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        return [word.strip() for word in answer.read_text().split('\n') if word.strip()]

    return complete


@pytest.mark.parametrize('line, offered', [
    ('ros2 fog st', ['status']),
    ('ros2 fog invite pl', ['planner']),
    ('ros2 fog revoke ', ['mapper', 'planner']),
    ('ros2 fog leave ', ['slam']),
    ('ros2 fog wait p', ['planner']),
    ('ros2 fog ssh-config ', ['mapper', 'planner']),
    ('ros2 fog status pl', ['planner']),
    ('ros2 fog delete ', ['all', 'mapper', 'planner']),
    ('ros2 fog list --region eu-west-', ['eu-west-1', 'eu-west-2', 'eu-west-3']),
    ('ros2 fog price --region ap-east-', ['ap-east-1', 'ap-east-2']),
    ('ros2 fog price --provider a', ['all', 'aws', 'azure']),
    ('ros2 fog regions sa-', ['sa-east-1']),
    ('ros2 fog doctor --provider ', [
        'aws', 'azure', 'cheapest', 'container', 'gcp', 'hosted', 'joined', 'kubernetes', 'ssh']),
    ('ros2 launch --machine ma', ['mapper=']),
])
def test_command_line_is_completed(complete: Complete, line: str, offered: list[str]) -> None:
    assert sorted(word for word in complete(line) if not word.startswith('-')) == offered
