# SPDX-License-Identifier: Apache-2.0
"""A workspace's own message, service and action, built and used by two nodes."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
from pathlib import Path
import shutil
import subprocess
import sys
import sysconfig
import textwrap

import pytest

from rigs import viewer as viewers
from rigs.domains import taken

ROOT = Path(__file__).parents[2]
CACHE = ROOT / '.cache/node'
PREFIXES = [sys.prefix, *os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)]
NO_TOOLS = Path(sys.prefix, 'ament_cmake/share/cmake/ament_cmake')
FILES = {
    'package.xml': """\
        <?xml version="1.0"?>
        <package format="3">
          <name>fogt_cargo</name><version>1.0.0</version><description>For a test.</description>
          <maintainer email="nobody@example.org">nobody</maintainer><license>Apache-2.0</license>
          <buildtool_depend>ament_cmake</buildtool_depend>
          <buildtool_depend>rosidl_default_generators</buildtool_depend>
          <depend>geometry_msgs</depend>
          <exec_depend>rosidl_default_runtime</exec_depend>
          <member_of_group>rosidl_interface_packages</member_of_group>
          <export><build_type>ament_cmake</build_type></export>
        </package>
        """,
    'CMakeLists.txt': """\
        cmake_minimum_required(VERSION 3.8)
        project(fogt_cargo)
        find_package(ament_cmake REQUIRED)
        find_package(geometry_msgs REQUIRED)
        find_package(rosidl_default_generators REQUIRED)
        rosidl_generate_interfaces(${PROJECT_NAME}
          "msg/Goods.msg" "srv/Weigh.srv" "action/Carry.action" DEPENDENCIES geometry_msgs)
        ament_package()
        """,
    # of another package's messages, whose libraries are those of ROS 2
    'msg/Goods.msg': 'string name\ngeometry_msgs/Point[] corners\n',
    'srv/Weigh.srv': 'fogt_cargo/Goods goods\n---\nfloat64 kilograms\n',
    'action/Carry.action': 'fogt_cargo/Goods goods\n---\nbool done\n---\nuint8 percent\n',
}
SERVER = """
import rclpy
from fogt_cargo.action import Carry
from fogt_cargo.msg import Goods
from fogt_cargo.srv import Weigh
from rclpy.action import ActionServer
rclpy.init()
node = rclpy.create_node('server')
def heard(goods):
    print('heard', goods.name, goods.corners[0].x, flush=True)
def weigh(request, response):
    response.kilograms = 2.5 * len(request.goods.corners)
    return response
def carry(handle):
    handle.publish_feedback(Carry.Feedback(percent=50))
    handle.succeed()
    return Carry.Result(done=handle.request.goods.name == 'box')
node.create_subscription(Goods, 'goods', heard, 1)
node.create_service(Weigh, 'weigh', weigh)
server = ActionServer(node, Carry, 'carry', carry)
print('ready', flush=True)
rclpy.spin(node)
"""
CLIENT = """
import rclpy
from fogt_cargo.action import Carry
from fogt_cargo.msg import Goods
from fogt_cargo.srv import Weigh
from geometry_msgs.msg import Point
from rclpy.action import ActionClient
rclpy.init()
node = rclpy.create_node('client')
goods = Goods(name='box', corners=[Point(x=1.5), Point()])
publisher = node.create_publisher(Goods, 'goods', 1)
node.create_timer(0.2, lambda: publisher.publish(goods))
weigh, carry = node.create_client(Weigh, 'weigh'), ActionClient(node, Carry, 'carry')
assert weigh.wait_for_service(60) and carry.wait_for_server(60)
def result(future):
    rclpy.spin_until_future_complete(node, future, timeout_sec=60)
    return future.result()
print(result(weigh.call_async(Weigh.Request(goods=goods))).kilograms)
percents = []
goal = result(carry.send_goal_async(
    Carry.Goal(goods=goods), feedback_callback=lambda it: percents.append(it.feedback.percent)))
print(result(goal.get_result_async()).result.done, percents, flush=True)
rclpy.spin(node)
"""


def lacking() -> str:
    """Return what this computer lacks to build a package of interfaces."""
    path = os.pathsep.join([os.path.dirname(sys.executable), os.environ['PATH']])
    for program in ('colcon', 'cmake', 'g++', 'make'):
        if shutil.which(program, path=path) is None:
            return program
    if not Path(sysconfig.get_path('include'), 'Python.h').exists():
        return 'the headers of Python'
    found = any(Path(prefix, 'share/rosidl_default_generators').is_dir() for prefix in PREFIXES)
    return '' if found else 'rosidl_default_generators'


@pytest.fixture(scope='module')
def environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """Build the workspace; return variables for its nodes."""
    if lacking():
        pytest.skip(f'{lacking()} is not installed')
    tmp_path = tmp_path_factory.mktemp('workspace')
    for name, text in FILES.items():
        file = tmp_path / 'src/fogt_cargo' / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(textwrap.dedent(text))
    path = os.pathsep.join([os.path.dirname(sys.executable), os.environ['PATH']])
    with taken() as domain:
        variables = {**os.environ, 'PATH': path, 'ROS_DOMAIN_ID': domain,
                     'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'PYTHONWARNINGS': 'ignore'}
        built = subprocess.run(['colcon', 'build'], cwd=tmp_path, env=variables, text=True,
                               stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=500)
        assert built.returncode == 0, built.stdout
        sourced = subprocess.run(
            ['bash', '-c', '. install/setup.bash && exec env -0'], cwd=tmp_path, env=variables,
            check=True, capture_output=True, text=True).stdout
        yield dict(line.split('=', 1) for line in sourced.split('\0') if '=' in line)


def test_own_message_service_and_action_work_between_nodes(environment: dict[str, str]) -> None:
    processes = [subprocess.Popen([sys.executable, '-c', code], env=environment, text=True,
                                  stdout=subprocess.PIPE) for code in (SERVER, CLIENT)]
    try:
        server, client = (process.stdout for process in processes)
        assert server is not None and client is not None
        assert [client.readline(), client.readline()] == ['5.0\n', 'True [50]\n']
        assert [server.readline(), server.readline()] == ['ready\n', 'heard box 1.5\n']
        called = subprocess.run(
            ['ros2', 'service', 'call', '/weigh', 'fogt_cargo/srv/Weigh',
             '{goods: {corners: [{x: 1}]}}'], env=environment, capture_output=True, text=True)
        assert 'Weigh_Response(kilograms=2.5)' in called.stdout, called.stderr
    finally:
        for process in processes:
            process.kill()
            process.communicate()


def test_viewer_calls_a_service_of_an_own_type(environment: dict[str, str]) -> None:
    pytest.importorskip('foxglove', reason='the extra "monitor" is not installed')
    why_not = viewers.install(ROOT / 'test/node', CACHE)
    if why_not:
        pytest.skip(why_not)
    processes = [subprocess.Popen(
        [sys.executable, *words], env=environment, text=True, cwd=ROOT,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT) for words in (
            ('-c', SERVER),
            ('-m', 'fogros2_monitor.bridge', '--ros-args', '-p', 'port:=0'))]
    assert processes[1].stdout is not None
    try:
        line = next(line for line in processes[1].stdout if 'serving ws://' in line)
        with contextlib.closing(viewers.Viewer(CACHE, line.split()[-1])) as viewer:
            assert 'MSG: geometry_msgs/Point' in viewer.until('service', '/weigh')['request']
            viewer.wish(call='/weigh', request={'goods': {'name': 'box', 'corners': [{'x': 1}]}})
            assert viewer.until('called', '/weigh')['response'] == {'kilograms': 2.5}
    finally:
        for process in processes:
            process.kill()
            process.communicate()


@pytest.mark.skipif(not NO_TOOLS.exists() or shutil.which('cmake') is None,
                    reason="needs our launch beside ROS 2's wheels, and cmake")
def test_build_without_its_tools_names_their_command(tmp_path: Path) -> None:
    shutil.copytree(NO_TOOLS, tmp_path / 'prefix/ament_cmake/share/cmake/ament_cmake')
    (tmp_path / 'CMakeLists.txt').write_text(
        'cmake_minimum_required(VERSION 3.8)\nproject(fogt NONE)\n'
        'find_package(ament_cmake REQUIRED)\n')
    done = subprocess.run(
        ['cmake', '-B', 'build', f'-DCMAKE_PREFIX_PATH={tmp_path}/prefix'], cwd=tmp_path,
        env={**os.environ, 'PATH': '/usr/bin:/bin'}, capture_output=True, text=True)
    assert done.returncode == 1
    assert "need more of ROS 2's wheels: 'make interfaces'" in \
        ' '.join(done.stderr.split())
