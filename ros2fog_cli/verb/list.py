# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog list``."""

from __future__ import annotations

import argparse
import json
import time

from ros2fog_cli.verb import add_json, add_region, VerbExtension, warn


class ListVerb(VerbExtension):
    """List the cloud machines of all providers."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_region(parser)
        add_json(parser)

    def main(self, *, args: argparse.Namespace) -> int:
        """Print the table."""
        from ros2fog_cli.api import machines, table
        entries = machines.survey(warn, regions=args.region)
        now = time.time()
        if args.json:
            print(json.dumps([entry.to_json(now) for entry in entries], indent=2))
            return 0
        if not entries:
            print('no machines')
            return 0
        print(table.table(
            ('NAME', 'PROVIDER', 'STATE', 'AGE', 'ADDRESS', 'TIME LEFT', 'COST/H'),
            [(entry.name, entry.provider, entry.state,
              table.duration(None if entry.created is None else max(0.0, now - entry.created)),
              entry.address or '-',
              table.duration(None if entry.expires is None else entry.expires - now),
              table.cost(entry.cost_per_hour)) for entry in entries]))
        return 0
