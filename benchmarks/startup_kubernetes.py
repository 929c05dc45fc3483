# SPDX-License-Identifier: Apache-2.0
"""
How long a launch with pods takes from ``ros2 launch`` to the first message, on a real cluster.

The cluster is one node on this computer (``rigs.cluster``), whose image is there already and has
ROS 2's wheels. Requests are counted from the API server's audit log, for a user who has the
sample role and no other right.

    python benchmarks/startup.py --provider kubernetes [--runs 3]
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
import contextlib
import os
from pathlib import Path
import subprocess
import tempfile
import time
import uuid

from figures import paper, Row, write
from figures.places import place, Pod

from fogros2.waiting import wait_until
from rigs.cluster import Cluster, READY
from rigs.cluster.namespaces import Namespace
from rigs.launched import launching, ros2

SCRIPT = Path(__file__).resolve().parents[1] / 'tools' / 'kubernetes.sh'
MANY = 20

LAUNCH = """\
from fogros2 import CloudNode, FogROSLaunchDescription, KubeInstance
from launch_ros.actions import Node


def generate_launch_description():
    machines = [KubeInstance(name=f'bench-{{n}}', container_image='{image}')
                for n in range({number})]
    return FogROSLaunchDescription([
        Node(package='fogros2_examples', executable='listener', output='screen'),
        *(CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                    output='screen') for machine in machines)])
"""


class Robot:
    """A robot that may use one namespace of a cluster."""

    def __init__(self, there: Cluster, space: Namespace, home: Path) -> None:
        self._cluster = there
        self._space = space
        self._home = home
        self.environment = {
            **os.environ, 'KUBECONFIG': str(space.kubeconfig),
            'FOGROS2_STATE_HOME': str(home / 'state'), 'ROS_LOG_DIR': str(home / 'log'),
            'ROS_DOMAIN_ID': '87', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}

    def talker(self, *words: str) -> tuple[float, Counter[str]]:
        """
        Launch the talker until the first message is heard.

        :returns: seconds, and the requests to the API server, those of the end too.
        """
        before = len(self._cluster.requests('robot'))
        with launching() as launch:
            begin = time.perf_counter()
            run = launch('fogros2_examples', 'talker.kube.launch.py', f'image:={READY}',
                         'count:=1', *words, environment=self.environment)
            run.wait_for('I heard: ', timeout=120.0)
            total = time.perf_counter() - begin
            if run.ended(120.0) != 0:
                raise SystemExit(f'the launch failed:\n{run.text}')
        asked = self._cluster.requests('robot')[before:]
        return total, Counter(
            f"{event['verb']} {what_of(event['objectRef'])}" for event in asked
            if 'objectRef' in event)

    def machines(self, number: int) -> float:
        """Return the seconds until each of ``number`` machines has been heard on the robot."""
        path = self._home / f'many-{uuid.uuid4().hex}.launch.py'
        path.write_text(LAUNCH.format(number=number, image=READY))
        with launching() as launch:
            begin = time.perf_counter()
            run = launch(str(path), environment=self.environment)
            for each in range(number):
                run.wait_for(f'I heard: [Hello World from bench-{each} ', timeout=300.0)
            total = time.perf_counter() - begin
            run.interrupt()
            if run.ended(120.0) != 0:
                raise SystemExit(f'the launch failed:\n{run.text}')
        self.settled()
        return total

    def bare(self, number: int) -> float:
        """
        Return the seconds that the cluster itself takes for as many pods: what can't be undercut.

        Jobs with a Service each, as for machines, of the same image; nothing of ours runs in them.
        """
        client, base = self._space.client, f'/api/v1/namespaces/{self._space.name}'
        jobs = f'/apis/batch/v1/namespaces/{self._space.name}/jobs'
        begin = time.perf_counter()

        def make(each: int) -> None:
            name = f'bare-{each}'
            client.create(jobs, 'batch/v1 Job', name, spec={
                'backoffLimit': 0, 'template': {'metadata': {'labels': {'bare': name}}, 'spec': {
                    'restartPolicy': 'Never', 'automountServiceAccountToken': False,
                    'enableServiceLinks': False, 'terminationGracePeriodSeconds': 0,
                    'containers': [{'name': 'machine', 'image': READY,
                                    'command': ['sleep', '600']}]}}})
            client.create(f'{base}/services', 'v1 Service', name, spec={
                'type': 'NodePort', 'selector': {'bare': name},
                'ports': [{'port': 51820, 'protocol': 'UDP'}]})

        def running() -> bool:
            found = self._space.all('pods')
            return sum('running' in status['state'] for pod in found
                       for status in pod['status'].get('containerStatuses', ())) == number

        with ThreadPoolExecutor(number) as pool:
            list(pool.map(make, range(number)))
        wait_until(running, timeout=300.0, interval=0.1, longest=0.1, what='the bare pods to run')
        total = time.perf_counter() - begin
        for each in range(number):
            client.ask('DELETE', f'{jobs}/bare-{each}', propagationPolicy='Background')
            client.ask('DELETE', f'{base}/services/bare-{each}')
        self.settled()
        return total

    def delete(self, name: str) -> None:
        """Delete a machine that was kept."""
        done = ros2('fog', 'delete', '--yes', name, environment=self.environment)
        if done.returncode != 0:
            raise SystemExit(f'ros2 fog delete failed:\n{done.stdout}{done.stderr}')
        self.settled()

    def settled(self) -> None:
        """Wait until nothing of the launches before is left to do for the cluster."""
        wait_until(lambda: not self._space.left() or None, timeout=120.0,
                   what='the namespace to be empty')


def what_of(reference: dict[str, str]) -> str:
    """Return what a request is for, such as ``pods/exec``."""
    return '/'.join(filter(None, (reference['resource'], reference.get('subresource'))))


def rows(here: Robot, runs: int) -> Iterator[Row]:
    """Yield the figures."""
    here.talker()  # the first one of a cluster reads files that nobody has read
    fresh = [here.talker() for _ in range(runs)]
    yield Row.of("a new pod on this computer's cluster, image there: to the first message",
                 [t for t, _ in fresh], 's', 5.0,
                 published=f"{paper.STARTUP['local']} s (a local cluster that ran), "
                           f"{paper.STARTUP['GCP']} s (GCP)")
    here.talker('name:=kept', 'on_exit:=keep')
    kept = [here.talker('name:=kept', 'on_exit:=keep') for _ in range(runs)]
    here.delete('kept')
    yield Row.of('a kept pod: to the first message', [t for t, _ in kept], 's', 2.0)
    calls = max((asked for _, asked in fresh), key=lambda asked: sum(asked.values()))
    print('requests of a launch:', ', '.join(f'{n} {what}' for what, n in sorted(calls.items())))
    yield Row('requests to the API server in a launch, at most', sum(calls.values()), 'requests',
              15.0, runs=runs)
    one = Row.of('1 pod: until it is heard', [here.machines(1) for _ in range(runs)], 's')
    many = Row.of(f'{MANY} pods: until all are heard',
                  [here.machines(MANY) for _ in range(runs)], 's')
    yield from (one, many)
    yield Row(f'{MANY} pods', many.value / one.value, 'times one', 4.0, runs=runs)
    bare = Row.of('1 bare pod, with nothing of FogROS2: until it runs',
                  [here.bare(1) for _ in range(runs)], 's')
    floor = Row.of(f'{MANY} bare pods: until they run',
                   [here.bare(MANY) for _ in range(runs)], 's')
    yield from (bare, floor)
    yield Row(f'{MANY} bare pods', floor.value / bare.value, 'times one', runs=runs)
    yield Row(f'{MANY} pods, without what the cluster takes for bare ones',
              (many.value - floor.value) / MANY, 's each', runs=runs)


@contextlib.contextmanager
def robot() -> Iterator[Robot]:
    """Yield a robot with a cluster: the one that FOGROS2_CLUSTER names, or one for this time."""
    with place('kubernetes') as here, tempfile.TemporaryDirectory() as home:
        assert isinstance(here, Pod)
        yield Robot(here.nodes, here.space, Path(home))


def measure(runs: int) -> None:
    """Take the figures and write them down, where there can be a cluster."""
    reason = subprocess.check_output([SCRIPT, '--why-not'], text=True).strip()
    if reason:
        print(f'no Kubernetes to measure: {reason}')
        return
    with robot() as here:
        write('startup_kubernetes', 'From ros2 launch to the first message, a local cluster',
              [*rows(here, runs)])
