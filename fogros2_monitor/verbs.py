# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog monitor`` and ``ros2 fog dashboard``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from ros2fog_cli.verb import add_name, add_region, VerbExtension, warn

if TYPE_CHECKING:
    from fogros2.errors import ConfigurationError
    from ros2fog_cli.api.machines import Entry

#: Seconds to wait for a browser that opens the page of this computer's own bridge.
TIMEOUT = 60.0


def port(text: str) -> int:
    """
    Parse a TCP port, 0 for any free one.

    :raises argparse.ArgumentTypeError: it is none.
    """
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"'{text}' is no port (0 to 65535)")
    return int(text)


def add_page(parser: argparse.ArgumentParser) -> None:
    """Add the options of verbs that serve a page."""
    parser.add_argument('--port', type=port, default=0,
                        help='port of this computer (default: any free port)')
    parser.add_argument('--no-browser', action='store_true',
                        help='print the address, but start no browser')


def taken(port: int, error: OSError) -> ConfigurationError:
    """Return the error for a port at which this computer does not serve."""
    from fogros2.errors import ConfigurationError
    return ConfigurationError(f'port {port} of this computer: {error.strerror}',
                              'another --port, or none for one that is free')


class MonitorVerb(VerbExtension):
    """Show a machine's topics in a browser, through a tunnel to its Foxglove bridge."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_name(parser)
        add_region(parser)
        add_page(parser)
        parser.add_argument('--share', action='store_true',
                            help='print the address, with its token, for the networks in '
                                 'monitor_allow=, and exit')

    def main(self, *, args: argparse.Namespace) -> int:
        """Serve the tunnel until Ctrl-C."""
        from fogros2_monitor import access
        from ros2fog_cli.api import reach
        here = access.on_robot(args.name)
        if here is not None and not args.share:
            return show_here(args.name, *here, browser=not args.no_browser)
        entry = reach.find(args.name, warn, regions=args.region)
        return share(entry) if args.share else serve(entry, args.port, not args.no_browser)


def serve(entry: Entry, port: int, browser: bool) -> int:
    """Forward a port of this computer to the machine's bridge until Ctrl-C."""
    import contextlib

    from fogros2_monitor import access
    from fogros2_monitor.addresses import loopback, PORT, port_of
    from fogros2_monitor.browser import browser_at
    from fogros2_monitor.tunnel import Tunnel
    from ros2fog_cli.api import reach
    remote_port = PORT if entry.record is None else port_of(entry.record.notes)
    if not remote_port:
        raise access.no_bridge(entry.name)
    with reach.session(entry) as shell:
        token = access.token_of(entry, shell, remote_port)
        try:
            tunnel = Tunnel(shell, ('127.0.0.1', remote_port), port=port, say=warn)
        except OSError as error:
            raise taken(port, error) from error
        with contextlib.closing(tunnel):
            try:
                page = say(f'{entry.name} is at {{}} until Ctrl-C; in a browser:',
                           loopback(tunnel.port), token)
                with browser_at(page, start=browser):
                    tunnel.ended.wait()
            except KeyboardInterrupt:
                print()
    return 0


def show_here(name: str, port: int, token: str, *, browser: bool) -> int:
    """Print the address of this computer's own bridge with its token, and open a browser."""
    from fogros2_monitor.addresses import loopback
    from fogros2_monitor.browser import browser_at
    page = say(f'{name} is at {{}}; in a browser:', loopback(port), token)
    with browser_at(page, start=browser) as came:
        came.wait(TIMEOUT)
    return 0


def say(what: str, where: str, token: str) -> str:
    """Print a bridge's address (at ``{}``) and its page; return the page."""
    from fogros2_monitor import urls
    page = urls.served(where, token)
    print(what.format(urls.with_token(where, token)), page, sep='\n', flush=True)
    return page


def share(entry: Entry) -> int:
    """Print the open addresses of a machine's bridge, with the machine's token."""
    from fogros2_monitor import access, urls
    from ros2fog_cli.api import reach
    with reach.session(entry) as shell:
        where, token, fingerprint = access.credentials_of(entry, shell)
    address = urls.with_token(where, token, 'wss')
    print(f'{address}\n\n'
          'Open this page once, so that the browser accepts the certificate:\n'
          f'https://{address[len("wss://"):]}\n'
          f'its SHA-256 is {fingerprint}\n\n'
          f'Then open one of these pages, and choose {urls.HOW}:\n'
          f'{urls.LICHTBLICK}\n{urls.FOXGLOVE}')
    return 0


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
        import threading

        from fogros2_monitor.browser import browser_at
        from fogros2_monitor.dashboard.server import Dashboard
        from ros2fog_cli.api.live import Live
        live = Live(regions=args.region, topics=not args.no_topics, pictures=True)
        try:
            dashboard = Dashboard(live, port=args.port)
        except OSError as error:
            raise taken(args.port, error) from error
        live.start()
        print(f'The dashboard is at {dashboard.url} until Ctrl-C.\n'
              'Everyone who has this address can see and delete machines.', flush=True)
        try:
            with browser_at(dashboard.url, start=not args.no_browser):
                threading.Event().wait()
        except KeyboardInterrupt:
            print()
        finally:
            dashboard.close()
            live.close()
        return 0
