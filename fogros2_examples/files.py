# SPDX-License-Identifier: Apache-2.0
"""Check files that launch arguments and parameters name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import contextlib
import os
from pathlib import Path
import pkgutil
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from launch import LaunchContext
    from launch.actions import OpaqueFunction

#: Formats of pictures that OpenCV and matplotlib write.
PICTURES = ('.png', '.jpg', '.jpeg')


class BadInput(ValueError):
    """A parameter or a file cannot be used; the text has the reason."""


def check_writable(text: str, endings: Sequence[str] = ()) -> None:
    """
    Check that a file can be written.

    :param endings: allowed file extensions; empty: all.
    :raises ValueError: the reason.
    """
    path = Path(text)
    if endings and path.suffix.lower() not in endings:
        raise ValueError(f'it has to end in {", ".join(endings)}')
    if not path.parent.is_dir():
        raise ValueError(f'there is no folder {path.parent}')
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise ValueError("it can't be written")


def checked(
    read: Mapping[str, str], written: Mapping[str, Sequence[str]] = {},
    made: Sequence[str] = (), folders: Sequence[str] = (), readers: Mapping[str, str] = {},
) -> OpaqueFunction:
    """
    Return an action that checks files on the robot before the launch creates a machine.

    :param read: launch arguments that name a file, and the remedy if it is missing.
    :param written: launch arguments that name a file to write, and its file extensions.
    :param made: values that name no file.
    :param folders: the arguments of ``read`` that may name a folder instead.
    :param readers: by argument of ``read``, 'module:function' that raises a ValueError for a file
        that the nodes cannot use.
    """
    # not imported for nodes
    from launch.actions import OpaqueFunction

    def check(context: LaunchContext) -> None:
        given = context.launch_configurations

        def refuse(name: str, reader: Callable[..., object], *arguments: object) -> None:
            try:
                reader(*arguments)
            except ValueError as error:
                raise RuntimeError(f'{name}:={given[name]}: {error}') from error

        for name, remedy in read.items():
            exists = os.path.exists if name in folders else os.path.isfile
            if given[name] not in ('', *made) and not (
                    exists(given[name]) and os.access(given[name], os.R_OK)):
                raise RuntimeError(f'{name}:={given[name]}: there is no such file here ({remedy})')
        for name, reader in readers.items():
            # the launch reports a module that the robot lacks
            with contextlib.suppress(ImportError):
                if given[name] not in ('', *made):
                    refuse(name, pkgutil.resolve_name(reader), Path(given[name]))
        for name, endings in written.items():
            if given[name]:
                refuse(name, check_writable, given[name], endings)

    return OpaqueFunction(function=check)
