# SPDX-License-Identifier: Apache-2.0
"""Read the figures of replicas, which the nodes ``first_answer`` write; compare their cost."""

from __future__ import annotations

from collections.abc import Sequence
import contextlib
import json
from pathlib import Path
from typing import Any, Optional, TYPE_CHECKING

from fogros2.errors import ConfigurationError

if TYPE_CHECKING:
    from fogros2.provider.offers import Offer

#: Names of the columns of :func:`row`.
HEADER = ('REPLICA OF', 'STATE', 'SHARE', 'LATENCY', 'P95', 'FAILURES')


def figures(folder: Path, machine: str) -> list[dict[str, Any]]:
    """
    Return the figures of a machine, one for each service or output that it replicates.

    :param folder: the launch's folder, whether or not it exists.
    """
    rows: list[dict[str, Any]] = []
    for path in sorted(folder.glob('first_answer_*.json')):
        with contextlib.suppress(OSError, ValueError):
            rows += [one for one in json.loads(path.read_text()) if one['machine'] == machine]
    return rows


def row(one: dict[str, Any]) -> tuple[str, ...]:
    """Return figures as words, one for each column."""
    share = '-' if one['share'] is None else f"{one['share']:.0%}"
    return one['of'], one['state'], share, _ms(one['latency']), _ms(one['p95']), \
        str(one['failures'])


def price(offers: Sequence[Offer], number: int, *, spot: bool) -> str:
    """
    Compare the cost of replicas, the cheapest offers, with that of one machine on demand.

    :raises ConfigurationError: there are not enough offers, or none on demand.
    """
    costs = sorted(cost for one in offers if (cost := one.cost(spot)) is not None)[:number]
    alone = min((one.price for one in offers if one.price is not None), default=None)
    if number < 2 or len(costs) < number or alone is None:
        raise ConfigurationError(f'--replicas {number}: {len(costs)} offers match',
                                 'give 2 or more, and search more regions: --region all')
    return (f"{number} replicas{' on spot machines' if spot else ''} ${sum(costs):.4f} an hour, "
            f'one machine on demand ${alone:.4f}: {sum(costs) / alone:.2f} times')


def _ms(value: Optional[float]) -> str:
    return '-' if value is None else f'{value:.1f} ms'
