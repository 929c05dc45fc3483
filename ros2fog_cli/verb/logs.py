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
        entry = reach.find(args.name, warn, regions=args.region)
        names: set[str] = set()

        def take(event: Event) -> None:
            names.add(str(event.get('name', '')))
            show(event, args.node)

        with reach.session(entry) as shell:
            client = reach.agent(entry, shell)
            try:
                there = reach.follow(client, take, forever=args.follow)
            except KeyboardInterrupt:
                return 0
            except BrokenPipeError:
                reach.hush()
                return 0
            finally:
                client.close()
        if not there:
            warn(f"the agent of '{args.name}' is gone")
        elif args.node and args.node not in names:
            raise ConfigurationError(f"'{args.name}' has no node '{args.node}'",
                                     did_you_mean(args.node, sorted(names - {''})))
        return 0 if there else 1


def show(event: Event, node: Optional[str]) -> None:
    """Print one event of the agent's log."""
    from ros2fog_cli.api.log import describe
    text = describe(event)
    if text is None or (node and event.get('name', node) != node):
        return
    name = f"[{event.get('name')}] " if event.get('name') else ''
    stream = sys.stderr if event.get('stream') == 'stderr' else sys.stdout
    for line in text.splitlines() or ['']:
        print(f'{name}{line}', file=stream, flush=True)
