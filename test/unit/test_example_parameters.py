# SPDX-License-Identifier: Apache-2.0
"""What the examples' nodes take for a parameter, and how a launch ends with a node."""

from __future__ import annotations

import contextlib
import math
import types

import numpy
import pytest

pytest.importorskip('rclpy')
from launch import LaunchContext
from launch.actions import Shutdown
import rclpy

from fogros2_examples.ending import ended
from fogros2_examples.files import checked, PICTURES
from fogros2_examples.nodes import run
from fogros2_examples.parameters import BadParameter, within, writable
from fogros2_examples.policy.onnx_file import perceptron


class Given:
    """A node that was started with a parameter."""

    def __init__(self, value):
        self.value = value

    def declare_parameter(self, name, default):
        return types.SimpleNamespace(value=self.value)


@pytest.mark.parametrize(('value', 'default', 'least', 'most'), [
    (0, 10, 0, math.inf), (64, 640, 64, 4096), (4096, 640, 64, 4096), (0.01, 1.0, 0.01, 1e3)])
def test_number_in_range_is_accepted(value, default, least, most):
    taken = within(Given(value), 'rate', default, least, most)
    assert (taken, type(taken)) == (value, type(default))


@pytest.mark.parametrize(('value', 'default', 'least', 'most', 'said'), [
    (-1, 200, 0, math.inf, "'rate' is -1: it has to be 0 at least"),
    (0.0, 10.0, 0.01, 1000, "'rate' is 0: it has to be from 0.01 to 1000"),
    (math.nan, 10.0, 0.01, 1000, "'rate' is nan: it has to be from 0.01 to 1000"),
    (math.inf, 10.0, 0.01, 1000, "'rate' is inf: it has to be from 0.01 to 1000"),
    (0, 640, 64, 4096, "'rate' is 0: it has to be from 64 to 4096")])
def test_number_out_of_range_is_refused(value, default, least, most, said):
    with pytest.raises(BadParameter) as caught:
        within(Given(value), 'rate', default, least, most)
    assert str(caught.value) == said


def test_writable_file_is_accepted(tmp_path):
    there = tmp_path / 'there.PNG'
    there.touch()
    for path in (there, tmp_path / 'new.jpg'):
        assert writable(Given(str(path)), 'picture', PICTURES) == str(path)
    assert writable(Given(str(tmp_path / 'figures')), 'results') == str(tmp_path / 'figures')
    assert writable(Given(''), 'picture', PICTURES) == ''


def test_unwritable_file_is_refused(tmp_path):
    (tmp_path / 'folder.png').mkdir()
    for name, said in (
            ('no/x.png', f'there is no folder {tmp_path}/no'), ('folder.png', "can't be written"),
            ('x.bmp.', 'it has to end in .png, .jpg, .jpeg'), ('x', 'it has to end in .png')):
        with pytest.raises(BadParameter, match=f"^'picture' is {tmp_path}/{name}: .*{said}"):
            writable(Given(str(tmp_path / name)), 'picture', PICTURES)


def test_launch_ends_with_the_status_of_its_node():
    context = LaunchContext()

    def exited(status):
        return ended(types.SimpleNamespace(process_name='camera-1', returncode=status), context)

    assert isinstance(exited(0), Shutdown)
    with pytest.raises(RuntimeError, match='^camera-1 ended with exit status 2$'):
        exited(2)
    context._set_is_shutdown(True)
    assert exited(2) is None and exited(0) is None


@pytest.mark.parametrize(('given', 'said'), [
    ({'policy': 'absent.onnx'}, 'policy:=absent.onnx: there is no such file here (train one)'),
    ({'policy': '.'}, 'policy:=.: there is no such file here (train one)'),
    ({'dataset': 'absent'}, 'dataset:=absent: there is no such file here (record one)'),
    ({'picture': 'here.txt'}, 'picture:=here.txt: it has to end in .png, .jpg, .jpeg'),
    ({'runs': 'nowhere/runs'}, 'runs:=nowhere/runs: there is no folder nowhere'),
    ({}, ''), ({'policy': 'synthetic'}, ''), ({'policy': 'there.onnx'}, ''),
    ({'dataset': '.', 'picture': 'new.png', 'runs': 'there.onnx'}, '')])
def test_files_are_checked_before_the_machine(given, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'there.onnx').touch()
    context = LaunchContext()
    context.launch_configurations.update(
        {'policy': '', 'dataset': '', 'picture': '', 'runs': '', **given})
    action = checked({'policy': 'train one', 'dataset': 'record one'},
                     {'picture': PICTURES, 'runs': ()}, ['synthetic'], ['dataset'])
    if not said:
        assert not action.execute(context)
        return
    with pytest.raises(RuntimeError) as caught:
        action.execute(context)
    assert str(caught.value) == said


@pytest.mark.parametrize(('argument', 'reader', 'content', 'said'), [
    ('policy', 'fogros2_examples.policy.onnx_file:check', b'', 'the file is empty'),
    ('policy', 'fogros2_examples.policy.onnx_file:check',
     b'version https://git-lfs.github.com/spec/v1\n', 'it is no ONNX model'),
    ('policy', 'fogros2_examples.policy.onnx_file:check', b'PK\3\4', 'it is no ONNX model'),
    ('policy', 'fogros2_examples.policy.onnx_file:check', perceptron({}, [(
        numpy.zeros((6, 12), 'f4'), numpy.zeros(12, 'f4'))], 2), ''),
    ('environment', 'fogros2_examples.planning.app_files:loaded', b'', "has no 'problem'"),
    ('environment', 'fogros2_examples.planning.app_files:loaded',
     b'[problem]\nrobot = "absent.dae"\n', 'absent.dae'),
    ('dataset', 'fogros2_examples.slam.tum:read', None, 'rgb.txt'),
    ('dataset', 'absent_module:read', b'', '')])
def test_unusable_files_are_refused_before_the_machine(argument, reader, content, said, tmp_path):
    path = tmp_path / 'file'
    path.mkdir() if content is None else path.write_bytes(content)
    context = LaunchContext()
    context.launch_configurations[argument] = str(path)
    action = checked({argument: ''}, folders=['dataset'], readers={argument: reader})
    if not said:
        assert not action.execute(context)
        return
    with pytest.raises(RuntimeError) as caught:
        action.execute(context)
    assert str(caught.value).startswith(f'{argument}:={path}: ') and said in str(caught.value)


@pytest.mark.parametrize('ended', [True, False])
def test_error_after_a_signal_ends_a_node_quietly(ended):
    """Ctrl-C between two messages invalidates the context of the publisher."""
    def turn(node):
        if ended:
            rclpy.shutdown()
        raise RuntimeError("publisher's context is invalid")

    with contextlib.nullcontext() if ended else pytest.raises(RuntimeError):
        run('talker', lambda: None, turn)
    rclpy.try_shutdown()
