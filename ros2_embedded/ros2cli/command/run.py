# SPDX-License-Identifier: Apache-2.0
"""The command ``ros2 run``."""
from __future__ import annotations

from argparse import REMAINDER
import os
import shlex
import signal
import subprocess
from typing import Any

from ros2cli.command import CommandExtension
from ros2cli.packages import get_executable_paths


class RunCommand(CommandExtension):
    """Run a package specific executable."""

    def add_arguments(self, parser: Any, cli_name: str, *, argv: Any = None) -> None:
        parser.add_argument('--prefix', help='Words to put before the executable')
        parser.add_argument('package_name', help='Name of the ROS package')
        parser.add_argument('executable_name', help='Name of the executable')
        parser.add_argument(
            'argv', nargs=REMAINDER, help='Pass arbitrary arguments to the executable')

    def main(self, *, parser: Any, args: Any) -> int | str:
        paths = [path for path in get_executable_paths(args.package_name)
                 if os.path.basename(path) == args.executable_name]
        if not paths:
            return 'No executable found'
        if len(paths) > 1:
            raise RuntimeError('\n- '.join(['Multiple executables found:', *paths]))
        process = subprocess.Popen([*shlex.split(args.prefix or ''), *paths, *args.argv])
        while process.returncode is None:
            try:
                process.communicate()
            except KeyboardInterrupt:
                # The subprocess got the signal as well, and decides what it means.
                continue
        if process.returncode < 0:
            print('[ros2run]:', signal.strsignal(-process.returncode))
        elif process.returncode > 0:
            print(f'[ros2run]: Process exited with failure {process.returncode}')
        return process.returncode
