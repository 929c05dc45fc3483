#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
A zenoh session for tests of the network: what ``dds_node.py`` is to ROS 2, with its arguments.

It reads ZENOH_SESSION_CONFIG_URI as rmw_zenoh's nodes do. With ``router`` for an argument it is
what ``rmw_zenohd`` is, and reads ZENOH_ROUTER_CONFIG_URI.
"""

import json
import os
import signal
import sys
import threading
import time

import zenoh

#: As rmw_zenoh's sessions have it without a configuration: the router of the computer.
OWN = {'mode': 'peer', 'connect': {'endpoints': ['tcp/127.0.0.1:7447']},
       'listen': {'endpoints': ['tcp/127.0.0.1:0']}, 'scouting': {'multicast': {'enabled': False}},
       'transport': {'shared_memory': {'enabled': False}}}  # its files would stay


def configuration(variable: str) -> zenoh.Config:
    path = os.environ.get(variable)
    return zenoh.Config.from_file(path) if path else zenoh.Config.from_json5(json.dumps(OWN))


def main() -> None:
    topics = sys.argv[1:]
    ended = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.set())
    if topics == ['router']:
        with zenoh.open(configuration('ZENOH_ROUTER_CONFIG_URI')):
            print(json.dumps({'ready': True}), flush=True)
            ended.wait()
        return
    with zenoh.open(configuration('ZENOH_SESSION_CONFIG_URI')) as session:
        kept = []
        for topic in topics:
            if topic.startswith('from:'):
                kept.append(session.declare_subscriber(
                    topic[6:], lambda sample, topic=topic[5:]: heard(topic, sample)))
        publishers = [session.declare_publisher(topic[4:]) for topic in topics
                      if topic.startswith('to:')]
        print(json.dumps({'ready': True}), flush=True)
        number = 0
        while not ended.wait(0.1):
            for publisher in publishers:
                publisher.put(f'{number} {time.monotonic()!r}')
            number += 1


def heard(topic: str, sample: zenoh.Sample) -> None:
    arrival = time.monotonic()
    count, sent = sample.payload.to_string().split()
    print(json.dumps({'topic': topic, 'number': int(count), 'arrival': arrival,
                      'latency': arrival - float(sent)}), flush=True)


if __name__ == '__main__':
    main()
