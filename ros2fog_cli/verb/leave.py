# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog leave``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import VerbExtension


class LeaveVerb(VerbExtension):
    """Leave a machine that this computer has joined; its nodes here have to end before."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        argument = parser.add_argument('name', help="the machine's name")
        argument.completer = complete_joined  # type: ignore[attr-defined]

    def main(self, *, args: argparse.Namespace) -> int:
        """Delete this computer's end of the VPN."""
        from fogros2.deploy import membership
        from fogros2.store import Store
        membership.leave(args.name, Store())
        print(f'left {args.name}')
        return 0


def complete_joined(prefix: str, **_: object) -> list[str]:
    """Return the machines that this computer has joined and that begin with ``prefix``."""
    from fogros2 import invitation
    from fogros2.store import Store
    return [name for name in invitation.joined(Store()) if name.startswith(prefix)]
