# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog status``."""

from __future__ import annotations

import argparse
import dataclasses
import time
from typing import Any, TYPE_CHECKING

from ros2fog_cli.verb import add_json, add_name, add_region, print_json, VerbExtension, warn

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fogros2.feature import Feature
    from ros2fog_cli.api.reach import Link


class StatusVerb(VerbExtension):
    """Show a machine's nodes, VPN and agent."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_name(parser)
        add_region(parser)
        add_json(parser)
        parser.add_argument('--watch', '-w', action='store_true',
                            help='continue until Ctrl-C; also before the machine exists')
        parser.add_argument('--topics', action='store_true',
                            help='with --watch: a node joins the launch and measures the rates '
                                 'of topics across the VPN')

    def main(self, *, args: argparse.Namespace) -> int:
        """Print the status; return 1 if there are problems or no expected agent answers."""
        from fogros2 import feature, plugin_system
        from fogros2.errors import ConfigurationError, FogError
        from fogros2.store import other_vpn, Store
        from ros2fog_cli.api import reach
        if args.watch:
            from ros2fog_cli.api.watching import watch
            return watch(args.name, regions=args.region, as_json=args.json, topics=args.topics)
        if args.topics:
            raise ConfigurationError('--topics is for --watch: a rate takes a while',
                                     'add --watch')
        store = Store()
        folder = store.other_vpns().get(args.name)
        other = other_vpn(folder) if folder is not None else None
        if other is not None and not store.exists(args.name):
            return show_link(reach.measure(
                other.interface.address, other.own, other.machine.public_key), as_json=args.json)
        entry = reach.find(args.name, warn, regions=args.region)
        tables = feature.tables(warn)
        status: dict[str, Any] = {**entry.to_json(), 'vpn': None, 'clock': None, 'agent': None,
                                  'streams': [], 'features': [],
                                  **{name: [] for name in tables}}
        problems: list[str] = []
        idle = reach.let_go(entry) and not entry.gone
        if idle:
            # The tag names the launch that created the machine.
            status['launch'] = ''
        elif entry.record is not None:
            folder = store.root / 'launches' / entry.record.launch
            figures = {name: each.figures(folder, entry.name) for name, each in tables.items()}
            status.update((name, rows) for name, rows in figures.items() if rows is not None)
            try:
                link = reach.link(entry.record)
                status['vpn'] = dataclasses.asdict(link) if link is not None else None
            except FogError as error:
                problems.append(f'VPN: {error}')
            offset = reach.clock(entry.record, Store())
            status['clock'] = dataclasses.asdict(offset) if offset is not None else None
            try:
                with reach.session(entry) as shell:
                    client = reach.agent(entry, shell)
                    try:
                        reply = client.status(timeout=15.0)
                        status['agent'] = {
                            key: value for key, value in reply.items() if key not in ('id', 'ok')}
                        if status['vpn'] is not None:
                            for name, each in tables.items():
                                if figures[name] is None:
                                    status[name] = each.entries(entry.record, shell)
                    finally:
                        client.close()
            except FogError as error:
                problems.append(f'agent: {error}')
        else:
            problems.append(f"agent: this robot has no record of '{entry.name}'; only the robot "
                            'that launched it can ask its agent')
        parts = [f'_{transport}_{part}' for part in ('encoder', 'decoder')
                 for transport in plugin_system.names('fogros2.image_transport')]
        if any(part in node['name'] for node in (status['agent'] or {}).get('nodes', ())
               for part in parts):
            from ros2fog_cli.api import progress
            from ros2fog_cli.api.watching import streams
            with progress.working('measuring streams'):
                status['streams'] = streams(entry.name, regions=args.region)
        if entry.record is not None:
            try:
                status['features'] = [row for each, own in feature.used(entry.record.spec)
                                      for row in each.status(status, own)]
            except FogError as error:
                problems.append(f'features: {error}')
        if args.json:
            print_json(**status, problems=problems)
        else:
            show(status, tables, idle=idle)
        for problem in problems:
            warn(problem)
        return 0 if (status['agent'] is not None or idle) and not problems else 1


def show(
    status: dict[str, Any], tables: Mapping[str, Feature] = {}, *, idle: bool = False,
) -> None:
    """
    Print a status for users.

    :param tables: the features that have a table, by name.
    :param idle: the machine is kept, and no launch uses it.
    """
    from decimal import Decimal

    from fogros2.clock import ClockOffset
    from ros2fog_cli.api import machines, table
    from ros2fog_cli.api.table import cost, duration
    now = time.time()
    lines = [
        ('machine', f"{status['name']} ({status['provider']} {status['id'] or '-'})"),
        ('state', status['state']),
        ('address', status['address'] or '-'),
        *((key.replace('_', ' '), status[key])
          for key in ('place', 'kind', *machines.notes()) if status[key]),
        ('age', duration(status['age'])),
        ('time left', duration(status['time_left'])),
        ('launch', 'none: it is kept for the next one' if idle else status['launch'] or '-'),
    ]
    if status['cost'] is not None:
        lines.append(('cost', f"{cost(Decimal(status['cost_per_hour']))} an hour, "
                              f"{cost(Decimal(status['cost']), 2)} so far"))
    lines += status['features']
    vpn, agent = status['vpn'], status['agent']
    if vpn is not None:
        lines += table.link(vpn, vpn['handshake_age'])
    if status['clock'] is not None:
        lines.append(('clock', str(ClockOffset(**status['clock']))))
    if agent is not None:
        lines.append(table.agent(now - agent['since'], 1000 * agent['rss_kb'],
                                 agent['heartbeat_age']))
    print_rows(lines)
    parts: list[tuple[Sequence[str], Sequence[Sequence[str]]]] = [
        (table.NODES, table.nodes(agent['nodes'] if agent is not None else ()))]
    parts += [(each.headings, list(map(each.row, status[name]))) for name, each in tables.items()]
    parts.append((table.CROSSING, table.crossing(status['name'], status['streams'])))
    for headings, rows in parts:
        if rows:
            print()
            print(table.table(headings, rows))


def print_rows(rows: Sequence[tuple[str, str]]) -> None:
    """Print rows of a name and a text."""
    width = max(len(name) for name, _ in rows)
    for name, text in rows:
        print(f'{name.ljust(width)}  {text}')


def show_link(link: Link, *, as_json: bool) -> int:
    """Print the link to another robot's machine; return 0 if the machine answers."""
    from ros2fog_cli.api import table
    fields = dataclasses.asdict(link)
    if as_json:
        print_json(**fields)
    else:
        print_rows(list(table.link(fields, link.handshake_age)))
    return 0 if link.latency is not None else 1
