# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog ssh-config``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import complete, machine_names, say, VerbExtension, warn


class SshConfigVerb(VerbExtension):
    """Let ssh, rsync, VS Code and others reach machines by their names."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        complete(parser.add_argument('name', nargs='*',
                                     help='only these machines (default: all that run)'),
                 machine_names)

    def main(self, *, args: argparse.Namespace) -> int:
        """Write the settings; return 1 if a named machine has none."""
        from fogros2.errors import FogError
        from fogros2.store import Store
        from ros2fog_cli.api import reach, ssh_settings
        store, failed = Store(), 0
        for name in dict.fromkeys(args.name or machine_names()):
            try:
                path = ssh_settings.write(reach.find(name, warn), store)
                say(f'{name}: {path}')
            except FogError as error:
                warn(f'{name}: {error}')
                failed = int(bool(args.name))
        line = ssh_settings.include(store)
        if not ssh_settings.included(line):
            say(f'Put this line first into ~/.ssh/config:\n{line}')
        return failed
