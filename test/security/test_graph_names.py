# SPDX-License-Identifier: Apache-2.0
"""
A hijacked machine chooses names, messages and stamps that the robot's own programs handle.

They control no terminal, end no program of the robot, and do no lasting harm to other machines.
"""

from __future__ import annotations

from pathlib import Path
import re
import socket
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='neither ROS 2 nor the embedded default is installed')
pytest.importorskip('av', reason='PyAV (the extra "video") is not installed')
from fogros2 import ros_types
from fogros2_monitor.dashboard import cameras, graph
from fogros2_monitor.dashboard.ways import Stream
from fogros2_monitor.tunnel import Tunnel
from fogros2_replicas.node import FirstAnswer, WARNINGS
from fogros2_replicas.pairs import Pair, SET_BACK
from fogros2_testing.fakes import FakeShell, FakeStream

ROOT = Path(__file__).resolve().parents[2]
#: Sets the clipboard, clears the screen, hides text.
ATTACK = '\x1b]52;c;cm0=\x07\x1b[2J\u202e\r'


def test_names_that_ros_does_not_allow_are_left_out() -> None:
    node = SimpleNamespace(get_topic_names_and_types=lambda: [
        ('/camera', ['sensor_msgs/msg/Image', 'x']), ('/a/b_1', ['std_msgs/msg/String']),
        (f'/camera{ATTACK}', ['sensor_msgs/msg/Image']), ('/x', [f'std_msgs/msg/String{ATTACK}']),
        ('/a b', ['std_msgs/msg/String']), ('//x', ['std_msgs/msg/String']),
        ('/x\n', ['std_msgs/msg/String']), ('/\u0430', ['std_msgs/msg/String']), ('/none', [])])
    node.get_service_names_and_types = node.get_topic_names_and_types
    for listed in (ros_types.topics(node), ros_types.services(node)):
        assert listed == {'/camera': 'sensor_msgs/msg/Image', '/a/b_1': 'std_msgs/msg/String'}


def test_programs_read_the_graph_by_the_filter_alone() -> None:
    for path in (ROOT / 'fogros2_monitor').rglob('*.py'):
        assert not re.search(r'\bget_(topic|service)_names_and_types\b', path.read_text()), path


def test_first_answer_logs_no_control_characters() -> None:
    said: list[str] = []
    node = SimpleNamespace(_complained=set(), get_logger=lambda: SimpleNamespace(
        error=said.append, warning=said.append))
    for number in range(2 * WARNINGS):
        FirstAnswer.complain(node, f'no replica has /plan; near: /plan{number}{ATTACK}')  # type: ignore
    assert len(said) == WARNINGS and all(map(str.isprintable, said))


@pytest.mark.parametrize('data', [b'', b'junk', b'\0\1\0\0' + b'\xff' * 40, b'\0' * 200],
                         ids=['empty', 'junk', 'lengths', 'zeros'])
@pytest.mark.parametrize('kind', [cameras.Camera, cameras.StreamCamera])
def test_bytes_that_are_no_image_leave_the_program_running(
    kind: type[cameras.Camera], data: bytes,
) -> None:
    told: list[Any] = []
    node: Any = SimpleNamespace(create_publisher=lambda *_: SimpleNamespace(publish=id))
    camera = kind(node, told.append, '/camera', '/camera')
    camera._due = True
    camera._take(data)
    assert 'note' in told[0] or not told


def test_many_streams_get_a_limited_number_of_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    class Camera:
        topic = ''

        def __init__(self, node: object, tell: object, name: str, topic: str) -> None:
            made.append(name)

        def look(self, *, stay: bool) -> None: ...

    for name in ('Camera', 'StreamCamera'):
        monkeypatch.setattr(cameras, name, Camera)
    node = SimpleNamespace(_cameras={}, _hosts=None, tell=None)
    streams = [Stream(f'/c{number}', 'h264', f'/c{number}/h264', 'sensor_msgs/msg/CompressedImage',
                      'a', 'b', True) for number in range(1000)]
    graph.GraphNode._take_pictures(node, [], streams)  # type: ignore[arg-type]
    assert len(made) == graph.MOST


def test_odd_lines_of_a_machine_end_one_connection() -> None:
    said: list[str] = []
    stream = FakeStream()
    for line in (b'\n', b'aGk=\n', b'a\n'):
        stream.say(line)
    tunnel = Tunnel(FakeShell(streams=[stream]), ('127.0.0.1', 8765), say=said.append)
    viewer, link = socket.socketpair()
    with viewer:
        tunnel._carry(link)
        assert viewer.recv(10) == b'hi' and viewer.recv(10) == b''
    tunnel.close()
    assert said == ['127.0.0.1:8765 there sends no base64']


def test_stamp_of_the_future_does_not_shut_out_other_replicas() -> None:
    """The hijacked machine may have ended long ago."""
    pair = Pair(['hijacked', 'honest'])
    pair.input(0.0, (10 * SET_BACK, ''))
    assert pair.output(0.1, 'honest', (10 * SET_BACK, ''))
    assert not pair.output(0.2, 'hijacked', ((1 << 31) * 1_000_000_000, ''))
    pair.died('hijacked')
    for number in range(11, 20):
        pair.input(number, (number * SET_BACK, ''))
        assert pair.output(number + 0.1, 'honest', (number * SET_BACK, ''))
