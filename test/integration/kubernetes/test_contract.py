# SPDX-License-Identifier: Apache-2.0
"""What every provider and every shell has to do, by pods of a real cluster."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import contextlib
import dataclasses
import secrets
import threading
from types import SimpleNamespace

import pytest

from fogros2 import kubernetes_client
from fogros2.errors import NameTaken, ProviderError, ShellError
from fogros2.model import Command, MachineSpec
from fogros2.provider import TAG_NAME
from fogros2.provider.kubernetes import KubernetesProvider
from fogros2.shell.kubernetes import KubernetesShell
from fogros2.waiting import wait_until
from fogros2_features.volumes import Volumes
from fogros2_testing import ProviderContract, request_for, ShellContract
from fogros2_testing.shell_contract import raised
from rigs.cluster import BARE, Refused


@pytest.fixture(scope='module')
def place(namespaces_of_module):
    """Yield a namespace in which the robot has the sample role."""
    found = namespaces_of_module()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('KUBECONFIG', str(found.kubeconfig))
        yield found


def run(name, **options):
    """Bring a machine up and return its provider, its id and itself."""
    provider = KubernetesProvider()
    spec = MachineSpec(name, provider.name, {'container_image': BARE, **options})
    provider.check(spec)
    machine_id = provider.create(spec, request_for(spec))
    try:
        return provider, machine_id, provider.reachable(
            machine_id, name=name, timeout=60.0)
    except BaseException:
        provider.destroy(machine_id)
        raise


def left(place, name):
    """Return what there is of a machine."""
    return [line for line in place.left() if f'fogros2-{name}' in line]


class TestProvider(ProviderContract):

    @pytest.fixture(autouse=True)
    def in_a_namespace(self, place):
        pass

    def make(self):
        return KubernetesProvider(), {'container_image': BARE}


@pytest.fixture(scope='module')
def pod(place):
    """Yield a machine that runs."""
    provider, machine_id, machine = run('shells')
    yield machine
    provider.destroy(machine_id)


class TestShell(ShellContract):

    @pytest.fixture(autouse=True)
    def in_a_pod(self, pod):
        self.pod = pod

    def make(self, folder):
        shell = KubernetesShell(self.pod.endpoint, name='shells')
        there = f'/tmp/{secrets.token_hex(4)}'
        shell.run(Command(('mkdir', there)), timeout=30.0)
        return shell, there


def test_pod_has_no_token_of_the_cluster(pod):
    with contextlib.closing(KubernetesShell(pod.endpoint, name='shells')) as shell:
        found = shell.run(Command(('ls', '/var/run/secrets/kubernetes.io'), sudo=True),
                          timeout=30.0, check=False)
        assert found.returncode != 0


def test_pod_in_another_namespace_than_the_contexts_is_found(kubernetes, place, monkeypatch):
    monkeypatch.setenv('KUBECONFIG', str(kubernetes.kubeconfig_of_robot('default')))
    provider, machine_id, _ = run('elsewhere', namespace=place.name)
    later = KubernetesProvider()
    later.search_for([MachineSpec('elsewhere', later.name, {'namespace': place.name})])
    try:
        for each in (provider, later):
            assert [found.id for found in each.find({TAG_NAME: 'elsewhere'})] == [machine_id]
    finally:
        provider.destroy(machine_id)
    assert list(later.find({TAG_NAME: 'elsewhere'})) == []


def test_launch_makes_few_requests_to_the_cluster(place, monkeypatch):
    """Everything a provider and a shell ask for a machine: the figure that is promised."""
    calls = []

    def counted(name):
        plain = getattr(kubernetes_client.Api, name)

        def call(api, *values, **options):
            calls.append(name)
            return plain(api, *values, **options)

        monkeypatch.setattr(kubernetes_client.Api, name, call)

    counted('send')
    counted('websocket')
    provider, machine_id, machine = run('counted')
    try:
        shell = KubernetesShell(machine.endpoint, name='counted')
        with contextlib.closing(shell):
            for _ in range(30):
                shell.run(Command(('true',)), timeout=30.0)
    finally:
        provider.destroy(machine_id)
    assert 0 < len(calls) <= 15


def test_pod_without_agent_ends_itself(place, monkeypatch):
    monkeypatch.setattr('fogros2.provider.kubernetes.manifests.BOOT', 2.0)
    provider = KubernetesProvider()
    spec = MachineSpec('unguarded', provider.name, {'container_image': BARE}, robot_timeout=2.0)
    machine_id = provider.create(spec, request_for(spec))
    try:
        wait_until(lambda: provider.describe(machine_id).state.value == 'stopping',
                   timeout=30.0, what='the pod to end')
    finally:
        provider.destroy(machine_id)


def test_end_command_ends_the_pod(place):
    provider, machine_id, machine = run('ended')
    try:
        with contextlib.closing(KubernetesShell(machine.endpoint, name='ended')) as shell:
            # the connection goes with the pod
            raised(ShellError, lambda: shell.run(
                Command((*machine.end_command[:2], f'{machine.end_command[2]}; exec sleep 30'),
                        sudo=True), timeout=30.0))
        wait_until(lambda: provider.describe(machine_id).state.value == 'stopping',
                   timeout=30.0, what='the pod to end')
    finally:
        provider.destroy(machine_id)


def test_requested_exposure_is_used(place):
    def asked(expose):
        provider, machine_id, machine = run(f"by-{expose.replace('_', '-')}", expose=expose)
        provider.destroy(machine_id)
        return machine

    ways = ('node_port', 'pod_dials_robot', 'pod_ip')
    with ThreadPoolExecutor() as pool:
        for expose, machine in zip(ways, pool.map(asked, ways)):
            assert f'UDP by {expose}' in machine.note
            assert (machine.vpn_host == '') is (expose == 'pod_dials_robot')
            assert (machine.vpn_port > 0) is (expose == 'node_port')
            assert machine.robot_host
            if expose == 'pod_ip':
                assert machine.vpn_host == machine.private_ip


def test_a_load_balancer_is_waited_for(place, client):
    """Nobody makes any here, so the test does what a cloud would, with the node's address."""
    services = f'/api/v1/namespaces/{place.name}/services'

    def provide():
        def made():
            return [one for one in place.all('services')
                    if one['spec']['type'] == 'LoadBalancer'] or None

        service, = wait_until(made, timeout=30.0, what='the Service')
        node, = client.ask('GET', '/api/v1/nodes')['items']
        address = next(each['address'] for each in node['status']['addresses']
                       if each['type'] == 'InternalIP')
        name = service['metadata']['name']
        client.ask('PATCH', f'{services}/{name}/status', {
            'status': {'loadBalancer': {'ingress': [{'ip': address}]}}})

    cloud = threading.Thread(target=provide)
    cloud.start()
    try:
        provider, machine_id, machine = run('balanced', expose='load_balancer')
        provider.destroy(machine_id)
    finally:
        cloud.join()
    assert 'UDP by load_balancer' in machine.note
    # at the load balancer the port is the VPN's own
    assert machine.vpn_port >= 49152 or machine.vpn_port == 51820


def test_blocked_exposure_is_reported(place, monkeypatch):
    """With a node's port that nobody answers at: what a firewall in between does."""
    monkeypatch.setattr('fogros2.provider.kubernetes.exposure.NODE_PORT', 1.0)
    monkeypatch.setattr('fogros2.provider.kubernetes.exposure.node_port', lambda service: 9)
    with ThreadPoolExecutor() as pool:
        either = pool.submit(run, 'open')
        error = raised(ProviderError, lambda: run('shut', expose='node_port'))
        provider, machine_id, machine = either.result()
    provider.destroy(machine_id)
    assert 'port 9 of the node' in str(error)
    assert 'pod_dials_robot' in error.hint
    # and where the choice is ours the next way is taken
    assert machine.vpn_host == ''
    assert 'pod_dials_robot: port 9 of the node' in machine.note


@pytest.fixture
def in_the_way(place, client):
    """Return what makes a Service that has a machine's name and isn't its; gone at the end."""
    base = f'/api/v1/namespaces/{place.name}/services'
    made = []

    def make(name, **metadata):
        service = client.create(base, 'v1 Service', f'fogros2-{name}', metadata=metadata,
                                spec={'ports': [{'port': 9, 'protocol': 'UDP'}]})
        made.append(f"{base}/{service['metadata']['name']}")
        return made[-1]

    yield make
    for path in made:
        with contextlib.suppress(Refused):
            client.ask('DELETE', path)


def test_foreign_service_is_not_taken_for_the_machines(
        place, client, in_the_way, monkeypatch):
    monkeypatch.setattr('fogros2.provider.kubernetes.ways.TAKEN', 0.5)
    path = in_the_way('twin')
    error = raised(NameTaken, lambda: run('twin', expose='node_port'))
    assert "'fogros2-twin'" in str(error)
    assert f'kubectl delete service -n {place.name} fogros2-twin' in error.hint
    assert left(place, 'twin') == ['services fogros2-twin']
    # where the way is ours to choose, it is another
    provider, machine_id, machine = run('twin')
    provider.destroy(machine_id)
    assert machine.note == "UDP by pod_dials_robot: the Service of that name is not the machine's"
    assert client.ask('GET', path)['spec']['ports'][0]['port'] == 9


def test_service_of_a_deleted_job_is_waited_for(place, client, in_the_way):
    """The cluster takes it away with its Job, but some time later."""
    path = in_the_way('heir', ownerReferences=[{
        'apiVersion': 'batch/v1', 'kind': 'Job', 'name': 'fogros2-heir', 'uid': 'of-another'}],
        finalizers=['fogros2.test/late'])

    def collect():
        wait_until(lambda: left(place, 'heir') != ['services fogros2-heir'], timeout=30.0,
                   what='the Job')
        client.ask('PATCH', path, {'metadata': {'finalizers': None}})

    collector = threading.Thread(target=collect)
    collector.start()
    try:
        provider, machine_id, machine = run('heir', expose='node_port')
        provider.destroy(machine_id)
    finally:
        collector.join()
    assert 'UDP by node_port' in machine.note


def test_deletion_keeps_pods_of_other_jobs(place, client):
    """Its pods are known by their Job: a new one may have the name by then."""
    base = f'/api/v1/namespaces/{place.name}/pods'
    other = client.create(
        base, 'v1 Pod', 'fogros2-same-other', metadata={'labels': {
            'fogros2-machine': 'fogros2-same', 'controller-uid': 'of-another'}},
        spec={'restartPolicy': 'Never', 'containers': [
            {'name': 'machine', 'image': BARE, 'command': ['sleep', '600']}]})
    try:
        provider, machine_id, _ = run('same')
        provider.destroy(machine_id)
        now, = (pod for pod in place.all('pods') if 'fogros2-same' in pod['metadata']['name'])
        assert now['metadata']['uid'] == other['metadata']['uid']
        assert 'deletionTimestamp' not in now['metadata']
    finally:
        client.ask('DELETE', f'{base}/fogros2-same-other', gracePeriodSeconds='0')


def test_volume_outlives_its_pod(place, client, tmp_path):
    """With a disk that an administrator has made: nothing here makes disks."""
    name = f'models-{secrets.token_hex(3)}'
    disk = f'/api/v1/persistentvolumes/{name}'
    client.create('/api/v1/persistentvolumes', 'v1 PersistentVolume', name, spec={
        'capacity': {'storage': '1Gi'}, 'accessModes': ['ReadWriteOnce'],
        'hostPath': {'path': str(tmp_path / 'disk'), 'type': 'DirectoryOrCreate'}})
    provider, wanted = KubernetesProvider(), {name: ('/data', 1)}

    def created(machine):
        spec = MachineSpec(machine, provider.name, {'container_image': BARE})
        return provider.create(spec, dataclasses.replace(request_for(spec), with_volumes=wanted))

    def within(machine_id, script):
        machine = provider.reachable(machine_id, name='holds', timeout=60.0)
        with contextlib.closing(KubernetesShell(machine.endpoint, name='holds')) as shell:
            running = SimpleNamespace(
                lost='', machine=machine, provider=provider, interface=SimpleNamespace(name='lo'),
                spec=MachineSpec('holds', provider.name),
                step=lambda name: contextlib.nullcontext([]),
                run=lambda command, timeout: shell.run(command, timeout=timeout).stdout)
            with Volumes().machine(running, wanted):
                return shell.run(Command(('sh', '-ec', script)), timeout=30.0).stdout

    try:
        first = created('first')
        assert within(first, 'stat -c %U /data; echo kept >/data/model') == 'fog\n'
        (volume,) = provider.volumes()
        assert (volume.name, volume.size_gb, volume.user) == (name, 1, 'first')
        raised(NameTaken, lambda: created('second'))
        raised(NameTaken, lambda: provider.delete_volume(volume.id))
        provider.destroy(first)
        second = created('second')
        assert within(second, 'cat /data/model') == 'kept\n'
        provider.destroy(second)
        provider.delete_volume(volume.id)
        wait_until(lambda: not list(provider.volumes()), timeout=30.0, what='no claim')
        provider.delete_volume(volume.id)
    finally:
        client.ask('DELETE', disk)
