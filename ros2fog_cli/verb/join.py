# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog join``."""

from __future__ import annotations

import argparse
import sys

from ros2fog_cli.verb import confirmed, VerbExtension


class JoinVerb(VerbExtension):
    """Join another robot's machine by an invitation; print what `ros2 fog env` prints."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add the verb's arguments."""
        parser.add_argument('invitation', help='what `ros2 fog invite` printed for this computer')

    def main(self, *, args: argparse.Namespace) -> int:
        """Print lines for ``eval "$(ros2 fog join INVITATION)"``."""
        from fogros2.deploy import membership
        from fogros2.store import Store
        from ros2fog_cli.api import joining, output, reach
        folder = membership.join(args.invitation, Store(), agreed=confirmed)
        print(*joining.shell_lines(folder, reach.variables_of(folder)), sep='\n',
              file=output.uncleaned(sys.stdout))
        return 0
