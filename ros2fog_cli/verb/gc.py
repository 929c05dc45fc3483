# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog gc``."""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

from ros2fog_cli.verb import add_json, add_region, VerbExtension, warn


class GcVerb(VerbExtension):
    """Delete machines past their lifetime, and clean up after launches that died."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_region(parser)
        parser.add_argument('--dry-run', action='store_true', help='only say what would go')
        parser.add_argument('--keep-stopped', type=float, default=7.0, metavar='DAYS',
                            help='how long a stopped machine is kept (default: 7)')
        add_json(parser)

    def main(self, *, args: argparse.Namespace) -> int:
        """Clean up; return 1 if something still exists that should be deleted."""
        from fogros2.errors import FogError
        from fogros2.store import Store
        from ros2fog_cli.api import endings, machines, progress
        store, now, failed = Store(), time.time(), 0
        done: list[dict[str, Any]] = []

        def note(what: str, name: str, reason: str, error: str = '') -> None:
            done.append({'what': what, 'name': name, 'reason': reason, 'error': error or None})
            if not args.json:
                verb = 'would clear' if args.dry_run else 'cleared'
                print(f"{'could not clear' if error else verb} {what} {name}: {error or reason}")

        with progress.shown() as report:
            for entry in machines.survey(warn, regions=args.region, store=store):
                reason = endings.why_end(entry, now, args.keep_stopped * 86400,
                                         endings.stopped_at(entry.machine, entry.record, store))
                record = entry.record
                lost = not reason and record is not None and record.launch \
                    and not record.launch_alive and not record.damage and entry.asked
                if not entry.asked and record is not None and record.launch \
                        and not record.launch_alive:
                    failed = 1
                    note('machine', entry.name, 'its launch is gone',
                         f"the provider '{entry.provider}' can't be asked")
                    continue
                if not reason and not lost:
                    continue
                what = 'leftovers of' if lost or entry.gone else 'machine'
                error = ''
                try:
                    if args.dry_run:
                        pass
                    elif reason:
                        endings.delete(entry, store, report)
                    elif record is not None:
                        endings.let_go(record, store)
                except FogError as problem:
                    error, failed = str(problem), 1
                note(what, entry.name, reason or 'its launch is gone', error)
            for leftover in endings.leftovers(store, now):
                error = ''
                try:
                    if not args.dry_run:
                        endings.clear(leftover)
                except FogError as problem:
                    error, failed = str(problem), 1
                note('leftovers of launch', leftover.launch, 'the launch is gone', error)
            if not args.dry_run:
                store.sweep()
                for what in endings.tidy(warn, regions=args.region):
                    note('leftover', what, 'its machine ended by itself')
        if args.json:
            print(json.dumps(done, indent=2))
        elif not done:
            print('nothing to clear')
        return failed
