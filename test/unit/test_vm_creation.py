# SPDX-License-Identifier: Apache-2.0
"""The order in which a creation asks for capacity, and what an attempt leaves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
from decimal import Decimal
import gzip
import json
import logging
import threading
from types import SimpleNamespace
from typing import Any, Optional

import pytest

from fogros2.errors import Cancelled, ProviderError
from fogros2.model import CreateRequest, MachineSpec, MachineState
from fogros2.provider import TAG_NAME, TAG_ROBOT
from fogros2.provider.aws.cloud import Ec2
from fogros2.provider.aws.provider import AWSProvider
from fogros2.provider.vm import provider
from fogros2.provider.vm.cloud import (
    CloudError,
    Order,
    Place,
    TAG_ATTEMPT,
    TAG_MADE,
    Vm,
    VmCloud,
    VmId,
)
from fogros2.provider.vm.creation import Creation
from fogros2.provider.vm.options import VmOptions


class Options(VmOptions):
    machine_type = 'small'
    machine_types = ('large', 'huge')
    DEFAULT_TYPE = 'small'


def create(
    insert: Callable[..., str], zones: Sequence[str] = ('a', 'b'), price: Optional[str] = '0.05',
    regions: Sequence[str] = ('north',), end_attempt: Callable[..., bool] = lambda *_: False,
    **options: Any,
) -> VmId:
    cloud: Any = SimpleNamespace(
        title='Meadow', boot='', find=lambda *_: [], begin=lambda *_: None, insert=insert,
        prepare=lambda region, order, types: dict.fromkeys(types),
        places=lambda *_: zones,  # a sequence: an adapter need not write a generator
        undo_begin=lambda *_: [], end_attempt=end_attempt,
        end_command=lambda machine, tags: machine)
    return Creation(
        cloud, cloud, MachineSpec('planner', 'meadow', {}),
        CreateRequest('token', 'key', {}, 1, agent_config={'launch': 'l1'}),
        Options(region='north', **options), sources=lambda: [],
        price=lambda *_: None if price is None else Decimal(price)).run([*regions])


def test_full_zone_is_tried_once_for_each_type() -> None:
    tried: list[tuple[str, str]] = []

    def insert(place: Place, *others: Any) -> str:
        tried.append((place.kind, place.zone))
        raise CloudError('full', 'wait', full='zone')

    with pytest.raises(CloudError, match='full'):
        create(insert)
    assert tried == [(kind, zone) for kind in ('small', 'large', 'huge') for zone in ('a', 'b')]


@pytest.mark.parametrize(('zones', 'limit', 'words'), [
    ([], None, ''), (['a'], Decimal('0.01'), ' that is known to cost at most max_price=0.01')])
def test_price_limit_is_named_if_it_excludes_all_types(
    zones: list[str], limit: Optional[Decimal], words: str,
) -> None:
    with pytest.raises(CloudError) as caught:
        create(lambda *_: '', zones, max_price=limit)
    assert caught.value.args[0] == f'Meadow has no small or large or huge in north{words}'
    assert caught.value.no_capacity


def test_end_command_gets_the_id_of_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Ec2, 'end_command', lambda self, machine, tags: machine)
    sent: list[bytes] = []

    def insert(place: Place, order: Order, *others: Any) -> str:
        sent.append(order.user_data)
        return 'i-1'

    region, vm, attempt = create(insert)
    report = Vm(vm, region, MachineState.RUNNING, {TAG_ATTEMPT: attempt})
    assert AWSProvider().machine_of(report).end_command == ('north', 'i-1', attempt)
    # nobody knows the id before the machine exists
    boot = json.loads(gzip.decompress(sent[0]).decode().partition('\n')[2])['bootcmd']
    assert f'"end_command": ["north", "", "{attempt}"]' in boot[0][-1]


def test_leftovers_are_old_or_of_dead_launches(caplog: pytest.LogCaptureFixture) -> None:
    now = 1e9
    made = {'old': '0', 'no time': None, 'new': '999999950', 'dead': '999999950',
            'of another robot': '0', 'with a machine': '0', 'damaged': 'nan', 'dead, damaged': '-'}
    tags = [{TAG_ATTEMPT: attempt, TAG_NAME: f'{attempt} one', **({} if at is None else {
        TAG_MADE: at})} for attempt, at in made.items()]
    next(one for one in tags if one[TAG_ATTEMPT] == 'of another robot')[TAG_ROBOT] = (
        'neighbour-0-00000000')
    adapter: Any = SimpleNamespace(
        title='Meadow', attempts=lambda region: ['with a machine'],
        remains=lambda region: [*tags, {TAG_MADE: '0'}])
    with caplog.at_level(logging.WARNING):
        names = VmCloud.leftovers(adapter, 'north', now, {'dead', 'dead, damaged'})
    assert names == {attempt: f'{attempt} one' for attempt in (
        'old', 'no time', 'dead', 'dead, damaged')}
    (record,) = caplog.records
    assert "'damaged one' has the damaged tag fogros2-made='nan'" in record.message


def test_launch_that_ends_does_not_wait_for_a_machine_to_stop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine = AWSProvider()
    machine.cancel = cancel = threading.Event()

    def get(self: Ec2, region: str, vm: str) -> SimpleNamespace:
        cancel.set()
        return SimpleNamespace(state=MachineState.STOPPING)

    monkeypatch.setattr(Ec2, 'get', get)
    monkeypatch.setattr(provider, 'END_TIMEOUT', 0.1)
    with pytest.raises(Cancelled):
        machine.start(f'aws:eu-west-1/i-{"0" * 17}/{"0" * 16}')


def test_machine_of_a_region_before_may_exist() -> None:
    """The region's refusal is sure, its clean-up is not."""
    def insert(place: Place, *others: Any) -> str:
        raise CloudError('full', 'wait', full='zone')

    def end_attempt(region: str, attempt: str) -> bool:
        if region == 'north':
            raise ProviderError('no answer')
        return False

    with pytest.raises(CloudError, match='full') as caught:
        create(insert, regions=['north', 'south'], end_attempt=end_attempt)
    assert caught.value.refused is False and len(caught.value.undo_failures) == 1


@pytest.mark.parametrize(('spot', 'tried'), [(False, []), (True, ['small'])])
def test_type_of_unknown_price_is_above_any_limit(spot: bool, tried: list[str]) -> None:
    """A cloud itself keeps the limit of a spot machine."""
    found: list[str] = []

    def insert(place: Place, *others: Any) -> str:
        found.append(place.kind)
        return 'm-1'

    with contextlib.nullcontext() if spot else pytest.raises(CloudError, match='max_price=1'):
        create(insert, price=None, spot=spot, max_price=Decimal(1))
    assert found == tried
