# SPDX-License-Identifier: Apache-2.0
"""``docker run`` lines, and what is made of them."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
import dataclasses
import os
from pathlib import Path
import signal
import subprocess
from types import SimpleNamespace
from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.launch_description_sources import get_launch_description_from_any_launch_file
import pytest

from fogros2.actions.nodes import CloudNode
from fogros2.dds.cyclonedds import CycloneDds
from fogros2.dds.fastdds import FastDds
from fogros2.dds.zenoh import Zenoh
from fogros2.deploy import Launch
from fogros2.describe import values
from fogros2.describe.machines import ContainerInstance
from fogros2.errors import (
    ConfigurationError,
    ConnectError,
    DdsError,
    PrerequisiteError,
    Unsupported,
)
from fogros2.model import Command, MachineSpec, NodeSpec, Result
from fogros2.provider.container import ContainerProvider
from fogros2.store import Store
from fogros2_features.containers import commands as containers
from fogros2_features.containers import Containers, docker_lines
from fogros2_features.containers.commands import Container, parse
from fogros2_features.containers.engine import Engine
from fogros2_testing.fakes import FakeProvider, FakeRunning, FakeShell
from rigs import deploying


def of(*lines: str) -> dict[str, Any]:
    """Return the features of a machine with containers."""
    return {'containers': {'docker_containers': list(lines)}}


def in_image(image: str, *options: str) -> dict[str, Any]:
    """Return the features of a node in an image."""
    return {'containers': {'image': image, 'image_options': options}}


@pytest.mark.parametrize(('line', 'meant'), [
    ('docker run hello', Container('hello')),
    ('sudo docker run -d --rm -p 8080:8080 lichtblick',
     Container('lichtblick', ('-p', '8080:8080'))),
    ('/usr/bin/podman container run -it --net=host -v /a:/b:ro -e X=1 r.io/a/b:1 run --fast -d',
     Container('r.io/a/b:1', ('--net', 'host', '-v', '/a:/b:ro', '-e', 'X=1'),
               ('run', '--fast', '-d'))),
    ('docker run -dit --privileged --name eyes --gpus all --ipc=host image',
     Container('image', ('--privileged', '--ipc', 'host'), (), 'all', 'eyes')),
    ('docker run -it=true --rm=true dir:/a/B@c image', Container('dir:/a/B@c', (), ('image',))),
    ('docker run -p8080:80 -e=X=1 -dP -- image',
     Container('image', ('-p', '8080:80', '-e', 'X=1', '-P'))),
    ('docker run -dp 3000:3000 -itv/a:/b -de A=b -Pdw /x image',
     Container('image', ('-p', '3000:3000', '-v', '/a:/b', '-e', 'A=b', '-P', '-w', '/x'))),
    ("docker run -e 'A=b c' --restart always image sh -c 'echo hi'",
     Container('image', ('-e', 'A=b c'), ('sh', '-c', 'echo hi'), restart='always')),
    # the beginning of a pasted line
    ('sudo -n -H docker run image', Container('image')),
    ('docker run \\\n  --rm \\\n  image  # the agent', Container('image')),
])
def test_a_line_is_understood(line, meant):
    assert parse(line) == meant


@pytest.mark.parametrize(('line', 'why'), [
    ('', 'no line of docker'), ('ls', 'no line of docker'), ('docker ps', 'runs nothing'),
    ('docker run', 'no image'), ('docker run -d', 'no image'), ('docker run -p', 'nothing after'),
    ("docker run 'image", 'no command line'), ("docker run '' ls", "has ''"),
    ('docker run –rm image', "has '–rm' where the image"), ('docker run “image”', 'has .“image”'),
])
def test_what_is_none_is_refused(line, why):
    with pytest.raises(ConfigurationError, match=why):
        parse(line)


@pytest.mark.parametrize('line', [
    'a  b\tc', 'a \\\n  b \\\n\tc', 'a\\\nb', 'a \\\r\n b', "a 'b  c' \"d  e\"", 'a "" \'\' b',
    'a\\ b \\$c', '$HOME/x ${HOME}/x "$HOME"/x "${HOME} x" \'$HOME\'', '~ ~/x x~ x=~/y "~"',
    '$PWD "$(pwd)" `pwd`', '$(id -u):$(id -g) "`id -un`" $(hostname) $(uname -m)',
    '${FOGT_NO:-/d} "${FOGT_NO-}" ${HOME:-x}', 'a # b $(c) > d', 'a#b c#',
    r'"\"" "\$HOME" "\\" "\n"', '"a\\\nb"', 'x$ "y$" a=b c:d e,f @% ^ ! [ ] { }',
    '"it\'s" \'say "x"\'', 'ä"ö ü" \'\u2028\'', '"a; b && c | d > e" \'$(f) `g`\'', 'a \\'])
def test_words_are_those_of_a_shell(line, tmp_path):
    def split(script: str) -> list[str]:
        done = subprocess.run(['sh', '-efc', script], capture_output=True, text=True, check=True,
                              cwd=tmp_path, env={**os.environ, 'HOME': '/home/ro bot'})
        return done.stdout.split('\0')[:-1]

    # a shell splits what is not in quotes; here every word stays one
    theirs = split('IFS=\nprintf "%s\\0" ' + line.replace('\r\n', '\n').removesuffix('\\'))
    ours = split('printf "%s\\0" ' + ' '.join(map(docker_lines.expression,
                                                  docker_lines.words(line))))
    assert ours == theirs


@pytest.mark.parametrize(('more', 'named'), [
    ('&& echo done', '&& echo done'), ('; docker run b', '; docker run b'), ('| tee log', '| tee'),
    ('&', '&'), ('> /dev/null 2>&1', '> /dev/null'), ('< x', '< x'), ('|| true', r'\|\| true'),
    ('\ndocker run b', 'a second line'), ('$(cat x)', r'\$\(cat x\)'), ('`date`', '`date`'),
    ('"$(date)"', r'\$\(date\)'), ('$1', r'\$1'), ('$$', r'\$\$'), ('$@', r'\$@'),
    ('${X%.*}', r'\$\{X%'), ("$'a'", r"\$'a'"), ('~bob/x', '~bob/x'), ('(a)', r'\(a\)'),
    ("'a", 'a quote has no end'), ('"a', 'a quote has no end'), ('\0$(x)\0', 'a NUL character')])
def test_what_takes_more_of_a_shell_is_refused(more, named):
    for line in (f'docker run image {more}', f'docker run -e A=b image {more}'):
        with pytest.raises(ConfigurationError, match=named):
            parse(line)
    machine = ContainerInstance(name='m')
    with pytest.raises(ConfigurationError, match=named):
        machine.add_docker_container(f'docker run image {more}')


@pytest.mark.parametrize(('line', 'named'), [
    ('sudo -u fog docker run a', '-u of sudo'), ('X=1 docker run a', 'sets X=1'),
    ('sudo DOCKER_HOST=a docker run a', 'sets DOCKER_HOST=a'), ('X=1 sudo docker run a', 'X=1'),
    ('docker --context b run a', "--context in front of 'run'"), ('docker -H b run a', '-H in'),
    ('docker run --no-trunc a b', '--no-trunc, which is no option'), ('docker run -k a b', '-k, '),
    ('docker run --volums /a:/b a', "volums.*did you mean '--volume'"),
    ('docker run $IMAGE', 'has \\${IMAGE} as image'), ('docker run a/$USER', r'\${USER} as im'),
    ('docker run --name $X a', r'\${X} as image, name'), ('docker run $OPTIONS a', 'OPTIONS} as')])
def test_part_of_a_line_that_cannot_work_is_named(line, named):
    with pytest.raises(ConfigurationError, match=named):
        parse(line)


def test_container_gets_values_of_the_machine(engine, tmp_path):
    container = parse('docker run -v ~/maps:/maps -v "$HOME/my maps":/more -e A=\'$HOME\' '
                      '--user "$(id -u)" -e B=${FOGT_NO:-b} image sh -c "ls $HOME"')
    told = done(containers.run(container, 0, 'abc', 'image', '/run/dds.xml', ''),
                HOME='/home/robot')[1]
    assert told[-1].endswith(
        '-v /home/robot/maps:/maps -v /home/robot/my maps:/more -e A=$HOME '
        f'--user {os.getuid()} -e B=b image sh -c ls /home/robot')
    assert told[-1].startswith(f'{engine} run -d --name fogros2-abc-0-image --label ')


@pytest.mark.parametrize(('name', 'text'), [
    ('a.launch.yaml', """
launch:
- fog_machine:
    name: m
    provider: container
    docker_container:
    - cmd: |
        docker run \\
          --rm \\
          -v $HOME/maps:/maps \\
          image:7
"""), ('a.launch.xml', """<launch><fog_machine name="m" provider="container">
  <docker_container cmd="docker run \\
      --rm \\
-v $HOME/maps:/maps image:7"/></fog_machine></launch>"""),
    ('b.launch.xml', """<launch><let name="v" value="7"/>
  <fog_machine name="m" provider="container">
  <docker_container cmd="docker run \\
      --rm -v $HOME/maps:/maps image:$(var v)"/></fog_machine></launch>""")])
def test_line_continues_in_a_launch_file(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    description = get_launch_description_from_any_launch_file(str(tmp_path / name))
    context = LaunchContext()
    context.launch_configurations['v'] = '7'
    [line] = description.entities[-1].machine.spec(context).features['containers'][
        'docker_containers']
    container = parse(line)
    assert container == Container('image:7', ('-v', '\0${HOME}\0/maps:/maps'))


@pytest.mark.parametrize(('name', 'text'), [
    ('a.launch.yaml', 'launch: [{fog_machine: {name: m, provider: container, docker_container: '
                      '[{cmd: docker run a > b}]}}]'),
    ('a.launch.xml', '<launch><fog_machine name="m" provider="container"><docker_container '
                     'cmd="docker run a &gt; b"/></fog_machine></launch>')])
def test_wrong_line_is_refused_when_the_file_is_read(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(Exception, match='has > b where a shell'):
        get_launch_description_from_any_launch_file(str(tmp_path / name))


def test_container_belongs_to_a_machine(tmp_path):
    with pytest.raises(AttributeError, match="'ContainerInstance' object has no .*'add_dockers'"):
        ContainerInstance(name='m').add_dockers('docker run a')
    path = tmp_path / 'a.launch.xml'
    path.write_text('<launch><docker_container cmd="docker run a"/></launch>')
    (alone,) = get_launch_description_from_any_launch_file(str(path)).entities
    with pytest.raises(ConfigurationError, match='a docker_container runs on a machine'):
        alone.execute(LaunchContext())


def test_parts_make_a_line():
    line = containers.described(
        'image:1', command='run --fast', ports=['80:8080'], environment={'A': 'b c'},
        volumes=['/x:/y'], gpus=1, restart='always', name='eyes')
    assert parse(line) == Container(
        'image:1', ('-p', '80:8080', '-e', 'A=b c', '-v', '/x:/y'),
        ('run', '--fast'), '1', 'eyes', 'always')


def test_each_launch_has_names_of_its_own():
    named, unnamed = Container('r.io/a/b:1', name='my eyes'), Container('r.io/a/b:1')
    assert containers.called(named, 0, 'abcdef') == 'fogros2-abcdef-0-my-eyes'
    assert containers.called(unnamed, 1, 'abcdef') == 'fogros2-abcdef-1-b-1'
    node = containers.follow(unnamed, 1)
    assert (node.name, node.arguments[-2], node.passes_signals) == ('b-1', '1-b-1', True)
    assert 'name=fogros2-abcdef-$1 ' in containers.follower('abcdef')


def test_arguments_of_a_machine_are_checked_at_once():
    machine = ContainerInstance(name='m')
    machine.add_docker_container('docker run image')
    machine.add_docker_container(image='image', ports=['80:80'])
    for wrong in ({}, {'cmd': 'docker run a', 'image': 'b'}, {'cmd': 'docker run a', 'ports': []},
                  {'cmd': 'docker ps'}, {'image': 'a', 'port': '80:80'}):
        with pytest.raises(ConfigurationError) as error:
            machine.add_docker_container(**wrong)
    assert 'ports' in error.value.hint


def test_machine_without_containers_is_refused_first(monkeypatch):
    monkeypatch.setattr(ContainerProvider, 'check_containers', lambda self, spec: (
        super(ContainerProvider, self).check_containers(spec)))
    # a computer without sudo makes no machine, and this test makes none
    monkeypatch.setattr('fogros2.deploy.launch.check_robot', lambda: None)
    launch = Launch()
    spec = MachineSpec('m', 'container', features=of('docker run image'))
    with pytest.raises(Unsupported, match='rights that an engine needs'):
        launch.prepare([spec])
    launch.down()


# --- nodes in images -----------------------------------------------------------------------------

@pytest.mark.parametrize(('image', 'name'), [
    ('ros:jazzy-perception', 'docker.io/library/ros:jazzy-perception'),
    ('example/mapper:2', 'docker.io/example/mapper:2'),
    ('ghcr.io/a/b@sha256:00', 'ghcr.io/a/b@sha256:00'),
    ('localhost/a', 'localhost/a'), ('host:5000/a', 'host:5000/a'),
    ('oci-archive:/tmp/a.tar', 'oci-archive:/tmp/a.tar'), ('docker://ros', 'docker://ros'),
])
def test_short_names_are_docker_s(image, name):
    assert containers.qualified(image) == name


def test_node_in_an_image_has_the_arguments_of_the_node():
    node = NodeSpec(
        '1', 'eyes-1', 'demo', 'talker', ('--ros-args', '--params-file', ({'file': 'p'},)),
        prefix=('nice', '-n', '5'), files={'p': 'a: 1'},
        environment={'COLOUR': 'red', 'no-name': ''}, cwd='/data', respawn=True,
        features={**in_image('demo:1', '--gpus=all', '-v', '/a:/b'), 'mine': {'a': 1}})
    made = containers.inside(node, 'demo:1', 'abcdef', '/ws', '/run/dds.xml', {'MORE': '1'})
    assert (made.package, made.executable, made.features) == ('', '', {'mine': {'a': 1}})
    assert (made.cwd, made.prefix, made.passes_signals) == (None, (), True)
    assert (made.respawn, made.environment) == (True, node.environment)
    outer, inner = made.arguments[1], made.arguments[6]
    assert made.arguments == (
        'sh', outer, 'fogros2-abcdef-eyes-1', 'all', '/ws', '4', inner,
        '--label', 'fogros2-launch=abcdef', '--network', 'host', '--ipc', 'host',
        '-v', '/run/dds.xml:/run/dds.xml:ro', '-v', '/a:/b',
        '-v', ({'file': 'p'}, ':', {'file': 'p'}, ':ro'), '-w', '/data',
        'demo:1', 'sh', inner, '/ws', 'demo', 'talker', 'nice -n 5',
        '--ros-args', '--params-file', ({'file': 'p'},))
    script = made.files[outer[0]['file']]
    assert ' COLOUR ' in script and ' MORE ' in script and 'RMW_IMPLEMENTATION' in script
    assert 'no-name' not in script and '@' not in script.replace('"$@"', '')
    assert made.files['p'] == 'a: 1'


@pytest.mark.parametrize('wrong', [['image2'], ['-v'], ['--', 'sh']])
def test_options_of_an_image_are_options_alone(wrong):
    with pytest.raises(ConfigurationError):
        containers.node_container('image', wrong)


def test_container_machine_has_the_requested_rights():
    def options(machine):
        return machine.spec(LaunchContext()).options

    plain, told, asked = (ContainerInstance(name=name) for name in 'abc')
    CloudNode(machine=plain, package='p', executable='e')
    told.add_docker_container('docker run image')
    CloudNode(machine=asked, package='p', executable='e', image='image')
    assert 'containers' not in options(plain)
    # among its options, so that one which an earlier launch kept without isn't taken for it
    assert options(asked)['containers'] is options(told)['containers'] is True
    provider = ContainerProvider()
    for machine in (told, asked):
        provider.check_containers(machine.spec(LaunchContext()))
    refused = ContainerInstance(name='d', containers=False)
    CloudNode(machine=refused, package='p', executable='e', image='image')
    for machine in (plain, refused):
        with pytest.raises(Unsupported, match='containers=True'):
            provider.check_containers(machine.spec(LaunchContext()))


def test_image_options_are_a_list_for_an_image():
    for wrong in ('--gpus=all', ['-v']):
        with pytest.raises(ConfigurationError, match='image_options'):
            CloudNode(machine='m', package='p', executable='e', image='a', image_options=wrong)
    node = NodeSpec('1', 'n', features={'containers': {'image_options': ['--gpus=all']}})
    with pytest.raises(ConfigurationError, match=r"image_options=\['--gpus=all'\] is no list"):
        Containers().check_node(MachineSpec('m', 'container'), node, ())


@pytest.mark.parametrize('options', ['--gpus=all, --init', '$(var options)'])
def test_an_image_is_an_attribute_in_xml(tmp_path, options):
    path = tmp_path / 'a.launch.xml'
    path.write_text(f"""<launch><cloud_node machine="m" pkg="p" exec="e" image="ros:jazzy"
        image_options="{options}"/></launch>""")
    description: LaunchDescription = get_launch_description_from_any_launch_file(str(path))
    (node,) = description.entities
    context = LaunchContext()
    context.launch_configurations['options'] = '--gpus=all, --init'
    assert values.resolve(context, node._features) == {
        'image': 'ros:jazzy', 'image_options': ['--gpus=all', '--init']}


# --- DDS -----------------------------------------------------------------------------------------

FILE = ('-v', '/run/dds.xml:/run/dds.xml:ro')
#: As BerkeleyAutomation/fogros2-examples has them, for grasp planning and for SLAM; its motion
#: planner runs as a node, in an image like these.
GQCNN = ('sudo docker run --net=host --env RMW_IMPLEMENTATION=rmw_cyclonedds_cpp --env '
         'CYCLONEDDS_URI=file:///tmp/cyclonedds.xml -v /home/ubuntu/cyclonedds.xml:'
         '/tmp/cyclonedds.xml --rm -it keplerc/gqcnn_ros:pj ros2 launch gqcnn_ros '
         'planner.launch.py')


@pytest.mark.parametrize(('options', 'became'), [
    ('', ('--env-file', '/run/v', '--network', 'host', '--ipc', 'host', *FILE)),
    ('-e ROS_DOMAIN_ID=3 --env-file mine', (
        '--env-file', '/run/v', '--network', 'host', '--ipc', 'host', *FILE,
        '-e', 'ROS_DOMAIN_ID=3', '--env-file', 'mine')),
    ('--net=host --ipc=private', (
        '--env-file', '/run/v', *FILE, '--net', 'host', '--ipc', 'private')),
    ('--network host --shm-size=1g', (
        '--env-file', '/run/v', *FILE, '--network', 'host', '--shm-size', '1g')),
    # a network of its own
    ('--network none', ('--network', 'none')), ('--net=mine', ('--net', 'mine')),
    ('-p 80:8080', ('-p', '80:8080')), ('-P', ('-P',)),
    ('--publish-all=true', ('--publish-all=true',)), ('--ip=10.0.0.7', ('--ip', '10.0.0.7')),
])
def test_container_on_machine_network_joins_its_dds(options, became):
    container = parse(f'docker run {options} image')
    assert containers.dds_options(container, '/run/dds.xml', '/run/v') == became
    assert containers.on_machine_network(container) == ('--env-file' in became)


@pytest.mark.parametrize(('written', 'became'), [
    ('-v /home/ubuntu/cyclonedds.xml:/tmp/c.xml', ('-v', '/run/dds.xml:/tmp/c.xml')),
    ('-v/home/ubuntu/cyclonedds.xml:/tmp/c.xml:ro', ('-v', '/run/dds.xml:/tmp/c.xml:ro')),
    ('--volume=/home/ubuntu/cyclonedds.xml:/home/ubuntu/cyclonedds.xml',
     ('--volume', '/run/dds.xml:/home/ubuntu/cyclonedds.xml')),
    ('--mount type=bind,src=/home/ubuntu/cyclonedds.xml,dst=/c.xml,readonly',
     ('--mount', 'type=bind,src=/run/dds.xml,dst=/c.xml,readonly')),
    # these are the user's
    ('-v /home/ubuntu/cyclonedds.xml.1:/c.xml', ('-v', '/home/ubuntu/cyclonedds.xml.1:/c.xml')),
    ('-v /d:/home/ubuntu/cyclonedds.xml', ('-v', '/d:/home/ubuntu/cyclonedds.xml')),
    ('-e A=/home/ubuntu/cyclonedds.xml', ('-e', 'A=/home/ubuntu/cyclonedds.xml')),
])
def test_mount_of_fogros2_s_file_is_the_launch_s(written, became):
    container = parse(f'docker run {written} image')
    assert containers.dds_options(container, '/run/dds.xml')[-2:] == became


def test_fogros2_s_file_needs_cyclone_dds():
    containers.check(parse(GQCNN), 'rmw_cyclonedds_cpp')
    containers.check(parse('docker run image'), 'rmw_zenoh_cpp')
    for rmw in ('rmw_fastrtps_cpp', 'rmw_zenoh_cpp'):
        with pytest.raises(DdsError, match=f'keplerc/gqcnn_ros:pj.*have {rmw}'):
            containers.check(parse(GQCNN), rmw)


@pytest.mark.parametrize(('vendor', 'variables'), [
    (CycloneDds, 'CYCLONEDDS_URI=file:///run/dds.xml\n'
                 'RMW_IMPLEMENTATION=rmw_cyclonedds_cpp\nROS_DOMAIN_ID=7\n'),
    (FastDds, 'FASTRTPS_DEFAULT_PROFILES_FILE=/run/dds.xml\nRMW_IMPLEMENTATION=rmw_fastrtps_cpp\n'
              'ROS_AUTOMATIC_DISCOVERY_RANGE=SYSTEM_DEFAULT\nROS_DOMAIN_ID=7\n'
              'SKIP_DEFAULT_XML_FILE=1\n'),
    (Zenoh, 'RMW_IMPLEMENTATION=rmw_zenoh_cpp\nROS_DOMAIN_ID=7\n'
            'ZENOH_SESSION_CONFIG_URI=/run/dds.xml\n'),
])
def test_container_gets_variables_of_the_middleware(vendor, variables):
    environment = {'ROS_DOMAIN_ID': '7', 'PATH': '/bin', 'ROS_STATIC_PEERS': 'a\nb',
                   **vendor(7).environment('/run/dds.xml', {})}
    lines = containers.dds_variables(environment).splitlines(keepends=True)
    assert ''.join(line for line in lines if not line.endswith('=\n')) == variables


def test_container_keeps_no_dds_settings_of_its_image():
    lines = containers.dds_variables({}).splitlines()
    assert lines.count('ROS_DOMAIN_ID=0') == 1
    assert {'ROS_LOCALHOST_ONLY=', 'ROS_DISCOVERY_SERVER=', 'ROS_STATIC_PEERS='} < {*lines}


def test_containers_start_with_the_middleware_of_the_machine(engine, monkeypatch):
    monkeypatch.setenv('THERE', 'ros:jazzy web')
    shell = FakeShell(handlers={'sh': here})
    started(shell, [parse('docker run ros:jazzy'), parse('docker run -p 80:80 web')])
    text, mode = shell.files['/var/lib/agent/container-variables']
    assert b'RMW_IMPLEMENTATION=rmw_fastrtps_cpp\n' in text and b'ROS_DOMAIN_ID=7\n' in text
    assert mode == 0o600
    first, second = (line for line in notes() if ' run ' in line)
    assert first.endswith(
        ' --label fogros2-launch=abc --env-file /var/lib/agent/container-variables --network host'
        ' --ipc host -v /var/lib/agent/dds.xml:/var/lib/agent/dds.xml:ro ros:jazzy')
    assert second.endswith(' --label fogros2-launch=abc -p 80:80 web')
    # no middleware is brought to an image that has a network, or a middleware, of its own
    assert sum(' create ' in line for line in notes()) == 1


# --- the scripts, with an engine that notes its arguments ----------------------------------------

ENGINE = r"""#!/bin/sh
printf '%s\n' "$0 $*" >> "$NOTES"
case $1-$2 in
    image-inspect) for last; do :; done
        case " $THERE " in *" $last "*) ;; *) exit 1 ;; esac
        case $4 in
            *Env*) echo "ROS_DISTRO=$DISTRO" ;;
            *Cmd*) echo "$COMMAND" ;;
            *User*) echo "$OWNER" ;;
            *) echo sha256:0123456789abcdef ;;
        esac ;;
    pull-*) [ "$3" != "$WRONG" ] || { echo "Error: $3: manifest unknown" >&2; exit 125; }
        echo "$3" ;;
    create-*) for each; do case $each in
            */variables-*) cat "$each" >"$NOTES.variables" ;; esac; done
        echo looking ;;
    inspect-*) echo 0 ;;
    cp-*) for last in $HAS; do [ "$2" != "looking:$last" ] || exit 0; done; exit 1 ;;
    run-*) echo 'what apt says'
        [ -z "$ABANDONED" ] || kill -s TERM 0 ;;
esac
"""


@pytest.fixture(params=['podman', 'docker'])
def engine(request, tmp_path, monkeypatch):
    """Have one engine alone on PATH, beside what a shell needs."""
    folder = tmp_path / 'bin'
    folder.mkdir()
    for name, text in ((request.param, ENGINE), ('sudo', '#!/bin/sh\nshift\nexec "$@"\n')):
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    for name in ('cat', 'id', 'mktemp', 'rm', 'sed', 'sh', 'tail', 'tr', 'printf'):
        (folder / name).symlink_to(f'/bin/{name}' if Path(f'/bin/{name}').exists()
                                   else f'/usr/bin/{name}')
    monkeypatch.setenv('NOTES', str(tmp_path / 'notes'))
    monkeypatch.setenv('PATH', str(folder))
    return request.param


def done(command: Command, **variables: str) -> tuple[str, list[str]]:
    """Run a command here; return what it printed and what the engine was told."""
    Path(os.environ['NOTES']).unlink(missing_ok=True)
    said = subprocess.run(command.argv, env={**os.environ, **variables}, text=True, check=True,
                          stdout=subprocess.PIPE).stdout
    return said.strip(), notes()


def notes() -> list[str]:
    """Return what the engine was told so far."""
    path = Path(os.environ['NOTES'])
    lines = path.read_text().splitlines() if path.exists() else []
    return [line.rpartition('/bin/')[2] for line in lines]


def test_an_image_that_is_there_is_not_downloaded(engine):
    assert done(containers.fetch('ros:jazzy'), THERE='ros:jazzy')[0] == 'ros:jazzy'
    name, told = done(containers.fetch('ros:jazzy'))
    assert name == 'docker.io/library/ros:jazzy'
    assert f'{engine} pull -q docker.io/library/ros:jazzy' in told


def test_an_image_without_the_middleware_gets_it_once(engine):
    fetch = containers.fetch('ros:rolling', 'rmw_cyclonedds_cpp')
    set_up, library = '/opt/ros/rolling/setup.sh', '/opt/ros/rolling/lib/librmw_cyclonedds_cpp.so'
    made = 'localhost/fogros2-rmw_cyclonedds_cpp:0123456789ab'
    for has in ('', f'{set_up} {library}'):
        name, told = done(fetch, THERE='ros:rolling', DISTRO='rolling', HAS=has)
        assert name == 'ros:rolling'
        assert told[-1] == f'{engine} rm -f -v looking'
    name, told = done(fetch, THERE='ros:rolling', DISTRO='rolling', HAS=set_up)
    assert name == made
    (run,) = (line for line in told if ' run ' in line)
    assert ' --user 0:0 ' in run and ' ros-rolling-rmw-cyclonedds-cpp' in told
    assert any(line.endswith(' install --no-install-recommends "$0"') for line in told)
    adding = run.split()[3]
    assert told[-1] == f'{engine} rm -f -v {adding}'
    name, told = done(fetch, THERE=f'ros:rolling {made}', DISTRO='rolling', HAS=set_up)
    assert name == made and not any(' run ' in line for line in told)


def test_container_of_an_abandoned_layer_goes(engine):
    command = containers.fetch('ros:rolling', 'rmw_cyclonedds_cpp')
    ended = subprocess.run(command.argv, start_new_session=True, env={
        **os.environ, 'THERE': 'ros:rolling', 'DISTRO': 'rolling',
        'HAS': '/opt/ros/rolling/setup.sh', 'ABANDONED': 'yes'})
    assert ended.returncode == 143
    assert notes()[-1].startswith(f'{engine} rm -f -v fogros2-adding-')


@pytest.mark.parametrize(('command', 'user', 'kept'), [
    ('["bash"]', 'ros', 'CMD ["bash"] --change USER ros'), ('null', '', 'CMD [] --change USER 0')])
def test_layer_keeps_command_and_user_of_image(engine, command, user, kept):
    told = done(containers.fetch('ros:rolling', 'rmw_cyclonedds_cpp'), THERE='ros:rolling',
                DISTRO='rolling', HAS='/opt/ros/rolling/setup.sh', COMMAND=command, OWNER=user)[1]
    (commit,) = (line for line in told if ' commit ' in line)
    assert f'commit --change {kept} fogros2-adding-' in commit
    assert commit.endswith(' localhost/fogros2-rmw_cyclonedds_cpp:0123456789ab')


def test_a_node_gets_its_gpus_and_nothing_is_downloaded_for_it(engine, tmp_path):
    node = NodeSpec('1', 'eyes', 'demo', 'talker', features=in_image('demo:1', '--gpus=all'))
    made = containers.inside(node, 'demo:1', 'abc', str(tmp_path), '/run/dds.xml')
    for key, script in made.files.items():
        (tmp_path / key).write_text(str(script))
    words = [word if isinstance(word, str) else str(tmp_path / word[0]['file'])
             for word in made.arguments]
    told = done(Command(tuple(words)), FOGROS2_AGENT_DIRECTORY=str(tmp_path),
                ROS_DOMAIN_ID='', RMW_IMPLEMENTATION='rmw')[1]
    lines = (tmp_path / 'notes.variables').read_text().splitlines()
    # the image's own values do not remain
    assert {'RMW_IMPLEMENTATION=rmw', 'ROS_DOMAIN_ID=0', 'ROS_DISCOVERY_SERVER='} < {*lines}
    gpus = ('--gpus all -e NVIDIA_DRIVER_CAPABILITIES=all' if engine == 'docker'
            else '--device nvidia.com/gpu=all')
    (create,) = (line for line in told if ' create ' in line)
    assert f' {gpus} ' in create and f' -v {tmp_path}:{tmp_path}:ro ' in create
    for option in ('--pull never', '--network host', '--ipc host', f'--user {os.getuid()}:'):
        assert f' {option}' in create
    assert create.endswith(f' demo:1 sh {tmp_path}/in-container {tmp_path} demo talker ')
    assert f'{engine} start -a fogros2-abc-eyes' in told
    assert told[-1] == f'{engine} rm -f -v fogros2-abc-eyes'


#: An engine whose only container is a process here, below an init or an entry point.
RUNNING = """#!/bin/sh
case $1-$3 in
    create-*) while [ "$1" != demo:1 ]; do shift; done; shift; printf '%s\\n' "$@" >words ;;
    start-*) IFS='
'
        sh -c 'echo $$ >pid; exec "$@"' sh $FIRST $(cat words); echo $? >code ;;
    inspect-*Pid*) echo "$(cat pid) running" ;;
    inspect-*) cat code ;;
esac
"""


@pytest.mark.parametrize('first', ['', 'sh\n-c\n"$@"; exit $?\nentry',
                                   'sh\n-c\nsh -c "exit 3" other & "$@"; exit $?\nentry'],
                         ids=['itself', 'below an init', 'beside another process'])
def test_signal_reaches_the_node_below_an_init_or_entry_point(tmp_path, first):
    (tmp_path / 'lib/demo').mkdir(parents=True)
    for name, text in {
            'podman': RUNNING, 'sudo': '#!/bin/sh\nshift\nexec "$@"\n', 'lib/demo/talker':
            '#!/bin/sh\ntrap "exit 4" USR1\necho up\nwhile :; do sleep 0.01; done\n'}.items():
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    node = NodeSpec('1', 'eyes', 'demo', 'talker', prefix=('env',), features=in_image('demo:1'))
    made = containers.inside(node, 'demo:1', 'abc', str(tmp_path), '/run/dds.xml')
    for key, script in made.files.items():
        (tmp_path / key).write_text(str(script))
    words = [word if isinstance(word, str) else str(tmp_path / word[0]['file'])
             for word in made.arguments]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=tmp_path, env={
        'PATH': f'{tmp_path}:{os.environ["PATH"]}', 'FIRST': first,
        'AMENT_PREFIX_PATH': str(tmp_path), 'FOGROS2_AGENT_DIRECTORY': str(tmp_path)})
    assert process.stdout is not None and process.stdout.readline() == 'up\n'
    process.send_signal(signal.SIGUSR1)
    process.communicate(timeout=60)
    assert process.returncode == 4


@pytest.mark.parametrize(('number', 'names'), [(1, ['0']), (2, ['0', '1'])])
def test_gpu_options_are_those_of_the_engine(engine, number, names):
    container = parse(f'docker run --gpus {number} -p 80:80 image run')
    told = done(containers.run(container, 0, 'abc', 'image', '/run/dds.xml', '/run/variables'))[1]
    gpus = (f'--gpus {number} -e NVIDIA_DRIVER_CAPABILITIES=all' if engine == 'docker'
            else ' '.join(f'--device nvidia.com/gpu={name}' for name in names))
    assert told[-1] == (f'{engine} run -d --name fogros2-abc-0-image {gpus} '
                        '--label fogros2-launch=abc -p 80:80 image run')


def here(command: Command) -> Result:
    said = subprocess.run(command.argv, text=True, capture_output=True)
    return Result(said.returncode, said.stdout, said.stderr)


def started(shell: FakeShell, own: Sequence[containers.Container]) -> None:
    running, engine = FakeRunning(shell, launch='abc'), Engine()
    engine.fetch(running, own, ())
    engine.start(running, own)


def test_a_wrong_image_is_one_clear_line(engine, monkeypatch):
    monkeypatch.setenv('WRONG', 'docker.io/library/no-such:1')
    node = NodeSpec('1', 'n', 'p', 'e', features=in_image('no-such:1'))
    with pytest.raises(PrerequisiteError) as error:
        Engine().inside(FakeRunning(FakeShell(handlers={'sh': here})), [node])
    assert str(error.value) == (
        "'a' can't get the image 'no-such:1': Error: docker.io/library/no-such:1: manifest "
        'unknown (is its name right, and may anybody download it?)')


def test_image_of_several_nodes_is_fetched_once(engine, monkeypatch):
    monkeypatch.setenv('THERE', 'localhost/a:1')
    shell = FakeShell(handlers={'sh': here})
    there, running = Engine(), FakeRunning(shell)
    nodes = [NodeSpec('1', 'n', 'p', 'e', features=in_image('localhost/a:1')),
             NodeSpec('2', 'plain', 'p', 'e')]
    there.fetch(running, (), nodes)
    asked = len(shell.commands)
    first, plain = there.inside(running, nodes)
    (second,) = there.inside(running, nodes[:1])
    assert 'localhost/a:1' in first.arguments and second == first and plain == nodes[1]
    assert len(shell.commands) == asked > 0


def test_a_node_that_comes_late_has_to_fit_its_machine_too():
    shell = FakeShell()
    running = FakeRunning(shell, spec=MachineSpec('m', 'container'))
    running.provider = ContainerProvider()
    with pytest.raises(Unsupported, match='containers=True'):
        Engine().inside(running, [NodeSpec('1', 'n', 'p', 'e', features=in_image('a'))])
    assert shell.commands == []


def test_machine_without_engine_and_apt_is_reported():
    shell = FakeShell(handlers={'sh': lambda command: Result(
        127 if 'apt-get' in command.argv[-1] else 0, '\n', 'sh: 2: apt-get: not found')})
    with pytest.raises(PrerequisiteError, match="'a' has neither podman nor docker.*apt-get"):
        started(shell, [parse('docker run image')])


def test_containers_are_recorded_before_they_are_made():
    running = FakeRunning(FakeShell(handlers={'sh': lambda command: Result(0, 'podman\n', '')}))
    feature = Containers()
    feature.installing(running, (), ())
    with feature.machine(running, ()):
        assert running.calls == []
        feature.starting(running, [NodeSpec('1', 'n', 'p', 'e', features=in_image('a'))], ())
        assert running.calls == [('makes', 'containers')]
    assert feature.clean_up('abc') == [containers.remove('abc')]


def test_machine_that_was_replaced_may_end_after_its_successor():
    feature, first, second = Containers(), FakeRunning(FakeShell()), FakeRunning(FakeShell())
    feature.installing(first, (), ())
    with feature.machine(first, ()):
        feature.installing(second, (), ())
        with feature.machine(second, ()):
            assert feature.starting(second, [], ()) == []
    with pytest.raises(ConnectError, match='given .* up meanwhile'):
        feature.starting(second, [], ())


@pytest.mark.parametrize(('survives', 'used'), [(True, True), (True, False), (False, True)])
def test_a_computer_that_stays_keeps_no_container(monkeypatch, survives, used):
    monkeypatch.setattr(FakeProvider, 'capabilities', FakeProvider.can(owned=not survives))
    _, job = deploying.job(Store().root, MachineSpec('m', 'fake'))
    job.record = dataclasses.replace(job.record, last='abc')
    job.shell = shell = FakeShell()
    job.may_make('containers')
    if used:
        job.makes('containers')
    job.undo.close()
    assert shell.commands == ([containers.remove('abc')] if survives and used else [])


@pytest.mark.parametrize(('rmw', 'wrong'), [
    ('rmw_cyclonedds_cpp', False), ('rmw_zenoh_cpp', True)])
def test_container_of_another_middleware_is_refused_early(rmw, wrong):
    launch = SimpleNamespace(
        spec=lambda name: MachineSpec(name, 'container', features=of(GQCNN)),
        environment={'RMW_IMPLEMENTATION': rmw})
    part = Containers().in_launch(launch)
    with pytest.raises(DdsError) if wrong else contextlib.nullcontext():
        part.beside((), 'm')
    assert not part.beside((), None)
