# SPDX-License-Identifier: Apache-2.0
"""EC2 in a box, by boto3 alone: whether it is what tests of FogROS2 may take for EC2."""

from __future__ import annotations

import functools
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import pytest

from fogros2 import process
from fogros2.model import Command
from fogros2.waiting import wait_until
from rigs.ec2 import Ec2Box

boto3 = pytest.importorskip('boto3', reason='needs boto3')
pytest.importorskip('moto', reason='needs moto[server]')
pytestmark = pytest.mark.usefixtures('engine')

UBUNTU = '/aws/service/canonical/ubuntu/server/24.04/stable/current/amd64/hvm/ebs-gp3/ami-id'
ROBOT = '198.51.100.2'


@pytest.fixture(scope='module')
def box(engine):
    with Ec2Box() as box:
        yield box


@pytest.fixture(autouse=True)
def nothing_goes_on(box):
    yield
    box.heal()
    box.set_boot_delay(0.0)
    left = box.alive()
    for region in {found.region for found in left}:
        client(box, region=region).terminate_instances(
            InstanceIds=[found.id for found in left if found.region == region])


@pytest.fixture(scope='module')
def key(tmp_path_factory):
    path = tmp_path_factory.mktemp('key') / 'id'
    for name in (path, path.with_name('host')):
        process.run(Command(('ssh-keygen', '-q', '-t', 'ed25519', '-N', '', '-f', str(name))),
                    timeout=60)
    return path


@functools.lru_cache(maxsize=16)
def client(box, service='ec2', region='us-east-1'):
    return boto3.client(service, region_name=region, **box.client_arguments)


def ubuntu(box, region='us-east-1', name=UBUNTU):
    return client(box, 'ssm', region).get_parameter(Name=name)['Parameter']['Value']


class Launched:
    """An instance with a key, a group of its own and known host keys."""

    def __init__(self, box, key, *, config=None, region='us-east-1', **words):
        self.box, self.key = box, key
        self.ec2 = client(box, region=region)
        name = f'test-{time.monotonic_ns()}'
        self.ec2.import_key_pair(KeyName=name, PublicKeyMaterial=key.with_suffix(
            '.pub').read_bytes())
        self.group = self.ec2.create_security_group(
            GroupName=name, Description='test')['GroupId']
        self.host_key = key.with_name('host.pub').read_text()
        config = {'ssh_keys': {
            'ed25519_private': key.with_name('host').read_text(),
            'ed25519_public': self.host_key}, **(config or {})}
        words = {'InstanceType': 't3.medium', 'InstanceInitiatedShutdownBehavior': 'terminate',
                 'MetadataOptions': {'HttpTokens': 'required'}, **words}
        words.setdefault('ImageId', ubuntu(box, region))
        self.made = self.ec2.run_instances(
            MinCount=1, MaxCount=1, KeyName=name, SecurityGroupIds=[self.group],
            UserData='#cloud-config\n' + json.dumps(config), **words)['Instances'][0]
        self.id = self.made['InstanceId']

    def allow(self, source=f'{ROBOT}/32'):
        self.ec2.authorize_security_group_ingress(GroupId=self.group, IpPermissions=[{
            'IpProtocol': 'tcp', 'FromPort': 22, 'ToPort': 22,
            'IpRanges': [{'CidrIp': source}]}])

    def described(self):
        found = self.ec2.describe_instances(InstanceIds=[self.id])
        return found['Reservations'][0]['Instances'][0]

    def runs(self):
        self.box.wait_for(self.id, 'running', computer=True)
        return self

    def ssh(self, script, *, deadline=5.0, seconds=2):
        """Run a script from the robot, as somebody who knows the host key."""
        address = self.described()['PublicIpAddress']
        known = self.key.with_name('known_hosts')
        known.write_text(f'{address} {" ".join(self.host_key.split()[:2])}\n')
        words = self.box.on_robot([
            'ssh', '-i', str(self.key), '-o', f'UserKnownHostsFile={known}',
            '-o', f'ConnectTimeout={seconds}', '-o', 'BatchMode=yes', f'ubuntu@{address}',
            script])
        end = time.monotonic() + deadline
        while True:
            result = subprocess.run(words, capture_output=True, text=True, timeout=30)
            if result.returncode != 255 or time.monotonic() > end:
                return result


def test_an_instance_is_a_computer(box, key):
    it = Launched(box, key, config={
        'bootcmd': [['sh', '-c', 'echo "$INSTANCE_ID" >/boot-id']],
        'runcmd': [['sh', '-c', 'echo told >/ran']]})
    assert it.made['State']['Name'] == 'pending'
    it.runs()
    # nobody gets in before the group says so
    assert it.ssh('true', deadline=0, seconds=1).returncode == 255
    it.allow()
    done = it.ssh('cloud-init status --wait; cat /boot-id /ran; id -un; hostname')
    assert done.stdout.split('\n')[:4] == ['status: done', it.id, 'told', 'ubuntu']
    # its metadata service wants a token
    done = it.ssh("""
        url=http://169.254.169.254/latest
        curl -s -o /dev/null -w '%{http_code}\\n' $url/meta-data/instance-id
        token=$(curl -s -X PUT -H 'X-aws-ec2-metadata-token-ttl-seconds: 60' $url/api/token)
        for what in instance-id spot/instance-action placement/region; do
            curl -s -w ' %{http_code}\\n' -H "X-aws-ec2-metadata-token: $token" \\
                $url/meta-data/$what
        done
        """)
    assert done.stdout.split('\n')[:4] == ['401', f'{it.id} 200', ' 404', 'us-east-1 200']
    # what nobody may reach from here, it can't reach either
    assert it.ssh('curl -s -m 2 http://192.0.2.1/ || echo none').stdout.strip() == 'none'
    # and it ends by its own word
    assert it.described()['State']['Name'] == 'running'
    it.ssh('sudo shutdown -h now', deadline=0)
    ended = box.wait_for(it.id, 'terminated')
    assert ended.reason == 'Client.InstanceInitiatedShutdown'
    it.ec2.delete_security_group(GroupId=it.group)


def test_the_robot_has_no_way_out_and_may_move(box):
    def on_robot(*words):
        return subprocess.run(box.on_robot(words), capture_output=True, text=True, timeout=60)

    assert on_robot('curl', '-s', box.checkip).stdout.strip() == ROBOT
    assert on_robot('curl', '-s', '-m', '2', 'http://192.0.2.1/').returncode != 0
    connect = ('import socket, sys; socket.create_connection((sys.argv[1], 443), 2).close()')
    assert on_robot(sys.executable, '-c', connect,
                    'ec2.eu-central-1.amazonaws.com').returncode == 0
    assert on_robot(sys.executable, '-c', connect,
                    'ec2.sa-east-1.amazonaws.com').returncode != 0
    assert not any(Path('/sys/class/net', name).exists() for name in (box.robot, 'robot'))
    moved = box.move_robot()
    try:
        assert on_robot('curl', '-s', box.checkip).stdout.strip() == moved != ROBOT
    finally:
        box.move_robot(back=True)


STARTER = """
import sys, time, boto3
from rigs.ec2 import Ec2Box
with Ec2Box() as box:
    ec2 = boto3.client('ec2', region_name='us-east-1', **box.client_arguments)
    image = boto3.client('ssm', region_name='us-east-1', **box.client_arguments).get_parameter(
        Name=sys.argv[1])['Parameter']['Value']
    made = ec2.run_instances(ImageId=image, InstanceType='t3.medium', MinCount=1, MaxCount=1)
    box.wait_for(made['Instances'][0]['InstanceId'], 'running', computer=True)
    print(box.mark, box._child.pid, flush=True)
    time.sleep(600)
"""


def traces_of(mark):
    """Return what a box with this mark has on this computer now."""
    found = [name for name in process.run(
        Command(('ip', 'netns', 'list'), sudo=True), timeout=60).stdout.split()
        if name.startswith(f'fogt{mark}')]
    found += process.run(Command(
        ('podman', 'ps', '-aq', f'--filter=label=fogros2-ec2={mark}'), sudo=True),
        timeout=60).stdout.split()
    found += [str(path) for path in Path('/var/lib/fogros2-ec2').glob(mark)]
    return found + [str(path) for path in Path('/etc/netns').glob(f'fogt{mark}*')]


@pytest.mark.soak
@pytest.mark.parametrize('whose', ['test', 'box'])
def test_box_leaves_nothing_whichever_process_dies(box, whose, tmp_path):
    # its log's folder is what the one that is killed can't take away
    child = subprocess.Popen([sys.executable, '-c', STARTER, UBUNTU], stdout=subprocess.PIPE,
                             text=True, env={**os.environ, 'TMPDIR': str(tmp_path)})
    mark, pid = child.stdout.readline().split()
    assert traces_of(mark)
    if whose == 'test':
        child.kill()
    else:
        process.run(Command(('kill', '-KILL', pid), sudo=True), timeout=60)
        assert traces_of(mark)
        os.kill(child.pid, signal.SIGKILL)
        with Ec2Box():
            pass  # the next one tidies up
    child.wait(60)
    child.stdout.close()
    wait_until(lambda: not traces_of(mark), timeout=60, what='the box to be gone')
