# SPDX-License-Identifier: Apache-2.0
"""Machines behind a firewall, with a host key that was handed over, that are taken away."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import dataclasses
import ipaddress
import json
import re
import shutil
import socket
import time
import uuid

import pytest

from fogros2.deploy import Launch
from fogros2.deploy import launch as launches
from fogros2.errors import VpnError
from fogros2.model import Command, MachineSpec, NodeSpec
from fogros2.process import run
from fogros2.provider.container import ContainerProvider, packet_filter
from fogros2.provider.container import machine as container_machine
from fogros2.report import StepDone
from fogros2.store import Store
from fogros2.waiting import Timeouts, wait_until
from fogros2_features.vpn_path import feature as vpn_path
from rigs.launched import ros2
from rigs.networks import without_udp

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]

#: Other runs of these tests may be under way on the same computer.
RUN = uuid.uuid4().hex[:6]

# what a cloud's firewall does in front of a machine; connections that exist end, too
RULES = """\
table inet cloud
delete table inet cloud
table inet cloud {
  chain input {
    type filter hook input priority filter; policy accept;
    iifname "fog*" accept
    iifname "lo" accept
    tcp dport %d ip saddr != { %s } drop
  }
}
"""


class CloudLike(ContainerProvider):
    """Containers as a cloud has them: behind a firewall, and with host keys from outside."""

    capabilities = dataclasses.replace(
        ContainerProvider.capabilities, firewall=True, one_time_host_key=True,
        preemption_notice=('cat', '/run/notice'))
    robot = ''

    def __init__(self):
        super().__init__()
        self.asked = []
        self.pinned = {}

    def robot_address(self):
        return self.robot

    def allow(self, machine_id, port, sources):
        self.asked.append((port, list(sources)))
        engine, identity, _ = container_machine.parse_id(machine_id)
        # 192.0.2.0 is nobody: a set has to have a member
        rules = RULES % (port, ', '.join(sources) or '192.0.2.0')
        engine.call('exec', identity, 'sh', '-c', 'printf %s "$1" | nft -f -', 'sh', rules,
                    what='set the firewall')

    def pin(self, machine_id, host_key):
        self.pinned[machine_id] = host_key


@pytest.fixture
def cloud(monkeypatch, cloud_network):
    provider = CloudLike()
    subnet = run(Command(('podman', 'network', 'inspect', cloud_network, '--format',
                          '{{range .Subnets}}{{.Subnet}}{{end}}'), sudo=True), timeout=60).stdout
    provider.robot = f'{next(ipaddress.ip_network(subnet.strip()).hosts())}/32'
    monkeypatch.setattr(launches, 'provider', lambda name: provider)
    return provider


@pytest.fixture
def spec(cloud_network):
    def make(name='guarded', **changes):
        return MachineSpec(f'{name}-{RUN}', 'container', {'network': cloud_network}, **changes)
    return make


def answers(host, port=22):
    try:
        with socket.create_connection((host, port), timeout=1.0):
            return True
    except OSError:
        return False


def server_address(machine):
    words = machine.shell.run(
        Command(('sh', '-c', 'echo $SSH_CONNECTION')), timeout=60).stdout.split()
    return words[2]


def test_firewalled_machine_is_reached_only_through_the_vpn(cloud, spec, monkeypatch):
    """From the robot's new address, and by a later launch, which sees the machine's end."""
    monkeypatch.setattr('fogros2.deploy.steps.connecting.POLL_INTERVAL', 0.5)
    monkeypatch.setattr('fogros2.deploy.steps.connecting.LOGIN_TIMEOUT', 1.0)
    monkeypatch.setattr('fogros2.deploy.steps.watching.SILENCE', 2.5)
    store = Store()
    first = Launch(store=store)
    kept = spec(on_exit='keep')
    handed_over = []
    create = cloud.create

    def shut(spec, request):
        machine_id = create(spec, request)
        machine = cloud.reachable(machine_id, name=spec.name, timeout=30)
        handed_over.append(machine.endpoint.host_key)
        cloud.allow(machine_id, 22, ['192.0.2.7/32'])
        return machine_id

    monkeypatch.setattr(cloud, 'create', shut)
    try:
        machine = first.up(kept)
        outside = machine.machine.endpoint.host
        key = store.load(kept.name).host_key
        assert key and key not in handed_over
        assert cloud.pinned == {machine.machine.id: key}
        assert cloud.asked == [(22, ['192.0.2.7/32']), (22, [cloud.robot]), (22, [])]
        assert server_address(machine) == machine.vpn_address
        assert not answers(outside)
        heard = []
        machine.subscribe(heard.append)
        machine.start([NodeSpec('n-1', 'n-1', arguments=('echo', 'hello'))])
        wait_for(heard, 'exited')
        cloud.asked.clear()
    finally:
        assert first.down() == []
    assert cloud.asked == [(22, [cloud.robot]), (22, [])]
    assert not answers(outside)

    # a later launch gets in all the same, and finds the key that the machine made
    cloud.asked.clear()
    second = Launch(store=store)
    heard = []
    try:
        again = second.up(spec())
        assert again.machine.id == machine.machine.id
        assert store.load(kept.name).host_key == key
        assert cloud.asked == [(22, [cloud.robot]), (22, [])]
        assert server_address(again) == again.vpn_address
        again.subscribe(heard.append)
        again.shell.run(Command.script('echo soon gone >/run/notice', sudo=True), timeout=60)
        wait_for(heard, 'notice')
        engine, identity, _ = container_machine.parse_id(again.machine.id)
        engine.call('kill', identity, what='take the machine away')
        wait_for(heard, 'lost')
        assert not again.reclaimed(0.0), 'it is gone, so nobody has to confirm a notice'
    finally:
        begin = time.monotonic()
        assert second.down() == []
        # a command of a machine that answers has 60 s
        assert time.monotonic() - begin < 45
    notice, lost = (e['reason'] for e in heard if e['event'] in ('notice', 'lost'))
    assert notice == 'soon gone' and (identity in lost or 'stopped' in lost)


def wait_for(heard, event):
    wait_until(lambda: any(e['event'] == event for e in heard), timeout=60, what=event)


def test_vpn_leaves_udp_and_returns(cloud, spec, cloud_network, monkeypatch):
    # nobody here has the time of a network
    for name, seconds in (('MISSING', 5.0), ('WORKING', 3.0), ('SHORTEST', 3.0)):
        monkeypatch.setattr(vpn_path, name, seconds)
    events = []
    launch = Launch(report=events.append)

    def uses(path, sources):
        def used():
            paths = [event.detail for event in events
                     if isinstance(event, StepDone) and event.step == 'VPN path']
            return paths[-1:] == [path] and machine.heartbeat.age < 1.0 \
                and cloud.asked[-1] == (22, sources)

        wait_until(used, timeout=60.0, what=f'answers by {path}')
        status = ros2('fog', 'status', machine.spec.name).stdout
        assert re.search(rf'^VPN path +{path}$', status, re.MULTILINE)
        kinds = [made.kind for made in launch.store.load(machine.spec.name).made]
        assert not sources or 'firewall' in kinds, 'nothing would close the port after a kill'
        return answers(machine.machine.endpoint.host) == bool(sources)

    try:
        with without_udp(cloud_network):
            machine = launch.up(spec())
            assert uses('stream', [cloud.robot])
        assert uses('udp', [])
        assert server_address(machine) == machine.vpn_address
        with without_udp(cloud_network):
            assert uses('stream', [cloud.robot])
    finally:
        assert launch.down() == []


def test_udp_alone_fails_and_names_the_remedy(spec, cloud_network):
    launch = Launch(timeouts=Timeouts(vpn=5.0))
    try:
        with without_udp(cloud_network), pytest.raises(VpnError, match="vpn_path='auto'"):
            launch.up(spec(features={'vpn_path': {'vpn_path': 'udp'}}))
    finally:
        assert launch.down() == []


def hide(cloud, monkeypatch, robots):
    """Make machines those that nobody dials; they dial the robot at the last of ``robots``."""
    monkeypatch.setattr(CloudLike, 'capabilities', ContainerProvider.capabilities)
    # these machines need the robot's VPN port, which a container machine does not reach
    monkeypatch.setattr(packet_filter, 'SET', ':')
    describe = cloud.describe

    def hidden(machine_id):
        machine = describe(machine_id)
        return dataclasses.replace(
            machine, vpn_host='', robot_host=robots[-1], private_network='pods',
            private_ip=machine.vpn_host)

    monkeypatch.setattr(cloud, 'describe', hidden)


#: What lies between a machine and where the robot was; SSH isn't what this is about.
MOVED = """\
table inet moved {
  chain input {
    type filter hook input priority -200; policy accept;
    meta l4proto udp ip saddr %s drop
  }
  chain output {
    type filter hook output priority -200; policy accept;
    meta l4proto udp ip daddr %s drop
  }
}
"""


def test_unreachable_machines_dial_the_robot_and_each_other(
        cloud, spec, monkeypatch, cloud_network):
    """And the robot where it has moved to."""
    monkeypatch.setattr('fogros2.deploy.steps.watching.SILENCE', 2.5)
    robots = [cloud.robot.partition('/')[0]]
    hide(cloud, monkeypatch, robots)
    network = json.loads(run(Command(
        ('podman', 'network', 'inspect', cloud_network), sudo=True), timeout=30).stdout)[0]
    bridge = network['network_interface']
    subnet = ipaddress.ip_network(network['subnets'][0]['subnet'])
    events = []
    launch = Launch(report=events.append)
    names = ('one', 'two')
    launch.expect(spec(name).name for name in names)

    def dials(step, robot):
        return [event for event in events if isinstance(event, StepDone)
                and event.step.startswith(step) and f'dials {robot}:' in event.detail]

    try:
        with ThreadPoolExecutor(2) as pool:
            one, two = pool.map(lambda name: launch.up(spec(name)), names)
        one.shell.run(Command(('ping', '-c', '1', '-W', '8', two.vpn_address)), timeout=60)
        two.shell.run(Command(('ping', '-c', '1', '-W', '8', one.vpn_address)), timeout=60)
        assert len(dials('VPN', robots[0])) == 2
        # neither a machine's nor the one that nobody has: addresses are handed out in a circle
        hosts = [machine.machine.endpoint.host for machine in (one, two)]
        later = next(str(host) for host in list(subnet.hosts())[-2:-5:-1]
                     if str(host) not in hosts)
        run(Command(('ip', 'address', 'add', f'{later}/32', 'dev', bridge), sudo=True), timeout=60)
        one.shell.run(Command(
            ('nft', '-f', '-'), input=(MOVED % (robots[0], robots[0])).encode(), sudo=True),
            timeout=60)
        robots.append(later)
        wait_until(lambda: dials('VPN, from', later), timeout=60,
                   what='the machine to dial again')
        begin = time.monotonic()
        wait_until(lambda: one.heartbeat.age < time.monotonic() - begin, timeout=60,
                   what='the heartbeat')
    finally:
        assert launch.down() == []
        run(Command(('ip', 'address', 'delete', f'{later}/32', 'dev', bridge), sudo=True),
            timeout=60, check=False)
