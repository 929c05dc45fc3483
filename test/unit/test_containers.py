# SPDX-License-Identifier: Apache-2.0
"""``docker run`` lines, and what is made of them."""

from __future__ import annotations

import pytest

from fogros2 import containers
from fogros2.actions.machines import ContainerInstance
from fogros2.containers import Container, parse
from fogros2.deploy import Launch
from fogros2.errors import ConfigurationError
from fogros2.model import MachineSpec


@pytest.mark.parametrize(('line', 'meant'), [
    ('docker run hello', Container('hello')),
    ('sudo docker run -d --rm -p 8080:8080 lichtblick',
     Container('lichtblick', ('-p', '8080:8080'))),
    ('/usr/bin/podman container run -it --net=host -v /a:/b:ro -e X=1 r.io/a/b:1 run --fast -d',
     Container('r.io/a/b:1', ('--net', 'host', '-v', '/a:/b:ro', '-e', 'X=1'),
               ('run', '--fast', '-d'))),
    ('docker run -dit --privileged --name eyes --gpus all --ipc=host image',
     Container('image', ('--privileged', '--ipc', 'host'), (), 'all', 'eyes')),
    ('docker run -p8080:80 -e=X=1 -dP -- image',
     Container('image', ('-p', '8080:80', '-e', 'X=1', '-P'))),
    ("docker run -e 'A=b c' --restart always image sh -c 'echo hi'",
     Container('image', ('-e', 'A=b c', '--restart', 'always'), ('sh', '-c', 'echo hi'))),
])
def test_a_line_is_understood(line, meant):
    assert parse(line) == meant


@pytest.mark.parametrize(('line', 'why'), [
    ('', 'no line of docker'), ('ls', 'no line of docker'), ('docker ps', 'runs nothing'),
    ('docker run', 'no image'), ('docker run -d', 'no image'), ('docker run -p', 'nothing after'),
    ("docker run 'image", 'no command line'),
])
def test_what_is_none_is_refused(line, why):
    with pytest.raises(ConfigurationError, match=why):
        parse(line)


def test_parts_make_a_line():
    line = containers.described(
        'image:1', command='run --fast', ports=['80:8080'], environment={'A': 'b c'},
        volumes=['/x:/y'], gpus=1, restart='always', name='eyes')
    assert parse(line) == Container(
        'image:1', ('-p', '80:8080', '-e', 'A=b c', '-v', '/x:/y', '--restart', 'always'),
        ('run', '--fast'), '1', 'eyes')


def test_each_launch_has_names_of_its_own():
    named, unnamed = Container('r.io/a/b:1', name='my eyes'), Container('r.io/a/b:1')
    assert containers.called(named, 0, 'abcdef') == 'fogros2-abcdef-0-my-eyes'
    assert containers.called(unnamed, 1, 'abcdef') == 'fogros2-abcdef-1-b-1'
    node = containers.follow(unnamed, 1, 'abcdef')
    assert (node.name, node.arguments[-1]) == ('b-1', 'fogros2-abcdef-1-b-1')


def test_what_a_machine_is_given_is_checked_where_it_is_written():
    machine = ContainerInstance(name='m')
    machine.add_docker_container('docker run image')
    machine.add_docker_container(image='image', ports=['80:80'])
    for wrong in ({}, {'cmd': 'docker run a', 'image': 'b'}, {'cmd': 'docker run a', 'ports': []},
                  {'cmd': 'docker ps'}, {'image': 'a', 'port': '80:80'}):
        with pytest.raises(ConfigurationError) as error:
            machine.add_docker_container(**wrong)
    assert 'ports' in error.value.hint


def test_a_machine_that_can_not_run_them_is_refused_before_it_is_made():
    launch = Launch()
    spec = MachineSpec('m', 'container', containers=('docker run image',))
    with pytest.raises(ConfigurationError, match='rights that an engine takes'):
        launch.prepare([spec])
    launch.down()
