# SPDX-License-Identifier: Apache-2.0
"""Budgets: how they are written, until when they pay, and when the user is warned."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path
import threading
from types import SimpleNamespace
from typing import Any, Optional

import pytest

from fogros2 import ContainerInstance
from fogros2.errors import ConfigurationError
from fogros2.feature import Cost
from fogros2.model import MachineSpec
from fogros2.store import Store
from fogros2_features import budget
from fogros2_features.budget import Budget, Spending


@pytest.mark.parametrize('written', ['5 USD', '5USD', '$5', '5', 5, '5.00'])
def test_sum_is_in_us_dollars(written: Any) -> None:
    assert Budget.options(written, launch_budget=written) == (5, 5)


@pytest.mark.parametrize('written', ['', '5 EUR', '0', '-1', 'much', '1e3', '$5 USD', '5\n6'])
def test_anything_else_is_no_sum(written: str) -> None:
    for keyword in ('budget', 'launch_budget'):
        with pytest.raises(ConfigurationError, match=f'{keyword}=.* is no sum of US dollars'):
            Budget.options(**{keyword: written})


def test_wrong_sum_is_named_where_it_is_written() -> None:
    with pytest.raises(ConfigurationError, match="launch_budget='5 EUR' is no sum"):
        ContainerInstance(name='a', launch_budget='5 EUR')


def cost(
    name: str, price: Optional[float], hours: float = 0.0, *, ended: bool = False,
    **budgets: Any,
) -> Cost:
    spec = MachineSpec(name, 'fake', lifetime=9e9, features={'budget': budgets})
    return Cost(spec, None if price is None else Decimal(str(price)), hours * 3600, ended)


def hours(*costs: Cost, made: bool = False) -> float:
    """Return how long the first machine may run, and end."""
    own = Budget.options(**costs[0].spec.features['budget'])
    seconds = Budget().lifetime(costs[0].spec, costs, own, made=made)
    return round((seconds + (60.0 if seconds < 9e9 else 0.0)) / 3600, 6)


@pytest.mark.parametrize(('costs', 'expected'), [
    ([cost('a', 2, budget=5)], 2.5),
    # a machine that it replaces has spent
    ([cost('a', 2, budget=5), cost('a', 4, 1, ended=True, budget=5)], 0.5),
    ([cost('a', 2, budget=5), cost('b', 4, 1)], 2.5),
    # all that run, or will be created, end at one time
    ([cost('a', 2, launch_budget=12), cost('b', 4)], 2.0),
    ([cost('a', 2), cost('b', 4, 1, launch_budget=10), cost('b', 3, 1, ended=True)], 0.5),
    # the first budget that is spent counts
    ([cost('a', 2, budget=3, launch_budget=12), cost('b', 4)], 1.5),
    ([cost('a', 2, budget=5, launch_budget=12), cost('b', 4)], 2.0),
    # what costs nothing stays, and shortens nothing
    ([cost('a', 0, budget=1, launch_budget=1)], 2.5e6),
    ([cost('a', 2, launch_budget=5), cost('b', 0)], 2.5),
    ([cost('a', None)], 2.5e6),
])
def test_machine_runs_as_long_as_its_budgets_pay(costs: list[Cost], expected: float) -> None:
    assert hours(*costs) == expected


@pytest.mark.parametrize(('costs', 'reason'), [
    ([cost('a', None, budget=1)], "price of 'a' is unknown: the budget of 'a' can't be kept"),
    ([cost('b', 1, launch_budget=1), cost('a', None)], "price of 'a' is .* of the launch"),
    ([cost('a', 1, launch_budget=1), cost('b', 1, launch_budget=2)],
     r"different budgets for it: 'a' launch_budget=\$1.00, 'b' launch_budget=\$2.00"),
    ([cost('a', 1, launch_budget=1), cost('b', 6.5, launch_budget=1)],
     r'the launch has \$1.00 of its budget of \$1.00 left, which pays for 420 s: less than the '
     '600 s'),
])
def test_machine_that_can_not_be_paid_is_refused(costs: list[Cost], reason: str) -> None:
    with pytest.raises(ConfigurationError, match=reason):
        hours(*costs)


def test_machine_that_exists_may_use_the_rest() -> None:
    assert hours(cost('a', 1, 4.9, budget=5), made=True) == 0.1
    with pytest.raises(ConfigurationError, match='pays for 0 s'):
        hours(cost('a', 1, 6, budget=5), made=True)


def test_user_is_warned_once_and_status_shows_what_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv('FOGROS2_STATE_HOME', str(tmp_path))
    costs: list[Cost] = []
    spending = Spending(SimpleNamespace(  # type: ignore[arg-type]
        costs=costs, folder=Store().launch_folder('0a0b0c'), ended=threading.Event()))

    def status(name: str) -> dict[str, str]:
        shown = {'launch': '0a0b0c', 'launch_alive': True, 'name': name}
        return dict(Budget().status(shown, Budget.options()))

    said: list[str] = []
    monkeypatch.setattr('launch.logging.get_logger', lambda name: SimpleNamespace(
        warning=said.append))
    assert status('a') == {}
    for spent in (1.5, 3.5, 3.6, 4.5, 9.0):
        costs[:] = [cost('a', 1, spent, budget=5), cost('b', 1, 3.5, launch_budget=10)]
        spending.look()
    assert [line.splitlines()[0] for line in said] == [
        "80% of the launch's budget of $10.00 is spent", 'a: 80% of its budget of $5.00 is spent']
    assert status('b') == {'launch budget': '$0.00 left of $10.00'}
    assert status('a') == {'budget': '$0.00 left of $5.00', **status('b')}
    assert Store().launch_folder('0a0b0c').joinpath(budget.FILE).stat().st_mode & 0o77 == 0


def test_watch_ends_with_the_launch(monkeypatch: pytest.MonkeyPatch) -> None:
    ended, looks = threading.Event(), []
    spending = Spending(SimpleNamespace(ended=ended))  # type: ignore[arg-type]

    def look() -> None:
        looks.append(1)
        if len(looks) > 1:
            ended.set()
        raise ConfigurationError('machines disagree')

    monkeypatch.setattr(budget, 'INTERVAL', 0.01)
    monkeypatch.setattr(spending, 'look', look)
    spending.watch()
    assert len(looks) == 2
