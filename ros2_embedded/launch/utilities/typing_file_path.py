# SPDX-License-Identifier: Apache-2.0
"""What is accepted as the path of a file."""
import os
import typing

FilePath = typing.TypeVar('FilePath', str, bytes, os.PathLike)  # type: ignore[type-arg]
