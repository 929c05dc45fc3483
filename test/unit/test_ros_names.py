# SPDX-License-Identifier: Apache-2.0
"""Names of topics on machines, and the remappings of nodes there."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from fogros2 import ros_names
from fogros2.model import NodeSpec
from fogros2.ros_names import identifier, local_topic, rewrite

NAMES = {'/camera': '/fogros2/m/camera', '/arm/camera': '/fogros2/m/arm/camera'}
OURS = ('--ros-args', '-r', '/camera:=/fogros2/m/camera',
        '-r', '/arm/camera:=/fogros2/m/arm/camera')


def remapped(*arguments: Any) -> tuple[Any, ...]:
    node = NodeSpec('id', 'name', 'p', 'e', arguments)
    result = ros_names.remapped(node, NAMES)
    assert dataclasses.replace(result, arguments=arguments) == node
    return result.arguments


def test_topics_of_their_own_name() -> None:
    assert remapped('--ros-args') == ('--ros-args', *OURS)


def test_programs_that_are_no_nodes() -> None:
    for arguments in ((), ('sleep', '60'), ('-r', 'image:=/camera')):
        assert remapped(*arguments) == arguments


def test_what_the_user_remapped_is_rewritten_in_its_place() -> None:
    assert remapped('--ros-args', '-r', 'image:=/camera', '--remap', 'x:=/y') == (
        '--ros-args', '-r', 'image:=/fogros2/m/camera', '--remap', 'x:=/y', *OURS)


def test_relative_names_are_in_the_node_s_namespace() -> None:
    assert remapped('--ros-args', '-r', '__ns:=/arm', '-r', 'image:=camera', '-r', 'x:=/camera') \
        == ('--ros-args', '-r', '__ns:=/arm', '-r', 'image:=/fogros2/m/arm/camera',
            '-r', 'x:=/fogros2/m/camera', *OURS)
    # the namespace counts wherever it stands
    assert remapped('--ros-args', '-r', 'image:=camera', '-r', '__ns:=/arm')[2] == (
        'image:=/fogros2/m/arm/camera')


def test_a_topic_that_the_node_calls_otherwise_already_stays_so() -> None:
    assert remapped('--ros-args', '-r', '/camera:=/other') == (
        '--ros-args', '-r', '/camera:=/other', '--ros-args', '-r',
        '/arm/camera:=/fogros2/m/arm/camera')
    assert remapped('--ros-args', '-r', '__ns:=/arm', '-r', 'camera:=/other')[-1] == (
        '/camera:=/fogros2/m/camera')


def test_what_is_no_remapping_stays() -> None:
    words = ('-r', 'a:=/camera', '--ros-args', '-r', '__node:=camera', '-p', 'topic:=/camera',
             '--params-file', ({'file': '0-x.yaml'},), '--', '-r', 'b:=/camera')
    assert remapped(*words) == (*words, *OURS)


def test_qos_overrides_have_the_new_name() -> None:
    old, new = (
        '/**:\n  ros__parameters:\n    frame: /camera\n'
        f'    qos_overrides.{name}.publisher.depth: 1\n'
        f'    qos_overrides:\n      {name}:\n        publisher: {{depth: 1}}\n      /camera2: x\n'
        for name in ('/camera', '/fogros2/m/camera'))
    override = 'qos_overrides.{}.subscription.reliability:=best_effort'
    node = NodeSpec('id', 'name', 'p', 'e', (
        '--ros-args', '-p', override.format('/camera'), '--params-file', ({'file': 'a'},)),
        files={'a': old, 'b': (old, {'share': 'p'}), 'c': '/camera: 1'})
    result = ros_names.remapped(node, NAMES)
    assert result.arguments[2] == override.format('/fogros2/m/camera')
    assert result.files == {'a': new, 'b': (new, {'share': 'p'}), 'c': '/camera: 1'}


def test_a_rule_for_one_node_of_several() -> None:
    assert remapped('--ros-args', '-r', 'one:image:=/camera')[2] == (
        'one:image:=/fogros2/m/camera')


def test_names_on_a_machine() -> None:
    assert local_topic('/camera', None) == '/camera'
    assert local_topic('/a/b', 'my-cloud') == '/fogros2/my_cloud/a/b'
    assert identifier('2nd--machine') == 'm_2nd_machine'


@pytest.mark.parametrize(('own', 'namespace', 'expected'), [
    ([], '/', [('/camera', '/f/camera')]),
    # a user's rule leads to the topic: it leads to the new name instead
    ([('image', '/camera')], '/', [('image', '/f/camera'), ('/camera', '/f/camera')]),
    ([('image', 'camera')], '/', [('image', '/f/camera'), ('/camera', '/f/camera')]),
    # in a namespace, the relative name is another topic
    ([('image', 'camera')], '/left', [('image', 'camera'), ('/camera', '/f/camera')]),
    # FogROS2's name for the topic on a machine
    ([('image', '/camera/cloud')], '/', [('image', '/f/camera'), ('/camera', '/f/camera')]),
    ([('/camera', 'camera/cloud')], '/', [('/camera', '/f/camera')]),
    ([('image', '/lidar/cloud')], '/', [('image', '/lidar/cloud'), ('/camera', '/f/camera')]),
    # the user has led the topic elsewhere: that stands
    ([('/camera', '/other')], '/', [('/camera', '/other')]),
    ([('camera', 'other')], '/', [('camera', 'other')]),
    ([('__node', 'x')], '/', [('__node', 'x'), ('/camera', '/f/camera')]),
])
def test_rules_do_not_chain_so_they_are_rewritten(
    own: list[tuple[str, str]], namespace: str, expected: list[tuple[str, str]],
) -> None:
    assert rewrite(own, {'/camera': '/f/camera'}, namespace) == expected


def test_a_streamed_topic_that_ends_in_cloud_keeps_its_name() -> None:
    names = {'/camera': '/f/camera', '/camera/cloud': '/f/camera/cloud'}
    assert rewrite([('image', '/camera/cloud')], names)[0] == ('image', '/f/camera/cloud')
