# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog dashboard``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import add_page, add_region, VerbExtension


class DashboardVerb(VerbExtension):
    """Show machines, nodes, links, streams and logs live, in a web page on this computer."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_region(parser, several=True)
        add_page(parser)
        parser.add_argument('--no-topics', action='store_true',
                            help='join no launch: measure no rates, take no pictures')

    def main(self, *, args: argparse.Namespace) -> int:
        """Serve the page until Ctrl-C."""
        from fogros2.errors import ConfigurationError
        from fogros2_monitor.dashboard.server import Dashboard
        from ros2fog_cli.api.browser import browser_at
        from ros2fog_cli.api.live import Live
        live = Live(regions=args.region, topics=not args.no_topics, pictures=True)
        try:
            dashboard = Dashboard(live, port=args.port)
        except OSError as error:
            raise ConfigurationError(
                f'port {args.port} of this computer: {error.strerror}',
                'another --port, or none for one that is free') from error
        live.start()
        print(f'The dashboard is at {dashboard.url} until Ctrl-C.\n'
              'Everyone who has this address can see and delete machines.', flush=True)
        try:
            with browser_at(dashboard.url, start=not args.no_browser):
                dashboard.serve()
        except KeyboardInterrupt:
            print()
        finally:
            dashboard.close()
            live.close()
        return 0
