# SPDX-License-Identifier: Apache-2.0
"""The command ``ros2 run``."""
from __future__ import annotations

from argparse import REMAINDER
import shlex
import signal
import subprocess
from typing import Any, List, Optional, Union

from ros2cli.api.pkg import (
    ExecutableNameCompleter,
    get_executable_path,
    MultipleExecutables,
    package_name_completer,
    PackageNotFound,
)
from ros2cli.command import CommandExtension

ROS2RUN_MSG_PREFIX = '[ros2run]:'


def run_executable(*, path: str, argv: List[str], prefix: Optional[List[str]] = None) -> int:
    """Run it, however often the terminal interrupts; return its status or minus its signal."""
    process = subprocess.Popen([*(prefix or ()), path, *argv])
    while process.returncode is None:
        try:
            process.communicate()
        except KeyboardInterrupt:
            # The subprocess got the signal as well, and decides what it means.
            continue
    if process.returncode < 0:
        print(ROS2RUN_MSG_PREFIX, signal.strsignal(-process.returncode))
    elif process.returncode > 0:
        print(ROS2RUN_MSG_PREFIX, f'Process exited with failure {process.returncode}')
    return process.returncode


class RunCommand(CommandExtension):
    """Run a package specific executable."""

    def add_arguments(self, parser: Any, cli_name: str, *, argv: Any = None) -> None:
        parser.add_argument(
            '--prefix',
            help='Prefix command, which should go before the executable. Command must be wrapped '
                 "in quotes if it contains spaces (e.g. --prefix 'gdb -ex run --args').")
        argument = parser.add_argument('package_name', help='Name of the ROS package')
        argument.completer = package_name_completer
        argument = parser.add_argument('executable_name', help='Name of the executable')
        argument.completer = ExecutableNameCompleter(package_name_key='package_name')
        parser.add_argument(
            'argv', nargs=REMAINDER, help='Pass arbitrary arguments to the executable')

    def main(self, *, parser: Any, args: Any) -> Union[int, str]:
        try:
            path = get_executable_path(
                package_name=args.package_name, executable_name=args.executable_name)
        except PackageNotFound as exc:
            raise RuntimeError(f"Package '{args.package_name}' not found") from exc
        except MultipleExecutables as exc:
            raise RuntimeError('\n- '.join(['Multiple executables found:', *exc.paths])) from exc
        if path is None:
            return 'No executable found'
        prefix = None if args.prefix is None else shlex.split(args.prefix)
        return run_executable(path=path, argv=args.argv, prefix=prefix)
