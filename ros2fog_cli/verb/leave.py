# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog leave``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import complete, VerbExtension


class LeaveVerb(VerbExtension):
    """Leave a machine that this computer has joined; its nodes here have to end before."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        complete(parser.add_argument('name', help="the machine's name"), joined_names)

    def main(self, *, args: argparse.Namespace) -> int:
        """Delete this computer's end of the VPN."""
        from fogros2.deploy import membership
        from fogros2.store import Store
        membership.leave(args.name, Store())
        print(f'left {args.name}')
        return 0


def joined_names() -> list[str]:
    """Return the names of the machines that this computer has joined."""
    from fogros2 import invitation
    from fogros2.store import Store
    return list(invitation.joined(Store()))
