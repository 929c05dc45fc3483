# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog doctor``."""

from __future__ import annotations

import argparse
import dataclasses
import sys

from ros2fog_cli.verb import (
    add_json,
    complete,
    number,
    print_json,
    provider_names,
    VerbExtension,
)

_MARKS = {'ok': ' ok ', 'warning': 'warn', 'failed': 'FAIL'}
_STYLES = {'ok': 'good', 'warning': 'warning', 'failed': 'bad'}


class DoctorVerb(VerbExtension):
    """Check whether this computer has what a launch needs."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_json(parser)
        complete(parser.add_argument(
            '--provider', nargs='+', default=[], metavar='NAME',
            help='provider that must work; others are checked if they are configured'),
                 provider_names)
        parser.add_argument('--lan-seconds', type=number, default=1.5, metavar='SECONDS',
                            help='how long to search the LAN for ROS 2 (0: not at all)')

    def main(self, *, args: argparse.Namespace) -> int:
        """Print each check, with a remedy unless it passed; return 1 if a check failed."""
        from ros2fog_cli.api import doctor, screen
        checks = doctor.examine(lan_seconds=args.lan_seconds, providers=args.provider)
        if args.json:
            print_json(checks=[dataclasses.asdict(check) for check in checks])
        else:
            paint = screen.painter(sys.stdout)
            for check in checks:
                mark = paint(_MARKS[check.verdict], _STYLES[check.verdict])
                print(f'[{mark}] {check.name}: {check.detail}')
                if check.remedy and check.verdict != 'ok':
                    print(f'       {check.remedy}')
        return 1 if any(check.verdict == 'failed' for check in checks) else 0
