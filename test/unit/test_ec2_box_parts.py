# SPDX-License-Identifier: Apache-2.0
"""The parts of EC2 in a box that only decide."""

from __future__ import annotations

import base64
import gzip
import shutil
import subprocess

import pytest

from fogros2 import process
from fogros2.model import Command
from rigs.computers import cloud_config, network
from rigs.computers.cloud_config import parse, Plan, UserDataError


def test_a_cloud_config_is_understood():
    packed = base64.b64encode(gzip.compress(b'packed')).decode()
    plan = parse(f"""#cloud-config
bootcmd: [echo early, [sh, -c, 'echo $INSTANCE_ID']]
runcmd:
  - [touch, /late]
ssh_keys: {{ed25519_private: private, ed25519_public: public}}
ssh_authorized_keys: [ssh-ed25519 AAAA me]
users: [default, {{name: robot, sudo: 'ALL=(ALL) NOPASSWD:ALL', groups: 'video, audio'}}]
packages: [rsync, [wireguard, 1.0]]
write_files:
  - {{path: /a, content: plain, permissions: '0600', owner: 'ubuntu:ubuntu'}}
  - {{path: /b, content: {packed}, encoding: gz+b64, defer: true}}
""".encode())
    assert plan.bootcmd == ('echo early', ('sh', '-c', 'echo $INSTANCE_ID'))
    assert plan.runcmd == (('touch', '/late'),)
    assert plan.host_keys == {'ed25519': ('private', 'public')}
    assert plan.authorized_keys == ('ssh-ed25519 AAAA me',)
    assert [user.name for user in plan.users] == ['robot']
    assert plan.users[0].groups == ('video', 'audio')
    assert plan.packages == ('rsync', 'wireguard')
    first, second = plan.files
    assert base64.b64decode(first.content) == b'plain'
    assert (first.mode, first.owner, first.defer) == ('0600', 'ubuntu:ubuntu', False)
    assert base64.b64decode(second.content) == b'packed'
    assert second.defer


def test_user_data_may_be_packed_a_script_or_several_documents():
    config = b'#cloud-config\nruncmd: [one]\n'
    assert parse(gzip.compress(config)).runcmd == ('one',)
    assert parse(b'#!/bin/sh\necho two\n').scripts == ('#!/bin/sh\necho two\n',)
    assert parse(b'') == Plan()
    both = parse(b'Content-Type: multipart/mixed; boundary="x"\nMIME-Version: 1.0\n\n'
                 b'--x\nContent-Type: text/cloud-config\n\n' + config +
                 b'\n--x\nContent-Type: text/x-shellscript\n\n#!/bin/sh\necho two\n--x--\n')
    assert both.runcmd == ('one',)
    assert len(both.scripts) == 1


@pytest.mark.parametrize('data, word', [
    (b'#cloud-config\nruncmds: [x]\n', 'runcmds'),
    (b'#cloud-config\nruncmd: echo\n', 'list'),
    (b'#cloud-config\nruncmd: [\n', 'YAML'),
    (b'hello', 'neither'),
    (b'\x1f\x8bdamaged', 'damaged'),
    (b'#cloud-config\nssh_keys: {dsa_private: x}\n', 'dsa_private'),
    (b'#cloud-config\nwrite_files: [{path: /a, content: aGVsbG8=, encoding: gz+b64}]\n', '/a'),
    (b'#' + b'x' * cloud_config.LIMIT, '16384'),
])
def test_user_data_that_cloud_init_would_pass_over_is_refused(data, word):
    with pytest.raises(UserDataError, match=word):
        parse(data)


def test_the_router_lets_in_what_the_groups_say():
    host = network.Host('i1', '198.51.100.10', '198.51.100.130', 'vpc-1', (
        network.Allowed('tcp', (22, 22), ('198.51.100.2/32',)),
        network.Allowed('udp', (51820, 51821), ('198.51.100.2/32', '198.51.100.3/32')),
        network.Allowed('-1', None, ('198.51.100.11/32',))))
    other = network.Host('i2', '198.51.100.11', '198.51.100.131', 'vpc-1')
    far = network.Host('i3', '198.51.100.12', '198.51.100.132', 'vpc-2')
    lines = [line.strip() for line in network.rules([host, other, far]).splitlines()]
    begin = lines.index('chain i1 {')
    assert lines[begin + 1:begin + 6] == [
        'ip saddr 198.51.100.2/32 tcp dport 22-22 accept',
        'ip saddr 198.51.100.2/32 udp dport 51820-51821 accept',
        'ip saddr 198.51.100.3/32 udp dport 51820-51821 accept',
        'ip saddr 198.51.100.11/32 accept', 'drop']
    # the private address is there for its own network alone
    assert 'iifname { "i1", "i2" } ip daddr 198.51.100.130 goto i1' in lines
    assert 'iifname { "i3" } ip daddr 198.51.100.132 goto i3' in lines
    # nobody dials the robot
    assert 'type filter hook forward priority 0; policy drop;' in lines
    assert not any(network.ROBOT in line and 'daddr' in line for line in lines)


@pytest.mark.skipif(shutil.which('nft', path='/usr/sbin:/usr/bin:/sbin') is None,
                    reason='needs nft')
def test_nft_understands_the_rules(root):
    host = network.Host('i1', '198.51.100.10', '198.51.100.130', 'vpc-1', (
        network.Allowed('tcp', (22, 22), ('198.51.100.2/32',)),
        network.Allowed('icmp', None, ('198.51.100.2/32',)),
        network.Allowed('udp', None, ('198.51.100.2/32',))))
    checked = subprocess.run(
        process.argv(Command(('nft', '-c', '-f', '-'), sudo=True)), text=True,
        input=network.rules([host]), capture_output=True)
    assert checked.returncode == 0, checked.stderr
