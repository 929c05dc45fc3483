# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog env``."""

from __future__ import annotations

import argparse
import sys

from ros2fog_cli.verb import add_json, add_name, print_json, VerbExtension


class EnvVerb(VerbExtension):
    """Print exports that let this terminal's nodes join a machine's launch."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_name(parser)
        add_json(parser)

    def main(self, *, args: argparse.Namespace) -> int:
        """Print lines for ``eval "$(ros2 fog env NAME)"``."""
        from fogros2.store import Store
        from ros2fog_cli.api import output, terminals
        folder, variables = terminals.launch_of(args.name, Store())
        if args.json:
            print_json(variables=variables)
        else:
            print(*terminals.shell_lines(folder, variables), sep='\n',
                  file=output.uncleaned(sys.stdout))
        return 0
