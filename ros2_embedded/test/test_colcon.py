# SPDX-License-Identifier: Apache-2.0
"""A workspace with an ``ament_python`` package built by colcon: set-up, run, launch."""

import os
import shutil
import subprocess
import sys
import textwrap

import pytest

# beside this interpreter, or where ROS 2's tools are
SEARCHED = os.pathsep.join([os.path.dirname(sys.executable), os.environ['PATH']])
COLCON = shutil.which('colcon', path=SEARCHED)

pytestmark = pytest.mark.skipif(COLCON is None, reason="colcon isn't installed here")

MANIFEST = '''<?xml version="1.0"?>
<package format="3">
  <name>{name}</name>
  <version>1.0.0</version>
  <description>For a test.</description>
  <maintainer email="nobody@example.org">nobody</maintainer>
  <license>Apache-2.0</license>
  <exec_depend>rclpy</exec_depend>
  <export><build_type>ament_python</build_type></export>
</package>
'''
SETUP = '''
from setuptools import setup
setup(
    name='{name}', version='1.0.0', packages=['{name}'], zip_safe=False,
    data_files=[('share/ament_index/resource_index/packages', ['resource/{name}']),
                ('share/{name}', ['package.xml', 'say.launch.py'])],
    entry_points={{'console_scripts': ['say = {name}.node:main']}})
'''
NODE = '''
import rclpy

def main():
    rclpy.init()
    node = rclpy.create_node('sayer')
    print('hello from', node.get_fully_qualified_name(), flush=True)
    node.destroy_node()
    rclpy.shutdown()
'''
LAUNCH_FILE = '''
from launch import LaunchDescription
from launch_ros.actions import Node

def generate_launch_description():
    return LaunchDescription([
        Node(package='{name}', executable='say', name='renamed', output='screen')])
'''


def run(script, cwd):
    """Run a script of bash's, with the interpreter of this test and ROS 2's variables."""
    done = subprocess.run(
        ['bash', '-ec', script], cwd=cwd, capture_output=True, text=True, timeout=120,
        env={**os.environ, 'PATH': SEARCHED, 'ROS_LOG_DIR': str(cwd / 'log'),
             'PYTHONWARNINGS': 'ignore'})
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_package_of_a_workspace_is_found_run_and_launched(tmp_path):
    name = 'fog_colcon_test'
    package = tmp_path / 'src' / name
    for folder in (package / name, package / 'resource'):
        folder.mkdir(parents=True)
    for path, content in (
            ('package.xml', MANIFEST), ('setup.py', SETUP), (f'resource/{name}', ''),
            ('setup.cfg', f'[develop]\nscript_dir=$base/lib/{name}\n'
                          f'[install]\ninstall_scripts=$base/lib/{name}\n'),
            (f'{name}/__init__.py', ''), (f'{name}/node.py', NODE),
            ('say.launch.py', LAUNCH_FILE)):
        (package / path).write_text(textwrap.dedent(content.format(name=name)))
    said = run(f'{COLCON} build --base-paths src >&2; . install/setup.bash; '
               f'ros2 pkg prefix {name}; ros2 pkg executables {name}; ros2 run {name} say; '
               f'ros2 launch {name} say.launch.py', tmp_path)
    assert said.splitlines()[:3] == [f'{tmp_path}/install/{name}', f'{name} say',
                                     'hello from /sayer']
    assert '] hello from /renamed' in said
