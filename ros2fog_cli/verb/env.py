# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog env``."""

from __future__ import annotations

import argparse
import json
import shlex

from ros2fog_cli.verb import add_json, add_name, VerbExtension


class EnvVerb(VerbExtension):
    """Print exports that let this terminal's nodes join a machine's launch."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_name(parser)
        add_json(parser)

    def main(self, *, args: argparse.Namespace) -> int:
        """Print lines for ``eval "$(ros2 fog env NAME)"``."""
        from fogros2.errors import ConfigurationError
        from fogros2.store import Store
        from ros2fog_cli.api import reach
        store = Store()
        record = store.machine(args.name).load()
        variables = reach.robot_environment(record, store)
        if variables is None:
            raise ConfigurationError(f"no launch is running with the machine '{args.name}'",
                                     'its nodes can be joined while one is')
        if args.json:
            print(json.dumps(variables, indent=2))
            return 0
        for name, value in sorted(variables.items()):
            print(f'export {name}={shlex.quote(value)}')
        return 0
