# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog plan``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import add_overrides, say, VerbExtension, warn


class PlanVerb(VerbExtension):
    """Show the machines of a launch file with prices, and which node goes where."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        parser.add_argument('file', help='path of the launch file')
        parser.add_argument('launch_arguments', nargs='*', default=[], metavar='NAME:=VALUE',
                            help='arguments of the launch file')
        add_overrides(parser)

    def main(self, *, args: argparse.Namespace) -> int:
        """
        Check the machines as a launch does, ask for types and prices, and create nothing.

        :return: 1 if a launch would refuse a machine.
        """
        from decimal import Decimal
        import functools
        import os

        from launch.launch_description_sources import get_launch_description_from_any_launch_file

        from fogros2.deploy import provider
        from fogros2.deploy.choosing import Choices
        from fogros2.describe import defaults
        from fogros2.describe.overrides import Overrides
        from fogros2.errors import ConfigurationError, FogError, naming
        from fogros2.launch_internals import hints
        from fogros2.report import silent
        from fogros2.runtime import log_files
        from ros2fog_cli.api import preview, progress
        if not os.path.isfile(args.file):
            raise ConfigurationError(f"there is no file '{args.file}'", 'give the path of one')
        hints.of_actions()
        with log_files.none():
            try:
                description = get_launch_description_from_any_launch_file(args.file)
            except Exception as error:
                raise ConfigurationError(
                    f"'{args.file}' can't be read: {error}", 'correct the file') from error
            plan = preview.Preview(description, preview.arguments(args.launch_arguments),
                                   Overrides(args.machine) if args.machine else None)
            providers = functools.cache(provider)
            choices, prices, failed = Choices(providers, silent), {}, 0
            with progress.working('asking for prices'):
                for machine in plan.machines:
                    try:
                        with naming(machine.name), defaults.named(os.environ):
                            price = preview.priced(machine, choices, providers)
                        if price is not None:
                            prices[machine.name] = price
                    except FogError as error:
                        warn(str(error))
                        failed = 1
        say('\n'.join(plan.lines(prices)) or 'The launch file has no machines and no nodes.')
        if len(prices) > 1:
            say(f'All machines: ${sum(prices.values(), Decimal(0)).normalize():f} an hour')
        return failed
