# SPDX-License-Identifier: Apache-2.0
"""
A machine's own firewall rules, which its network tag selects.

Google's default network admits SSH from everywhere, and everything from inside, at priority
65534. So allow rules alone close nothing: a rule of ours between them denies everything else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
import json
from typing import Any

from fogros2 import untrusted
from fogros2.errors import ConfigurationError, ProviderError
from fogros2.provider.gcp.account import Account
from fogros2.provider.vm.address import ADDRESS_VARIABLE
from fogros2.provider.vm.cloud import Order, own_name, TAG_SSH_FROM, VmCloud, VmId
from fogros2.provider.vm.failures import unless_gone
from fogros2.provider.vm.options import FREE_PORTS, ipv4, SSH

ALLOW, DENY = 1000, 2000
#: Sources of WireGuard's port, which answers only known keys, and of the denial.
ANYONE = ('0.0.0.0/0',)


def rule(
    attempt: str, suffix: str, network: str, tags: Mapping[str, str], sources: Sequence[str],
    protocol: str = '', ports: str = '',
) -> dict[str, Any]:
    """Return the body of firewalls.insert: admit ports, or without a protocol deny all."""
    if protocol:
        action: dict[str, Any] = {'priority': ALLOW, 'allowed': [
            {'IPProtocol': protocol, 'ports': [ports]}]}
    else:
        action = {'priority': DENY, 'denied': [{'IPProtocol': 'all'}]}
    return {
        'name': f'{own_name(attempt)}-{suffix}', 'network': network, 'direction': 'INGRESS',
        # a firewall rule has no labels
        'description': json.dumps(dict(tags)), 'targetTags': [own_name(attempt)],
        'sourceRanges': list(sources), **action}


def tags_of(body: Mapping[str, Any]) -> dict[str, str]:
    """Return the tags in the description of a rule; {} if it is not ours."""
    try:
        return untrusted.parsed(body['description'], dict[str, str])  # type: ignore[no-any-return]
    except (untrusted.InvalidMessage, KeyError):
        return {}


class GoogleFirewall(VmCloud):
    """The part of Compute Engine that has firewall rules."""

    _account: Account

    def begin(self, region: str, order: Order, created: list[str]) -> None:
        """Create the rules at the same time; those of an earlier attempt are used again."""
        network = f'global/networks/{order.options.network}'
        tags = {**{key: value for key, value in order.tags.items() if key.startswith('fogros2-')},
                'region': region}
        sources = ipv4(order.sources)
        if not sources:
            raise ConfigurationError(
                'machines at Google have IPv4 addresses, and the robot has none',
                f'{ADDRESS_VARIABLE}= or ssh_from= names an address or a network of IPv4')
        rules = [
            rule(order.attempt, 'deny', network, tags, ANYONE),
            rule(order.attempt, 'vpn', network, tags, ANYONE, 'udp', str(order.request.vpn_port)),
            *(rule(order.attempt, f'fleet-{protocol}', network, tags, sources, protocol,
                   '{}-{}'.format(*FREE_PORTS))
              for protocol in (('tcp', 'udp') if order.options.fleet else ())),
            rule(order.attempt, f'tcp-{SSH}', network, tags, sources, 'tcp', str(SSH))]
        base = f'{self._account.project}/global/firewalls'
        with ThreadPoolExecutor(len(rules), 'fog-firewall') as pool:
            *_, existed = pool.map(lambda body: self._account.create(
                base, f'creating the firewall rule {body["name"]}', body), rules)
        if not existed:
            self._account.admitted[order.attempt] = sources

    def undo_begin(
        self, region: str, attempt: str, created: Sequence[str],
    ) -> Iterator[tuple[str, Callable[[], None]]]:
        yield 'the firewall rules', lambda: self._drop_rules(self._account.project, attempt)

    def _drop_rules(self, project: str, attempt: str) -> None:
        base, what = f'{project}/global/firewalls', 'deleting the firewall rules'
        names = [str(entry['name']) for entry in self._account.pages(
            base, what, filter=f'name eq {own_name(attempt)}-.*')]
        with ThreadPoolExecutor(max(1, len(names)), 'fog-firewall') as pool:
            list(pool.map(lambda name: self._account.remove(f'{base}/{name}', what), names))

    def remains(self, region: str) -> list[dict[str, str]]:
        tags = [tags_of(entry) for entry in self._account.pages(
            f'{self._account.project}/global/firewalls', 'looking for what is left',
            filter='name eq fogros2-.*')]
        return [own for own in tags if region in ('', own.get('region'))]

    def set_firewall(self, machine: VmId, port: int, sources: Sequence[str]) -> None:
        """Let only ``sources`` reach a TCP port, beside the networks of ``ssh_from=``."""
        if port == SSH and self._account.admits(machine.attempt, ipv4(sources)):
            return
        base, own = f'{machine.vm.partition("/")[0]}/global/firewalls', own_name(machine.attempt)
        name, what = f'{own}-tcp-{port}', f'{"opening" if sources else "closing"} port {port}'
        if not ipv4(sources):
            self._account.remove(f'{base}/{name}', what)
            return
        existing: Mapping[str, Any] = {}
        for one in (name, f'{own}-deny'):
            with unless_gone():
                existing = existing or self._account.call('GET', f'{base}/{one}', what)
        if not existing:
            raise ProviderError('the machine has no firewall rules any more',
                                'ros2 fog list shows whether it is there')
        tags = tags_of(existing)
        more = tags.get(TAG_SSH_FROM, '').split() if port == SSH else []
        body = rule(machine.attempt, f'tcp-{port}', existing['network'], tags,
                    ipv4([*sources, *more]), 'tcp', str(port))
        if existing['name'] != name:
            self._account.create(base, what, body)
        elif sorted(existing['sourceRanges']) != body['sourceRanges']:
            self._account.run('PATCH', f'{base}/{name}', what,
                              body={'name': name, 'sourceRanges': body['sourceRanges']})
