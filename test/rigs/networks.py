# SPDX-License-Identifier: Apache-2.0
"""Container networks for the time of a test; those of killed runs of the tests are removed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import contextlib
import json
import os

from fogros2.model import Command
from fogros2.process import run
from fogros2.store import process_alive, process_start

#: Label of a network: id and start time of the process that made it.
LABEL = 'fogt-run'


def abandoned(listed: str) -> list[str]:
    """Return the networks whose process has ended, from the JSON of ``podman network ls``."""
    found = []
    for network in json.loads(listed):
        pid, _, start = (network.get('labels') or {}).get(LABEL, '').partition('-')
        if pid and not process_alive(int(pid), int(start)):
            found.append(network['name'])
    return found


def _remove(name: str) -> None:
    run(Command(('podman', 'network', 'rm', '-f', name), sudo=True), timeout=60.0, check=False)
    # the packet filter of a fleet's network
    run(Command(('nft', 'delete', 'table', 'inet', name), sudo=True), timeout=60.0, check=False)


@contextlib.contextmanager
def without_udp(addresses: str) -> Iterator[None]:
    """
    Drop UDP between this computer and others of a test's own.

    :param addresses: theirs, or the name of their container network.
    """
    if addresses.startswith('fogt'):
        addresses = run(Command((
            'podman', 'network', 'inspect', '--format',
            '{{range .Subnets}}{{.Subnet}}{{end}}', addresses), sudo=True),
            timeout=60.0).stdout.strip()
    table = f'inet fogt{os.urandom(4).hex()}'
    rules = '\n'.join(
        f'add chain {table} {hook} {{ type filter hook {hook} priority 0; }}\n'
        f'add rule {table} {hook} ip {end} {addresses} meta l4proto udp drop'
        for hook, end in (('output', 'daddr'), ('input', 'saddr')))
    run(Command(('nft', '-f', '-'), sudo=True, input=f'add table {table}\n{rules}\n'.encode()),
        timeout=30.0)
    try:
        yield
    finally:
        run(Command(('nft', 'delete', 'table', *table.split()), sudo=True), timeout=30.0)


@contextlib.contextmanager
def network(
    subnets: Sequence[str], options: Callable[[str], Sequence[str]] = lambda subnet: (),
) -> Iterator[tuple[str, str]]:
    """
    Make a network in the first of some subnets that is free; yield its name and subnet.

    :param options: further options of ``podman network create`` for a subnet.
    """
    for name in abandoned(run(Command(
            ('podman', 'network', 'ls', '--format', 'json'), sudo=True), timeout=30.0).stdout):
        _remove(name)
    name, pid = f'fogt{os.urandom(4).hex()}', os.getpid()
    for subnet in subnets:
        made = run(Command((
            'podman', 'network', 'create', '--label', f'{LABEL}={pid}-{process_start(pid)}',
            '--subnet', subnet, *options(subnet), name), sudo=True), timeout=60.0, check=False)
        if made.returncode == 0:
            break
    else:
        raise RuntimeError(f'no subnet for the tests is free: {made.stderr}')
    try:
        yield name, subnet
    finally:
        _remove(name)
