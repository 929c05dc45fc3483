# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog delete``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import (
    add_deletion,
    add_region,
    agreed,
    complete,
    machine_names,
    say,
    VerbExtension,
    warn,
)


class DeleteVerb(VerbExtension):
    """Delete machines and everything that was created for them."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        name = parser.add_argument('name', nargs='+',
                                   help="names of machines, or 'all' for this robot's")
        complete(name, lambda: [*machine_names(), 'all'])
        add_region(parser)
        add_deletion(parser)
        parser.add_argument(
            '--force', action='store_true',
            help='delete even if a launch runs, or if the machine or its provider does not answer')
        parser.add_argument('--any-robot', action='store_true',
                            help="include other robots' machines: of that name, or 'all'")

    def main(self, *, args: argparse.Namespace) -> int:
        """Delete the machines; return 1 if something still exists."""
        from fogros2.store import check_name, Store
        from ros2fog_cli.api import endings, machines, progress
        store = Store()
        for name in args.name:
            check_name(name)
        names = [None] if 'all' in args.name else list(dict.fromkeys(args.name))
        every = machines.survey(warn, name=names[0] if len(names) == 1 else None,
                                regions=args.region, store=store)
        entries, failed = [], 0
        for name in names:
            matches = [entry for entry in every if name in (None, entry.name)]
            own = [entry for entry in matches if entry.own]
            # Another robot's machine can be deleted by name, unless this robot has one of that
            # name.
            if not args.any_robot and (name is None or own):
                if len(own) < len(matches):
                    warn(f'{len(matches) - len(own)} of other robots left out (--any-robot takes '
                         'them)')
                matches = own
            entries += matches
            if name is not None and not matches:
                warn(str(machines.unknown(name, store)))
                failed = 1
        if not entries:
            if not failed:
                say('no machines')
            return failed
        for entry in entries:
            whose = '' if entry.own else f' of the robot {entry.robot}'
            say(f"{'would delete' if args.dry_run else 'delete'} {entry.name}{whose}: "
                f"{entry.provider} {entry.machine_id or '-'}, {entry.state}")
        if args.dry_run:
            return failed
        for entry in entries:
            endings.check_free(entry, force=args.force)
        if not args.yes and not agreed('machine', len(entries)):
            return 1
        with progress.working('deleting'):
            for entry, error in endings.delete_all(
                    entries, store, progress.report, force=args.force):
                if error is None:
                    say(f'deleted {entry.name}')
                    for warning in endings.awaited(store, entry.name):
                        warn(warning)
                else:
                    warn(f'{entry.name}: {error}')
                    failed = 1
        return failed
