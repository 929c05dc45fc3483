# SPDX-License-Identifier: Apache-2.0
"""
Join a launch for the dashboard, while somebody watches.

The program reads lines of JSON, ``{"machines": {name: [nodes]}, "pictures": true}``, from standard
input, and exits at its end. It prints lines of JSON: ``{"streams": [...], "topics": [...]}``, and
for each new picture ``{"picture": topic, "number": n, "data": base64}``.

Pictures come from the image topic on the robot, where a streamed topic keeps its name. They need
no decoding and no traffic over the VPN. The program takes one message per second, and subscribes
only for that message. If a decoder publishes the topic and no other node subscribes, the program
stays subscribed, because a stream that restarts every second looks poor. Of a stream between two
machines, the program takes a packet every five seconds.

The program measures the rates of topics that cross the VPN. It subscribes to small topics all the
time, and to topics with much traffic for one second in ten. It never subscribes to a stream that
has no other subscriber, because that would start the encoder.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
import time
from typing import Any, Optional, TYPE_CHECKING

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64MultiArray

from fogros2 import ros_types
from fogros2_monitor.dashboard.meter import Meter
from fogros2_monitor.dashboard.ways import (
    Crossing,
    crossing,
    decoded,
    Hosts,
    OWN,
    Stream,
    streams,
    Topic,
)
from image_transport_h264 import ending
from image_transport_h264.lazy import every, Tap
from image_transport_h264.sharing import claim_of, UNLIMITED, VALID

if TYPE_CHECKING:
    from fogros2_monitor.dashboard.cameras import Camera

#: Poll interval of the graph in seconds.
LOOK = 0.5
#: Maximum number of topics with a measured rate, and of streams with pictures.
MOST = 64
#: Compatible with every publisher; best effort, so that no publisher waits for this node.
_QOS = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=32,
                  reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)
_IMAGE, _PACKET = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'


class _Ear:
    """Subscribe to a topic when its meter asks for it."""

    def __init__(self, node: Node, topic: str, kind: str) -> None:
        self.meter = Meter(time.monotonic())
        self._tap = Tap(node, ros_types.message(kind), topic, _QOS, self._heard, adapt=False)

    def look(self, *, wanted: bool) -> None:
        """Subscribe or unsubscribe."""
        self._tap.want(self.meter.wants(time.monotonic()) and wanted)

    def _heard(self, data: bytes) -> None:
        self.meter.heard(time.monotonic(), len(data))


class GraphNode(Node):
    """Observe the graph, measure rates, take pictures, and print the results."""

    def __init__(self) -> None:
        super().__init__(OWN, enable_rosout=False, start_parameter_services=False)
        self._hosts = Hosts({})
        self._pictures = False
        self._ears: dict[str, Optional[_Ear]] = {}
        self._cameras: dict[str, Camera] = {}
        #: Time and contents of the last report of each stream about its share.
        self._reports: dict[str, tuple[float, Any]] = {}
        every(self, LOOK, self._look)

    def know(self, machines: dict[str, list[str]], *, pictures: bool) -> None:
        """Set the nodes of each machine, and whether to take pictures; from any thread."""
        self._hosts = Hosts(machines)
        self._pictures = pictures

    def tell(self, what: dict[str, Any]) -> None:
        """Print a line; ignore a reader that is gone, as it closes standard input too."""
        with contextlib.suppress(BrokenPipeError):
            sys.stdout.write(json.dumps(what) + '\n')
            sys.stdout.flush()

    def _look(self) -> None:
        topics = [self._topic(*item) for item in ros_types.topics(self).items()]
        streamed = streams(topics, self.get_node_names(), self._hosts)
        others = crossing(topics, self._hosts, streamed)
        ways = {one.between: one for one in streamed}
        wanted: dict[str, tuple[str, bool]] = {
            name: (one.kind, one.heard) for name, one in ways.items()}
        wanted.update({one.topic: (one.kind, True) for one in others if not one.large})
        for name in [name for name in self._ears if name not in wanted]:
            self._listen(name, '', heard=False)
            del self._ears[name]
        for name, (kind, heard) in list(wanted.items())[:MOST]:
            self._listen(name, kind, heard=heard)
        if self._pictures and (streamed or self._cameras):
            self._take_pictures(topics, streamed)
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
                self._ears[name] = None  # the message type is not installed here
        ear = self._ears.get(name)
        if ear is not None:
            ear.look(wanted=heard)

    def _take_pictures(self, topics: list[Topic], streamed: list[Stream]) -> None:
        """Keep a camera for each stream with images, and let each one take a due picture."""
        try:
            from fogros2_monitor.dashboard.cameras import Camera, StreamCamera
        except ModuleNotFoundError:
            return  # all streams are between machines, so the robot may lack the image libraries
        by_name = {topic.name: topic for topic in topics}
        wanted: dict[str, tuple[type[Camera], str, bool]] = {}
        for one in streamed[:MOST]:
            image = by_name.get(one.topic)
            if one.source and one.target:
                kind = Camera if one.kind == _IMAGE else StreamCamera
                if one.heard and one.kind in (_IMAGE, _PACKET):
                    wanted[one.topic] = kind, one.between, False
            elif image is not None and image.kind == _IMAGE and any(
                    not self._hosts.of(node) for node in image.publishers):
                alone = not image.subscribers - {OWN} and decoded(image)
                wanted[one.topic] = Camera, one.topic, alone
        for name, camera in list(self._cameras.items()):
            if name not in wanted or camera.topic != wanted[name][1]:
                self._cameras.pop(name).end()
        for name, (kind, topic, stay) in wanted.items():
            if name not in self._cameras:
                self._cameras[name] = kind(self, self.tell, name, topic)
            self._cameras[name].look(stay=stay)

    def _rates(self, topic: str) -> dict[str, Any]:
        ear = self._ears.get(topic)
        rate, bandwidth = (None, None) if ear is None else ear.meter.rates()
        return {'rate': rate, 'bandwidth': bandwidth,
                'sampled': ear is not None and ear.meter.sampled}

    def _stream(self, one: Stream) -> dict[str, Any]:
        note = '' if one.heard else 'nobody subscribes'
        return {'topic': one.topic, 'transport': one.transport, 'source': one.source,
                'target': one.target, 'note': note, **self._rates(one.between),
                **self._share(one.between)}

    def _share(self, between: str) -> dict[str, Any]:
        """Return share (bits/s) and latency (s) of a stream, None if there is none or unknown."""
        if between not in self._reports:
            self._reports[between] = 0.0, None
            self.create_subscription(
                Float64MultiArray, f'{between}/share', lambda message: self._reports.update({
                    between: (time.monotonic(), claim_of(message))}), _QOS)
        when, report = self._reports[between]
        claim = report[1] if report and time.monotonic() - when < VALID else None
        return {'share': claim.share if claim and claim.share < UNLIMITED else None,
                'latency': claim and claim.latency or None}

    def _crossing(self, one: Crossing) -> dict[str, Any]:
        return {'topic': one.topic, 'type': one.kind, 'from': one.sources, 'to': one.targets,
                'large': one.large, **self._rates(one.topic)}


def _take_lines(node: GraphNode) -> None:
    for line in sys.stdin:
        with contextlib.suppress(ValueError, TypeError, KeyError, AttributeError):
            message = json.loads(line)
            node.know(message['machines'], pictures=bool(message['pictures']))
    rclpy.try_shutdown()


def _make() -> GraphNode:
    node = GraphNode()
    threading.Thread(target=_take_lines, args=(node,), daemon=True).start()
    return node


def main() -> None:
    """Run until standard input ends."""
    os.nice(5)  # the nodes of the launch have priority
    ending.run(_make)


if __name__ == '__main__':
    main()
