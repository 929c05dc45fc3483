# SPDX-License-Identifier: Apache-2.0
"""The agent's events on disk."""

from __future__ import annotations

import contextlib
import errno
import os
import time

from fogros2.agent.protocol import dump, say

TYPE_CHECKING = False
if TYPE_CHECKING:
    from fogros2.events import AgentEvent

#: Bytes to read or send at once.
BLOCK = 1 << 18


class Generation:
    """
    One file of the journal: whole lines, each beginning ``{"seq":N,``.

    :param begin: the position of its first byte.
    """

    def __init__(self, path: str, flags: int, begin: int) -> None:
        self.fd = os.open(
            path, os.O_RDWR | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC | flags, 0o600)
        self.size = os.fstat(self.fd).st_size
        self.begin = begin
        self.first = self.seq_at(0)

    def __del__(self) -> None:
        with contextlib.suppress(AttributeError, OSError):
            os.close(self.fd)

    def write(self, line: bytes) -> None:
        """
        Append a line, or nothing.

        :raises OSError: such as a full disk.
        """
        written = os.write(self.fd, line)
        if written < len(line):
            os.ftruncate(self.fd, self.size)
            raise OSError(errno.ENOSPC, 'disk full')
        self.size += written

    def read(self, offset: int) -> bytes:
        """Return whole lines from ``offset`` on, at least one if there is one."""
        count = BLOCK
        while offset < self.size:
            data = os.pread(self.fd, min(count, self.size - offset), offset)
            cut = data.rfind(b'\n') + 1
            if cut or len(data) < count:  # else a long line, or something truncated the file
                return data[:cut]
            count *= 4
        return b''

    def seq_at(self, offset: int) -> int:
        """Return the seq of the line that begins at ``offset``; 0 if it is no line of the log."""
        head = os.pread(self.fd, 40, offset)
        number = head[7:].split(b',')[0]
        return int(number) if head.startswith(b'{"seq":') and number.isdigit() else 0

    def find(self, seq: int) -> int:
        """Return the offset of an event's line, 0 if it is not there; reads the whole file."""
        mark, offset = b'\n{"seq":%d,' % seq, 0
        while offset < self.size:
            data = os.pread(self.fd, BLOCK, offset)
            at = data.find(mark)
            if at >= 0:
                return offset + at + 1
            if len(data) < BLOCK:
                break
            offset += BLOCK - len(mark)
        return 0

    def last_line(self) -> int:
        """Return the offset of the last line; ignore the last byte, its end."""
        step = 4096
        while True:
            begin = max(0, self.size - step)
            at = os.pread(self.fd, self.size - begin - 1, begin).rfind(b'\n')
            if at >= 0 or begin == 0:
                return begin + at + 1
            step *= 8

    def cut_torn_line(self) -> None:
        """Remove an incomplete last line that a crash left."""
        if self.size and os.pread(self.fd, 1, self.size - 1) != b'\n':
            self.size = self.last_line()
            os.ftruncate(self.fd, self.size)


class Journal:
    """
    The events on disk, in two generations, so that neither memory nor disk fills up.

    Positions count the bytes of all generations.

    :param limit: size of a generation in bytes; less on a small disk, which may be memory.
    """

    def __init__(self, directory: str, limit: int) -> None:
        self.path = os.path.join(directory, 'events.jsonl')
        self.old = os.path.join(directory, 'events.1.jsonl')
        disk = os.statvfs(directory)
        self.limit = min(limit, disk.f_blocks * disk.f_frsize // 8 or limit)
        self.full = False
        self.files = [Generation(self.old, 0, 0)] if os.path.exists(self.old) else []
        current = Generation(self.path, os.O_CREAT, sum(file.size for file in self.files))
        current.cut_torn_line()
        self.files.append(current)
        last = current if current.size else self.files[0]
        self.next = last.seq_at(last.last_line()) + 1 if last.size else 1
        if not current.size:
            current.first = self.next

    @property
    def first(self) -> int:
        """The oldest seq that exists; the next seq if the journal is empty."""
        return self.files[0].first

    def append(self, event: AgentEvent) -> None:
        """Number and write an event."""
        number, self.next = self.next, self.next + 1
        data = dump({'seq': number, 'time': time.time(), **event})
        try:
            file = self.files[-1]
            if file.size and file.size + len(data) > self.limit:
                file = self.rotate(number)
            try:
                file.write(data)
            except OSError as error:
                if error.errno != errno.ENOSPC or not any(each.size for each in self.files):
                    raise
                # the older generation's room
                self.rotate(number).write(data)
            self.full = False
        except OSError as error:
            # the agent works without a journal too; the missing seqs show the gap
            if not self.full:
                say(f'events are being lost: {error}')
            self.full = True

    def rotate(self, first: int) -> Generation:
        """Begin a new generation with the event ``first``; return the new generation."""
        last = self.files[-1]
        with contextlib.suppress(FileNotFoundError):  # renamed by an attempt that failed then
            os.rename(self.path, self.old)
        file = Generation(self.path, os.O_CREAT | os.O_EXCL, last.begin + last.size)
        file.first = first
        self.files = [last, file]
        return file

    def find(self, seq: int) -> int:
        """Return the position of an event, or of an earlier one if the event was lost."""
        last = self.files[-1]
        if seq >= self.next:
            return last.begin + last.size
        file = last if last.first <= seq else self.files[0]
        return file.begin + (file.find(seq) if file.first < seq else 0)

    def read(self, position: int) -> tuple[bytes, int]:
        """Return whole lines from ``position`` on, and the position after them."""
        for file in self.files:
            offset = max(0, position - file.begin)  # rotation may have deleted earlier lines
            if offset < file.size:
                data = file.read(offset)
                return data, file.begin + offset + len(data)
        return b'', position
