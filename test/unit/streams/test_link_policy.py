# SPDX-License-Identifier: Apache-2.0
"""The keywords ``bandwidth``, ``deny_topics`` and ``limit_topics`` of machines."""

from __future__ import annotations

import json
from typing import Any

import pytest

pytest.importorskip('launch', reason='rclpy is not installed')
from launch import LaunchContext

from fogros2 import ContainerInstance
from fogros2.errors import ConfigurationError
from fogros2.feature import options
from fogros2.model import MachineSpec
from fogros2_features.streams import Streaming


def policy(**keywords: Any) -> Any:
    machine = ContainerInstance(name='gpu-1', **keywords).spec(LaunchContext())
    return options('streams', machine.features.get('streams', {}))


@pytest.mark.parametrize(('given', 'bits'), [
    (None, 0.0), ('10Mbit/s', 10e6), ('2.5 Mbit/s', 2.5e6), ('500kbit/s', 500e3),
    ('1Gbit/s', 1e9), ('250000bit/s', 250e3), (10_000_000, 10e6), ('1000000', 1e6)])
def test_bandwidth_is_read_as_bits_per_second(given: Any, bits: float) -> None:
    assert policy(bandwidth=given).bandwidth == bits


@pytest.mark.parametrize(('given', 'hertz'), [
    ('20 Hz', 20.0), ('0.5Hz', 0.5), (' 7 ', 7.0), (20, 20.0), (0.1, 0.1)])
def test_rate_is_read_as_messages_per_second(given: Any, hertz: float) -> None:
    assert policy(limit_topics={'/tf': given}).limits == {'/tf': hertz}


def test_denied_and_limited_topics_have_the_names_of_the_machine() -> None:
    made = policy(deny_topics=['/costmap'], limit_topics={'/tf': 20})
    assert made.names('gpu-1') == {
        '/costmap': '/fogros2/gpu_1/costmap', '/tf': '/fogros2/gpu_1/tf'}
    (robot, here), (machine, away) = made.ends('gpu-1')
    assert (robot, machine) == (None, 'gpu-1') and here.id != away.id
    out, back = '/fogros2/gpu_1/tf/from_robot', '/fogros2/gpu_1/tf/from_machine'
    assert [json.loads(str(node.arguments[0])) for node in (here, away)] == [
        [['/tf', out, back, 0.05]], [['/fogros2/gpu_1/tf', back, out, 0.05]]]


def test_link_without_limits_has_no_programs() -> None:
    assert policy(deny_topics=['/costmap']).ends('a') == policy().ends('a') == []


@pytest.mark.parametrize(('keywords', 'message'), [
    ({'bandwidth': 0}, 'bandwidth=0 is no bandwidth from 100 kbit/s'),
    ({'bandwidth': -1e6}, 'is no bandwidth'),
    ({'bandwidth': 'fast'}, "write '500kbit/s', '10Mbit/s' or '1Gbit/s'"),
    ({'bandwidth': '10MB/s'}, "bandwidth='10MB/s' is no bandwidth"),
    ({'bandwidth': 'nan'}, 'is no bandwidth'),
    ({'deny_topics': ['costmap']}, "'costmap' is not the full name of a topic"),
    ({'deny_topics': ['/tf_static']}, '/tf_static in deny_topics would leave nodes without'),
    ({'limit_topics': {'/tf_static': 1}}, '/tf_static in limit_topics would leave nodes'),
    ({'limit_topics': {'/go/_action/feedback': 1}}, 'belongs to an action or a service'),
    ({'deny_topics': ['/plan/_service_event']}, 'belongs to an action or a service'),
    ({'limit_topics': {'/tf': 'fast'}}, "'fast' of /tf in limit_topics is no rate"),
    ({'limit_topics': {'/tf': '20 kHz'}}, 'is no rate from 0.01 to 1000 Hz'),
    ({'limit_topics': {'/tf': 0}}, "write limit_topics={'/tf': '20 Hz'}"),
    ({'deny_topics': ['/tf'], 'limit_topics': {'/tf': 1}}, 'is in deny_topics and in limit'),
    ({'deny_topics': '/tf'}, "deny_topics=['/tf']")])
def test_wrong_policy_is_refused(keywords: Any, message: str) -> None:
    with pytest.raises(ConfigurationError) as error:
        policy(**keywords)
    assert message in str(error.value)


def test_shared_topic_is_neither_denied_nor_limited() -> None:
    spec = MachineSpec('a', 'container', features={'share': {'share': ['/map', '/news']}})
    Streaming().check(spec, policy(deny_topics=['/costmap']))
    with pytest.raises(ConfigurationError, match="'a' has /map in share= and in deny_topics or"):
        Streaming().check(spec, policy(limit_topics={'/map': 1}))
