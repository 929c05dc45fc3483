# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog bugreport``."""

from __future__ import annotations

import argparse

from ros2fog_cli.verb import VerbExtension, warn


class BugreportVerb(VerbExtension):
    """Print the facts about this computer for a bug report, without secrets."""

    def add_arguments(self, parser: argparse.ArgumentParser, cli_name: str) -> None:
        """Add no arguments."""

    def main(self, *, args: argparse.Namespace) -> int:
        """Print the report."""
        import os
        from pathlib import Path

        from fogros2.store import Store
        from ros2fog_cli.api import bugreport, doctor
        home = os.environ.get('ROS_HOME') or '~/.ros'
        log = Path(os.environ.get('ROS_LOG_DIR') or f'{home}/log').expanduser()
        print(bugreport.report(doctor.examine(lan_seconds=0), Store(), os.environ, log),
              flush=True)
        warn('read it before you send it: only known forms of secrets are left out')
        return 0
