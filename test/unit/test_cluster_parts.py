# SPDX-License-Identifier: Apache-2.0
"""What the tests' cluster is made of, by value: configuration, images, certificates."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path
import subprocess

import pytest

from fogros2 import process
from fogros2.errors import PrerequisiteError
from rigs.cluster import images, node, ros, services
from rigs.cluster.node_process import ClusterError, run_node


def test_only_who_has_a_token_gets_in():
    layout = services.Layout('198.51.100.254', '198.51.100.253', 30)
    assert '--anonymous-auth=false' in services.commands(layout)['kube-apiserver']
    assert not json.loads(services.files(layout, 's', 'g')['kubelet.json'])[
        'authentication']['anonymous']['enabled']
    text = services.tokens({'admin': ('secret', ('system:masters', 'b')), 'robot': ('word', ())})
    assert list(csv.reader(text.splitlines())) == [
        ['secret', 'admin', '0', 'system:masters,b'], ['word', 'robot', '1']]


@pytest.fixture
def busybox(tmp_path, monkeypatch):
    """Return the only busybox on PATH, as a link to any program."""
    path = tmp_path / 'busybox'
    for name in ('grep', 'ldd'):
        path.with_name(name).symlink_to(f'/usr/bin/{name}')
    monkeypatch.setattr(process, '_ENVIRONMENT', {'PATH': str(tmp_path)})
    return path


#: needs libraries, needs none
DYNAMIC, STATIC = '/bin/sh', '/sbin/ldconfig'


def test_image_takes_only_a_static_busybox(busybox):
    with pytest.raises(PrerequisiteError, match='not found'):
        images.static_busybox()
    busybox.symlink_to(DYNAMIC)
    with pytest.raises(PrerequisiteError, match='shared libraries'):
        images.static_busybox()
    busybox.unlink()
    busybox.symlink_to(STATIC)
    assert images.static_busybox() == busybox


@pytest.mark.parametrize('program, wanted', [(None, True), (DYNAMIC, True), (STATIC, False)])
def test_set_up_demands_a_static_busybox(busybox, program, wanted):
    if program:
        busybox.symlink_to(program)
    common = Path(__file__).parents[2] / 'tools' / 'common.sh'
    done = subprocess.run(['/bin/sh', '-c', f'. {common}; have_static busybox'],
                          env={'PATH': str(busybox.parent)})
    assert (done.returncode != 0) == wanted


def test_changed_content_makes_new_images(tmp_path):
    busybox, packages = tmp_path / 'busybox', tmp_path / 'root/var/lib/dpkg/status'
    packages.parent.mkdir(parents=True)
    keys = set()
    for text in ('dynamic', 'static', 'dynamic'):
        for path, other in ((busybox, packages), (packages, busybox)):
            path.write_text(text)
            other.write_text('same')
            keys.add(images.system_key(tmp_path / 'root', busybox))
    assert len(keys) == 4


def test_an_image_is_made_anew_when_something_is_installed(tmp_path):
    (tmp_path / 'share').mkdir()
    os.utime(tmp_path / 'share', (1, 1))
    before = ros.key(tmp_path)
    assert ros.key(tmp_path) == before
    (tmp_path / 'share' / 'turtlesim').mkdir()
    assert ros.key(tmp_path) != before


def test_a_folder_is_one_node_s(tmp_path):
    with node.claimed(tmp_path) as mine, node.claimed(tmp_path) as again:
        assert (mine, again) == (True, False)
    with node.claimed(tmp_path) as mine:
        assert mine


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
