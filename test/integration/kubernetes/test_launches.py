# SPDX-License-Identifier: Apache-2.0
"""``ros2 launch`` with pods of a real cluster as machines, until nothing of them is left."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import contextlib
import re
import shutil
import signal
import subprocess
import time
import urllib.request
import uuid

import pytest

from fogros2.waiting import wait_until
from rigs.cluster import APPLICATION, DEFAULT, READY
from rigs.launched import launching, ros2
from rigs.networks import without_udp

pytestmark = pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH')

#: Seconds for what takes a few on a computer that has nothing else to do.
TIMEOUT = 150.0
#: Seconds after its end for which a Job stays here, by its ttlSecondsAfterFinished.
TTL = 5
#: Has a launch file take the tests' web application for Lichtblick.
IMAGE = f"from fogros2_monitor import addresses\naddresses.IMAGE = '{APPLICATION}'\n"

HEADER = """
from fogros2 import CloudNode, FogROSLaunchDescription, KubeInstance
from launch_ros.actions import Node


def pod(name, **more):
    return KubeInstance(name=name, container_image='{image}', **more)


def talker(machine, **more):
    return CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                     output='screen', **more)


def listener(**more):
    return Node(package='fogros2_examples', executable='listener', output='screen', **more)


def generate_launch_description():
    return FogROSLaunchDescription([
"""


@pytest.fixture(autouse=True, scope='module')
def ready(kubernetes):
    """Skip where the pods' image can't have what this robot's launches need."""
    if reason := kubernetes.why_not_ready:
        pytest.skip(reason)


@pytest.fixture(autouse=True)
def logs(tmp_path, monkeypatch):
    """Keep what launch logs out of the user's home."""
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))


@pytest.fixture
def launch(tmp_path):
    """Return what starts a launch of some entities, written as in a launch file."""
    with launching() as start:
        def run(*entities: str, before: str = '', **launched):
            path = tmp_path / f'{uuid.uuid4().hex[:6]}.launch.py'
            lines = ''.join(f'        {entity},\n' for entity in entities)
            path.write_text(f"{before}{HEADER.replace('{image}', READY)}{lines}    ])\n")
            return start(str(path), **launched)

        yield run


def clean(run):
    """Return whether it said nothing that would worry anybody, but for a Ctrl-C."""
    warnings = [line for line in run.said if 'WARNING' in line and 'ctrl-c' not in line]
    return run.errors == warnings == [] and 'Traceback' not in run.text


@pytest.fixture(scope='module')
def killed(kubernetes, namespaces_of_module, tmp_path_factory):
    """Return the namespace of a robot that was killed while its pod was talking, and when."""
    space = namespaces_of_module()
    folder = tmp_path_factory.mktemp('killed')
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('KUBECONFIG', str(space.kubeconfig))
        patch.setenv('FOGROS2_STATE_HOME', str(folder / 'state'))
        patch.setenv('ROS_LOG_DIR', str(folder / 'log'))
        path = folder / 'killed.launch.py'
        path.write_text(
            IMAGE + HEADER.replace('{image}', READY)
            + "        talker(pod('killed', robot_timeout=3, launch_foxglove=True)),\n"
            + '        listener()])\n')
        with launching() as start:
            run = start(str(path))
            run.wait_for('I heard', timeout=TIMEOUT)
            (job,) = space.all('jobs')
            assert job['spec']['ttlSecondsAfterFinished'] == 60
            # nobody here has a minute
            space.client.ask(
                'PATCH', f"/apis/batch/v1/namespaces/{space.name}/jobs/{job['metadata']['name']}",
                {'spec': {'ttlSecondsAfterFinished': TTL}})
            run.kill()
        when = time.monotonic()
        yield space, when
        # what the robot itself keeps is the next launch's, or this, to take away
        assert ros2('fog', 'gc').returncode == 0


def test_a_killed_robot_s_pod_ends_itself(killed):
    """The container of the web application, too."""
    space, _ = killed
    assert space.all('services')

    def ended():
        return {pod['status']['phase'] for pod in space.all('pods')} <= {'Succeeded', 'Failed'}

    wait_until(ended, timeout=90.0, what='both containers to end')


@pytest.mark.usefixtures('nothing_left')
def test_example_runs_in_a_pod(namespace):
    with launching() as start:
        run = start('fogros2_examples', 'talker.kube.launch.py', 'name:=planner',
                    f'image:={READY}', 'count:=2')
        assert run.ended(TIMEOUT) == 0, run.text
    assert run.text.count('I heard: [Hello World from planner ') >= 2
    assert clean(run), run.text
    assert 'node_port' in run.text, f'it says which way UDP took: {run.text}'
    assert namespace.left() == []


@pytest.mark.usefixtures('nothing_left')
def test_unedited_talker_kube_of_fogros2_runs(upstream, namespace):
    """Its image is KubeInstance()'s own; the cluster has one of that name."""
    with launching() as start:
        run = start(str(upstream / 'FogROS2/fogros2_examples/launch/talker.kube.launch.py'))
        run.wait_for('I heard: [Hello World from ', timeout=TIMEOUT)
        (pod,) = namespace.all('pods')
        assert pod['spec']['containers'][0]['image'] == DEFAULT
        run.interrupt()
        assert run.ended() == 0, run.text
    assert clean(run), run.text
    assert namespace.left() == []


@pytest.mark.usefixtures('nothing_left')
def test_a_pod_dials_the_robot(launch, namespace, kubernetes):
    run = launch(
        "talker(pod('dialler', expose='pod_dials_robot', "
        f"robot_host='{kubernetes.layout.host}'))", 'listener()')
    run.wait_for('I heard: [Hello World from dialler ', times=2, timeout=TIMEOUT)
    assert namespace.all('services') == []
    run.interrupt()
    assert run.ended() == 0, run.text
    assert clean(run), run.text
    assert namespace.left() == []


@pytest.mark.usefixtures('nothing_left')
def test_a_pod_needs_no_udp(launch, namespace, kubernetes):
    with without_udp(kubernetes.layout.node):
        run = launch("talker(pod('narrow'))", 'listener()')
        run.wait_for('I heard: [Hello World from narrow ', times=2, timeout=TIMEOUT)
        assert re.search(r'VPN path .*stream', run.text), run.text
        run.interrupt()
        assert run.ended() == 0, run.text
    assert clean(run), run.text
    assert namespace.left() == []


@pytest.mark.usefixtures('nothing_left')
def test_two_pods_talk_and_verbs_and_web_application_work(
        launch, namespace, kubernetes, monkeypatch, tmp_path):
    run = launch(
        "talker(pod('known', launch_foxglove=True))",
        "CloudNode(machine=pod('hearer'), package='fogros2_examples', executable='listener', "
        "output='screen')", "listener(name='robot_listener')", before=IMAGE)
    run.wait_for('[listener]: I heard: [Hello World from known ', times=2, timeout=TIMEOUT)
    run.wait_for('[robot_listener]: I heard: [Hello World from known ', timeout=TIMEOUT)
    with ThreadPoolExecutor() as pool:
        listed, status, logs, connected, swept = pool.map(lambda words: ros2('fog', *words), (
            ['list'], ['status', 'known'], ['logs', 'known'],
            ['connect', 'known', '--', 'sh', '-c', 'hostname; id -un'], ['gc']))
    # the robot's role lets it see its own namespace
    assert 'known' in listed.stdout and namespace.name in listed.stdout, listed
    assert status.returncode == 0 and 'talker' in status.stdout, status
    assert 'Publishing: "Hello World from known ' in logs.stderr, logs  # where ROS 2 logs
    assert connected.stdout.split() == ['known', 'fog'], connected
    assert swept.returncode == 0, swept
    # one who may sees all of them, with nothing of this robot's at hand
    with monkeypatch.context() as patch:
        patch.setenv('KUBECONFIG', str(kubernetes.kubeconfig))
        patch.setenv('FOGROS2_STATE_HOME', str(tmp_path / 'another'))
        everywhere = ros2('fog', 'list')
    assert 'known' in everywhere.stdout and namespace.name in everywhere.stdout, everywhere
    before = run.text.count('I heard')
    run.wait_for('I heard', times=before + 1, timeout=TIMEOUT)  # gc has let it be
    check_application('known')
    assert {name: [each['name'] for each in pod['spec']['containers']]
            for pod in namespace.all('pods') for name in [pod['spec']['hostname']]} == {
        'known': ['machine', 'application'], 'hearer': ['machine']}
    run.interrupt()
    assert run.ended() == 0, run.text
    assert clean(run), run.text
    assert namespace.left() == []


def check_application(machine):
    """Check that a machine's web application is served by ``ros2 fog monitor``."""
    opener = urllib.request.build_opener(
        urllib.request.ProxyHandler({}), urllib.request.HTTPCookieProcessor())

    def shown():
        with contextlib.suppress(OSError), opener.open(f'http://{address}', timeout=5) as answer:
            return answer.read().decode().strip() == 'the application'

    tunnel = subprocess.Popen(['ros2', 'fog', 'monitor', machine, '--no-browser'], text=True,
                              stdout=subprocess.PIPE)
    try:
        line = tunnel.stdout.readline()
        address = re.search(r'is at ws://(127.0.0.1:\d+/\?token=\S+) ', line)[1]
        wait_until(shown, timeout=60.0, what='the application')
    finally:
        tunnel.send_signal(signal.SIGINT)
        tunnel.wait(20)
        tunnel.stdout.close()


@pytest.mark.usefixtures('nothing_left')
def test_a_pod_that_is_killed_ends_the_launch(launch, namespace):
    run = launch("talker(pod('victim'))", 'listener()')
    run.wait_for('I heard', timeout=TIMEOUT)
    (pod,) = namespace.all('pods')
    namespace.client.ask(
        'DELETE', f"/api/v1/namespaces/{namespace.name}/pods/{pod['metadata']['name']}",
        gracePeriodSeconds='0')
    assert run.ended() != 0, run.text
    assert any("'victim'" in line for line in run.errors), run.text
    namespace.gone()


@pytest.mark.usefixtures('nothing_left')
def test_nodes_of_an_evicted_pod_continue_on_the_robot(launch, namespace):
    run = launch("talker(pod('evicted', on_interrupt='robot'))", 'listener()')
    run.wait_for('I heard: [Hello World from evicted ', timeout=TIMEOUT)
    (pod,) = namespace.all('pods')
    name = pod['metadata']['name']
    namespace.client.create(
        f'/api/v1/namespaces/{namespace.name}/pods/{name}/eviction', 'policy/v1beta1 Eviction',
        name)
    wait_until(
        lambda: any('I heard' in line and 'from evicted ' not in line for line in run.said),
        timeout=60.0, what=f'the robot to talk itself: {run.text}')
    # its time is up sooner here than it would be there
    namespace.client.ask(
        'DELETE', f'/api/v1/namespaces/{namespace.name}/pods/{name}', gracePeriodSeconds='0')
    run.interrupt()
    assert run.ended() == 0, run.text
    namespace.gone()


@pytest.mark.usefixtures('nothing_left')
def test_restart_of_the_api_server_is_waited_for(launch, namespace, kubernetes):
    run = launch("talker(pod('patient'))", 'listener()')
    wait_until(lambda: namespace.all('jobs') or None, timeout=60.0, what='the Job')
    kubernetes.stop('kube-apiserver')
    kubernetes.start('kube-apiserver')
    run.wait_for('I heard: [Hello World from patient ', timeout=TIMEOUT)
    kubernetes.stop('kube-apiserver')
    before = run.text.count('I heard')
    run.wait_for('I heard', times=before + 5, timeout=20.0)
    kubernetes.start('kube-apiserver')
    # the agent's events come again
    before = run.text.count('[patient.talker-1]')
    run.wait_for('[patient.talker-1]', times=before + 5, timeout=TIMEOUT)
    run.interrupt()
    assert run.ended() == 0, run.text
    assert namespace.left() == []


@pytest.mark.usefixtures('nothing_left')
def test_second_launch_reuses_a_kept_pod(launch, namespace):
    entities = ("talker(pod('warm', on_exit='keep'))", 'listener()')
    pods = []
    for _ in range(2):
        run = launch(*entities)
        run.wait_for('I heard', timeout=TIMEOUT)
        run.interrupt()
        assert run.ended() == 0, run.text
        assert clean(run), run.text
        pods += [pod['metadata']['uid'] for pod in namespace.all('pods')]
    assert len(pods) == 2 and len({*pods}) == 1, "the second launch took the first one's pod"
    status = ros2('fog', 'status', 'warm')
    assert status.returncode == 0 and 'kept for the next one' in status.stdout, status
    assert status.stderr == '', status
    deleted = ros2('fog', 'delete', 'warm', '--yes')
    assert deleted.returncode == 0, deleted
    assert namespace.left() == []


def test_pod_and_services_of_a_killed_robot_end_in_time(killed):
    space, when = killed
    space.gone(timeout=max(5.0, when + 30.0 + TTL + 15.0 - time.monotonic()))
