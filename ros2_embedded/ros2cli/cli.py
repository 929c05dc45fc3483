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

    Nodes then find this Python. (The ament index is set at each start of this Python.)
    """
    paths = os.environ.get('PATH', '').split(os.pathsep)
    if (programs := os.path.join(sys.prefix, 'bin')) not in paths:
        os.environ['PATH'] = os.pathsep.join([programs, *filter(None, paths)])
    os.environ.setdefault('ROS_DISTRO', 'jazzy')
    os.environ.setdefault('ROS_VERSION', '2')
    os.environ.setdefault('ROS_PYTHON_VERSION', '3')


def main(
    *, script_name: str = 'ros2', argv: list[str] | None = None,
    description: str | None = None, extension: Any = None
) -> Any:
    """
    Parse the arguments and call the command.

    :param extension: the command, if it isn't to be found among the arguments.
    :return: what ``sys.exit()`` takes: a status, or an error's text.
    """
    set_up_environment()
    parser = argparse.ArgumentParser(
        description=description or f'{script_name} is an extensible command-line tool for ROS 2.',
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        '--use-python-default-buffering', action='store_true',
        help="Leave stdout's buffering to Python instead of forcing it to be by line")
    try:
        if extension:
            extension.add_arguments(parser, script_name)
        else:
            add_subparsers_on_demand(
                parser, script_name, '_command', 'ros2cli.command', required=False, argv=argv)
        if os.environ.get('_ARGCOMPLETE') == '1':
            from argcomplete import autocomplete  # type: ignore[import-not-found, unused-ignore]
            autocomplete(parser, exclude=['-h', '--help'])
        args = parser.parse_args(args=argv)
        if not args.use_python_default_buffering and hasattr(sys.stdout, 'reconfigure'):
            sys.stdout.reconfigure(line_buffering=True)
        extension = extension or getattr(args, '_command', None)
        if extension is None:
            parser.print_help()
            return 0
        return extension.main(parser=parser, args=args)
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
