# SPDX-License-Identifier: Apache-2.0
"""The applications' launch files: on a container, here, and what they differ by from a twin."""

from __future__ import annotations

import ast
import importlib
import json
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import threading
import time

from ament_index_python.packages import get_package_prefix, get_package_share_directory
from launch.launch_description_sources import get_launch_description_from_any_launch_file
import pytest

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH')


def started(executable, *words):
    """Return a node as a process; it ends with SIGINT."""
    path = Path(get_package_prefix('fogros2_examples'), 'lib/fogros2_examples', executable)
    return subprocess.Popen([sys.executable, path, '--ros-args', *words], text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def launch_file(name):
    return Path(get_package_share_directory('fogros2_examples'), 'launch', f'{name}.launch.py')


def twin(source):
    """
    Return a launch file without what is about machines: plain nodes, all here.

    Of ``source``, arguments that only say where things run, machines and streams go.
    """
    lines = source.splitlines()
    gone = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module == 'fogros2':
            gone.append(node)
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            first = node.args[0] if node.args else None
            if node.func.id == 'FogMachine' or (
                    node.func.id == 'DeclareLaunchArgument' and isinstance(first, ast.Constant)
                    and first.value in ('machine', 'foxglove', 'transport')):
                gone.append(node)
            elif node.func.id == 'CloudNode':
                gone += [word for word in node.keywords
                         if word.arg in ('machine', 'stream_topics', 'checkpoint')]
    for node in sorted(gone, key=lambda node: -node.lineno):
        head = lines[node.lineno - 1][:node.col_offset]
        tail = lines[node.end_lineno - 1][node.end_col_offset:].lstrip(',').lstrip()
        rest = head + tail if head.strip() else tail and ' ' * node.col_offset + tail
        lines[node.lineno - 1:node.end_lineno] = [rest] if rest.strip() else []
    text = '\n'.join(lines) + '\n'
    imported = ('from launch import LaunchDescription\n'
                if 'import LaunchDescription' not in text else '')
    place = text.index('from launch')
    return text[:place] + imported + text[place:].replace(
        'FogROSLaunchDescription', 'LaunchDescription').replace('CloudNode', 'Node')


@pytest.mark.parametrize('name', ['grasp', 'planning', 'policy', 'slam'])
def test_cloud_launch_file_has_at_most_ten_more_lines(name, tmp_path):
    source = launch_file(name).read_text()
    here = twin(source)
    assert 'fogros2 ' not in here.replace('fogros2_examples', '') and 'Cloud' not in here
    assert 0 < source.count('\n') - here.count('\n') <= 10
    path = tmp_path / 'twin.launch.py'
    path.write_text(here)
    # and it is one that launch takes
    arguments = {argument.name for argument in get_launch_description_from_any_launch_file(
        str(path)).get_launch_arguments()}
    assert 'machine' not in arguments and 'picture' in arguments


def test_motion_planning(launch, tmp_path):
    drawn = tmp_path / 'planning.png'
    run = launch('fogros2_examples', 'planning.launch.py', 'environment:=cubicles',
                 f'picture:={drawn}')
    assert run.ended() == 0, run.text
    assert run.errors == [] and 'WARNING' not in run.text, run.text
    assert 'path of ' in run.text
    assert '[planner.motion_planner-1]' in run.text
    assert drawn.read_bytes().startswith(b'\x89PNG')


def test_grasp_planning(launch, tmp_path):
    drawn = tmp_path / 'grasp.png'
    run = launch('fogros2_examples', 'grasp.launch.py', 'trials:=3', f'picture:={drawn}')
    assert run.ended() == 0, run.text
    assert run.errors == [] and 'WARNING' not in run.text, run.text
    # depth crosses without loss
    assert '/depth comes' in run.text or 'depth_h264_decoder' in run.text
    for number in range(3):
        assert re.search(rf'bin {number}: [1-9][0-9]* grasps, q 0[.]', run.text), run.text
    assert drawn.read_bytes().startswith(b'\x89PNG')


def test_grasp_planner_survives_bad_images(launch):
    """Images that are none, then one that is; the unit tests have all kinds of bad ones."""
    from geometry_msgs.msg import PoseArray
    import rclpy
    from sensor_msgs.msg import CameraInfo, Image
    from std_msgs.msg import Header

    from fogros2.waiting import wait_until
    from fogros2_examples.grasp.bins import camera, depth_image, thrown
    from fogros2_examples.grasp.messages import depth_message, info_message

    planner = started('grasp_planner')
    rclpy.init()
    node = rclpy.create_node('camera')
    answers = {}
    images = node.create_publisher(Image, 'depth', 2)
    infos = node.create_publisher(CameraInfo, 'camera_info', 10)
    node.create_subscription(
        PoseArray, 'grasps', lambda poses: answers.update({poses.header.frame_id: poses}), 10)
    eye = camera(320, 240)
    depth = depth_image(thrown(0), eye, 0)

    def answered(image):
        name = image.header.frame_id = f'image {len(answers)}'

        def there():
            # the first ones may come before the planner is there
            infos.publish(info_message(320, 240, eye.focal, Header()))
            images.publish(image)
            deadline = time.monotonic() + 2
            while time.monotonic() < deadline and name not in answers:
                rclpy.spin_once(node, timeout_sec=0.1)
            return name in answers
        wait_until(there, timeout=60.0, what='an answer')
        return len(answers[name].poses)

    try:
        assert answered(Image(encoding='bgr8')) == 0
        assert answered(depth_message(0 * depth, '16UC1', Header())) == 0
        assert answered(depth_message(depth[:100], '32FC1', Header())) == 0
        assert answered(depth_message(depth, '32FC1', Header())) > 0
    finally:
        node.destroy_node()
        rclpy.shutdown()
        planner.send_signal(signal.SIGINT)
        said = planner.communicate(timeout=60)[0]
    assert planner.returncode == 0, said
    for words in ("depth as 'bgr8'", '0 of 76800 pixels have a depth',
                  'camera_info is of 320x240 pixels'):
        assert words in said, said


def test_motion_planner_survives_bad_requests(launch):
    """A scene that is none, poses that are none or touch, a goal out of reach; then a good one."""
    from diagnostic_msgs.msg import DiagnosticStatus
    from geometry_msgs.msg import PoseStamped
    from nav_msgs.srv import GetPlan
    import numpy
    import rclpy
    from visualization_msgs.msg import MarkerArray

    from fogros2.waiting import wait_until
    from fogros2_examples.meshes import box, joined
    from fogros2_examples.nodes import LATCHED
    from fogros2_examples.planning.messages import pose_message, scene_message
    from fogros2_examples.planning.scene import pose, Scene

    planner = started('motion_planner', '-p', 'time:=1.0')
    rclpy.init()
    node = rclpy.create_node('asker')
    told = []
    scenes = node.create_publisher(MarkerArray, 'environment', LATCHED)
    node.create_subscription(DiagnosticStatus, 'planning_status', told.append, LATCHED)
    client = node.create_client(GetPlan, 'plan')

    def until(true):
        def spun():
            rclpy.spin_once(node, timeout_sec=0.1)
            return true()
        wait_until(spun, timeout=60.0, what='an answer')

    def planned(start, goal, frame='cell'):
        request = GetPlan.Request()
        request.start, request.goal = (PoseStamped(pose=pose_message(p)) for p in (start, goal))
        request.start.header.frame_id = frame
        before, future = len(told), client.call_async(request)
        until(lambda: future.done() and len(told) > before)
        return len(future.result().plan.poses), told[-1].message

    # the far half is behind a wall
    scene = Scene('cell', box((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1)),
                  box((1.4, -1, -1), (1.5, 2, 2)), joined([]), numpy.zeros(3),
                  numpy.array([3.0, 1.0, 1.0]), pose(0.2, 0.2, 0.2), pose(1.2, 0.8, 0.8))
    here, there, beyond = scene.start, scene.goal, pose(2.5, 0.5, 0.5)
    try:
        until(client.service_is_ready)
        assert planned(here, there) == (
            0, "no plan: the start is in the frame 'cell', the environment is not there yet")
        scenes.publish(MarkerArray())
        until(lambda: told[-1].message == "no environment: no marker 'body'")
        scenes.publish(scene_message(scene))
        until(lambda: told[-1].hardware_id == 'cell')
        for start, goal, why in [
                (pose(1.45, 0.5, 0.5), there, 'the start touches something'),
                (here, pose(9, 0.5, 0.5), 'the goal touches something, or is out of bounds'),
                (here, beyond, 'no way was found in 1 s'),
                (here, numpy.zeros(7), 'is no pose'), (numpy.nan * here, there, 'is no pose')]:
            count, message = planned(start, goal)
            assert count == 0 and why in message
        assert 'the environment is' in planned(here, there, 'hall')[1]
        assert planned(here, there)[0] >= 2
    finally:
        node.destroy_node()
        rclpy.shutdown()
        planner.send_signal(signal.SIGINT)
        said = planner.communicate(timeout=60)[0]
    assert planner.returncode == 0, said


def test_impossible_request_fails_the_launch(launch):
    run = launch('fogros2_examples', 'slam.launch.py', 'machine:=robot', 'rate:=0')
    assert run.ended() == 1, run.text
    assert "slam_camera: 'rate' is 0: it has to be from 0.01 to 1000" in run.text
    # the other node may be interrupted while it starts
    assert not re.search(r'\[slam_camera-\d+\] Traceback', run.text)


@pytest.mark.parametrize(('node', 'asked', 'said'), [
    ('slam.camera.SlamCamera', 'frames:=99999', "'frames' is 99999: it has to be from 1 to 2330"),
    ('slam.camera.SlamCamera', 'width:=0', "'width' is 0: it has to be from 64 to 4096"),
    ('slam.camera.SlamCamera', 'picture:=x.txt', "'picture' is x.txt: it has to end in .png, "),
    ('slam.camera.SlamCamera', 'results:=/no/x', "'results' is /no/x: there is no folder /no"),
    ('grasp.grasp_camera.GraspCamera', 'trials:=-1', "'trials' is -1: it has to be 0 at least"),
    ('grasp.grasp_camera.GraspCamera', 'encoding:=rgb8', "'encoding' is 'rgb8': it has to be 16"),
    ('planning.planning_client.PlanningClient', 'picture:=/no/x.png', 'there is no folder /no'),
    ('policy.policy_arm.PolicyArm', 'targets:=0', "'targets' is 0: it has to be from 1 to 1000"),
    ('policy.policy_client.PolicyClient', 'rate:=5.0', "'rate' is 5: it has to be from 10"),
    ('policy.policy_server.PolicyServer', 'images:=[/front]', 'each has to be of the form INPUT='),
    ('planning.motion_planner.MotionPlanner', 'time:=0.0', "'time' is 0: it has to be 0.1 at le")])
def test_node_checks_its_parameters_first(node, asked, said):
    import rclpy

    from fogros2_examples.parameters import BadParameter

    module, _, kind = f'fogros2_examples.{node}'.rpartition('.')
    made = getattr(importlib.import_module(module), kind)
    rclpy.init(args=['--ros-args', '-p', asked])
    try:
        with pytest.raises(BadParameter, match=f'^.*{re.escape(said)}'):
            made()
    finally:
        rclpy.shutdown()


def test_starting_nodes_can_be_interrupted(tmp_path):
    """As by another one's end: it has nothing to say, and nobody looks for a fault of its."""
    (tmp_path / 'rclpy.py').write_text('''
import signal, sys
try:
    signal.raise_signal(signal.SIGINT)
except KeyboardInterrupt:
    # other nodes are ready for modules such as NumPy, which turn it into an ImportError
    raise KeyboardInterrupt if '/fogros2_examples/' in sys.argv[0] else ImportError
''')
    kinds = {}  # most scripts differ by names alone
    for path in sorted(ROOT.glob('*/scripts/*')):
        if path.is_file() and path.parts[-3] != 'fogros2_monitor':
            kinds[re.sub(r'""".*"""|(?<=from )[\w.]+', '', path.read_text())] = path
    assert 1 < len(kinds) < 8
    for path in kinds.values():
        done = subprocess.run(
            [sys.executable, path],
            env={**os.environ, 'PYTHONPATH': f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"},
            capture_output=True, text=True, timeout=30)
        assert (done.returncode, done.stdout, done.stderr) == (0, '', ''), path


def test_wait_for_a_plan_lasts_for_its_time_out():
    """Not for as long as the planner may take to come up."""
    from nav_msgs.srv import GetPlan
    import numpy
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    from fogros2_examples.planning.messages import path_message
    from fogros2_examples.planning.planning_client import PlanningClient
    from fogros2_examples.planning.scene import cubicles

    scene = cubicles()
    rclpy.init(args=['--ros-args', '-p', 'time:=20.0', '-p', 'wait:=0.2'])
    client, planner = PlanningClient(), rclpy.create_node('planner')
    busy = threading.Event()

    def plan(_, response):
        busy.wait(1.0)
        response.plan = path_message(numpy.array([scene.start, scene.goal]), scene.name)
        return response

    planner.create_service(GetPlan, 'plan', plan)
    executor = SingleThreadedExecutor()
    executor.add_node(planner)
    thread = threading.Thread(target=executor.spin)
    thread.start()
    try:
        assert client.planner.wait_for_service(60)
        path = client._plan(scene, 0)
    finally:
        executor.shutdown()
        thread.join(60)
        rclpy.shutdown()
    assert len(path) == 2


def test_camera_limits_its_frames_in_flight(tmp_path):
    """Two leave before the first is answered, and not a third."""
    import cv2
    from geometry_msgs.msg import PoseStamped
    from nav_msgs.msg import Path as PathMessage
    import numpy
    import rclpy
    from sensor_msgs.msg import Image

    from fogros2.waiting import wait_until
    from fogros2_examples.nodes import LATCHED
    from fogros2_examples.slam.camera import TIMEOUT

    cv2.imwrite(str(tmp_path / 'grey.png'), numpy.full((48, 64, 3), 99, numpy.uint8))
    cv2.imwrite(str(tmp_path / 'far.png'), numpy.full((48, 64), 9999, numpy.uint16))
    for which, file in (('rgb', 'grey'), ('depth', 'far')):
        (tmp_path / f'{which}.txt').write_text(
            ''.join(f'{time}.0 {file}.png\n' for time in (1, 2, 3)))
    camera = started('slam_camera', *(word for setting in (
        f'dataset:={tmp_path}', 'ahead:=2', 'frames:=0', 'rate:=100.0',
        f'results:={tmp_path}/results.json') for word in ('-p', setting)))
    rclpy.init()
    node = rclpy.create_node('slam')
    poses = node.create_publisher(PoseStamped, 'pose', 10)
    paths = node.create_publisher(PathMessage, 'path', LATCHED)
    seen = []
    node.create_subscription(Image, 'camera/image', lambda image: seen.append(image.header), 2)

    def until(true, timeout=60.0):
        def spun():
            rclpy.spin_once(node, timeout_sec=0.02)
            return true()
        wait_until(spun, timeout=timeout, what='frames', longest=0.001)

    try:
        until(lambda: len(seen) == 2)
        # at 100 Hz a third would be here at once; after half the time-out it waits no more
        with pytest.raises(RuntimeError):
            until(lambda: len(seen) > 2, 0.3)
        poses.publish(PoseStamped(header=seen[0]))
        until(lambda: len(seen) == 3)
        left = [header.stamp.sec + 1e-9 * header.stamp.nanosec for header in seen]
        assert left[2] - left[0] < TIMEOUT / 2
        poses.publish(PoseStamped(header=seen[1]))
        paths.publish(PathMessage(poses=[PoseStamped(header=seen[2])]))
        said = camera.communicate(timeout=60)[0]
    finally:
        node.destroy_node()
        rclpy.shutdown()
        camera.kill()
    assert camera.returncode == 0, said
    assert '2 of 3 frames were answered' in said
    first, second = json.loads((tmp_path / 'results.json').read_text())['came']
    assert first == 0.0 < second
