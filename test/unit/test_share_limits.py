# SPDX-License-Identifier: Apache-2.0
"""What leaves an end of a limited link, and when; by value."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='rclpy is not installed')
from fogros2_share import limits
from fogros2_share.wire import Form


class Bench:
    """A node's timer, which a test lets expire, and a publisher."""

    def __init__(self, kind: str) -> None:
        self.sent: list[Any] = []
        self.running = False
        self.expire: Callable[[], None] = lambda: None
        self.leaving, self.coming = self._ways()
        for way in (self.leaving, self.coming):
            way.form = Form(kind, True, 1)
            way.message = lambda transforms: transforms
            way.publisher = SimpleNamespace(publish=self.sent.append)

    def _ways(self) -> tuple[limits.Leaving, limits.Coming]:
        node: Any = SimpleNamespace(
            create_timer=self._timer, create_subscription=lambda *_, **__: object(),
            destroy_subscription=lambda _: None, get_publishers_info_by_topic=lambda _: (),
            get_subscriptions_info_by_topic=lambda _: ())
        leaving = limits.Leaving(node, '/tf', '/there', 0.05)
        return leaving, limits.Coming(node, '/back', '/tf', leaving)

    def _timer(self, period: float, callback: Callable[[], None], **_: Any) -> Any:
        self.expire = callback
        return SimpleNamespace(
            is_canceled=lambda: not self.running, reset=lambda: setattr(self, 'running', True),
            cancel=lambda: setattr(self, 'running', False))


def test_message_does_not_return(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench('std_msgs/msg/String')
    monkeypatch.setattr(limits, 'form_of', lambda _: bench.leaving.form)
    monkeypatch.setattr(limits, 'others', lambda *_: ['a node'])
    bench.leaving.look()
    bench.coming.heard(b'theirs')
    bench.leaving.heard(b'theirs')
    assert bench.sent == [b'theirs']
    # a latched one is heard again by a later subscription
    bench.leaving.unsubscribe()
    bench.leaving.look()
    bench.leaving.heard(b'theirs')
    assert bench.sent == [b'theirs']
    bench.leaving.heard(b'ours')
    assert bench.sent == [b'theirs', b'ours']
    # a node here may say later what the other side has said last
    bench.expire()
    bench.expire()
    bench.leaving.look()
    bench.leaving.heard(b'theirs')
    assert bench.sent == [b'theirs', b'ours', b'theirs']


def test_wrong_transforms_end_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def deserialized(data: bytes, kind: object) -> Any:
        if data == b'wrong':
            raise RuntimeError('failed to deserialize ROS message')
        return SimpleNamespace(transforms=[
            SimpleNamespace(child_frame_id=str(number)) for number in range(int(data))])

    monkeypatch.setattr(limits, 'deserialize_message', deserialized)
    bench = Bench(limits.TRANSFORMS)
    for data in (b'1', b'wrong', b'%d' % (limits.MOST + 2)):
        bench.leaving.heard(data)
    bench.expire()
    assert [(len(message), message[-1].child_frame_id) for message in bench.sent] == [
        (1, '0'), (limits.MOST, str(limits.MOST - 1))]


def test_each_latched_message_is_kept_from_returning(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench('std_msgs/msg/String')
    bench.leaving.form = bench.coming.form = Form('std_msgs/msg/String', True, 2)
    monkeypatch.setattr(limits, 'form_of', lambda _: bench.leaving.form)
    monkeypatch.setattr(limits, 'others', lambda *_: ['a node'])
    for data in (b'one', b'two', b'three'):
        bench.coming.heard(data)
    # a new subscription hears the latched ones once more
    bench.leaving.look()
    for data in (b'two', b'three'):
        bench.leaving.heard(data)
    assert bench.sent == [b'one', b'two', b'three']
    bench.leaving.heard(b'one')
    assert bench.sent[3:] == [b'one']
