# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog dashboard``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import add_region, VerbExtension


class DashboardVerb(VerbExtension):
    """Show machines, nodes, links, streams and logs live, in a web page on this computer."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_region(parser)
        parser.add_argument('--port', type=int, default=0,
                            help='of this computer; one that is free unless given')
        parser.add_argument('--no-browser', action='store_true',
                            help='only say where the page is')
        parser.add_argument('--no-topics', action='store_true',
                            help='join no launch: no rates of topics and no pictures')

    def main(self, *, args: argparse.Namespace) -> int:
        """Serve the page until Ctrl-C."""
        from fogros2.errors import ConfigurationError
        from fogros2_monitor.dashboard.server import Dashboard
        from ros2fog_cli.api.board import Board
        if not 0 <= args.port < 65536:
            raise ConfigurationError(f'--port {args.port} is no port', 'give one up to 65535')
        board = Board(regions=args.region, topics=not args.no_topics)
        try:
            dashboard = Dashboard(board, port=args.port)
        except OSError as error:
            raise ConfigurationError(
                f'port {args.port} of this computer: {error.strerror}',
                'another --port, or none for one that is free') from error
        board.start()
        print(f'The dashboard is at {dashboard.url} until Ctrl-C.\n'
              'Everyone with this address may look, and delete machines.', flush=True)
        if not args.no_browser:
            import webbrowser
            webbrowser.open(dashboard.url_with_ticket())
        try:
            dashboard.serve()
        except KeyboardInterrupt:
            print()
        finally:
            dashboard.close()
            board.close()
        return 0
