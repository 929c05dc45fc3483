# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog monitor``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from ros2fog_cli.verb import add_name, add_page, add_region, VerbExtension, warn

if TYPE_CHECKING:
    from ros2fog_cli.api.machines import Entry

#: Seconds to wait for a browser that opens the page of this computer's own bridge.
TIMEOUT = 60.0


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
        from ros2fog_cli.api import monitor, reach
        here = monitor.on_robot(args.name)
        if here is not None and not args.share:
            return show_here(args.name, *here, browser=not args.no_browser)
        entry = reach.find(args.name, warn, regions=args.region)
        return share(entry) if args.share else serve(entry, args.port, not args.no_browser)


def serve(entry: Entry, port: int, browser: bool) -> int:
    """Forward a port of this computer to the machine's bridge until Ctrl-C."""
    from fogros2 import monitor_addresses as addresses
    from fogros2.errors import ConfigurationError
    from fogros2.model import host_port
    from fogros2_monitor.tunnel import Tunnel
    from ros2fog_cli.api import monitor, reach
    from ros2fog_cli.api.browser import browser_at
    if entry.record is not None and not entry.record.monitor:
        raise ConfigurationError(
            f"'{entry.name}' has no Foxglove bridge",
            'launch_foxglove=True of the machine, or a Foxglove action, starts one')
    remote_port = (entry.record.monitor if entry.record is not None else 0) or addresses.PORT
    with reach.session(entry) as shell:
        token = monitor.token_of(entry, shell, remote_port)
        try:
            tunnel = Tunnel(shell, ('127.0.0.1', remote_port), port=port, say=warn)
        except OSError as error:
            raise ConfigurationError(
                f'port {port} of this computer: {error.strerror}',
                'another --port, or none for one that is free') from error
        with monitor.carrying(tunnel) as ended:
            try:
                page = say(f'{entry.name} is at {{}} until Ctrl-C; in a browser:',
                           host_port('localhost', tunnel.port), token)
                with browser_at(page, start=browser):
                    ended.wait()
            except KeyboardInterrupt:
                print()
    return 0


def show_here(name: str, port: int, token: str, *, browser: bool) -> int:
    """Print the address of this computer's own bridge with its token, and open a browser."""
    from fogros2.model import host_port
    from ros2fog_cli.api.browser import browser_at
    page = say(f'{name} is at {{}}; in a browser:', host_port('localhost', port), token)
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
    from fogros2_monitor import urls
    from ros2fog_cli.api import monitor, reach
    with reach.session(entry) as shell:
        where, token, fingerprint = monitor.credentials_of(entry, shell)
    address = urls.with_token(where, token, 'wss')
    print(f'{address}\n\n'
          'Open this page once, so that the browser accepts the certificate:\n'
          f'https://{address[len("wss://"):]}\n'
          f'its SHA-256 is {fingerprint}\n\n'
          f'Then open one of these pages, and choose {urls.HOW}:\n'
          f'{urls.LICHTBLICK}\n{urls.FOXGLOVE}')
    return 0
