# SPDX-License-Identifier: Apache-2.0
"""What replicas cost, compared with one machine on demand."""

from __future__ import annotations

from decimal import Decimal
from types import SimpleNamespace

import pytest

from fogros2.errors import ConfigurationError
from fogros2_features.replicas import price


def offer(price, spot_price):
    price, spot_price = (None if one is None else Decimal(one) for one in (price, spot_price))
    return SimpleNamespace(
        price=price, spot_price=spot_price, cost=lambda spot: spot_price if spot else price)


OFFERS = [offer('0.10', '0.03'), offer('0.08', '0.02'), offer(None, '0.01'), offer('0.2', None)]


def test_cheapest_spot_machines_are_compared_with_one_on_demand():
    assert price.line(OFFERS, SimpleNamespace(replicas=3, spot=True)) == (
        '3 replicas on spot machines $0.0600 an hour, one machine on demand $0.0800: 0.75 times')


def test_replicas_on_demand_cost_a_multiple():
    line = price.line(OFFERS, SimpleNamespace(replicas=2, spot=False))
    assert line.endswith('$0.0800: 2.25 times')


@pytest.mark.parametrize('number', [1, 4])
def test_too_few_offers_are_refused(number):
    with pytest.raises(ConfigurationError, match=f'--replicas {number}: [13] offers match'):
        price.line(OFFERS, SimpleNamespace(replicas=number, spot=True))
