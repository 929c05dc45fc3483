# SPDX-License-Identifier: Apache-2.0
"""
Print for terminals and for programs.

The texts of machines may control a terminal: what the verbs print is cleaned once, here.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import json
import sys
from typing import Any, cast, Optional, TextIO

from fogros2.untrusted import clean

#: Version of the output of ``--json``: it grows when a field goes or changes its meaning.
JSON_VERSION = 1


class _Cleaned:
    """A stream that replaces control characters; it has the other methods of ``stream``."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write a text without control characters."""
        self.stream.write(clean(text))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextlib.contextmanager
def cleaned() -> Iterator[None]:
    """Clean what is printed in this block."""
    with contextlib.redirect_stdout(cast(TextIO, _Cleaned(sys.stdout))), \
            contextlib.redirect_stderr(cast(TextIO, _Cleaned(sys.stderr))):
        yield


def uncleaned(stream: TextIO) -> TextIO:
    """Return the stream for text that moves the cursor, or that a shell evaluates."""
    return stream.stream if isinstance(stream, _Cleaned) else stream


def as_json(fields: dict[str, Any], *, indent: Optional[int] = 2) -> str:
    """
    Return fields, and their version, as a JSON object; ``doc/reference/scripts.md`` lists them.

    :param indent: None for one line.
    """
    return json.dumps({'version': JSON_VERSION, **fields}, indent=indent)
