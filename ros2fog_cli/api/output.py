# SPDX-License-Identifier: Apache-2.0
"""
Print for terminals and for programs.

The texts of machines may control a terminal: what the verbs print is cleaned once, here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import errno
import io
import json
import os
import sys
from typing import Any, cast, Optional, TextIO

from fogros2.untrusted import clean

#: Version of the output of ``--json``: it grows when a field goes or changes its meaning.
JSON_VERSION = 1


class _Output:
    """
    A stream that replaces control characters; it has the other methods of ``stream``.

    :param needed: whether a text that can not be written ends the verb.
    :param change: what is done with each text.
    """

    def __init__(
        self, stream: TextIO, needed: bool, change: Callable[[str], str] = clean,
    ) -> None:
        self.stream, self.needed, self.change = stream, needed, change

    def write(self, text: str) -> int:
        """
        Write a text.

        :raises BrokenPipeError: it can not be written, such as behind ``| head``.
        """
        try:
            self.stream.write(self.change(text))
        except OSError as error:
            self._lost(error)
        return len(text)

    def flush(self) -> None:
        """Write what is kept, as :meth:`write` does."""
        try:
            self.stream.flush()
        except OSError as error:
            self._lost(error)

    def _lost(self, error: OSError) -> None:
        # the stream keeps the text, and the exit would fail to write it again
        with open(os.devnull, 'w') as nowhere:
            os.dup2(nowhere.fileno(), self.stream.fileno())
        if self.needed:
            if error.errno != errno.EPIPE:
                print(f"can't write the output: {error.strerror}", file=sys.stderr)
            raise BrokenPipeError from error

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


@contextlib.contextmanager
def cleaned() -> Iterator[None]:
    """
    Clean what is printed in this block; a closed stream is /dev/null.

    A character that the encoding of standard output lacks becomes an escape sequence of Python.
    """
    for name, mode in (('stdin', 'r'), ('stdout', 'w'), ('stderr', 'w')):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == 'strict':
        sys.stdout.reconfigure(errors='backslashreplace')
    with contextlib.redirect_stdout(cast(TextIO, _Output(sys.stdout, True))), \
            contextlib.redirect_stderr(cast(TextIO, _Output(sys.stderr, False))):
        yield


def uncleaned(stream: TextIO) -> TextIO:
    """Return the stream for text that moves the cursor, or that a shell evaluates."""
    return cast(TextIO, _Output(stream.stream, stream.needed, str)) \
        if isinstance(stream, _Output) else stream


def needed(stream: TextIO) -> TextIO:
    """Return the stream for what the verb is for: if it can not be written, the verb ends."""
    return cast(TextIO, _Output(stream.stream, True, stream.change)) \
        if isinstance(stream, _Output) else stream


def as_json(fields: dict[str, Any], *, indent: Optional[int] = 2) -> str:
    """
    Return fields, and their version, as a JSON object; ``doc/reference/scripts.md`` lists them.

    :param indent: None for one line.
    """
    return json.dumps({'version': JSON_VERSION, **fields}, indent=indent)
