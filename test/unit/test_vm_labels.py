# SPDX-License-Identifier: Apache-2.0
"""Tags survive the character rules of a cloud's labels."""

from __future__ import annotations

import re

import pytest

from fogros2.provider.vm.labels import LabelRules

TAGS = {
    'fogros2-name': 'planner',
    'fogros2-host-key': 'ssh-ed25519 AAAAC3NzaC1lZDI1NTE5' + 'x/+=' * 20,
    'fogros2-robot': 'Robot_7-1000', 'fogros2-note': 'Grüße', 'fogros2-empty': '', 'team_1': 'red',
    'lab': 'a', 'lab_1': 'b', 'lab_2': 'c', '_1': 'd'}


@pytest.mark.parametrize('rules', [LabelRules(), LabelRules(plain='a-z0-9', longest=7),
                                   LabelRules(plain='A-Za-z0-9 +./=-', longest=256)])
def test_tags_are_decoded_as_they_were(rules: LabelRules) -> None:
    labels = rules.encode(TAGS)
    assert rules.decode(labels) == TAGS
    for value in labels.values():
        assert len(value) <= rules.longest and re.fullmatch(f'[_{rules.plain}]*', value)


def test_plain_value_stays_readable() -> None:
    assert LabelRules().encode({'fogros2-name': 'planner-2'}) == {'fogros2-name': 'planner-2'}
