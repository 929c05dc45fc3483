# SPDX-License-Identifier: Apache-2.0
"""The order in which a creation asks for capacity."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from fogros2.model import CreateRequest, MachineSpec
from fogros2.provider.vm.cloud import CloudError, Place
from fogros2.provider.vm.creation import Creation
from fogros2.provider.vm.options import VmOptions


class Options(VmOptions):
    machine_type = 'small'
    machine_types = ('large', 'huge')
    DEFAULT_TYPE = 'small'


def test_full_zone_is_tried_once_for_each_type() -> None:
    tried: list[tuple[str, str]] = []

    def insert(place: Place, *others: Any) -> str:
        tried.append((place.kind, place.zone))
        raise CloudError('full', 'wait', full='zone')

    cloud: Any = SimpleNamespace(
        title='Meadow', text_limit=0, find=lambda *_: [], begin=lambda *_: None, insert=insert,
        prepare=lambda region, order, types: dict.fromkeys(types),
        places=lambda *_: ['a', 'b'],  # a list: an adapter need not write a generator
        undo_begin=lambda *_: [], end_attempt=lambda *_: False)
    creation = Creation(
        cloud, cloud, MachineSpec('planner', 'meadow', {}), CreateRequest('token', 'key', {}, 1),
        Options(region='north'), sources=lambda: [], price=lambda *_: None)
    with pytest.raises(CloudError, match='full'):
        creation.run(['north'])
    assert tried == [(kind, zone) for kind in ('small', 'large', 'huge') for zone in ('a', 'b')]
