# SPDX-License-Identifier: Apache-2.0
"""The command ``ros2``."""
from __future__ import annotations

import argparse
import os
import signal
import sys
from typing import Any

from ros2cli.command import add_subparsers_on_demand


def set_up_environment() -> None:
    """
    Do what sourcing ``setup.bash`` does for ROS 2, for this process and those it starts.

    Nodes then find this Python, and the ament index its packages, behind those of overlays.
    """
    def extended(name: str, *paths: str) -> None:
        os.environ[name] = os.pathsep.join(dict.fromkeys(filter(None, paths)))

    extended('PATH', os.path.join(sys.prefix, 'bin'),
             *os.environ.get('PATH', '').split(os.pathsep))
    extended('AMENT_PREFIX_PATH', *os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep),
             sys.prefix)
    os.environ.setdefault('ROS_DISTRO', 'jazzy')
    os.environ.setdefault('ROS_VERSION', '2')
    os.environ.setdefault('ROS_PYTHON_VERSION', '3')


def main(*, script_name: str = 'ros2', argv: list[str] | None = None) -> Any:
    """
    Parse the arguments and call the command.

    :return: what ``sys.exit()`` takes: a status, or an error's text.
    """
    set_up_environment()
    parser = argparse.ArgumentParser(
        description=f'{script_name} is an extensible command-line tool for ROS 2.',
        formatter_class=argparse.RawDescriptionHelpFormatter)
    try:
        add_subparsers_on_demand(
            parser, script_name, '_command', 'ros2cli.command', required=False, argv=argv)
        if os.environ.get('_ARGCOMPLETE') == '1':
            from argcomplete import autocomplete  # type: ignore[import-not-found, unused-ignore]
            autocomplete(parser, exclude=['-h', '--help'])
        args = parser.parse_args(args=argv)
        if hasattr(sys.stdout, 'reconfigure'):
            strict = sys.stdout.errors == 'strict'
            # the user's terminal may lack a character of a topic or of a tree
            sys.stdout.reconfigure(
                line_buffering=True, errors='backslashreplace' if strict else None)
        if not hasattr(args, '_command'):
            parser.print_help()
            return 0
        return args._command.main(parser=parser, args=args)
    except KeyboardInterrupt:
        return signal.SIGINT
    except RuntimeError as exc:
        return str(exc)
    except Exception as exc:
        # Only where rclpy has been imported can its exception have been raised.
        executors = sys.modules.get('rclpy.executors')
        if executors is not None and isinstance(exc, executors.ExternalShutdownException):
            return signal.SIGTERM
        raise
