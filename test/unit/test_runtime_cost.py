# SPDX-License-Identifier: Apache-2.0
"""The last words of a launch, about money."""

from __future__ import annotations

from decimal import Decimal

import pytest

from fogros2.feature import Cost
from fogros2.model import MachineSpec
from fogros2.runtime import cost


def paid(name, price, seconds):
    return Cost(MachineSpec(name, 'fake'), price, seconds)


def test_a_launch_without_costs_says_nothing():
    assert cost.lines([paid('unknown', None, 60.0), paid('free', Decimal(0), 60.0),
                       paid('not created', Decimal(1), 0.0)]) == []


def test_one_machine():
    assert cost.lines([paid('planner', Decimal('0.0416'), 5400.0)]) == [
        'planner: 1.50 h at $0.0416 an hour, $0.062']


def test_several_have_a_sum():
    assert cost.lines([paid('a', Decimal('1.10'), 3600.0), paid('b', Decimal('20'), 36.0)]) == [
        'a: 1.00 h at $1.1 an hour, $1.10', 'b: 0.01 h at $20 an hour, $0.20',
        'all machines: $1.30']


@pytest.mark.parametrize(('amount', 'text'), [
    ('0', '0.00'), ('0.000042817', '0.000043'), ('0.0949', '0.095'), ('0.1', '0.10'),
    ('12.345', '12.34'), ('1234.5', '1234.50')])
def test_amounts(amount, text):
    assert cost.short(Decimal(amount)) == text


@pytest.mark.parametrize(('seconds', 'text'), [
    (3.7, '0.0010 h'), (90.0, '0.025 h'), (360.0, '0.10 h'), (5400.0, '1.50 h'),
    (720000.0, '200.00 h')])
def test_hours(seconds, text):
    assert cost.lines([paid('planner', Decimal(1), seconds)])[0].startswith(f'planner: {text} at')
