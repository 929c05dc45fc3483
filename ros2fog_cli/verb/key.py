# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog key``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import VerbExtension


class KeyVerb(VerbExtension):
    """Print this computer's public key, for an invitation to another robot's machine."""

    def main(self, *, args: argparse.Namespace) -> int:
        """Print the name and the key of this computer."""
        from fogros2 import invitation
        from fogros2.store import Store
        print(invitation.own_name(Store()))
        return 0
