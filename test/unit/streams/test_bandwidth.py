# SPDX-License-Identifier: Apache-2.0
"""The keyword ``bandwidth`` of machines."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip('launch', reason='rclpy is not installed')
from launch import LaunchContext

from fogros2 import ContainerInstance
from fogros2.errors import ConfigurationError
from fogros2.feature import options


@pytest.mark.parametrize(('given', 'bits'), [
    (None, 0.0), ('10Mbit/s', 10e6), ('2.5 Mbit/s', 2.5e6), ('500kbit/s', 500e3),
    ('1Gbit/s', 1e9), ('250000bit/s', 250e3), (10_000_000, 10e6), ('1000000', 1e6)])
def test_bandwidth_is_read_as_bits_per_second(given: Any, bits: float) -> None:
    machine = ContainerInstance(name='a', bandwidth=given).spec(LaunchContext())
    assert options('streams', machine.features.get('streams', {})).bandwidth == bits


@pytest.mark.parametrize(('given', 'said'), [
    (0, 'bandwidth=0 is no bandwidth from 100 kbit/s'), (-1e6, 'is no bandwidth'),
    ('-1Mbit/s', 'is no bandwidth'), ('fast', "write '500kbit/s', '10Mbit/s' or '1Gbit/s'"),
    ('10MB/s', "bandwidth='10MB/s' is no bandwidth"), ('10', "bandwidth='10' is no bandwidth"),
    ('nan', 'is no bandwidth')])
def test_wrong_bandwidth_is_refused_where_it_is_written(given: Any, said: str) -> None:
    with pytest.raises(ConfigurationError) as error:
        ContainerInstance(bandwidth=given)
    assert said in str(error.value)
