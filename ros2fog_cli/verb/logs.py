# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog logs``."""

from __future__ import annotations

import argparse
import sys
from typing import Optional, TYPE_CHECKING

from ros2fog_cli.verb import add_name, add_region, VerbExtension, warn

if TYPE_CHECKING:
    from fogros2.events import Event


class LogsVerb(VerbExtension):
    """Print the output of a machine's nodes."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_name(parser)
        add_region(parser)
        parser.add_argument('-f', '--follow', action='store_true', help='continue until Ctrl-C')
        parser.add_argument('--node', help='only this node (its name in the launch: talker-1)')

    def main(self, *, args: argparse.Namespace) -> int:
        """Print the log."""
        from fogros2.errors import ConfigurationError, did_you_mean
        from ros2fog_cli.api import reach
        from ros2fog_cli.api.log import Lines
        entry = reach.find(args.name, warn, regions=args.region)
        names: set[str] = set()
        log = Lines()

        def take(event: Event) -> None:
            name = str(event.get('name', ''))
            names.add(name)
            show(name, str(event.get('stream', '')), log.of(event), args.node)

        with reach.session(entry) as shell:
            client = reach.agent(entry, shell)
            try:
                try:
                    alive = reach.follow(client, take, forever=args.follow)
                finally:
                    client.close()
                for (name, stream), line in list(log.begun.items()):
                    show(name, stream, [line], args.node)
            except (KeyboardInterrupt, BrokenPipeError):
                return 0
        if not alive:
            warn(f"the agent of '{args.name}' is gone")
        elif args.node and args.node not in names:
            raise ConfigurationError(f"'{args.name}' has no node '{args.node}'",
                                     did_you_mean(args.node, sorted(names - {''})))
        return 0 if alive else 1


def show(name: str, stream: str, lines: list[str], node: Optional[str]) -> None:
    """Print lines of a node's log, or of the machine's if ``name`` is ''."""
    if node and name not in ('', node):
        return
    prefix = f'[{name}] ' if name else ''
    from ros2fog_cli.api import output
    file = output.needed(sys.stderr) if stream == 'stderr' else sys.stdout
    for line in lines:
        print(f'{prefix}{line}', file=file, flush=True)
