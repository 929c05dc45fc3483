# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog status``."""

from __future__ import annotations

import argparse
import dataclasses
import time
from typing import Any, TYPE_CHECKING

from ros2fog_cli.verb import add_json, add_name, add_region, print_json, VerbExtension, warn

if TYPE_CHECKING:
    from collections.abc import Mapping

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
        parser.add_argument('--interval', type=float, default=1.0, metavar='SECONDS',
                            help='poll interval of --watch (default: 1)')

    def main(self, *, args: argparse.Namespace) -> int:
        """Print the status; return 1 if there are problems or no expected agent answers."""
        from fogros2.errors import ConfigurationError, FogError
        from fogros2.feature import installed, used
        from fogros2.store import other_vpn, Store
        from ros2fog_cli.api import reach, replicas
        if args.watch:
            from ros2fog_cli.api.watching import watch
            if not 0.1 <= args.interval <= 3600:
                raise ConfigurationError(f'--interval {args.interval:g} is out of range',
                                         'give 0.1 to 3600 seconds')
            return watch(args.name, interval=args.interval, regions=args.region,
                         as_json=args.json, topics=args.topics)
        if args.topics:
            raise ConfigurationError('--topics is for --watch: a rate takes a while',
                                     'add --watch')
        store = Store()
        folder = store.other_vpns().get(args.name)
        other = other_vpn(folder) if folder is not None else None
        if other is not None and not store.exists(args.name):
            return show_link(reach.link_of(other), as_json=args.json)
        entry = reach.find(args.name, warn, regions=args.region)
        tables = {name: each for name, each in installed().items() if each.headings}
        status: dict[str, Any] = {**entry.to_json(), 'vpn': None, 'clock': None, 'agent': None,
                                  'streams': [], 'replicas': [], 'features': [],
                                  **{name: [] for name in tables}}
        problems: list[str] = []
        idle = reach.let_go(entry) and not entry.gone
        if idle:
            # The tag names the launch that created the machine.
            status['launch'] = ''
        elif entry.record is not None:
            status['replicas'] = replicas.figures(
                store.root / 'launches' / entry.record.launch, entry.name)
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
                                status[name] = each.entries(entry.record, shell)
                    finally:
                        client.close()
            except FogError as error:
                problems.append(f'agent: {error}')
        else:
            problems.append(f"agent: this robot has no record of '{entry.name}'; only the robot "
                            'that launched it can ask its agent')
        if any('_encoder' in node['name'] or '_decoder' in node['name']
               for node in (status['agent'] or {}).get('nodes', ())):
            from ros2fog_cli.api.watching import streams
            status['streams'] = streams(entry.name, regions=args.region)
        if entry.record is not None:
            try:
                status['features'] = [row for feature, own in used(entry.record.spec)
                                      for row in feature.status(status, own)]
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
    from fogros2.report import size
    from ros2fog_cli.api import machines, replicas
    from ros2fog_cli.api.table import cost, duration, NODES, nodes, shares, table
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
        latency = '-' if vpn['latency'] is None else f"{vpn['latency']:.2f} ms"
        handshake = 'none yet' if vpn['handshake_age'] is None \
            else f"{duration(vpn['handshake_age'])} ago"
        lines += [
            ('VPN', f"{vpn['address']} on {vpn['interface']}"),
            ('handshake', handshake),
            ('round trip', latency),
            ('traffic', f"{size(vpn['received'])} received, {size(vpn['sent'])} sent"),
        ]
    if status['clock'] is not None:
        lines.append(('clock', str(ClockOffset(**status['clock']))))
    if agent is not None:
        heartbeat = agent['heartbeat_age']
        lines += [
            ('agent', f"since {duration(max(0.0, now - agent['since']))}, "
                      f"{size(1000 * agent['rss_kb'])}"),
            ('heartbeat', '-' if heartbeat is None else f'{duration(heartbeat)} ago'),
        ]
    width = max(len(name) for name, _ in lines)
    for name, value in lines:
        print(f'{name.ljust(width)}  {value}')
    if agent is not None and agent['nodes']:
        print()
        print(table(NODES, nodes(agent['nodes'])))
    if status['replicas']:
        print()
        print(table(replicas.HEADER, list(map(replicas.row, status['replicas']))))
    for name, feature in tables.items():
        if status[name]:
            print()
            print(table(feature.headings, list(map(feature.row, status[name]))))
    if status['streams']:
        print()
        print(table(('STREAM', 'BY', 'FROM', 'TO', 'RATE', 'TRAFFIC', 'SHARE', 'LATENCY'), [
            (one['topic'], one['transport'], one['source'] or 'robot', one['target'] or 'robot',
             one['note'] or ('-' if one['rate'] is None else f"{one['rate']:.1f}/s"),
             '-' if one['bandwidth'] is None else f"{size(one['bandwidth'])}/s", *shares(one))
            for one in status['streams']]))


def show_link(link: Link, *, as_json: bool) -> int:
    """Print the link to another robot's machine; return 0 if the machine answers."""
    from ros2fog_cli.api.table import duration
    if as_json:
        print_json(**dataclasses.asdict(link))
    else:
        answer = 'no answer' if link.latency is None else f'{link.latency:.2f} ms'
        handshake = 'none' if link.handshake_age is None \
            else f'{duration(link.handshake_age)} ago'
        print(f'VPN         {link.address} on {link.interface}\nhandshake   {handshake}\n'
              f'round trip  {answer}')
    return 0 if link.latency is not None else 1
