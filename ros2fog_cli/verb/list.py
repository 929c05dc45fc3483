# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog list``."""

from __future__ import annotations

import argparse
import time
from typing import Any

from ros2fog_cli.verb import add_json, add_region, print_json, VerbExtension, warn


class ListVerb(VerbExtension):
    """List the cloud machines of all providers, and what they cost."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_region(parser, several=True)
        add_json(parser)

    def main(self, *, args: argparse.Namespace) -> int:
        """Print the table, or JSON."""
        from concurrent.futures import ThreadPoolExecutor

        from fogros2 import plugin_system
        from ros2fog_cli.api import machines, table

        def more(name: str) -> tuple[list[dict[str, Any]], str]:
            rows, line = plugin_system.load('fogros2.listed', name)(args.region)
            return rows, line

        with ThreadPoolExecutor(1, 'fog-list') as pool:
            names = plugin_system.names('fogros2.listed')
            asked = pool.submit(machines.ask_all, warn, names, more)
            entries = machines.survey(warn, regions=args.region)
            others = {name: one or ([], '') for name, one in zip(names, asked.result())}
        now = time.time()
        if args.json:
            if entries:
                machines.notes(warn)  # entries have no notes of features that cannot be loaded
            print_json(machines=[entry.to_json(now) for entry in entries],
                       **{name: rows for name, (rows, _) in others.items()})
            return 0
        kept = '\n'.join(line for _, line in others.values() if line)
        if not entries:
            print('\n'.join(filter(None, ('no machines', kept))))
            return 0
        print(table.table(
            ('NAME', 'PROVIDER', 'PLACE', 'KIND', 'STATE', 'AGE', 'ADDRESS', 'TIME LEFT',
             'COST/H', 'COST'),
            [(entry.name, entry.provider, entry.known.region or '-', entry.known.kind or '-',
              entry.state,
              table.duration(None if entry.created is None else max(0.0, now - entry.created)),
              entry.address or '-',
              table.duration(None if entry.expires is None else entry.expires - now),
              table.cost(entry.cost), table.cost(entry.spent(now), 2)) for entry in entries],
            width=table.terminal_width(),
            optional=('KIND', 'PLACE', 'ADDRESS', 'COST', 'AGE', 'COST/H', 'PROVIDER')))
        noted = [entry for entry in entries if entry.record is not None and entry.record.notes]
        # all features are loaded for their lines, which takes long
        lines = machines.notes(warn) if noted else {}
        for entry in noted:
            for key, line in lines.items():
                if line and entry.notes[key]:
                    print(f'{entry.name}:', line.format(name=entry.name, note=entry.notes[key]))
        total = machines.total(entries, now)
        if total is not None:
            unknown = sum(entry.runs and entry.cost is None for entry in entries)
            print(f'{table.cost(total[0])} an hour, {table.cost(total[1], 2)} so far, '
                  'disks and traffic aside'
                  + f'; the price of {unknown} more is unknown' * bool(unknown))
        if kept:
            print(kept)
        return 0
