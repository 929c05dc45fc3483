# SPDX-License-Identifier: Apache-2.0
"""
The program that joins a launch for the dashboard, while somebody looks.

It takes lines of JSON, ``{"machines": {name: [nodes]}}``, on its standard input and ends with it.
It prints lines of JSON: ``{"streams": [...], "topics": [...]}`` and, with each new picture,
``{"picture": topic, "number": n, "data": base64}``.

A picture is taken from the image topic on the robot, where a streamed topic keeps its own name:
that costs no decoding, and nothing crosses the VPN for it. It is one message a second: the
subscription is made for it and goes with it. Where nobody else looks at what a decoder publishes
here, we are a viewer as any other, and stay subscribed, as a stream that begins anew each second
would be a poor one. Of what crosses, small topics are listened to all
the time and large ones for a second in ten; nothing that nobody else listens to is listened to,
as that would wake its encoder.
"""

from __future__ import annotations

import base64
import contextlib
import functools
import json
import os
import sys
import threading
import time
from typing import Any, Optional

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image

from fogros2.monitor.dashboard.meter import Meter
from fogros2.monitor.dashboard.ways import (
    Crossing,
    crossing,
    decoded,
    Hosts,
    OWN,
    Stream,
    streams,
    Topic,
)
from fogros2.monitor.definitions import message_class

#: Seconds between two looks at the graph, from one picture of a topic to the next, and after
#: which one that doesn't come is asked for anew.
LOOK, PICTURE, PATIENCE = 0.5, 1.0, 5.0
#: Topics that are listened to at the most.
MOST = 64
#: Hears every publisher, and keeps none of them waiting.
_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=32,
                  reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)
_ONE = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=1,
                  reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)
_IMAGE = 'sensor_msgs/msg/Image'


class _Ear:
    """Listens to a topic as its meter wants."""

    def __init__(self, node: Node, topic: str, kind: str) -> None:
        self.meter = Meter(time.monotonic())
        self._node, self._topic = node, topic
        self._class = message_class(kind)
        self._subscription: Optional[Subscription] = None

    def look(self, *, wanted: bool) -> None:
        """Subscribe, or end it."""
        wanted = self.meter.wants(time.monotonic()) and wanted
        if wanted and self._subscription is None:
            self._subscription = self._node.create_subscription(
                self._class, self._topic, self._heard, _QOS, raw=True)
        elif not wanted and self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _heard(self, data: bytes) -> None:
        self.meter.heard(time.monotonic(), len(data))


class _Camera:
    """Takes a picture of an image topic each second."""

    def __init__(self, node: GraphNode, topic: str) -> None:
        self._node, self._topic = node, topic
        self._subscription: Optional[Subscription] = None
        self._asked = -1e9
        self._number = 0
        self._due = self._stay = False

    def look(self, *, stay: bool) -> None:
        """
        Take one if it is time.

        :param stay: whether to stay subscribed from one to the next.
        """
        self._stay = stay
        now = time.monotonic()
        if self._subscription is not None and now - self._asked > PATIENCE:
            self.close()  # it may be of a publisher that has gone
        if now - self._asked > PICTURE - LOOK / 2:
            if self._subscription is None:
                self._subscription = self._node.create_subscription(
                    Image, self._topic, self._take, _ONE, raw=True)
                self._asked = now
            self._due = True

    def close(self) -> None:
        """Stop waiting for one."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _take(self, data: bytes) -> None:
        if not self._due:
            return
        # where images are streamed there is what this takes
        from fogros2.monitor.dashboard import shots
        from image_transport_h264.message import picture
        from image_transport_h264.picture import BadPicture
        self._due, self._asked = False, time.monotonic()
        if not self._stay:
            self.close()
        try:
            shot = shots.jpeg(picture(deserialize_message(data, Image)))
        except BadPicture as error:
            self._node.tell({'picture': self._topic, 'note': str(error)})
            return
        self._number += 1
        self._node.tell({'picture': self._topic, 'number': self._number,
                         'data': base64.b64encode(shot).decode()})


class GraphNode(Node):
    """Looks at the graph, listens, and tells."""

    def __init__(self) -> None:
        super().__init__(OWN, enable_rosout=False, start_parameter_services=False)
        self._hosts = Hosts({})
        self._ears: dict[str, Optional[_Ear]] = {}
        self._cameras: dict[str, _Camera] = {}
        self.create_timer(LOOK, self._look)

    def know(self, machines: dict[str, list[str]]) -> None:
        """Take what runs where; from any thread."""
        self._hosts = Hosts(machines)

    def tell(self, what: dict[str, Any]) -> None:
        """Print a line; whoever no longer reads it has closed the standard input, too."""
        with contextlib.suppress(BrokenPipeError):
            sys.stdout.write(json.dumps(what) + '\n')
            sys.stdout.flush()

    def _look(self) -> None:
        topics = [self._topic(name, kinds[0]) for name, kinds in self.get_topic_names_and_types()
                  if kinds]
        streamed = streams(topics, self.get_node_names(), self._hosts)
        others = crossing(topics, self._hosts, streamed)
        ways = {one.between: one for one in streamed}
        wanted: dict[str, tuple[str, bool]] = {
            name: (one.kind, one.heard) for name, one in ways.items()}
        wanted.update({one.topic: (one.kind, True) for one in others})
        for name in [name for name in self._ears if name not in wanted]:
            self._listen(name, '', heard=False)
            del self._ears[name]
        for name, (kind, heard) in list(wanted.items())[:MOST]:
            self._listen(name, kind, heard=heard)
        shown = {one.topic for one in streamed if '' in (one.source, one.target)}
        self._take_pictures([topic for topic in topics
                             if topic.name in shown and topic.kind == _IMAGE])
        self.tell({'streams': [self._stream(one) for one in streamed],
                   'topics': [self._crossing(one) for one in others]})

    def _topic(self, name: str, kind: str) -> Topic:
        return Topic(
            name, kind,
            frozenset(info.node_name for info in self.get_publishers_info_by_topic(name)),
            frozenset(info.node_name for info in self.get_subscriptions_info_by_topic(name)))

    def _listen(self, name: str, kind: str, *, heard: bool) -> None:
        if name not in self._ears and heard:
            try:
                self._ears[name] = _Ear(self, name, kind)
            except LookupError:
                self._ears[name] = None  # of a type that isn't installed here
        ear = self._ears.get(name)
        if ear is not None:
            ear.look(wanted=heard)

    def _take_pictures(self, images: list[Topic]) -> None:
        here = {image.name: image for image in images
                if any(not self._hosts.of(node) for node in image.publishers)}
        for name in [name for name in self._cameras if name not in here]:
            self._cameras.pop(name).close()
        for name, image in here.items():
            alone = not image.subscribers - {OWN} and decoded(image)
            self._cameras.setdefault(name, _Camera(self, name)).look(stay=alone)

    def _rates(self, topic: str) -> dict[str, Any]:
        ear = self._ears.get(topic)
        rate, bandwidth = (None, None) if ear is None else ear.meter.rates()
        return {'rate': rate, 'bandwidth': bandwidth,
                'sampled': ear is not None and ear.meter.sampled}

    def _stream(self, one: Stream) -> dict[str, Any]:
        note = ''
        if one.source and one.target:
            note = 'between two machines'
        elif not one.heard:
            note = 'nobody subscribes'
        return {'topic': one.topic, 'transport': one.transport, 'source': one.source,
                'target': one.target, 'note': note, **self._rates(one.between)}

    def _crossing(self, one: Crossing) -> dict[str, Any]:
        return {'topic': one.topic, 'type': one.kind, 'from': one.sources, 'to': one.targets,
                **self._rates(one.topic)}


def _take_lines(node: GraphNode, ended: functools.partial[None]) -> None:
    for line in sys.stdin:
        with contextlib.suppress(ValueError, TypeError, KeyError, AttributeError):
            node.know(json.loads(line)['machines'])
    ended()


def main() -> None:
    """Run until the standard input ends."""
    os.nice(5)  # whoever looks must not take the processor from those who work
    rclpy.init(args=[])
    node = GraphNode()
    threading.Thread(target=_take_lines, args=(
        node, functools.partial(rclpy.try_shutdown)), daemon=True).start()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()


if __name__ == '__main__':
    main()
