# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog key``, ``invite`` and ``revoke``, ``join`` and ``leave``."""

from __future__ import annotations

import argparse
import sys

from ros2fog_cli.verb import add_name, complete, confirmed, VerbExtension, warn


class KeyVerb(VerbExtension):
    """Print this computer's public key, for an invitation to another robot's machine."""

    def main(self, *, args: argparse.Namespace) -> int:
        """Print the name and the key of this computer."""
        from fogros2.store import Store
        from fogros2_features.guests import invitation
        print(invitation.own_name(Store()))
        return 0


class InviteVerb(VerbExtension):
    """Admit another computer to a machine, and print its invitation."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_name(parser)
        parser.add_argument('--key', required=True,
                            help='what `ros2 fog key` prints on the other computer')
        parser.add_argument('--for', dest='seconds', default='1h', metavar='TIME',
                            help='validity of the invitation, such as 10m or 2h (default: 1h)')
        parser.add_argument('--address', metavar='HOST',
                            help='address at which the other computer reaches the machine '
                                 '(default: the one that the provider reports)')

    def main(self, *, args: argparse.Namespace) -> int:
        """Print the invitation, which only the other computer can open."""
        from fogros2.describe.values import parse_duration
        from fogros2_features.guests import inviting
        print(inviting.invite(args.name, args.key, parse_duration('--for', args.seconds), warn,
                              host=args.address))
        return 0


class RevokeVerb(VerbExtension):
    """Withdraw the access of invited computers to a machine."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        add_name(parser)
        parser.add_argument('who', nargs='?', metavar='WHO',
                            help='name, VPN address or key of one, as in `ros2 fog status` '
                                 '(default: all invited computers)')

    def main(self, *, args: argparse.Namespace) -> int:
        """Print who was removed."""
        from fogros2_features.guests import inviting
        names = inviting.revoke(args.name, args.who, warn)
        for each in names:
            print(f'revoked {each}')
        if not names:
            print(f"'{args.name}' has no guests")
        return 0


class JoinVerb(VerbExtension):
    """Join another robot's machine by an invitation; print what `ros2 fog env` prints."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        parser.add_argument('invitation', help='what `ros2 fog invite` printed for this computer')

    def main(self, *, args: argparse.Namespace) -> int:
        """Print lines for ``eval "$(ros2 fog join INVITATION)"``."""
        from fogros2.store import Store
        from fogros2_features.guests import membership
        from ros2fog_cli.api import output, reach, terminals
        folder = membership.join(args.invitation, Store(), agreed=confirmed)
        print(*terminals.shell_lines(folder, reach.variables_of(folder)), sep='\n',
              file=output.uncleaned(sys.stdout))
        return 0


class LeaveVerb(VerbExtension):
    """Leave a machine that this computer has joined; first end its nodes here."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        complete(parser.add_argument('name', help="the machine's name"), joined_names)

    def main(self, *, args: argparse.Namespace) -> int:
        """Delete this computer's end of the VPN."""
        from fogros2.store import Store
        from fogros2_features.guests import membership
        membership.leave(args.name, Store())
        print(f'left {args.name}')
        return 0


def joined_names() -> list[str]:
    """Return the names of the machines that this computer has joined."""
    from fogros2.store import Store
    return list(Store().other_vpns())
