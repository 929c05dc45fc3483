# SPDX-License-Identifier: Apache-2.0
"""Which regions machines are looked for in, and asking all of them at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
import os
from typing import Optional, TypeVar

from fogros2.errors import FogError
from fogros2.provider.aws.clients import Account
from fogros2.provider.aws.failures import code_of, DENIED

T = TypeVar('T')

#: Names the regions that 'all regions' means, such as 'eu-central-1 us-east-1'.
REGIONS_VARIABLE = 'FOGROS2_AWS_REGIONS'
ALL = 'all'
#: Regions asked at once.
PARALLEL = 20


def named(chosen: Sequence[str]) -> list[str]:
    """Return the regions that somebody has named: those chosen, else the variable's."""
    return list(chosen) or os.environ.get(REGIONS_VARIABLE, '').replace(',', ' ').split()


def base(account: Account, chosen: Sequence[str]) -> str:
    """Return a region to ask what belongs to none."""
    regions = [region for region in named(chosen) if region != ALL]
    return account.region() or (regions[0] if regions else 'us-east-1')


def _regions(account: Account, chosen: Sequence[str]) -> tuple[list[str], bool]:
    """Return the regions to look in, and whether somebody has named them."""
    regions = named(chosen)
    if regions and ALL not in regions:
        return regions, True
    found = account.call('ec2', base(account, chosen), 'describe_regions',
                         'asking for the regions of the account')['Regions']
    return sorted(str(entry['RegionName']) for entry in found), False


def ask(account: Account, chosen: Sequence[str], question: Callable[[str], T]) -> list[T]:
    """
    Return what each region answers.

    A region that an organisation closes to these credentials can hold no machine of theirs: it
    counts only where it was named, or none is open.

    :param chosen: names, or 'all'; none for those of the variable, or all that are enabled.
    """
    regions, all_count = _regions(account, chosen)

    def attempt(region: str) -> tuple[Optional[T], Optional[FogError]]:
        try:
            return question(region), None
        except FogError as error:
            return None, error

    with ThreadPoolExecutor(min(PARALLEL, len(regions)), 'fog-aws') as pool:
        answers = list(pool.map(attempt, regions))
    found = [answer for answer, error in answers if answer is not None]
    for _, error in answers:
        if error is not None and (all_count or not found or code_of(error) not in DENIED):
            raise error
    return found
