# SPDX-License-Identifier: Apache-2.0
"""A budget: how it is written, when the user is warned, and what is left."""

from __future__ import annotations

from decimal import Decimal
from types import SimpleNamespace
from typing import Any

import pytest

from fogros2 import ContainerInstance
from fogros2.errors import ConfigurationError
from fogros2.waiting import wait_until
from fogros2_features.budget import Budget


@pytest.mark.parametrize('written', ['5 USD', '5USD', '$5', '5', 5, '5.00'])
def test_sum_is_in_us_dollars(written: Any) -> None:
    assert Budget.options(written) == 5


@pytest.mark.parametrize('written', ['', '5 EUR', '0', '-1', 'much', '1e3', '$5 USD', '5\n6'])
def test_anything_else_is_no_sum(written: str) -> None:
    with pytest.raises(ConfigurationError, match='is no sum of US dollars'):
        Budget.options(written)


def test_wrong_sum_is_named_where_it_is_written() -> None:
    with pytest.raises(ConfigurationError, match="budget='5 EUR' is no sum"):
        ContainerInstance(name='a', budget='5 EUR')


def warned(own: str, lifetime: float, cost: tuple[Any, Any], wait: bool) -> list[str]:
    said: list[str] = []
    running = SimpleNamespace(cost=cost, spec=SimpleNamespace(lifetime=lifetime, on_exit='stop'),
                              warn=lambda text, remedy: said.append(f'{text}; {remedy}'))
    with Budget().machine(running, Decimal(own)):  # type: ignore[arg-type]
        if wait:
            wait_until(lambda: said or None, timeout=30.0, what='the warning')
    return said


def test_user_is_warned_when_most_is_spent() -> None:
    # 0.0001 dollars, at 1 dollar an hour, are 0.36 s
    assert warned('1', 900.0, (Decimal(1), Decimal('0.7999')), wait=True) == [
        "80% of its budget of $1.00 is spent; it ends when the rest is spent, as "
        "on_exit='stop' says"]


@pytest.mark.parametrize(('lifetime', 'cost'), [
    (900.0, (None, Decimal(0))), (900.0, (Decimal(0), Decimal(0))),
    (900.0, (Decimal(1), Decimal(0))), (9000.0, (Decimal(1), Decimal(0)))])
def test_nobody_is_warned_before(lifetime: float, cost: tuple[Any, Any]) -> None:
    assert warned('1', lifetime, cost, wait=False) == []


def test_free_machine_keeps_its_lifetime() -> None:
    spec: Any = SimpleNamespace(name='a', lifetime=60.0)
    assert Budget().lifetime(spec, Decimal(0), Decimal(0), Decimal(5), made=False) == 60.0


@pytest.mark.parametrize(('shown', 'rows'), [
    ({'cost_per_hour': '2', 'time_left': 5400.0}, [('budget', '$3.00 more at most, of $5.00')]),
    ({'cost_per_hour': '2', 'time_left': 90000.0}, [('budget', '$5.00 more at most, of $5.00')]),
    ({'cost_per_hour': None, 'time_left': 5400.0}, []),
    ({'cost_per_hour': '2', 'time_left': None}, [])])
def test_status_shows_what_it_may_still_cost(shown: dict[str, Any], rows: Any) -> None:
    assert list(Budget().status(shown, Decimal(5))) == rows


def test_machine_that_exists_may_use_the_rest() -> None:
    spec: Any = SimpleNamespace(name='a', lifetime=9e9)
    arguments = spec, Decimal(1), Decimal('4.9'), Decimal(5)
    assert Budget().lifetime(*arguments, made=True) == pytest.approx(360.0)
    with pytest.raises(ConfigurationError, match='pays for 360 s: less than the 600 s'):
        Budget().lifetime(*arguments, made=False)
    with pytest.raises(ConfigurationError, match='pays for 0 s'):
        Budget().lifetime(spec, Decimal(1), Decimal(6), Decimal(5), made=True)
