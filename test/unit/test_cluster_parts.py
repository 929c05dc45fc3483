# SPDX-License-Identifier: Apache-2.0
"""What the tests' cluster is made of, by value: configuration, programs."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path
import subprocess

import pytest

from rigs.cluster import services
from rigs.cluster.node_process import ClusterError, run_node


def test_only_who_has_a_token_gets_in():
    layout = services.Layout('198.51.100.254', '198.51.100.253', 30)
    assert '--anonymous-auth=false' in services.commands(layout)['kube-apiserver']
    assert not json.loads(services.files(layout, 's', 'g')['kubelet.json'])[
        'authentication']['anonymous']['enabled']
    text = services.tokens({'admin': ('secret', ('system:masters', 'b')), 'robot': ('word', ())})
    assert list(csv.reader(text.splitlines())) == [
        ['secret', 'admin', '0', 'system:masters,b'], ['word', 'robot', '1']]


#: needs libraries, needs none
DYNAMIC, STATIC = '/bin/sh', '/sbin/ldconfig'


@pytest.mark.parametrize('program, wanted', [(None, True), (DYNAMIC, True), (STATIC, False)])
def test_set_up_demands_a_static_busybox(tmp_path, program, wanted):
    for name, target in (('grep', '/usr/bin/grep'), ('ldd', '/usr/bin/ldd'), ('busybox', program)):
        if target:
            (tmp_path / name).symlink_to(target)
    common = Path(__file__).parents[2] / 'tools' / 'common.sh'
    done = subprocess.run(['/bin/sh', '-c', f'. {common}; have_static busybox'],
                          env={'PATH': str(tmp_path)})
    assert (done.returncode != 0) == wanted


@pytest.fixture
def sudo(tmp_path, monkeypatch):
    """Return a function that sets what sudo does for a user who is not root."""
    def does(script):
        (tmp_path / 'sudo').write_text(f'#!/bin/sh\n{script}\n')
        (tmp_path / 'sudo').chmod(0o755)

    monkeypatch.setattr(os, 'geteuid', lambda: 1000)
    monkeypatch.setenv('PATH', str(tmp_path), prepend=':')
    return does


def test_node_that_sudo_refuses_is_an_error(sudo, tmp_path):
    sudo('echo "sudo: a password is required" >&2; exit 1')
    with pytest.raises(ClusterError, match='exit status 1\nsudo: a password is required'):
        run_node(tmp_path / 'runs', {}, {}).wait()


def test_node_stays_in_the_session_of_the_sudo_ticket(sudo, tmp_path):
    # the sixth field of its stat; with another terminal or none, sudo asks for the password
    sudo('read -r line </proc/$$/stat; set -- $line; echo "{\\"session\\": $6}"')
    started = run_node(tmp_path / 'runs', {}, {})
    try:
        assert started.await_line(10.0) == {'session': os.getsid(0)}
    finally:
        started.stop()
