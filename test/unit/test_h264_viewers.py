# SPDX-License-Identifier: Apache-2.0
"""The topic that an encoder has for programs of ``image_transport``."""

from __future__ import annotations

from types import SimpleNamespace
from unittest import mock

import pytest

pytest.importorskip('av', reason='PyAV (the extra "video") is not installed')
pytest.importorskip('rclpy', reason='rclpy is not installed')

from image_transport_h264 import message, senders


def test_packets_for_viewers_have_no_drivers_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """A driver with the plugin publishes /camera/ffmpeg."""
    packets = object()
    monkeypatch.setattr(message, 'installed', lambda *_: packets)
    node = mock.Mock()
    node.declare_parameter.side_effect = lambda _, default, *__: SimpleNamespace(value=default)
    senders.VideoSender(node, '/camera/h264', mock.Mock())
    assert [call.args[1] for call in node.offer.call_args_list if call.args[0] is packets] == [
        '/camera/h264/ffmpeg']
