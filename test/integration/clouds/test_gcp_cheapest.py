# SPDX-License-Identifier: Apache-2.0
"""A machine of the cheapest cloud, where that cloud has no capacity."""

from __future__ import annotations

from collections.abc import Iterator
import json
import subprocess
import sys
from typing import Any

import pytest

from fogros2.provider.gcp import prices
from rigs.azure import service
from rigs.gce.catalogue import API_KEY

CLOUDS = ('gcp',)
pytestmark = pytest.mark.soak

#: Azure without computers: it has the lowest price, and no capacity. It runs on the robot.
FULL_AZURE = '''\
import json, logging, sys, threading
from rigs.azure import service
from werkzeug.serving import make_server
logging.getLogger('werkzeug').setLevel(logging.ERROR)
azure = service.Service(ghost=0.0)
azure.faults.append(service.Fault(
    'SkuNotAvailable', kind='virtualmachines', method='PUT', times=0))
server = make_server('127.0.0.1', 0, azure, threaded=True)
threading.Thread(target=server.serve_forever, daemon=True).start()
print(server.server_port, flush=True)
sys.stdin.read()
names = [call.region.split('/')[-1] for call in azure.calls if call.error == 'SkuNotAvailable']
print(json.dumps([sorted(azure.groups), names]))
'''

LAUNCH = '''\
from fogros2 import cheapest, CloudNode, FogROSLaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    machine = cheapest(name={name!r}, arch='x86_64', min_cpu=2, min_memory_gb=4,
                       regions=['westeurope', 'europe-west3'])
    words = {{'package': 'fogros2_examples', 'output': 'screen'}}
    return FogROSLaunchDescription([
        CloudNode(machine=machine, executable='talker', **words),
        Node(executable='listener', **words),
    ])
'''


@pytest.fixture
def azure(box: Any, robot: Any) -> Iterator[subprocess.Popen[str]]:
    """Run Azure on the robot, and lead the robot's programs to both clouds."""
    with subprocess.Popen(box.on_robot([sys.executable, '-c', FULL_AZURE]), text=True,
                          stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stdin is not None
        port = process.stdout.readline().strip()
        robot.variables.update({
            **service.environment(f'http://127.0.0.1:{port}'),
            prices.KEY_VARIABLE: API_KEY, prices.ENDPOINT_VARIABLE: f'{box.inside}/'})
        yield process
        process.stdin.close()


def test_launch_continues_in_the_next_cloud(
    robot: Any, box: Any, azure: subprocess.Popen[str], name: str,
) -> None:
    path = robot.write('cheapest.launch.py', LAUNCH.format(name=name))
    shown = robot.ros2('launch', path, '-s')
    assert shown.returncode == 0 and box.calls() == [], shown.stdout + shown.stderr
    table = robot.ros2('fog', 'price', '--arch', 'x86_64', '--json',
                       '--region', 'westeurope', 'europe-west3')
    assert [(one['provider'], one['type']) for one in json.loads(table.stdout)['offers'][:2]] == [
        ('azure', 'Standard_B2als_v2'), ('gcp', 'e2-medium')]
    run = robot.launch(path)
    run.wait_for(f'I heard: [Hello World from {name} ')
    assert 'the launch tries the next offer, of ' in run.text
    (instance,) = box.alive()
    assert (instance.type, instance.region) == ('e2-medium', 'europe-west3')
    # containers of tests beside this one are listed too
    (machine,) = [one for one in json.loads(
        robot.ros2('fog', 'list', '--json').stdout)['machines'] if one['name'] == name]
    assert (machine['provider'], machine['cost_per_hour']) == ('gcp', 0.04316778)
    run.interrupt()
    assert run.ended() == 0, run.text
    # each attempt had a name of its own, and Azure has nothing of them
    left, tried = json.loads(azure.communicate()[0])
    assert left == [] and len(set(tried)) == len(tried) >= 1
