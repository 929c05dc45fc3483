# SPDX-License-Identifier: Apache-2.0
"""
Containers beside nodes and nodes in images: with the engine of this computer, as on a machine that
is reached by SSH, and with one of its own on a container machine.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import dataclasses
import json
import os
from pathlib import Path
import re
import secrets
import shlex
import signal
import subprocess

import pytest

from fogros2 import plan
from fogros2.errors import CommandError, ConfigurationError, DdsError
from fogros2.model import Command, CreateRequest, MachineSpec, NodeSpec
from fogros2.process import last_error, run, which
from fogros2.provider.container import ContainerProvider
from fogros2.provider.container import engine as container_engine
from fogros2.provider.container import root as container_root
from fogros2.waiting import wait_until
from fogros2_features.containers import commands as containers
from fogros2_features.containers.commands import Container
from rigs.launched import launching, ros2


@pytest.fixture(scope='module')
def image(engine: str, busybox: Path) -> Iterator[str]:
    """Import an image that holds busybox alone."""
    name = f'localhost/fogt-{secrets.token_hex(4)}:1'
    run(Command((engine, 'import', str(busybox), name), sudo=True), timeout=60)
    yield name
    run(Command((engine, 'rmi', '-f', name), sudo=True), timeout=60)


@pytest.fixture
def launch(engine: str) -> Iterator[str]:
    """Return the id of a launch, of which no container is left after."""
    name = secrets.token_hex(3)
    yield name
    at_machine(containers.remove(name))
    assert there(name) == []


#: What a launch tells containers of its DDS.
VARIABLES = 'RMW_IMPLEMENTATION=rmw\nROS_DOMAIN_ID=7\nROS_STATIC_PEERS=a b\n'


def at_machine(command: Command) -> str:
    """
    Run what a launch runs on a machine, here, and return what it prints.

    As root: the login user of a machine has root without a password, and the user who runs the
    tests may have it at this terminal alone, where not all of a shell's commands run.
    """
    return run(dataclasses.replace(command, sudo=True), timeout=60).stdout


def settings(folder: Path) -> Path:
    """Write a middleware's configuration."""
    path = folder / 'dds.xml'
    path.write_text('settings of DDS\n')
    return path


def there(launch: str) -> list[str]:
    return run(Command(('podman', 'ps', '-a', '--format', '{{.Names}} {{.State}}', '--filter',
                        f'label={containers.LABEL}={launch}'), sudo=True), timeout=60,
               ).stdout.splitlines()


def begun(words: Sequence[str], folder: Path, **variables: str) -> subprocess.Popen[str]:
    """Start what the agent would start."""
    return subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env={**os.environ, 'FOGROS2_AGENT_DIRECTORY': str(folder), **variables})


def started(container: Container, launch: str, folder: Path) -> subprocess.Popen[str]:
    """Start a container as a deployment does, and follow it as the agent does."""
    assert at_machine(containers.FIND).strip() == 'podman'
    image = at_machine(containers.fetch(container.image)).strip()
    (folder / 'variables').write_text(VARIABLES)
    at_machine(containers.run(container, 0, launch, image, str(settings(folder)),
                              str(folder / 'variables')))
    (folder / containers.FOLLOWER).write_text(containers.follower(launch))
    words = containers.follow(container, 0).arguments
    return begun([str(word) for word in words], folder)


def limited(image: str, *command: str, restart: str = '') -> Container:
    return Container(
        image, (*container_engine.limits(), '--net', 'none'), command, restart=restart)


def node(image: str, launch: str, folder: Path, *command: str, options: Sequence[str] = (),
         **variables: str) -> subprocess.Popen[str]:
    """Start a node in an image as the agent does."""
    made = containers.inside(
        NodeSpec('1', 'n-1', arguments=command, sigkill_timeout=1.5, features={
            'containers': {'image': image,
                           'image_options': (*container_engine.limits(), *options)}}),
        image, launch, str(folder), str(settings(folder)), ('COLOUR',))
    for key, text in made.files.items():
        (folder / key).write_text(str(text))
    return begun([word if isinstance(word, str) else str(folder / word[0]['file'])
                  for word in made.arguments], folder, **variables)


@pytest.fixture
def foreign(engine: str, tmp_path: Path) -> Iterator[str]:
    """Import an image whose programs are for a processor that this computer has not."""
    here = os.uname().machine
    word, number = ('amd64', 62) if here == 'aarch64' else ('arm64', 183)
    archive = container_root.Archive()
    archive.file('bin/sh', b'\x7fELF\x02\x01\x01' + bytes(9) + b'\x02\0' + bytes([number])
                 + bytes(45), 0o755)
    path, name = tmp_path / 'image.tar', f'localhost/fogt-{secrets.token_hex(4)}:1'
    path.write_bytes(archive.data())
    run(Command((engine, 'import', '--arch', word, str(path), name), sudo=True), timeout=60)
    yield name
    run(Command((engine, 'rmi', '-f', name), sudo=True), timeout=60)


def test_image_for_another_processor_is_named(foreign: str, image: str) -> None:
    podman = container_engine.podman()
    # as a container machine, before it is created
    with pytest.raises(ConfigurationError, match='processors, and this computer has'):
        container_engine.check_architecture(podman, foreign)
    for unknown in (image, 'localhost/never-heard-of:1'):
        container_engine.check_architecture(podman, unknown)
    # for a node, on a machine that shows which emulators it has: none
    fetch = containers.fetch(foreign)
    with pytest.raises(CommandError) as caught:
        at_machine(dataclasses.replace(fetch, argv=(
            'unshare', '--mount', 'sh', '-ec',
            'mount -t tmpfs none /proc/sys/fs/binfmt_misc; : >/proc/sys/fs/binfmt_misc/status; '
            'exec "$@"', 'sh', *fetch.argv)))
    assert 'processors, and the machine has' in last_error(
        caught.value.result.stderr)


def test_failed_container_restarts_as_often_as_allowed(image, launch, tmp_path):
    follower = started(
        limited(image, 'sh', '-c', 'echo up; exit 3', restart='on-failure:1'), launch, tmp_path)
    said = follower.communicate(timeout=60)[0].splitlines()
    assert (said.count('up'), follower.returncode) == (2, 3)
    assert sum('is started again' in line for line in said) == 1
    assert there(launch) == []


def test_container_stops_with_its_follower(image, launch, tmp_path):
    follower = started(limited(
        image, 'sh', '-c', "trap 'echo bye; exit 7' TERM; echo up; "
        'while :; do busybox sleep 0.1; done',
        restart='always'), launch, tmp_path)
    assert follower.stdout.readline() == 'up\n'
    assert [line.split()[1].lower() for line in there(launch)] in (['up'], ['running'])
    follower.send_signal(signal.SIGINT)
    assert follower.communicate(timeout=60)[0].strip() == 'bye'
    assert follower.returncode == 7
    assert there(launch) == []


def test_removed_container_is_not_restarted(image, launch, tmp_path):
    follower = started(limited(
        image, 'sh', '-c', 'echo up; exec busybox sleep 1000', restart='always'), launch, tmp_path)
    assert follower.stdout.readline() == 'up\n'
    at_machine(containers.remove(launch))
    follower.communicate(timeout=60)
    assert follower.returncode != 0


def test_container_has_machine_s_network_and_dds(image, launch, tmp_path):
    mine = tmp_path / 'mine'
    mine.write_text('ROS_DOMAIN_ID=8\n')
    options = (*container_engine.limits(), '--user', '1234', '--env-file', str(mine),
               '-e', 'RMW_IMPLEMENTATION=mine')
    follower = started(Container(image, options, (
        'sh', '-c', 'echo $RMW_IMPLEMENTATION $ROS_DOMAIN_ID "$ROS_STATIC_PEERS"; '
        f'busybox cat {tmp_path}/dds.xml; busybox ls -L /proc/self/ns/net -i')), launch, tmp_path)
    said = follower.communicate(timeout=60)[0].splitlines()
    # the launch file's own come first, from a file as from an option
    assert said[:2] == ['mine 8 a b', 'settings of DDS']
    assert said[2].split()[0] == str(os.stat('/proc/self/ns/net').st_ino)


# --- nodes in images -----------------------------------------------------------------------------

def test_node_in_an_image_has_variables_files_and_user(image, launch, tmp_path):
    process = node(
        image, launch, tmp_path, 'sh', '-c',
        'echo $RMW_IMPLEMENTATION "$COLOUR" $HOME ${SECRET-none}; '
        'busybox cat ${CYCLONEDDS_URI##*file://}; busybox id -u; busybox hostname; '
        f'busybox touch {tmp_path}/dds.xml; exit 5',
        CYCLONEDDS_URI=f'<a/>,file://{settings(tmp_path)}', RMW_IMPLEMENTATION='rmw',
        COLOUR='dark red', SECRET='s')
    said = process.communicate(timeout=60)[0].splitlines()
    assert said[:4] == [
        'rmw dark red /tmp none', 'settings of DDS', str(os.geteuid()), os.uname().nodename]
    assert 'Read-only' in said[4]
    assert process.returncode == 5
    assert there(launch) == []
    assert not list(tmp_path.glob('variables-*'))


#: The container's first process runs the node's shell, as an init and some entry points do.
BELOW = ('--entrypoint', json.dumps(['sh', '-c', '"$@"; exit $?', 'entry']))


@pytest.mark.parametrize(('trapped', 'asked', 'returncode', 'options'), [
    ("trap 'exit 4' INT USR1 TERM", (signal.SIGINT, signal.SIGUSR1, signal.SIGTERM), 4, ()),
    ("trap 'exit 4' INT USR1 TERM", (signal.SIGINT,), 4, BELOW),
    ("trap '' TERM", (signal.SIGTERM,), -signal.SIGKILL, ())])
def test_node_in_an_image_ends_by_its_first_signal(
        image, launch, tmp_path, trapped, asked, returncode, options):
    process = node(image, launch, tmp_path, 'sh', '-c',
                   f'{trapped}; echo up; while :; do busybox sleep 0.01; done', options=options)
    assert process.stdout.readline() == 'up\n'
    for number in asked:
        process.send_signal(number)
    process.communicate(timeout=60)
    assert process.returncode == returncode
    assert there(launch) == []


@pytest.mark.parametrize('moment', ['variables-*', 'container-there'])
def test_node_interrupted_before_its_start_ends(image, launch, tmp_path, moment):
    process = node(image, launch, tmp_path, 'sh', '-c', 'exec busybox sleep 1000')
    wait_until(lambda: there(launch) if moment == 'container-there'
               else list(tmp_path.glob(moment)), timeout=60, longest=0.01, what=moment)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode != 0
    assert there(launch) == []


# --- on a container machine ----------------------------------------------------------------------

LAUNCH_FILE = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    machine = ContainerInstance(name={name!r}, network={network!r}, mounts={mounts!r})
    machine.add_docker_container(
        image='oci-archive:{images}/box.tar', name='box', ports=['8080:80'], command=['sh', '-c', (
            'trap "exit 0" TERM; echo in the box; while :; do busybox sleep 0.1; done')])
    machine.add_docker_container({line!r})
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='demo', executable='program', name='demo',
                  image='oci-archive:{images}/ros.tar', output='screen'),
        CloudNode(machine=machine, package='fogros2_examples', executable='talker', name='talker',
                  image='oci-archive:{images}/system.tar', image_options={options!r},
                  respawn=True, output='screen'),
        Node(package='fogros2_examples', executable='listener', output='screen'),
        Node(package='fogros2_examples', executable='listener', name='answered', output='screen',
             remappings=[('chatter', 'answers')])])
"""

#: Stands for the programs in the images of FogROS2's examples: answers what it hears.
ANSWERING = """
import sys
import rclpy
from rclpy.executors import ExternalShutdownException
from std_msgs.msg import String

rclpy.init()
node = rclpy.create_node(sys.argv[1])
answers = node.create_publisher(String, 'answers', 10)
node.create_subscription(String, 'chatter', lambda message: answers.publish(
    String(data=f'{sys.argv[1]} answers {message.data}')), 10)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, ExternalShutdownException):
    pass
"""
ANSWERING_FILE = """
from fogros2 import CloudNode, ContainerInstance, FogROSLaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    machine = ContainerInstance(name={name!r}, network={network!r}, mounts={mounts!r})
    for line in {lines!r}:
        machine.add_docker_container(line)
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='talker',
                  remappings=[('chatter', 'elsewhere')]),
        Node(package='fogros2_examples', executable='talker'),
        Node(package='fogros2_examples', executable='listener', output='screen',
             remappings=[('chatter', 'answers')])], dds={dds!r})
"""
#: The line of BerkeleyAutomation/fogros2-examples (gqcnn, vslam) but for image and command. The
#: other one's image (mpt) has Cyclone DDS set by its entry point, and no line of its own.
LINES = {
    'gqcnn': 'sudo docker run --net=host --env RMW_IMPLEMENTATION=rmw_cyclonedds_cpp '
             '--env CYCLONEDDS_URI=file:///tmp/cyclonedds.xml '
             '-v /home/ubuntu/cyclonedds.xml:/tmp/cyclonedds.xml --rm -it ',
    'mpt': 'docker run ',
}


def answering_line(name: str, folder: Path, images: Path, with_python: Sequence[str]) -> str:
    """Write the answering program, and return the line of a container that runs it."""
    program = folder / 'answering.py'
    program.write_text(ANSWERING)
    return LINES[name] + shlex.join([
        *with_python, '-v', f'{program}:/answering.py', f'oci-archive:{images}/system.tar',
        'python3', '/answering.py', name])


@pytest.mark.usefixtures('nothing_left')
@pytest.mark.skipif(which('ros2') is None, reason='needs ros2 on PATH')
@pytest.mark.parametrize(('rmw', 'names'), [
    ('rmw_cyclonedds_cpp', ['gqcnn', 'mpt']), ('rmw_zenoh_cpp', ['mpt'])])
def test_container_s_node_and_robot_hear_each_other(
        images, crun, with_python, cloud_network, tmp_path, monkeypatch, rmw, names):
    try:
        plan.check_rmw(rmw, plan.ament_prefixes(os.environ), ())
    except DdsError as error:
        pytest.skip(str(error))
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    lines = [answering_line(name, tmp_path, images, with_python) for name in names]
    path = tmp_path / 'answering.launch.py'
    path.write_text(ANSWERING_FILE.format(
        name=f'boxes-{secrets.token_hex(3)}', network=cloud_network, lines=lines, dds=rmw,
        mounts=[str(images), f'{tmp_path}/answering.py', *crun]))
    with launching() as start:
        launched = start(str(path))
        for name in names:
            launched.wait_for(f'I heard: [{name} answers Hello World from ')
        launched.interrupt()
        assert launched.ended() == 0, launched.text


def words(*command: str) -> set[str]:
    return set(run(Command(('podman', *command), sudo=True), timeout=30).stdout.split())


@pytest.mark.usefixtures('nothing_left')
@pytest.mark.skipif(which('ros2') is None, reason='needs ros2 on PATH')
def test_container_machine_runs_containers_and_images(
        images, crun, with_python, cloud_network, tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    name = f'boxes-{secrets.token_hex(3)}'
    path = tmp_path / 'boxes.launch.py'
    path.write_text(LAUNCH_FILE.format(
        name=name, network=cloud_network, images=images, options=with_python,
        line=answering_line('mpt', tmp_path, images, with_python),
        mounts=[str(images), f'{tmp_path}/answering.py', *crun]))
    with launching() as start:
        launched = start(str(path))
        launched.wait_for(f'I heard: [Hello World from {name} ')
        volumes = words('inspect', '--format', '{{range .Mounts}}{{.Name}} {{end}}',
                        f'fogros2-{name}')
        launched.wait_for('I heard: [mpt answers Hello World from ')
        launched.wait_for('it has demo librmw_fastrtps_cpp.so for rmw_fastrtps_cpp and was '
                          'told --ros-args')
        status = ros2('fog', 'status', name).stdout
        assert re.search(r'talker-\d +running', status) and re.search(r'box-\d +running', status)
        wait_until(lambda: '] in the box' in ros2('fog', 'logs', name).stdout, timeout=60,
                   what='what the container said')
        # by whatever its end comes, launch sees it as of any process
        run(Command(('podman', 'exec', f'fogros2-{name}', 'pkill', '-KILL', '-f',
                     '^[^ ]*python3 .*lib/fogros2_examples/talker'), sudo=True), timeout=30)
        launched.wait_for('exit code -9')
        launched.wait_for('Hello World from', times=launched.text.count('Hello World from') + 2)
        launched.interrupt()
        assert launched.ended() == 0, launched.text
        assert len([line for line in launched.errors if name in line]) == 1, launched.text
    # what it downloaded went with it
    assert volumes and not volumes & words('volume', 'ls', '-q')


def test_restarted_machine_runs_containers_again(images, crun, cloud_network):
    name = f'boxes-{secrets.token_hex(3)}'
    machines = ContainerProvider()
    machine = machines.create(
        MachineSpec(name, 'container', {'network': cloud_network, 'containers': True,
                                        'mounts': [str(images), *crun]}, on_exit='stop'),
        CreateRequest(secrets.token_hex(8), 'ssh-ed25519 AAAA', {}, 51820))

    def said(script: str, check: bool = True) -> str:
        return run(Command(('podman', 'exec', f'fogros2-{name}', 'sh', '-ec', script), sudo=True),
                   timeout=60, check=check).stdout

    def up() -> None:
        wait_until(lambda: said('pgrep -x sshd', check=False), timeout=60, what='the machine')

    try:
        up()
        said(f'podman run -q -d --name one oci-archive:{images}/box.tar busybox sleep 1000')
        machines.stop(machine)
        machines.start(machine)
        up()
        # the one from before doesn't run, and its image is there
        assert said('podman ps -q; podman rm -f one >/dev/null; '
                    'podman run --rm $(podman images -q) sh -c "echo again"') == 'again\n'
    finally:
        machines.destroy(machine)
