# SPDX-License-Identifier: Apache-2.0
"""Requests to a cluster, and what its answers mean: by value, without a cluster."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
import socket
import subprocess
import threading
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from fogros2 import kubernetes_client
from fogros2.errors import (
    Cancelled,
    ConfigurationError,
    DeadlineExceeded,
    FogError,
    MachineNotFound,
    ProviderError,
)
from fogros2.kubernetes_client import ApiError, Unreachable
from fogros2.model import CreateRequest, MachineSpec, MachineState
from fogros2.provider import TAG_LAUNCH, TAG_NAME, TAG_ROBOT
from fogros2.provider.kubernetes import (
    boot,
    container_of,
    ending,
    exposure,
    hints,
    kind_of,
    KubernetesProvider,
    manifests,
    names,
    pods,
    start,
    ways,
)
from fogros2.provider.kubernetes.exposure import Exposure
from fogros2.provider.kubernetes.names import MachineId
from fogros2.provider.kubernetes.options import Options
from fogros2.provider.kubernetes.pods import Trouble
from fogros2_testing.shell_contract import raised

ROOT = Path(__file__).resolve().parents[2]
#: What the manifests have to hold in, beside the real cluster of the tests (1.20).
VERSIONS = ('1.25', '')
REQUEST = CreateRequest(
    token='4f5b2a9c-0001-4000-8000-000000000001', authorized_key='ssh-ed25519 AAAA',
    tags={TAG_NAME: 'Talker', TAG_LAUNCH: 'a1b2c3', TAG_ROBOT: "Anna's robot"}, vpn_port=51830)

OWNER = MachineId('robots', 'fogros2-talker', 'a-uid')
MONITORED = dataclasses.replace(REQUEST, application='registry.example/lichtblick:1')


def made(**options: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the Job for some options, and its pod's specification."""
    spec = MachineSpec('Talker', 'kubernetes', options, lifetime=90.5)
    job = manifests.job(spec, REQUEST, Options.parse(options))
    return job, job['spec']['template']['spec']


def valid(manifest: dict[str, Any]) -> None:
    """Hold a manifest against the schemas of several versions, unknown names included."""
    validate = pytest.importorskip('kubernetes_validate', reason='needs kubernetes-validate')
    for version in VERSIONS:
        validate.validate(manifest, version or validate.latest_version(), strict=True)


EVERYTHING: dict[str, Any] = {
    'container_image': 'registry.example/robots/slam:1', 'namespace': 'robots', 'mcpu': 1500,
    'mb': 2048, 'gpus': 2, 'gpu_resource': 'amd.com/gpu', 'zone': 'us-central1-a',
    'node_selector': {'pool': 'gpu'}, 'tolerations': [{'key': 'gpu', 'operator': 'Exists'}],
    'runtime_class': 'nvidia', 'image_pull_secrets': ['registry'], 'service_account': 'machines',
    'env': {'LANG': 'C.UTF-8'}, 'annotations': {'example.com/load-balancer-scheme': 'internal'}}


@pytest.mark.parametrize('options', [{}, EVERYTHING], ids=['defaults', 'everything'])
def test_manifests_are_valid_in_old_and_new_versions(options):
    job, _ = made(**options)
    valid(job)
    spec = MachineSpec('Talker', 'kubernetes', options)
    for kind in ('NodePort', 'LoadBalancer'):
        valid(manifests.service(
            kind, OWNER.job, OWNER, 'UDP', 51830, labels=names.labels('Talker', REQUEST.tags),
            annotations=options.get('annotations', {})))
    for request in (REQUEST, MONITORED):
        pod = manifests.pod(spec, request, Options.parse(options))
        valid({**pod, 'metadata': {**pod['metadata'], 'name': 'x'}})


@pytest.mark.parametrize('name', ['role.yaml', 'networkpolicy.yaml'])
def test_manifests_for_administrators_are_valid(name):
    documents = list(yaml.safe_load_all((ROOT / 'packaging' / 'kubernetes' / name).read_text()))
    assert documents
    for document in documents:
        if name == 'networkpolicy.yaml':
            # a range of ports is newer than 1.20
            pytest.importorskip('kubernetes_validate').validate(document, '1.30', strict=True)
        else:
            valid(document)


def test_the_sample_role_has_what_is_looked_for():
    documents = yaml.safe_load_all((ROOT / 'packaging' / 'kubernetes' / 'role.yaml').read_text())
    role, = (d for d in documents if d['kind'] == 'Role')
    assert hints.missing_rights(role['rules']) == []
    for number, rule in enumerate(role['rules']):
        for verb in rule['verbs']:
            less = [dict(each) for each in role['rules']]
            less[number]['verbs'] = [each for each in rule['verbs'] if each != verb]
            missing = hints.missing_rights(less)
            resource = rule['resources'][0]
            # what some clusters, or launches with monitor_allow= or volumes=, ask for
            if (verb, resource) not in (('update', 'jobs/finalizers'), ('delete', 'services')) \
                    and resource != 'persistentvolumeclaims':
                assert [each.split('.')[0] for each in missing] == [f'{verb} {resource}']


def test_rights_on_everything_are_rights():
    assert hints.missing_rights([{'verbs': ['*'], 'apiGroups': ['*'], 'resources': ['*']}]) == []
    assert 'create pods/exec' in hints.missing_rights(
        [{'verbs': ['*'], 'apiGroups': ['*'], 'resources': ['pods', 'jobs']}])
    assert hints.missing_rights(
        [{'verbs': ['*'], 'apiGroups': ['*'], 'resources': ['*'], 'resourceNames': ['one']}])


def test_a_job_guards_itself():
    job, pod = made()
    assert job['spec']['activeDeadlineSeconds'] == 91
    assert job['spec']['ttlSecondsAfterFinished'] <= 300
    assert job['spec']['backoffLimit'] == 0
    assert pod['restartPolicy'] == 'Never'
    assert 'resources' not in pod['containers'][0], 'limits that nobody asked for'
    # what a mesh adds would run on when the machine has ended
    meta = job['spec']['template']['metadata']
    assert meta['labels']['sidecar.istio.io/inject'] == 'false'
    assert meta['annotations']['sidecar.istio.io/inject'] == 'false'
    assert meta['annotations']['linkerd.io/inject'] == 'disabled'
    assert meta['annotations']['karpenter.sh/do-not-disrupt'] == 'true'


def test_a_pod_has_net_admin_and_no_other_right():
    _, pod = made(**EVERYTHING)
    container, = pod['containers']
    assert container['securityContext']['capabilities'] == {'add': ['NET_ADMIN']}
    assert container['securityContext']['privileged'] is False
    assert pod['automountServiceAccountToken'] is False
    for word in ('hostNetwork', 'hostPID', 'hostIPC'):
        assert word not in pod
    # not the 64 MB of the runtimes
    volume, = pod['volumes']
    assert volume == {'name': volume['name'], 'emptyDir': {'medium': 'Memory'}}
    assert container['volumeMounts'] == [{'name': volume['name'], 'mountPath': '/dev/shm'}]
    assert container['imagePullPolicy'] == 'IfNotPresent'
    # nothing secret in what everybody in the namespace can read
    assert REQUEST.token not in json.dumps(pod)
    assert REQUEST.authorized_key not in json.dumps(pod)


@pytest.mark.parametrize(('options', 'resources'), [
    ({}, None), ({'mcpu': 1500}, {'cpu': '100m'}),
    (EVERYTHING, {'cpu': '100m', 'memory': '128Mi'})])
def test_web_application_is_a_second_container(options, resources):
    spec = MachineSpec('Talker', 'kubernetes', options)
    machine, application = manifests.pod_spec(
        spec, MONITORED, Options.parse(options))['containers']
    assert machine['name'] == 'machine' and application['name'] == 'application'
    assert application['image'] == 'registry.example/lichtblick:1'
    assert application['ports'][0]['containerPort'] == 8080
    rights = application['securityContext']
    assert rights['capabilities'] == {'drop': ['ALL'], 'add': ['NET_BIND_SERVICE']}
    assert not rights['allowPrivilegeEscalation']
    limits = application.get('resources')
    assert limits == (resources and {'limits': resources, 'requests': resources})
    # what ends it with the machine: nobody else would
    assert application['livenessProbe']['tcpSocket'] == {'port': boot.ALIVE_PORT}
    assert machine['command'][-1] == boot.ALIVE


def test_options_reach_the_pod():
    job, pod = made(**EVERYTHING)
    container, = pod['containers']
    assert container['image'] == 'registry.example/robots/slam:1'
    assert container['resources']['limits'] == container['resources']['requests'] == {
        'cpu': '1500m', 'memory': '2048Mi', 'amd.com/gpu': '2'}
    assert container['env'] == [{'name': 'LANG', 'value': 'C.UTF-8'}]
    assert pod['nodeSelector'] == {'kubernetes.io/os': 'linux', 'pool': 'gpu'}
    assert pod['tolerations'] == [{'key': 'gpu', 'operator': 'Exists'}]
    assert pod['runtimeClassName'] == 'nvidia'
    assert pod['imagePullSecrets'] == [{'name': 'registry'}]
    assert pod['serviceAccountName'] == 'machines'
    # a zone that the cluster does not have prevents no pod
    assert list(pod['affinity']['nodeAffinity']) == [
        'preferredDuringSchedulingIgnoredDuringExecution']
    assert kind_of(job) == '2 amd.com/gpu, 1500m cpu, 2048Mi memory, slam:1'
    assert container_of(job)['image'].endswith('/slam:1')


@pytest.mark.parametrize('expose, port', [
    ('auto', 51830), ('node_port', 51830), ('load_balancer', 51830), ('pod_dials_robot', 0),
    ('pod_ip', 0)])
def test_a_pod_answers_where_the_way_is_to_be_found_out(expose, port):
    _, pod = made(expose=expose)
    assert pod['containers'][0]['command'][6] == str(port)


def test_tags_survive_even_where_they_can_be_no_label():
    job, _ = made()
    assert names.tags_of(job) == dict(REQUEST.tags)
    assert TAG_ROBOT not in job['metadata']['labels']
    assert job['metadata']['labels'][TAG_LAUNCH] == 'a1b2c3'
    assert names.wanted({TAG_ROBOT: "Anna's robot", TAG_LAUNCH: 'x'}) == {
        **names.MANAGED, TAG_LAUNCH: 'x'}
    assert names.tags_of({'metadata': {'annotations': {names.TAGS: 'no JSON'}}}) == {}


def test_names_fit_where_a_cluster_has_less_room():
    assert names.job_name('Talker') == 'fogros2-talker'
    assert len(names.job_name('a' * 80)) + len('-abcde') <= 63


def test_machine_id_is_read_back_from_text():
    where = MachineId('robots', 'fogros2-talker', '1b-2c', 'arn:aws:eks:x:1:cluster/y@z')
    assert MachineId.parse(str(where)) == where
    for wrong in ('no-such-machine', 'a/b/c@d', 'podman:0123456789ab:token'):
        raised(MachineNotFound, lambda text=wrong: MachineId.parse(text))


@pytest.mark.parametrize('options, word', [
    ({'sizee': 1}, 'sizee'), ({'mcpu': -1}, 'mcpu'), ({'mb': '2g'}, 'mb'),
    ({'expose': 'nodeport'}, 'nodeport'), ({'tolerations': 'gpu'}, 'tolerations'),
    ({'tolerations': [{'kez': 'gpu'}]}, 'tolerations'), ({'container_image': 'a b'}, 'a b'),
    ({'namespace': 'Robots'}, 'Robots'), ({'user': 'A B'}, 'A B'),
    ({'node_selector': ['pool']}, 'node_selector'), ({'env': {'a-b': 'c'}}, 'a-b'),
    ({'robot_host': 'a b'}, 'a b')])
def test_invalid_option_is_named(options, word):
    error = raised(ConfigurationError, lambda: Options.parse(options))
    assert word in str(error)


def test_pods_that_differ_by_name_alone_are_tried_once(monkeypatch):
    asked = []

    class Cluster:
        context, namespace, server = 'here', 'robots', 'https://198.51.100.1'

        def request(self, method, target, body=None, *, dryRun='', **more):
            what = target.rpartition('/')[2]
            asked.append(f'{what} {dryRun}'.strip())
            if method == 'GET':
                raise ApiError('no such Job', status=404)
            if asked == ['pods All']:
                raise ApiError('exceeded quota', status=403)
            return {'metadata': {'name': 'it', 'uid': 'its-uid', 'namespace': 'robots'}}

    cluster = Cluster()
    monkeypatch.setattr(kubernetes_client, 'connect', lambda context='': cluster)
    provider = KubernetesProvider()

    def create(name, **options):
        spec = MachineSpec(name, 'kubernetes', {'expose': 'pod_dials_robot', **options})
        provider.create(spec, REQUEST)

    raised(ProviderError, lambda: create('one'))
    assert asked == ['pods All', 'fogros2-one']
    asked[1:] = []
    for name in ('one', 'another'):
        create(name)
    create('larger', mb=64)
    assert asked[1:] == ['pods All', 'jobs', 'jobs', 'pods All', 'jobs']


@pytest.mark.parametrize(('fails', 'error', 'certain'), [
    ('pods', Unreachable('no answer'), True),
    ('pods', Cancelled('the dry run'), True),
    ('jobs', Unreachable('no answer'), False),
    ('jobs', Cancelled('the request'), False),
    ('jobs', ApiError('etcd is slow', status=500), False),
    ('jobs', ApiError('quota', status=403), True),
    ('services', Cancelled('the request'), True)])
def test_only_a_job_without_an_answer_may_appear(monkeypatch, fails, error, certain):
    class Cluster:
        context, namespace, server = 'here', 'robots', 'https://198.51.100.1'

        def request(self, method, target, body=None, **more):
            if target.endswith(fails):
                raise error
            return {'metadata': {'name': 'it', 'uid': 'its-uid', 'namespace': 'robots'}}

    monkeypatch.setattr(kubernetes_client, 'connect', lambda context='': Cluster())
    provider, ended = KubernetesProvider(), []
    monkeypatch.setattr(provider, 'destroy', ended.append)
    spec = MachineSpec('planner', 'kubernetes', {'expose': 'node_port'})
    told = raised(FogError, lambda: provider.create(spec, REQUEST))
    assert told.refused is certain
    assert len(ended) == (fails == 'services')


@pytest.mark.parametrize(('options', 'nodes', 'architecture'), [
    ({'node_selector': {'kubernetes.io/arch': 'arm64'}}, None, 'aarch64'),
    ({}, ['amd64', 'amd64'], 'x86_64'),
    ({}, ['amd64', 'arm64'], ''),
    ({}, [], ''),
    ({}, ['s390x'], ''),
    ({}, ApiError('you may not', status=403), ''),
    ({'node_selector': {'pool': 'gpu'}}, ['amd64'], 'x86_64'),
])
def test_architecture_is_that_of_the_matching_nodes(monkeypatch, options, nodes, architecture):
    class Cluster:
        def request(self, method, path, *, labelSelector, **words):
            assert (method, path) == ('GET', '/api/v1/nodes')
            assert labelSelector == ','.join(['kubernetes.io/os=linux', *(
                f'{k}={v}' for k, v in options.get('node_selector', {}).items())])
            if isinstance(nodes, ApiError):
                raise nodes
            return {'items': [{'metadata': {'labels': {'kubernetes.io/arch': arch}}}
                              for arch in nodes]}

    monkeypatch.setattr(KubernetesProvider, '_place', lambda self, options: (Cluster(), 'robots'))
    spec = MachineSpec('m', 'kubernetes', options)
    assert KubernetesProvider().architecture(spec) == architecture


class Limited:
    """A cluster in which a user has a role in some namespaces; others refuse to list."""

    server = 'https://127.0.0.1:6443'

    def __init__(self, context: str, *namespaces: str) -> None:
        self.context, self.namespace, self.namespaces = context, 'default', namespaces

    def request(self, method: str, target: str, **more: Any) -> dict[str, Any]:
        namespace = target.partition('/namespaces/')[2].partition('/')[0]
        if namespace not in self.namespaces:
            raise ApiError(f'User "robot" cannot list in "{namespace}"', status=403)
        if not target.endswith('/jobs'):
            return {}
        job, _ = made(namespace=namespace)
        job['metadata'].update(uid=f'uid-{namespace}', namespace=namespace,
                               creationTimestamp='2026-01-01T00:00:00Z')
        return {'items': [job]}


@pytest.mark.parametrize(('places', 'regions', 'refused'), [
    ([{'namespace': 'robots'}], ['here/robots'], ''),
    ([{'namespace': 'robots', 'context': 'here'}], ['here/robots'], ''),
    # the namespaces of one cluster are not searched in another
    ([{'namespace': 'robots'}, {'namespace': 'lab', 'context': 'away'}],
     ['away/lab', 'here/robots'], ''),
    ([], [], 'default'),
    ([{}, {'namespace': 'robots'}], [], 'default'),
    ([{'namespace': 'robots'}, {'namespace': 'shut'}], ['here/robots'], 'shut')])
def test_role_in_a_named_namespace_finds_its_pods(monkeypatch, places, regions, refused):
    clusters = {'': Limited('here', 'robots'), 'away': Limited('away', 'lab')}
    clusters['here'] = clusters['']
    monkeypatch.setattr(kubernetes_client, 'connect', lambda context='': clusters[context])
    monkeypatch.setattr(kubernetes_client, 'configured', lambda: True)
    provider, searched = KubernetesProvider(), []
    provider.search_for(MachineSpec('Talker', 'kubernetes', options) for options in places)

    def search() -> None:
        searched.extend(machine.region for machine in provider.find({TAG_NAME: 'Talker'}))

    if refused:
        assert f'cannot list in "{refused}"' in str(raised(ProviderError, search))
    else:
        search()
    assert sorted(searched) == regions


#: What API servers have said, and a word that the remedy has to hold.
REFUSALS = [
    ('jobs.batch is forbidden: User "robot" cannot create resource "jobs" in API group "batch" '
     'in the namespace "robots"', "let 'robot' create jobs.batch in the namespace 'robots'"),
    ('nodes "a" is forbidden: User "robot" cannot get resource "nodes" in API group "" at the '
     'cluster scope', "let 'robot' get nodes in the whole cluster"),
    ('pods "fogros2-a" is forbidden: violates PodSecurity "baseline:latest": non-default '
     'capabilities (container "machine" must not include "NET_ADMIN" in '
     'securityContext.capabilities.add)',
     'kubectl label namespace robots pod-security.kubernetes.io/enforce=privileged'),
    ('pods "a" is forbidden: PodSecurityPolicy: unable to admit pod: '
     '[spec.containers[0].securityContext.capabilities.add: Invalid value: "NET_ADMIN"]',
     'PodSecurityPolicy'),
    ('pods "a" is forbidden: unable to validate against any pod security policy: []',
     'allowedCapabilities'),
    ('admission webhook "policy.example" denied the request: no NET_ADMIN here', 'policy'),
    ('pods "a" is forbidden: exceeded quota: q, requested: pods=1, used: pods=4, limited: pods=4',
     'quota'),
    ('pods "a" is forbidden: failed quota: q: must specify limits.cpu', 'mcpu= and mb='),
    ('pods "a" is forbidden: [maximum cpu usage per Container is 1, but limit is 2]', 'limits'),
    ('namespaces "robots" not found', 'kubectl create namespace robots'),
    ('pods "a" is forbidden: error looking up service account robots/x: serviceaccount "x" not '
     'found', 'service_account='),
    ('pods "a" is forbidden: pod rejected: RuntimeClass "nvidia" not found', 'runtime_class='),
    ('unable to create new content in namespace robots because it is being terminated',
     'deleted')]


@pytest.mark.parametrize('message, word', REFUSALS, ids=[word[:20] for _, word in REFUSALS])
def test_a_refusal_has_a_remedy(message, word):
    assert word in hints.of_refusal(message, 'robots')


def job_of(**status: Any) -> dict[str, Any]:
    return {'metadata': {'uid': 'j', 'name': 'fogros2-a', 'namespace': 'robots'},
            'status': status}


def pod_of(phase: str = 'Running', name: str = 'p', created: str = '2026-01-01T00:00:00Z',
           state: Any = None, **status: Any) -> dict[str, Any]:
    container = {'name': 'machine', 'image': 'x/y:z',
                 'state': state if state is not None else {'running': {}}}
    return {'metadata': {'uid': name, 'name': name, 'creationTimestamp': created,
                         'ownerReferences': [{'uid': 'j'}]},
            'spec': {}, 'status': {'phase': phase, 'containerStatuses': [container], **status}}


def condition(kind: str, **values: str) -> dict[str, Any]:
    return {'type': kind, 'status': 'True', **values}


def test_state_of_a_machine_follows_job_and_pod():
    assert pods.state_of(job_of(), None) is MachineState.PENDING
    assert pods.state_of(job_of(), pod_of('Pending', state={'waiting': {}})) \
        is MachineState.PENDING
    begun = pod_of('Pending', state={'waiting': {'reason': 'ContainerCreating'}})
    assert pods.trouble_of(begun) is None
    assert pods.state_of(job_of(), pod_of()) is MachineState.RUNNING
    assert pods.state_of(job_of(), pod_of('Failed', state={})) is MachineState.STOPPING
    assert pods.state_of(job_of(conditions=[condition('Failed')]), None) is MachineState.STOPPING
    deleted = job_of()
    deleted['metadata']['deletionTimestamp'] = 'now'
    assert pods.state_of(deleted, pod_of()) is MachineState.STOPPING


@pytest.mark.parametrize('name', ['application', 'linkerd-proxy'])
def test_other_container_neither_holds_up_nor_keeps_a_machine(name):
    def beside(machine: Any, application: Any, phase: str) -> dict[str, Any]:
        pod = pod_of(phase, state=machine)
        pod['status']['containerStatuses'].insert(
            0, {'name': name, 'image': 'x/app:1', 'state': application})
        return pod

    running: dict[str, Any] = {'running': {}}
    pulled = {'waiting': {'reason': 'ErrImagePull', 'message': 'not found'}}
    coming = beside(running, pulled, 'Pending')
    assert pods.state_of(job_of(), coming) is MachineState.RUNNING
    assert pods.trouble_of(coming) is None and not pods.has_ended(coming)
    only = beside({'waiting': {}}, running, 'Pending')
    assert pods.state_of(job_of(), only) is MachineState.PENDING
    over = beside({'terminated': {'exitCode': 3, 'reason': 'Error'}}, running, 'Running')
    assert pods.state_of(job_of(), over) is MachineState.STOPPING
    assert pods.has_ended(over)
    assert 'exit status 3' in pods.end_of(job_of(), over)


def test_oldest_pod_of_the_job_is_the_machine():
    later = pod_of(name='b', created='2026-01-01T00:10:00Z')
    first = pod_of(name='a')
    other = pod_of(name='c', created='2025-01-01T00:00:00Z')
    other['metadata']['ownerReferences'] = [{'uid': 'another'}]
    found = pods.pod_of(job_of(), [later, other, first])
    assert found is not None
    assert found['metadata']['name'] == 'a'
    assert pods.pod_of(job_of(), [other]) is None


def test_reason_of_the_end_is_found():
    over = job_of(conditions=[condition('Failed', reason='DeadlineExceeded')])
    assert pods.end_of(over, None) == 'its lifetime is over'
    assert 'Evicted: low on memory' in pods.end_of(
        job_of(), pod_of('Failed', reason='Evicted', message='low on memory'))
    ended = {'terminated': {'reason': 'Error', 'exitCode': 127}}
    assert 'exit status 127' in pods.end_of(job_of(), pod_of('Failed', state=ended))
    assert pods.end_of(job_of(), None) == 'its pod is gone'


@pytest.mark.parametrize('reason, message, final, word', [
    ('ErrImagePull', 'rpc error: code = NotFound desc = failed to pull and unpack image '
     '"docker.io/library/ros:jazy": not found', True, 'its tag'),
    ('ImagePullBackOff', 'Back-off pulling image "x"', False, 'reach the registry'),
    ('ErrImagePull', 'pull access denied, repository does not exist or may require '
     'authorization', True, 'image_pull_secrets='),
    ('ErrImagePull', 'dial tcp 1.2.3.4:443: i/o timeout', False, 'reach the registry'),
    ('ErrImagePull', 'unexpected status code https://registry-1.docker.io/v2/library/ros/manifests/'
     'sha256:e401: 429 Too Many Requests - Server message: toomanyrequests: You have reached your '
     'unauthenticated pull rate limit.', False, 'limits pulls without a login'),
    ('ErrImagePull', 'failed to pull and unpack image "x": no match for platform in manifest: not '
     'found', True, 'architecture'),
    ('InvalidImageName', "couldn't parse image reference", True, "no image's name"),
    ('CreateContainerConfigError', 'secret "x" not found', True, '')])
def test_unavailable_image_is_reported(reason, message, final, word):
    trouble = pods.trouble_of(pod_of(
        'Pending', state={'waiting': {'reason': reason, 'message': message}}))
    assert trouble is not None
    assert trouble.what == f'{reason}: {message}'
    assert trouble.final is final
    assert word in trouble.hint


def test_repeated_image_pull_keeps_its_first_reason():
    """The kubelet says why once, and from then on that it waits for the next try."""
    why = Trouble('ErrImagePull: dial tcp 1.2.3.4:443: i/o timeout')
    waiting = Trouble('ImagePullBackOff: Back-off pulling image "x"')
    assert waiting.less_than(why)
    assert not why.less_than(waiting) and not waiting.less_than(Trouble('FailedScheduling: x'))


@pytest.mark.parametrize('message, word', [
    ('0/3 nodes are available: 3 Insufficient nvidia.com/gpu.', 'nvidia.com/gpu'),
    ('0/1 nodes are available: 1 Insufficient cpu.', 'mcpu='),
    ("0/1 nodes are available: 1 node(s) didn't match Pod's node affinity/selector.",
     'node_selector='),
    ('0/1 nodes are available: 1 node(s) had untolerated taint {gpu: true}.', 'tolerations='),
    ('Pod not supported on Fargate: invalid SecurityContext fields: Capabilities added: NET_ADMIN',
     'without a Fargate profile')])
def test_pod_that_fits_on_no_node_is_reported(message, word):
    trouble = pods.trouble_of(pod_of('Pending', state={}, conditions=[
        {'type': 'PodScheduled', 'status': 'False', 'reason': 'Unschedulable',
         'message': message}]))
    assert trouble is not None
    assert trouble.what == f'FailedScheduling: {message}'
    assert not trouble.final
    assert word in trouble.hint


def test_trouble_is_found_in_events():
    def event(reason: str, message: str) -> dict[str, Any]:
        return {'reason': reason, 'message': message, 'metadata': {'namespace': 'robots'}}

    assert pods.trouble_in([]) is None
    assert pods.trouble_in([event('Scheduled', 'fine')]) is None
    none, = (pods.trouble_in([event('NotTriggerScaleUp', "pod didn't trigger scale-up")]),)
    assert none is not None and none.final
    quota = pods.trouble_in([event('FailedCreate', 'exceeded quota: q')])
    assert quota is not None and not quota.final and 'quota' in quota.hint


def at(second: int, reason: str, message: str = '') -> dict[str, Any]:
    return {'reason': reason, 'message': message, 'metadata': {'namespace': 'robots'},
            'lastTimestamp': f'2026-01-01T00:00:{second:02}Z'}


UNSCHEDULED = {'state': {}, 'conditions': [{
    'type': 'PodScheduled', 'status': 'False',
    'message': '0/1 nodes are available: pod has unbound immediate PersistentVolumeClaims.'}]}
CREATING = {'state': {'waiting': {'reason': 'ContainerCreating'}}}
NO_SANDBOX = at(1, 'FailedCreatePodSandBox', 'no address yet')


@pytest.mark.parametrize(('pod', 'before', 'events', 'ends'), [
    (UNSCHEDULED, [], [], 60),
    (UNSCHEDULED, [at(1, 'FailedScheduling')], [at(1, 'FailedScheduling'), at(9, 'Nominated')], 0),
    (UNSCHEDULED, [], [at(9, 'NotTriggerScaleUp', 'no node')], 15),
    (UNSCHEDULED, [], [at(9, 'NotTriggerScaleUp', 'no node'), at(2, 'TriggeredScaleUp')], 0),
    (UNSCHEDULED, [], [at(2, 'NotTriggerScaleUp'), at(9, 'TriggeredScaleUp')], 0),
    (CREATING, [NO_SANDBOX], [NO_SANDBOX], 20),
    (CREATING, [NO_SANDBOX], [NO_SANDBOX, at(3, 'Pulling')], 0),
    (CREATING, [at(5, 'FailedMount'), at(3, 'Pulled')], [at(5, 'FailedMount')], 20),
    (CREATING, [], [{**NO_SANDBOX, 'lastTimestamp': None,
                     'eventTime': '2026-01-01T00:00:01.500000Z'},
                    at(2, 'Created')], 0)])
def test_pod_is_given_up_only_for_what_lasts(monkeypatch, pod, before, events, ends):
    """The events are ``before`` in the first ten seconds; ``ends`` is 0 for a pod that runs."""
    now = 0.0

    class Cluster:
        def request(self, method, target, **query):
            return {'items': before if now < 10 else events}

        def follow(self, target, look, *, tick, **more):
            nonlocal now
            assert look('ADDED', pod_of('Pending', **pod)) is None
            while now < 200:
                now += 0.5
                tick()
            return look('MODIFIED', pod_of())

    monkeypatch.setattr(start, 'time', SimpleNamespace(monotonic=lambda: now))
    waiting = start.Start(Cluster(), OWNER, job_of(), name='planner', cancel=threading.Event())
    if ends:
        raised(ProviderError, lambda: waiting.wait(300.0))
        assert ends <= now < ends + 1
    else:
        assert waiting.wait(300.0)['metadata']['name'] == 'p'


@pytest.mark.parametrize('message, final', [
    ('pods "m" is forbidden: violates PodSecurity "baseline:latest": NET_ADMIN', True),
    ('Pod "m" is invalid: spec.containers[0].image: Required value', True),
    ('admission webhook "policy.example" denied the request: no NET_ADMIN', True),
    ('pods "m" is forbidden: exceeded quota: q', False),
    ('Post "https://192.0.2.1:6443/api/v1/namespaces/robots/pods": unexpected EOF', False),
    ('etcdserver: request timed out', False),
    ('Internal error occurred: failed calling webhook "policy.example": dial tcp 192.0.2.1:443: '
     'connect: connection refused', False)])
def test_only_a_refusal_of_a_pod_is_final(message, final):
    trouble = pods.trouble_in([{'reason': 'FailedCreate', 'message': message,
                                'metadata': {'namespace': 'robots'}}])
    assert trouble is not None and trouble.final == final


@pytest.mark.parametrize('server, groups, maker', [
    ('https://ABCD.gr7.eu-north-1.eks.amazonaws.com', [], 'EKS'),
    ('https://robots-dns-1.hcp.westeurope.azmk8s.io:443', [], 'AKS'),
    ('https://34.1.2.3', ['apps', 'networking.gke.io'], 'GKE'),
    ('https://192.168.1.2:6443', ['helm.cattle.io', 'k3s.cattle.io'], 'k3s'),
    ('https://192.168.1.2:6443', ['metallb.io'], 'MetalLB'),
    ('https://192.168.1.2:6443', ['apps', 'helm.cattle.io', 'notgke.io'], ''),
    ('https://eks.amazonaws.com.example', [], '')])
def test_provider_of_load_balancers_is_recognised(server, groups, maker):
    assert exposure.load_balancers(server, groups) == maker


def test_a_load_balancer_has_an_address_or_a_name():
    def service(*ingress: dict[str, str]) -> dict[str, Any]:
        return {'status': {'loadBalancer': {'ingress': list(ingress)}}}

    assert exposure.ingress({'status': {'loadBalancer': {}}}) == []
    assert exposure.ingress(service({'ip': '198.51.100.7'})) == ['198.51.100.7']
    assert exposure.ingress(service({'hostname': 'a.elb.example'}, {'ip': ''})) == \
        ['a.elb.example']


def test_an_outer_address_of_a_node_comes_first():
    assert exposure.node_addresses({'status': {'addresses': [
        {'type': 'InternalIP', 'address': '10.0.0.4'}, {'type': 'Hostname', 'address': 'a'},
        {'type': 'ExternalIP', 'address': '198.51.100.4'}]}}) == ['198.51.100.4', '10.0.0.4']


@pytest.mark.parametrize('way', [
    Exposure('node_port', '198.51.100.4', 31234, 'the node answers'),
    Exposure('pod_dials_robot', '', 0, 'no load balancer came in 180 s; port 1 answers nothing'),
    Exposure('pod_ip', '10.1.2.3')])
def test_exposure_is_read_back_from_text(way):
    assert Exposure.parse(str(way)) == way


def test_invalid_text_of_an_exposure_is_ignored():
    assert Exposure.parse('') is None
    assert Exposure.parse('node_port 1.2.3.4 x') is None
    assert Exposure.parse('node_port 1.2.3.4 \u00b2') is None


@pytest.fixture
def echo(tmp_path):
    """Return the port at which a pod's own answering program listens, here."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(('127.0.0.1', 0))
        port = link.getsockname()[1]
    program = boot.ECHO.replace("'/run/fogros2'", repr(str(tmp_path)))
    child = subprocess.Popen(['python3', '-ISc', program, str(port), 'word'])
    yield port
    (tmp_path / 'an agent').mkdir()
    # it leaves the port to the VPN as soon as an agent has come
    assert child.wait(60.0) == 0


def test_first_address_that_answers_is_found(echo):
    places = [('127.0.0.1', 9), ('no-such-host.invalid', echo), ('127.0.0.1', echo)]
    assert exposure.first_to_answer(places, 'word', timeout=10.0) == ('127.0.0.1', echo)
    # another launch's question isn't answered
    assert exposure.first_to_answer(places, 'other', timeout=0.3) is None


@pytest.mark.parametrize(('expose', 'waited', 'deleted'), [
    ('auto', 180.0, ['/api/v1/namespaces/robots/services/fogros2-talker']),
    ('load_balancer', 420.0, [])])
def test_silent_load_balancer_is_not_billed(expose, waited, deleted):
    timeouts, gone = [], []

    class Cluster:
        context, server = '', 'https://1.eks.amazonaws.com'

        def request(self, method, target, body=None, **more):
            if method == 'DELETE':
                gone.append(target)
            return {'metadata': {'ownerReferences': [{'uid': 'its-uid'}]},
                    'spec': {'type': 'LoadBalancer', 'ports': [{}]}}

        def follow(self, *words, timeout, **more):
            timeouts.append(timeout)
            raise DeadlineExceeded('a load balancer')

    job = {'metadata': {'annotations': {names.EXPOSE: expose}}}
    where = MachineId('robots', 'fogros2-talker', 'its-uid')

    def find():
        return ways.find(Cluster(), where, job, {}, timeout=290.0, cancel=threading.Event())

    if expose == 'auto':
        assert find().kind == 'pod_dials_robot'
    else:
        assert 'no load balancer came in 420 s' in str(raised(ProviderError, find))
    assert (timeouts, gone) == ([waited], deleted)


def test_deletion_waits_for_a_slow_load_balancer():
    waits = {}

    class Cluster:
        def request(self, method, target, body=None, **more):
            return {'items': []}

        def follow(self, target, look, *, timeout, **more):
            waits[target] = timeout

    ending.end(Cluster(), MachineId('robots', 'fogros2-talker', 'its-uid'))
    # for AWS's controller, a security group alone may take two minutes
    assert waits == {'/apis/batch/v1/namespaces/robots/jobs': 300.0}


def test_cancel_ends_the_search_for_an_exposure():
    cancel = threading.Event()
    cancel.set()
    raised(Cancelled, lambda: exposure.first_to_answer(
        [('127.0.0.1', 9)], 'word', timeout=10.0, cancel=cancel))
