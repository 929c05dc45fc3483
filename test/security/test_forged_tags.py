# SPDX-License-Identifier: Apache-2.0
"""A tag that another person writes neither reaches a command line nor ends a list of machines."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from fogros2.errors import NameTaken
from fogros2.model import Machine, MachineSpec, MachineState
from fogros2.provider import TAG_NAME
from fogros2.provider.gcp import firewall
from fogros2.provider.kubernetes import names
from fogros2.provider.vm.cloud import (
    TAG_ATTEMPT,
    TAG_DISK,
    TAG_HOST_KEY,
    TAG_PRICE,
    TAG_USER,
    Vm,
)
from fogros2.provider.vm.creation import Creation
from fogros2.provider.vm.labels import LabelRules
from fogros2.provider.vm.provider import VmProvider
from ros2fog_cli.api import machines, table

TAGS = {TAG_NAME: 'planner', TAG_USER: 'ubuntu', TAG_HOST_KEY: 'ssh-ed25519 AA', TAG_PRICE: '0.1'}


def machine_of(address: str = '203.0.113.1', **tags: str) -> Machine:
    """Return a machine of a cloud as the provider reports it."""
    cloud: Any = SimpleNamespace(end_command=lambda machine, tags: ())
    provider: Any = SimpleNamespace(cloud=cloud, _text='/'.join, name='cloud')
    return VmProvider.machine_of(provider, Vm(
        'i-1', 'region', MachineState.RUNNING, address=address, private_ip=address,
        tags={**TAGS, **tags}))


@pytest.mark.parametrize('user', [
    "x' -o ProxyCommand='touch /tmp/pwned", '-oProxyCommand=true', 'a b', 'fog\n', ''])
def test_machine_whose_login_is_no_name_is_not_reached(user: str) -> None:
    assert machine_of().endpoint is not None
    found = machine_of(**{TAG_USER: user})
    assert found.endpoint is None and found.name == 'planner', 'it is listed'


@pytest.mark.parametrize('key', ['', 'ssh-ed25519 AA\n* ssh-ed25519 BB', '@cert-authority AA'])
def test_machine_whose_host_key_is_none_is_not_reached(key: str) -> None:
    assert machine_of(**{TAG_HOST_KEY: key}).endpoint is None


@pytest.mark.parametrize('address', [
    '-oProxyCommand=true', 'evil.example', '203.0.113.1\n', '203.0.113.1 -x', 'fe80::1%$(reboot)'])
def test_machine_whose_address_is_none_is_not_reached(address: str) -> None:
    """Azure reports no address with a machine, but a tag has it."""
    found = machine_of(address)
    assert (found.endpoint, found.vpn_host, found.private_ip) == (None, '', '')
    assert machine_of('2001:db8::1').vpn_host == '2001:db8::1'


@pytest.mark.parametrize('attempt', ['', 'x', '0123456789abcde/', '../0123456789abcd', 'é' * 16])
def test_machine_with_an_odd_attempt_has_an_id(attempt: str) -> None:
    """Without one, its deletion would delete nothing and report no error."""
    assert machine_of(**{TAG_ATTEMPT: attempt}).id == f'region/i-1/{"0" * 16}'
    assert machine_of(**{TAG_ATTEMPT: 'ab' * 8}).id == f'region/i-1/{"ab" * 8}'


@pytest.mark.parametrize('size', ['9' * 5000, '-1', '1e3', '²'])
def test_odd_size_of_a_disk_is_none(size: str) -> None:
    assert machine_of(**{TAG_DISK: size}).disk_gb is None


def test_machine_without_an_attempt_takes_its_name() -> None:
    """Somebody has removed the tag, by which the launch recognises its own machine."""
    cloud: Any = SimpleNamespace(find=lambda region, tags: [
        Vm('i-1', region, MachineState.RUNNING, tags={TAG_NAME: 'planner'})])
    creation: Any = SimpleNamespace(cloud=cloud, spec=MachineSpec('planner', 'cloud'))
    with pytest.raises(NameTaken):
        Creation._existing(creation, 'region', '0' * 16)


@pytest.mark.parametrize('price', ['NaN', 'sNaN', 'Infinity', '-1', '1e40', '9' * 200, 'x'])
def test_odd_price_is_none(price: str) -> None:
    assert table.cost(machine_of(**{TAG_PRICE: price}).cost_per_hour) == '-'


@pytest.mark.parametrize('end', ['9' * 400, '9' * 14])
def test_odd_end_of_a_lifetime_is_none(end: str) -> None:
    entry = machines.Entry('planner', 'cloud', machine_of(**{'fogros2-expires': end}), None)
    assert entry.expires is None and table.duration(entry.expires) == '-'


@pytest.mark.parametrize('value', ['_ffffffff_', '_110000_', '_d800_'])
def test_label_that_is_no_character_is_read(value: str) -> None:
    assert LabelRules().decode({'fogros2-name': value})


@pytest.mark.parametrize('text', [
    '[' * 200_000, '7', '{"a": []}', 'NaN', '{"a": "%s"}' % ('9' * (1 << 20))],
    ids=lambda text: text[:10])
def test_odd_tags_of_a_pod_or_a_rule_are_none(text: str) -> None:
    assert names.tags_of({'metadata': {'annotations': {names.TAGS: text}}}) == {}
    assert firewall.tags_of({'description': text}) == {}
