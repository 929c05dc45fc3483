# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog gc``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import add_json, add_region, number, print_json, say, VerbExtension, warn


class GcVerb(VerbExtension):
    """Delete machines past their lifetime, and clean up after launches that died."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_region(parser, several=True)
        parser.add_argument('--dry-run', action='store_true', help='print what would be cleared')
        parser.add_argument('--keep-stopped', type=number, default=7.0, metavar='DAYS',
                            help='how long a stopped machine is kept (default: 7)')
        add_json(parser)

    def main(self, *, args: argparse.Namespace) -> int:
        """Clean up; return 1 if something still exists that should be deleted."""
        from concurrent.futures import ThreadPoolExecutor

        from fogros2.errors import FogError
        from fogros2.store import Store
        from ros2fog_cli.api import endings, machines, progress
        store, done = Store(), []

        def note(what: str, name: str, reason: str, error: str = '') -> None:
            done.append({'what': what, 'name': name, 'reason': reason, 'error': error or None})
            if not args.json:
                verb = 'would clear' if args.dry_run else 'cleared'
                say(f"{'could not clear' if error else verb} {what} {name}: {error or reason}")

        def end(due: endings.Due) -> str:
            try:
                if not args.dry_run:
                    due.end()
            except FogError as problem:
                return str(problem)
            return due.error

        entries = machines.survey(warn, regions=args.region, store=store)
        with progress.working('clearing'), ThreadPoolExecutor(16, 'fog-gc') as pool:
            for dues in endings.due(entries, store, args.keep_stopped * 86400, progress.report):
                for due, error in zip(dues, pool.map(end, dues)):
                    note(due.what, due.name, due.reason, error)
            if not args.dry_run:
                store.sweep()
                for what in endings.tidy(warn, regions=args.region):
                    note('leftover', what, 'its machine ended by itself')
        if args.json:
            print_json(cleared=done)
        elif not done:
            say('nothing to clear')
        return int(any(one['error'] for one in done))
