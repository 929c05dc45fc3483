# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog monitor``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import add_name, add_region, VerbExtension, warn


class MonitorVerb(VerbExtension):
    """See a machine's topics in a browser, through a tunnel to its Foxglove bridge."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_name(parser)
        add_region(parser)
        parser.add_argument('--port', type=int, default=0,
                            help='of this computer; one that is free unless given')
        parser.add_argument('--no-browser', action='store_true',
                            help='only say where to look, for another computer or application')

    def main(self, *, args: argparse.Namespace) -> int:
        """Serve until interrupted."""
        from fogros2.errors import ConfigurationError
        from fogros2.monitor import urls
        from fogros2.monitor.tunnel import Tunnel
        from ros2fog_cli.api import reach
        entry = reach.find(args.name, warn, regions=args.region)
        there = (entry.record.monitor if entry.record is not None else 0) or urls.PORT
        with reach.session(entry) as shell:
            try:
                tunnel = Tunnel(shell, ('127.0.0.1', there), port=args.port, say=warn)
            except OSError as error:
                raise ConfigurationError(
                    f'port {args.port} of this computer: {error.strerror}',
                    'another --port, or none for one that is free') from error
            address = urls.bridge('localhost', tunnel.port)
            print(f'{args.name} is at {address} until Ctrl-C; in a browser:\n'
                  f'{urls.app(address)}', flush=True)
            if not args.no_browser:
                import webbrowser
                webbrowser.open(urls.app(address))
            try:
                tunnel.serve()
            except KeyboardInterrupt:
                print()
            finally:
                tunnel.close()
        return 0
