# SPDX-License-Identifier: Apache-2.0
"""What the tests' cluster is made of, by value: configuration, images, certificates."""

from __future__ import annotations

import csv
import hashlib
import json
import os
from pathlib import Path
import socket
import ssl
import subprocess
import tarfile
import threading

import pytest

from fogros2 import process
from fogros2.errors import PrerequisiteError
from rigs.cluster import images, node, services
from rigs.cluster.certificates import Authority, rsa_key
from rigs.cluster.images import Image
from rigs.cluster.node_process import ClusterError, run_node
from rigs.cluster.pod_security import verdict

LAYOUT = services.Layout('198.51.100.254', '198.51.100.253', 30)


def test_all_files_that_commands_name_are_written():
    files = services.files(LAYOUT, 'sandbox:1', 'fogros2-x')
    # the rest is made for each cluster: keys, certificates, tokens, kubeconfigs
    made = {'api.crt', 'api.key', 'ca.crt', 'accounts.key', 'tokens.csv', 'cluster.conf',
            'node.conf', 'log/audit.json', 'plugins', 'kubelet-certificates'}
    for words in services.commands(LAYOUT).values():
        for word in words[1:]:
            _, _, value = word.partition('=')
            path = value or word
            if path.startswith(services.HERE):
                assert path.removeprefix(f'{services.HERE}/') in {*files, *made}, word


def test_services_start_after_what_they_need():
    order = list(services.commands(LAYOUT))
    assert order.index('etcd') < order.index('kube-apiserver') < order.index('kubelet')
    assert order.index('containerd') < order.index('kubelet')


def test_nothing_asks_for_what_a_container_may_not():
    files = services.files(LAYOUT, 'sandbox:1', 'fogros2-x')
    kubelet = json.loads(files['kubelet.json'])
    # lowering an oom score takes CAP_SYS_RESOURCE
    assert kubelet['oomScoreAdj'] == 0
    assert 'restrict_oom_score_adj = true' in files['containerd.toml']
    assert kubelet['cgroupRoot'] == '/fogros2-x'
    assert '--oom-score-adj=0' in services.commands(LAYOUT)['kube-proxy']


def test_only_who_has_a_token_gets_in():
    assert '--anonymous-auth=false' in services.commands(LAYOUT)['kube-apiserver']
    assert not json.loads(services.files(LAYOUT, 's', 'g')['kubelet.json'])[
        'authentication']['anonymous']['enabled']
    text = services.tokens({'admin': ('secret', ('system:masters', 'b')), 'robot': ('word', ())})
    assert list(csv.reader(text.splitlines())) == [
        ['secret', 'admin', '0', 'system:masters,b'], ['word', 'robot', '1']]


def test_an_archive_is_an_image_layout(tmp_path):
    low, high = tmp_path / 'low.tar', tmp_path / 'high.tar'
    low.write_bytes(b'low')
    high.write_bytes(b'high')
    target = tmp_path / 'images.tar'
    images.write_archive(target, [
        Image('a.test/one:1', (low,), {'Cmd': ['sh']}),
        Image('a.test/two:1', (low, high), {})], leave_out=[high])
    with tarfile.open(target) as archive:
        files = {member.name: archive.extractfile(member).read() for member in archive}
    for name, data in files.items():
        if name.startswith('blobs/'):
            assert name == f'blobs/sha256/{hashlib.sha256(data).hexdigest()}'
    index = json.loads(files['index.json'])
    assert [m['annotations']['io.containerd.image.name'] for m in index['manifests']] == [
        'a.test/one:1', 'a.test/two:1']
    two = json.loads(files['blobs/' + index['manifests'][1]['digest'].replace(':', '/')])
    config = json.loads(files['blobs/' + two['config']['digest'].replace(':', '/')])
    assert config['rootfs']['diff_ids'] == [layer['digest'] for layer in two['layers']]
    there = ['blobs/' + layer['digest'].replace(':', '/') in files for layer in two['layers']]
    assert there == [True, False], 'the upper layer was to be left out'


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


def test_a_certificate_proves_its_host(tmp_path):
    authority = Authority('test')
    pair = authority.issue('server', ['127.0.0.1'])
    path = tmp_path / 'pair.pem'
    path.write_bytes(pair.certificate + pair.key)
    ours = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    ours.load_cert_chain(path)
    theirs = ssl.create_default_context(cadata=authority.certificate.decode())
    stranger = ssl.create_default_context(cadata=Authority('other').certificate.decode())

    said = []

    def serve(raw: socket.socket) -> None:
        try:
            with raw, ours.wrap_socket(raw, server_side=True):
                said.append('served')
        except OSError:
            said.append('refused')

    for context in (theirs, stranger):
        here, there = socket.socketpair()
        thread = threading.Thread(target=serve, args=(there,))
        thread.start()
        try:
            with here, context.wrap_socket(here, server_hostname='127.0.0.1'):
                said.append('trusted')
        except ssl.SSLCertVerificationError:
            said.append('not trusted')
        thread.join(60.0)
    assert sorted(said[:2]) == ['served', 'trusted']
    assert sorted(said[2:]) == ['not trusted', 'refused']
    assert rsa_key().startswith(b'-----BEGIN RSA PRIVATE KEY-----')


def test_baseline_refuses_what_a_vpn_takes():
    def pod(*added: str) -> dict[str, object]:
        return {'spec': {'containers': [
            {'name': 'machine', 'securityContext': {'capabilities': {'add': list(added)}}}]}}

    assert verdict({'spec': {'containers': [{'name': 'plain'}]}}) == ''
    assert verdict(pod('CHOWN')) == ''
    assert '"machine" must not include "NET_ADMIN"' in verdict(pod('NET_ADMIN'))


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


def test_node_that_was_killed_is_an_error(sudo, tmp_path):
    sudo('kill -9 $$')
    with pytest.raises(ClusterError, match='exit status -9'):
        run_node(tmp_path / 'runs', {}, {}).wait()


def test_node_stays_in_the_session_of_the_sudo_ticket(sudo, tmp_path):
    # the sixth field of its stat; with another terminal or none, sudo asks for the password
    sudo('read -r line </proc/$$/stat; set -- $line; echo "{\\"session\\": $6}"')
    started = run_node(tmp_path / 'runs', {}, {})
    try:
        assert started.await_line(10.0) == {'session': os.getsid(0)}
    finally:
        started.stop()


def test_error_of_a_service_has_no_stacks_of_go(tmp_path, monkeypatch):
    monkeypatch.setattr(node, 'HERE', tmp_path)
    (tmp_path / 'log').mkdir()
    (tmp_path / 'log/kubelet.log').write_text(
        'F1 open /dev/kmsg: no such file\ngoroutine 1 [running]:\n' + 'main.main()\n' * 20)
    assert node.Node(tmp_path, {}).last_words('kubelet') == 'F1 open /dev/kmsg: no such file'
