# SPDX-License-Identifier: Apache-2.0
"""End a machine when a launch has spent on it what it may."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import contextlib
from decimal import Decimal
import re
import threading
from typing import Any, Optional, TYPE_CHECKING

from fogros2.errors import ConfigurationError
from fogros2.feature import Feature, RunningMachine
from fogros2.model import MachineSpec

if TYPE_CHECKING:
    from fogros2.describe.machines import Scalar

#: The share of a budget at which the user is warned.
WARNING = Decimal('0.8')
#: The least seconds that a machine is created for: it takes minutes to come up.
LEAST = 600.0


class Budget(Feature):
    """``budget='5 USD'``: the most that a launch spends on a machine and its replacements."""

    @staticmethod
    def options(budget: Optional[Scalar] = None) -> Optional[Decimal]:
        """
        Return the budget in US dollars.

        :param budget: such as '5 USD', '$5' or 5.
        """
        if budget is None:
            return None
        text = str(budget).strip()
        match = re.fullmatch(r'\$?(\d{1,9}(?:\.\d{1,6})?)|(\d{1,9}(?:\.\d{1,6})?) ?USD', text)
        if match is None or not Decimal(match[1] or match[2]):
            raise ConfigurationError(f'budget={text!r} is no sum of US dollars',
                                     "write '5 USD' or 0.5")
        return Decimal(match[1] or match[2])

    def lifetime(
        self, spec: MachineSpec, price: Optional[Decimal], spent: Decimal, own: Decimal, *,
        made: bool,
    ) -> float:
        """Return the seconds that the rest of the budget pays for."""
        if price is None:
            raise ConfigurationError(
                f"the price of '{spec.name}' is unknown: its budget can't be kept",
                'leave budget= out, or use a machine whose price `ros2 fog list` would show')
        if not price:
            return spec.lifetime
        seconds = float((own - spent) / price) * 3600
        if seconds < (1.0 if made else LEAST):
            raise ConfigurationError(
                f"'{spec.name}' has {_dollars(max(own - spent, Decimal(0)))} of its budget of "
                f'{_dollars(own)} left, which pays for {max(seconds, 0.0):.0f} s: less than the '
                f'{LEAST:g} s that a machine is made for',
                'raise budget=, or take a smaller machine')
        return seconds

    @contextlib.contextmanager
    def machine(self, running: RunningMachine, own: Decimal) -> Iterator[None]:
        """Warn when most of the budget is spent."""
        price, spent = running.cost
        seconds = float((WARNING * own - spent) / price) * 3600 if price else 0.0
        if not 0 < seconds < running.spec.lifetime:
            yield
            return
        timer = threading.Timer(min(seconds, threading.TIMEOUT_MAX), running.warn, (
            f'{WARNING:.0%} of its budget of {_dollars(own)} is spent',
            f"it ends when the rest is spent, as on_exit='{running.spec.on_exit}' says"))
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()
            timer.join()

    def status(self, shown: Mapping[str, Any], own: Decimal) -> Iterator[tuple[str, str]]:
        """Yield what the machine may still cost."""
        if shown['cost_per_hour'] is not None and shown['time_left'] is not None:
            left = Decimal(shown['cost_per_hour']) * Decimal(shown['time_left']) / 3600
            yield 'budget', f'{_dollars(min(left, own))} more at most, of {_dollars(own)}'


def _dollars(value: Decimal) -> str:
    return f'${value:.2f}'
