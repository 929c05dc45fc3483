# SPDX-License-Identifier: Apache-2.0
"""The contract of every shell, as tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import contextlib
import functools
from pathlib import Path
import threading
import time
from typing import ClassVar

import pytest

from fogros2.errors import (
    Cancelled,
    CommandError,
    DeadlineExceeded,
    FogError,
    WorkspaceError,
)
from fogros2.model import Command
from fogros2.shell import Shell
from fogros2.waiting import in_thread


class ShellContract:
    """The contract of every shell; pytest collects its subclasses."""

    #: Whether the login user may become root without a password.
    sudo: ClassVar[bool] = True

    def make(self, folder: Path) -> tuple[Shell, str]:
        """Return a shell, and the path of an empty folder there; ``folder`` is a local folder."""
        raise LookupError(f'{type(self).__name__} has to say what it tests: write make()')

    @contextlib.contextmanager
    def connected(self, folder: Path) -> Iterator[tuple[Shell, str]]:
        """Yield what ``make`` returns, and close the shell afterwards."""
        shell, remote = self.make(folder)
        try:
            yield shell, remote
        finally:
            shell.close()

    @pytest.fixture
    def connection(self, tmp_path: Path) -> Iterator[tuple[Shell, str]]:
        """Connect a shell for one test."""
        with self.connected(tmp_path) as connection:
            yield connection

    @pytest.fixture
    def shell(self, connection: tuple[Shell, str]) -> Shell:
        """Return the shell."""
        return connection[0]

    @pytest.fixture
    def there(self, connection: tuple[Shell, str]) -> str:
        """Return the path of the empty folder there."""
        return connection[1]

    def read(self, shell: Shell, path: str) -> str:
        """Return the content of a file on the shell's machine."""
        return shell.run(Command(('cat', path)), timeout=30.0).stdout

    def test_a_command_s_output_and_status_come_back(self, shell: Shell) -> None:
        result = shell.run(Command(('echo', 'hello')), timeout=30.0)
        assert (result.returncode, result.stdout) == (0, 'hello\n')
        assert shell.run(Command(('false',)), timeout=30.0, check=False).returncode == 1

    def test_words_arrive_as_they_are(self, shell: Shell) -> None:
        words = ('a b', "it's", '"x"', '$HOME', '`id`', 'é\u4e16', '*', ';', '\\', 'two\nlines')
        result = shell.run(Command(('echo', *words)), timeout=30.0)
        assert result.stdout == ' '.join(words) + '\n'

    def test_a_failure_says_what_where_and_why(self, shell: Shell, there: str) -> None:
        command = Command(('cat', f'{there}/nothing'), what='reading it')
        error = raised(CommandError, lambda: shell.run(command, timeout=30.0))
        assert isinstance(error, CommandError)
        assert error.result.returncode == 1
        assert 'reading it failed' in str(error)
        assert 'No such file' in str(error)

    def test_a_missing_program_is_an_error(self, shell: Shell) -> None:
        error = raised(FogError, lambda: shell.run(
            Command(('fogros2-no-such-program',)), timeout=30.0))
        assert 'fogros2-no-such-program' in str(error)

    def test_input_reaches_the_command(self, shell: Shell) -> None:
        text = 'line\n' * 100_000
        result = shell.run(Command(('cat',), input=text.encode()), timeout=30.0)
        assert result.stdout == text

    def test_the_environment_is_set(self, shell: Shell) -> None:
        command = Command(('printenv', 'FOG_TEST'), environment={'FOG_TEST': 'a b$c'})
        assert shell.run(command, timeout=30.0).stdout == 'a b$c\n'

    def test_sudo_is_root(self, shell: Shell) -> None:
        if not self.sudo:
            return
        assert shell.run(Command(('id', '-u'), sudo=True), timeout=30.0).stdout == '0\n'

    def test_output_comes_line_by_line(self, shell: Shell) -> None:
        lines: list[str] = []
        shell.run(Command(('seq', '20000')), timeout=30.0, on_output=lines.append)
        assert lines == [str(n + 1) for n in range(20000)]

    def test_command_that_takes_too_long_is_given_up(self, shell: Shell) -> None:
        begin = time.monotonic()
        raised(DeadlineExceeded,
                lambda: shell.run(Command(('sleep', '60')), timeout=0.3))
        assert time.monotonic() - begin < 30.0
        assert shell.run(Command(('true',)), timeout=30.0).returncode == 0

    def test_a_command_can_be_cancelled(self, shell: Shell) -> None:
        cancel = threading.Event()
        timer = threading.Timer(0.2, cancel.set)
        timer.start()
        begin = time.monotonic()
        raised(Cancelled, lambda: shell.run(
            Command(('sleep', '60')), timeout=60.0, cancel=cancel))
        timer.join()
        assert time.monotonic() - begin < 30.0

    def test_many_threads_use_one_shell(self, shell: Shell) -> None:
        calls = [in_thread(functools.partial(
            shell.run, Command(('echo', str(number))), timeout=30.0)) for number in range(24)]
        assert [call.result(60.0).stdout for call in calls] == [f'{n}\n' for n in range(24)]

    def test_put_makes_folders_and_sets_the_mode(self, shell: Shell, there: str) -> None:
        path = f'{there}/new folder/é'
        for data, mode in ((b'secret', 0o600), (b'', 0o644), (b'x' * 3_000_000, 0o700)):
            shell.put(data, path, mode=mode)
            assert self.read(shell, path) == data.decode()
            mode_text = shell.run(Command(('stat', '-c', '%a', path)), timeout=30.0).stdout
            assert mode_text == f'{mode:o}\n'

    def test_sync_makes_a_folder_equal(self, shell: Shell, there: str, tmp_path: Path) -> None:
        source = tmp_path / 'the source'
        _write(source, {'a': 'one', 'sub/b': 'two', 'sub/é c': 'three', 'log/l': 'l'})
        target = f'{there}/the target'
        first = shell.sync(source, target, excludes=['log'], timeout=60.0)
        assert first.files == 3
        assert self.read(shell, f'{target}/sub/é c') == 'three'
        raised(CommandError, lambda: self.read(shell, f'{target}/log/l'))
        again = shell.sync(source, target, excludes=['log'], timeout=60.0)
        assert again.files == 0
        (source / 'a').write_text('another one')
        (source / 'sub/b').unlink()
        last = shell.sync(source, target, excludes=['log'], timeout=60.0)
        assert last.files == 1
        assert self.read(shell, f'{target}/a') == 'another one'
        raised(CommandError, lambda: self.read(shell, f'{target}/sub/b'))

    def test_sync_leaves_alone_what_is_excluded(
        self, shell: Shell, there: str, tmp_path: Path,
    ) -> None:
        source = tmp_path / 'source'
        _write(source, {'a': 'one', 'build/b': 'two', 'build/keep': 'three'})
        target = f'{there}/target'
        shell.put(b'theirs', f'{target}/build/made', mode=0o644)
        shell.sync(source, target, excludes=['build/*'], includes=['build/keep'],
                   timeout=60.0)
        assert self.read(shell, f'{target}/build/made') == 'theirs'
        assert self.read(shell, f'{target}/build/keep') == 'three'
        raised(CommandError, lambda: self.read(shell, f'{target}/build/b'))

    def test_sync_tells_how_far_it_is(self, shell: Shell, there: str, tmp_path: Path) -> None:
        source = tmp_path / 'source'
        _write(source, {f'f{n}': 'x' * 100_000 for n in range(30)})
        seen: list[tuple[int, int]] = []
        shell.sync(source, f'{there}/target', excludes=[], timeout=60.0,
                   on_progress=lambda done, total: seen.append((done, total)))
        assert seen[-1] == (3_000_000, 3_000_000)
        assert [done for done, _ in seen] == sorted(done for done, _ in seen)

    def test_sync_needs_a_folder(self, shell: Shell, there: str, tmp_path: Path) -> None:
        raised(WorkspaceError, lambda: shell.sync(
            tmp_path / 'nothing', there, excludes=[], timeout=60.0))

    def test_a_stream_carries_lines_both_ways(self, shell: Shell) -> None:
        stream = shell.open(Command(('cat',)))
        for line in (b'one\n', 'zw\u00f6lf\n'.encode(), b'x' * 30_000 + b'\n'):
            stream.write(line)
            assert stream.readline() == line
        stream.close()
        assert stream.readline() == b''

    def test_closing_a_stream_wakes_its_reader(self, shell: Shell) -> None:
        stream = shell.open(Command(('cat',)))
        line = in_thread(stream.readline)
        stream.close()
        assert line.result(10.0) == b''

    def test_it_opens_again_after_close(self, shell: Shell) -> None:
        shell.run(Command(('true',)), timeout=30.0)
        shell.close()
        assert shell.run(Command(('true',)), timeout=30.0).returncode == 0


def raised(kind: type[FogError], call: Callable[[], object]) -> FogError:
    """Return the error of type ``kind`` that a call must raise."""
    try:
        value = call()
    except kind as error:
        return error
    raise AssertionError(f'{kind.__name__} was expected, not {value!r}')


def _write(folder: Path, files: Mapping[str, str]) -> None:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
