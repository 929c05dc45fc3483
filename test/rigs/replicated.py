# SPDX-License-Identifier: Apache-2.0
"""
A launch file with replicas on container machines, and a client that prints what each call costs.

The client prints ``call NUMBER by REPLICA: MILLISECONDS``. It asks the replica that answers to die
at the end of a call, and prints the milliseconds from the death to the answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Optional

#: Seconds that a call takes, and milliseconds until the next replica is asked.
TAKES, HEDGE = 0.02, 300.0
#: Calls between two deaths; the first calls measure the latency of each replica.
BETWEEN = 60
#: The number of the robot's own copy.
ROBOT = 9

SERVER = f"""
import os, sys, time
import rclpy
from rcl_interfaces.srv import ListParameters

def answer(request, response):
    time.sleep({TAKES})
    called, dies = map(int, request.prefixes)
    if dies == number:
        print(f'dies at {{time.monotonic()}}', flush=True)
        os._exit(1)
    response.result.names = [str(called), str(number)]
    return response

rclpy.init()
node = rclpy.create_node('planner')
robot = any('/fogros2/robot/' in word for word in sys.argv)
number = {ROBOT} if robot else int(os.uname().nodename.rpartition('-')[2])
node.create_service(ListParameters, 'plan', answer)
rclpy.spin(node)
"""

CLIENT = f"""
import time
import rclpy
from rcl_interfaces.srv import ListParameters

rclpy.init()
node = rclpy.create_node('client')
client = node.create_client(ListParameters, '/plan')
client.wait_for_service()
number = by = 0
while rclpy.ok():
    number += 1
    dies = by if number % {BETWEEN} == 0 and by != {ROBOT} else -1  # none is left after it
    begin = time.monotonic()
    future = client.call_async(ListParameters.Request(prefixes=[str(number), str(dies)]))
    rclpy.spin_until_future_complete(node, future, timeout_sec=30)
    taken = time.monotonic() - begin
    answer = future.result().result.names if future.done() else []
    if answer[:1] != [str(number)]:
        print(f'call {{number}} is lost', flush=True)
        continue
    by = int(answer[1])
    print(f'call {{number}} by {{by}}: {{1e3 * taken:.1f}} ms', flush=True)
    if dies >= 0:
        # the one that died took as long before it did
        print(f'death of {{dies}}: {{1e3 * (taken - {TAKES}):.1f}} ms from then', flush=True)
    time.sleep(0.03)
"""

LAUNCH = """
from fogros2 import ContainerInstance, FogROSLaunchDescription, Replicated
from launch.actions import ExecuteProcess


def generate_launch_description():
    return FogROSLaunchDescription([
        Replicated(
            [*(ContainerInstance(name=name, network={network!r}, vpn_path={path!r})
               for name in {names!r}),
             *{robot!r}],
            [ExecuteProcess(cmd=['python3', '-c', {server!r}, '--ros-args'], name='planner',
                            respawn=True, respawn_delay=0.5, output='screen')],
            services=['/plan'], {when}),
        ExecuteProcess(cmd=['python3', '-u', '-c', {client!r}], name='client', output='screen'),
    ])
"""


def write(
    path: Path, names: Sequence[str], network: Optional[str], hedge: float = HEDGE,
    deadline: Optional[float] = None, vpn_path: str = 'auto',
) -> Path:
    """
    Write the launch file; names of machines end with ``-`` and a number.

    :param deadline: seconds until the robot's copy answers; without, the robot has none.
    """
    robot, when = ([], f'hedge_after={hedge}') if deadline is None else (
        [None], f'hedge_after={hedge}, deadline={deadline}')
    path.write_text(LAUNCH.format(names=list(names), network=network, server=SERVER,
                                  client=CLIENT, robot=robot, when=when, path=vpn_path))
    return path
