# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog``."""

from __future__ import annotations

import argparse
import functools
import re
from typing import Any, NoReturn, Optional, Union

from ros2cli.command import add_subparsers_on_demand, CommandExtension

from ros2fog_cli.api import output


class FogCommand(CommandExtension):
    """Look after the cloud machines of launch files."""

    def add_arguments(
        self, parser: argparse.ArgumentParser, cli_name: str, *, argv: Optional[Any] = None,
    ) -> None:
        """Add the verbs; only the chosen one is imported."""
        self._subparser = parser
        parser.error = functools.partial(_error, parser)  # type: ignore[method-assign]
        parser.add_argument('--version', action='store_true', help='show the version and exit')
        add_subparsers_on_demand(
            parser, cli_name, '_verb', 'fogros2.verb', required=False, argv=argv)

    def main(
        self, *, parser: argparse.ArgumentParser, args: argparse.Namespace,
    ) -> Union[int, str, None]:
        """Run the verb, or print version or help; return the exit status."""
        with output.cleaned():
            try:
                if args.version:
                    from importlib import metadata
                    print(f"fogros2 {metadata.version('fogros2')}")
                    return 0
                if not hasattr(args, '_verb'):
                    self._subparser.print_help()
                    return 0
                status: Union[int, str, None] = args._verb.main(args=args)
            except BrokenPipeError:
                return 1
        return status


def _error(parser: argparse.ArgumentParser, message: str) -> NoReturn:
    """Exit with a message; the nearest verb is part of it."""
    wrong = re.search(r"invalid choice: '([^']*)'", message)
    if wrong:
        from fogros2 import plugin_system
        from fogros2.errors import did_you_mean
        hint = did_you_mean(wrong[1], plugin_system.names('fogros2.verb'), all_too=True)
        message = f"'{wrong[1]}' is no command of ros2 fog ({hint})"
    type(parser).error(parser, message)
