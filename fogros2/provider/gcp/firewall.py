# SPDX-License-Identifier: Apache-2.0
"""
A machine's own firewall rules, which its network tag selects.

Google's default network admits SSH from everywhere, and everything from inside, at priority
65534. So allow rules alone close nothing: a rule of ours between them denies everything else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
import json
from typing import Any

from fogros2.errors import ProviderError
from fogros2.provider.gcp.account import Account
from fogros2.provider.vm.cloud import own_name, TAG_SSH_FROM
from fogros2.provider.vm.failures import unless_gone
from fogros2.provider.vm.options import ipv4, SSH

ALLOW, DENY = 1000, 2000
#: Sources of WireGuard's port, which answers only known keys, and of the denial.
ANYONE = ('0.0.0.0/0',)


def rule(
    attempt: str, suffix: str, network: str, tags: Mapping[str, str], sources: Sequence[str],
    protocol: str = '', port: int = 0,
) -> dict[str, Any]:
    """Return the body of firewalls.insert: admit a port, or without a protocol deny all."""
    if protocol:
        action: dict[str, Any] = {'priority': ALLOW, 'allowed': [
            {'IPProtocol': protocol, 'ports': [str(port)]}]}
    else:
        action = {'priority': DENY, 'denied': [{'IPProtocol': 'all'}]}
    return {
        'name': f'{own_name(attempt)}-{suffix}', 'network': network, 'direction': 'INGRESS',
        # a firewall rule has no labels
        'description': json.dumps(dict(tags)), 'targetTags': [own_name(attempt)],
        'sourceRanges': list(sources), **action}


def tags_of(found: Mapping[str, Any]) -> dict[str, str]:
    """Return the tags in the description of a rule; {} if it is not ours."""
    try:
        return {str(key): str(value) for key, value in json.loads(found['description']).items()}
    except (ValueError, KeyError, AttributeError):
        return {}


def create(account: Account, rules: Sequence[Mapping[str, Any]]) -> None:
    """Create rules at the same time; those of an earlier attempt are used again."""
    with ThreadPoolExecutor(max(1, len(rules)), 'fog-firewall') as pool:
        list(pool.map(lambda body: account.create(
            f'{account.project}/global/firewalls',
            f'creating the firewall rule {body["name"]}', body), rules))


def allow(
    account: Account, project: str, attempt: str, port: int, sources: Sequence[str],
) -> None:
    """
    Let only ``sources`` reach a TCP port; none closes it.

    The networks of ``ssh_from=`` are admitted together with the others.
    """
    base, name = f'{project}/global/firewalls', f'{own_name(attempt)}-tcp-{port}'
    what = f'{"opening" if sources else "closing"} port {port}'
    if not ipv4(sources):
        account.remove(f'{base}/{name}', what)
        return
    deny: Mapping[str, Any] = {}
    with unless_gone():
        deny = account.call('GET', f'{base}/{own_name(attempt)}-deny', what)
    if not deny:
        raise ProviderError('the machine has no firewall rules any more',
                            'ros2 fog list shows whether it is there')
    tags = tags_of(deny)
    more = tags.get(TAG_SSH_FROM, '').split() if port == SSH else []
    body = rule(attempt, f'tcp-{port}', deny['network'], tags, ipv4([*sources, *more]), 'tcp',
                port)
    if account.create(base, what, body):
        account.run('PATCH', f'{base}/{name}', what,
                    body={'name': name, 'sourceRanges': body['sourceRanges']})


def delete(account: Account, project: str, attempt: str) -> None:
    """Delete all rules of an attempt."""
    base, what = f'{project}/global/firewalls', 'deleting the firewall rules'
    names = [str(found['name']) for found in account.pages(
        base, what, filter=f'name eq {own_name(attempt)}-.*')]
    with ThreadPoolExecutor(max(1, len(names)), 'fog-firewall') as pool:
        list(pool.map(lambda name: account.remove(f'{base}/{name}', what), names))
