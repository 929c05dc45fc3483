# SPDX-License-Identifier: Apache-2.0
"""The command ``ros2``."""
from __future__ import annotations

import argparse
import os
import signal
import sys
from typing import Any, List, Optional

from ros2cli.command import add_subparsers_on_demand


def set_up_environment() -> None:
    """
    Do what sourcing ``setup.bash`` does for ROS 2, for this process and those it starts.

    Nodes then find this Python, and the ament index the packages installed into it.
    """
    def prepend(name: str, path: str) -> None:
        paths = [one for one in os.environ.get(name, '').split(os.pathsep) if one]
        if path not in paths:
            # Behind overlays' prefixes, but before other Pythons' executables.
            paths.insert(len(paths) if name == 'AMENT_PREFIX_PATH' else 0, path)
            os.environ[name] = os.pathsep.join(paths)

    prepend('PATH', os.path.join(sys.prefix, 'bin'))
    prepend('AMENT_PREFIX_PATH', sys.prefix)
    os.environ.setdefault('ROS_DISTRO', 'jazzy')
    os.environ.setdefault('ROS_VERSION', '2')
    os.environ.setdefault('ROS_PYTHON_VERSION', '3')


def _is_external_shutdown(exc: BaseException) -> bool:
    # Only where rclpy has been imported can its exception have been raised.
    executors = sys.modules.get('rclpy.executors')
    return executors is not None and isinstance(exc, executors.ExternalShutdownException)


def main(
    *, script_name: str = 'ros2', argv: Optional[List[str]] = None,
    description: Optional[str] = None, extension: Any = None
) -> Any:
    """
    Parse the arguments and call the command.

    :param extension: the command, if it isn't to be found among the arguments.
    :return: what ``sys.exit()`` takes: a status, or an error's text.
    """
    set_up_environment()
    parser = argparse.ArgumentParser(
        description=description or (
            f'{script_name} is an extensible command-line tool for ROS 2.'),
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        '--use-python-default-buffering', action='store_true', default=False,
        help='Do not force line buffering in stdout and instead use the python default '
             'buffering, which might be affected by PYTHONUNBUFFERED/-u and depends on '
             'whatever stdout is interactive or not')
    key = '_command'
    if extension:
        extension.add_arguments(parser, script_name)
    else:
        try:
            add_subparsers_on_demand(
                parser, script_name, key, 'ros2cli.command', required=False, argv=argv,
                hide_extensions=['extension_points', 'extensions'])
        except RuntimeError as exc:
            return str(exc)
    if os.environ.get('_ARGCOMPLETE') == '1':
        from argcomplete import autocomplete  # type: ignore[import-not-found, unused-ignore]
        autocomplete(parser, exclude=['-h', '--help'])
    args = parser.parse_args(args=argv)
    if not args.use_python_default_buffering and hasattr(sys.stdout, 'reconfigure'):
        sys.stdout.reconfigure(line_buffering=True)
    extension = extension or getattr(args, key, None)
    if extension is None:
        parser.print_help()
        return 0
    try:
        return extension.main(parser=parser, args=args)
    except KeyboardInterrupt:
        return signal.SIGINT
    except RuntimeError as exc:
        return str(exc)
    except Exception as exc:
        if _is_external_shutdown(exc):
            return signal.SIGTERM
        raise
