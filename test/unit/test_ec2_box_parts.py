# SPDX-License-Identifier: Apache-2.0
"""The parts of EC2 in a box that only decide."""

from __future__ import annotations

import gzip
import json
import shutil
import subprocess

import pytest

from fogros2 import process
from fogros2.model import Command
from rigs.computers import cloud_config, network
from rigs.computers.cloud_config import parse, UserDataError


def test_a_cloud_config_is_understood():
    config = {'bootcmd': [['echo', 'early']], 'ssh_keys': {
        'ed25519_private': 'private', 'ed25519_public': 'public'}, 'ssh_pwauth': False}
    text = f'#cloud-config\n{json.dumps(config)}'.encode()
    assert parse(text) == parse(gzip.compress(text)) == {
        **config, 'runcmd': [], 'hostname': '', 'ssh_authorized_keys': []}
    assert parse(b'')['bootcmd'] == []


@pytest.mark.parametrize('data, word', [
    (b'#cloud-config\n{"runcmds": ["x"]}', 'runcmds'),
    (b'#cloud-config\n{"runcmd": "echo"}', 'echo'),
    (b'#cloud-config\n{"runcmd": [', 'damaged'),
    (b'hello', 'no cloud-config'),
    (b'\x1f\x8bdamaged', 'damaged'),
    (b'#cloud-config\n{"ssh_keys": {"dsa_private": "x"}}', 'dsa_private'),
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
