# SPDX-License-Identifier: Apache-2.0
"""Install launch, launch_ros and ros2 into an interpreter with the wheels of rclpy alone."""

import importlib.metadata
import os
from pathlib import Path
import sys

from setuptools import find_packages, setup

NAME = 'ros2-embedded'
VERSION = '0.4.0'
HERE = Path(__file__).resolve().parent


def ros2_found() -> str | None:
    """Say where this interpreter gets ROS 2 from, or None if it has none but ours."""
    for package in ('launch', 'launch_ros', 'ros2cli'):
        for distribution in importlib.metadata.distributions(name=package):
            return f'{package} {distribution.version} in {distribution.locate_file("")}'
    for entry in sys.path:
        if entry.startswith('/opt/ros/'):
            return f'{entry} on the Python path'
    for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        if prefix and prefix != sys.prefix and Path(prefix, 'share/ros2cli').is_dir():
            return f'ROS 2 {os.environ.get("ROS_DISTRO", "")} in {prefix}'
    return None


ROS_PACKAGES = (
    'launch', 'launch_ros', 'launch_xml', 'launch_yaml', 'rosidl_runtime_py', 'ros2cli',
    'ros2launch', 'ros2run', 'ros2pkg', 'ros2topic', 'ros2node', 'ros2service', 'ros2param')

#: Where CMake looks after the folder of ROS 2's own wheel of ament_cmake.
NO_BUILD_FOLDER = 'ament_cmake/share/cmake/ament_cmake'
NO_BUILD = """message(FATAL_ERROR "Packages of interfaces need more of ROS 2's wheels: \
'make interfaces' in the folder of FogROS2 installs them.")
"""


def index_entries() -> list[tuple[str, list[str]]]:
    """Write the files beside the modules; say where they are installed."""
    entries: list[tuple[str, list[str]]] = []
    markers = Path('build', 'index')
    for name in ROS_PACKAGES:
        marker = markers / name
        (HERE / marker).parent.mkdir(parents=True, exist_ok=True)
        (HERE / marker).write_text('')
        entries.append(('share/ament_index/resource_index/packages', [str(marker)]))
    config = Path('build', 'ament_cmakeConfig.cmake')
    (HERE / config).write_text(NO_BUILD)
    entries.append((NO_BUILD_FOLDER, [str(config)]))
    return entries


def verbs(command: str, **classes: str) -> list[str]:
    """Give the entry points of a command's verbs, all of which live in one module."""
    return [f'{verb.rstrip("_")} = ros2cli.verb.{command}:{name}'
            for verb, name in classes.items()]


if (found := ros2_found()) is not None:
    sys.exit(f'{NAME} is for interpreters without ROS 2; this one has {found}: use that')

setup(
    name=NAME,
    version=VERSION,
    description="FogROS2's launch, launch_ros and ros2 where ROS 2 isn't installed",
    license='Apache-2.0',
    python_requires='>=3.10',
    packages=find_packages(str(HERE), exclude=['test', 'test.*', 'build', 'build.*']),
    package_data={'': ['py.typed', '*.xml']},
    data_files=index_entries(),
    # rclpy and the messages are pinned in fogros2/host/locked.txt: see tools/setup.sh
    install_requires=['numpy', 'PyYAML'],
    zip_safe=False,
    entry_points={
        'console_scripts': ['ros2 = ros2cli.script:main'],
        'ros2cli.command': [
            'launch = ros2cli.command.launch:LaunchCommand',
            'run = ros2cli.command.run:RunCommand',
            'pkg = ros2cli.command.verbs:PkgCommand',
            'topic = ros2cli.command.verbs:TopicCommand',
            'node = ros2cli.command.verbs:NodeCommand',
            'service = ros2cli.command.verbs:ServiceCommand',
            'param = ros2cli.command.verbs:ParamCommand',
        ],
        'ros2topic.verb': verbs(
            'topic', list='ListVerb', info='InfoVerb')
        + ['echo = ros2cli.verb.topic_echo:EchoVerb', 'pub = ros2cli.verb.topic_pub:PubVerb',
           'hz = ros2cli.verb.topic_rate:HzVerb'],
        'ros2node.verb': verbs('node', list='ListVerb', info='InfoVerb'),
        'ros2service.verb': verbs('service', list='ListVerb', call='CallVerb'),
        'ros2param.verb': verbs('param', list='ListVerb', get='GetVerb', set='SetVerb'),
        'ros2pkg.verb': verbs(
            'pkg', list='ListVerb', prefix='PrefixVerb', executables='ExecutablesVerb'),
    },
)
