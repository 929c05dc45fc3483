#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
A participant of Cyclone DDS without ROS 2, with the arguments and the output of ``dds_node.py``.

Topics and types have the names that ROS 2 gives them.
"""

import argparse
from dataclasses import dataclass
import json
import signal
import time

from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

QOS = Qos(Policy.Reliability.Reliable(duration(milliseconds=100)), Policy.History.KeepLast(10))


@dataclass
class String(IdlStruct, typename='std_msgs::msg::dds_::String_'):
    data: str


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument('topics', nargs='+')
    parser.add_argument('--period', type=float, default=0.1)
    parser.add_argument('--size', type=int, default=0)
    arguments = parser.parse_args()
    ended = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ended.append(True))
    participant = DomainParticipant(0)
    waitset = WaitSet(participant)
    writers, readers = [], []
    for word in arguments.topics:
        kind, _, name = word.partition(':')
        topic = Topic(participant, f'rt{name}', String)
        if kind == 'to':
            writers.append(DataWriter(participant, topic, QOS))
        else:
            readers.append((name, DataReader(participant, topic, QOS)))
            waitset.attach(ReadCondition(
                readers[-1][1], SampleState.NotRead | ViewState.Any | InstanceState.Any))
    print(json.dumps({'ready': True}), flush=True)
    padding = 'x' * arguments.size
    due, count = time.monotonic(), 0
    while not ended:
        if time.monotonic() >= due:
            due += arguments.period
            for writer in writers:
                writer.write(String(f'{count} {time.monotonic()!r} {padding}'))
            count += 1
        pause = max(0.001, min(0.2, due - time.monotonic()))
        if readers:
            waitset.wait(duration(seconds=pause))
        else:  # a wait set without a condition returns at once
            time.sleep(pause)
        for name, reader in readers:
            for sample in reader.take(N=100):
                if not isinstance(sample, String):
                    continue  # the end of a writer
                arrival = time.monotonic()
                number, sent = sample.data.split()[:2]
                print(json.dumps({'topic': name, 'number': int(number), 'arrival': arrival,
                                  'latency': arrival - float(sent)}), flush=True)


if __name__ == '__main__':
    main()
