# SPDX-License-Identifier: Apache-2.0
"""
End machines when a launch has spent on them, or on all together, what it may.

What a budget has left pays for all machines that run or will be created until one time, the same
for all. That time limits each machine's lifetime, which its agent enforces.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import contextlib
from decimal import Decimal
import json
import re
from typing import Any, NamedTuple, Optional, TYPE_CHECKING

from fogros2 import feature
from fogros2.errors import ConfigurationError, FogError
from fogros2.feature import Cost, Feature, LaunchPart, RunningLaunch
from fogros2.model import MachineSpec
from fogros2.store import Store, write_private

if TYPE_CHECKING:
    from fogros2.describe.machines import Scalar

#: The share of a budget at which the user is warned.
WARNING = Decimal('0.8')
#: The least seconds that a machine is created for: it takes minutes to come up.
LEAST = 600.0
#: Seconds that are kept back: a cloud bills before ``create`` returns and while a machine ends.
ENDING = 60.0
#: Seconds between two looks at what is spent.
INTERVAL = 5.0
#: In a launch's folder: what its budgets have left.
FILE = 'budgets.json'


class Own(NamedTuple):
    """What a machine's keywords say, in US dollars."""

    budget: Optional[Decimal]
    launch_budget: Optional[Decimal]


class Budget(Feature):
    """``budget='5 USD'``, ``launch_budget='20 USD'``: the most that a launch spends."""

    # the launch's budget may be another machine's keyword
    always = True

    @staticmethod
    def options(budget: Optional[Scalar] = None, launch_budget: Optional[Scalar] = None) -> Own:
        """
        Return the budgets.

        :param budget: of the machine and its replacements, such as '5 USD', '$5' or 5.
        :param launch_budget: of all machines of the launch; one machine may have it for all.
        """
        return Own(_read('budget', budget), _read('launch_budget', launch_budget))

    def in_launch(self, launch: RunningLaunch) -> LaunchPart:
        """Return what watches the budgets."""
        return Spending(launch)

    def lifetime(
        self, spec: MachineSpec, costs: Sequence[Cost], own: Own, *, made: bool,
    ) -> float:
        """Return the seconds for which all budgets of the machine pay."""
        result = spec.lifetime
        price = next((one.price for one in costs
                      if one.spec.name == spec.name and not one.ended), Decimal(0))
        for machine, budget, paid in _budgets(costs):
            if machine not in ('', spec.name):
                continue
            whose = f"'{machine}'" if machine else 'the launch'
            for one in paid:
                if one.price is None:
                    raise ConfigurationError(
                        f"the price of '{one.spec.name}' is unknown: the budget of {whose} can't "
                        'be kept', 'leave the budget out, or use a machine whose price '
                        '`ros2 fog list` would show')
            if not price:
                continue
            rest = budget - _spent(paid)
            rate = sum(one.price or Decimal(0) for one in paid if not one.ended)
            seconds = float(rest / rate) * 3600 - ENDING
            if seconds < (1.0 if made else LEAST):
                raise ConfigurationError(
                    f'{whose} has {_dollars(max(rest, Decimal(0)))} of its budget of '
                    f'{_dollars(budget)} left, which pays for {max(seconds, 0.0):.0f} s: less '
                    f'than the {LEAST:g} s that a machine is made for',
                    'raise the budget, or take a smaller machine')
            result = min(result, seconds)
        return result

    def status(self, shown: Mapping[str, Any], own: Own) -> Iterator[tuple[str, str]]:
        """Yield what the budgets of the machine and of its launch have left."""
        path = Store().root / 'launches' / (shown['launch'] or '') / FILE
        if shown['launch_alive'] and path.exists():
            for machine, budget, rest in json.loads(path.read_text()):
                if machine in ('', shown['name']):
                    yield 'budget' if machine else 'launch budget', f'{rest} left of {budget}'


class Spending(LaunchPart):
    """Warn of budgets that are spent soon, and note for ``ros2 fog status`` what they have."""

    def __init__(self, launched: RunningLaunch) -> None:
        self._launch = launched
        self._warned: set[str] = set()
        self._noted: list[tuple[str, str, str]] = []

    def watch(self) -> None:
        """Look at what is spent."""
        while True:
            with contextlib.suppress(FogError):  # a machine that disagrees is refused elsewhere
                self.look()
            if self._launch.ended.wait(INTERVAL):
                return

    def look(self) -> None:
        """
        Look at what is spent now.

        :raises ConfigurationError: machines disagree.
        """
        import launch.logging
        rests = []
        for machine, budget, paid in _budgets(self._launch.costs):
            spent = _spent(paid)
            if spent >= WARNING * budget and machine not in self._warned:
                self._warned.add(machine)
                what = f'{machine}: {WARNING:.0%} of its' if machine \
                    else f"{WARNING:.0%} of the launch's"
                launch.logging.get_logger('fogros2').warning(
                    f'{what} budget of {_dollars(budget)} is spent\n'
                    'what it pays for ends with the rest: it is deleted, or stopped with '
                    "on_exit='stop'")
            rests.append((machine, _dollars(budget), _dollars(max(budget - spent, Decimal(0)))))
        if rests != self._noted:
            self._noted = rests
            write_private(self._launch.folder / FILE, json.dumps(rests).encode())


def _budgets(costs: Sequence[Cost]) -> Iterator[tuple[str, Decimal, Sequence[Cost]]]:
    """
    Yield each budget: its machine, '' for the launch's, its dollars, and what it pays for.

    :raises ConfigurationError: two machines disagree about the launch's.
    """
    given: list[tuple[str, Own]] = [(one.spec.name, feature.options(
        'budget', one.spec.features.get('budget', {}))) for one in costs]
    shared = {own.launch_budget: name for name, own in given if own.launch_budget is not None}
    if len(shared) > 1:
        raise ConfigurationError(
            'machines of this launch have different budgets for it: ' + ', '.join(
                f"'{name}' launch_budget={_dollars(budget)}" for budget, name in shared.items()),
            'give one to one machine or the same to all')
    for budget in shared:
        yield '', budget, costs
    for name, own in dict(given).items():
        if own.budget is not None:
            yield name, own.budget, [one for one in costs if one.spec.name == name]


def _read(keyword: str, value: Optional[Scalar]) -> Optional[Decimal]:
    if value is None:
        return None
    text = str(value).strip()
    match = re.fullmatch(r'\$?(\d{1,9}(?:\.\d{1,6})?)|(\d{1,9}(?:\.\d{1,6})?) ?USD', text)
    if match is None or not Decimal(match[1] or match[2]):
        raise ConfigurationError(f'{keyword}={text!r} is no sum of US dollars',
                                 "write '5 USD' or 0.5")
    return Decimal(match[1] or match[2])


def _spent(costs: Sequence[Cost]) -> Decimal:
    return sum((one.spent for one in costs), Decimal(0))


def _dollars(value: Decimal) -> str:
    return f'${value:.2f}'
