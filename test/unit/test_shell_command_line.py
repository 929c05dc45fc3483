# SPDX-License-Identifier: Apache-2.0
"""Tests of the lines that remote shells get; by value."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import sys

import pytest

from fogros2.model import Command, Result
from fogros2.shell import command_line


@pytest.mark.parametrize('command, user, words', [
    (Command(('ls', 'a b')), 'fog', ['ls', 'a b']),
    (Command(('ls',), sudo=True), 'fog', ['sudo', '-n', '--', 'ls']),
    (Command(('ls',), sudo=True), 'root', ['ls']),
    (Command(('ls',), environment={'A': 'b c'}), 'fog', ['env', 'A=b c', 'ls']),
    (Command(('ls',), environment={'A': '$x'}, sudo=True), 'fog',
     ['sudo', '-n', '--', 'env', 'A=$x', 'ls']),
])
def test_arguments_are_quoted_once(command, user, words):
    assert shlex.split(command_line.remote_line(command, user=user)) == words


def test_input_is_in_no_line():
    command = Command(('cat',), input=b'secret')
    assert 'secret' not in command_line.announced_line(command, user='fog')


def test_an_announced_line_prints_its_process_first():
    line = command_line.announced_line(Command(('sh', '-c', 'echo $$ "$1"', 'x', 'a b')), user='u')
    child = subprocess.run(['sh', '-c', line], capture_output=True, text=True, check=True)
    first, second = child.stdout.splitlines()
    assert second == f'{first} a b'


@pytest.mark.parametrize('login', [*filter(shutil.which, ['sh', 'bash', 'tcsh', 'fish'])])
def test_any_login_shell_takes_scripts_of_several_lines(login):
    script = "read -r a\nprintf '%s!x\\\\%s\\n' $a \"$HOME's\"\n"
    line = command_line.marked_line(
        command_line.announced_line(Command.script(script), user='u'))
    assert '\n' not in line and '!' not in line
    child = subprocess.run([login, '-c', line], input='in\n', capture_output=True, text=True,
                           check=True)
    assert child.stdout.splitlines()[-1] == f"in!x\\{os.environ['HOME']}'s"


def test_the_end_script_ends_a_group():
    child = subprocess.Popen(['sh', '-c', 'trap "" TERM; sleep 60 & wait; wait'],
                             start_new_session=True)
    # the signal has to find the trap set
    subprocess.run(['sh', '-ec', f'until pgrep -P {child.pid} >/dev/null; do sleep 0.01; done'],
                   check=True, timeout=10)
    subprocess.run(['sh', '-c', command_line.end_script(child.pid)], check=False, timeout=20,
                   stderr=subprocess.DEVNULL)
    assert child.wait(60) == -signal.SIGKILL


@pytest.mark.parametrize('path, quoted', [
    ('/a b', "'/a b'"), ('~', '"$HOME"'), ('~/a b', '"$HOME"/\'a b\''), ('~other', "'~other'"),
])
def test_paths_are_quoted_and_the_home_is_known(path, quoted):
    assert command_line.remote_path(path) == quoted


def test_a_file_is_written_aside_first(tmp_path):
    target = tmp_path / 'new/file'
    script = command_line.write_script(str(target), 0o640)
    subprocess.run(['sh', '-ec', script], input=b'data', check=True)
    assert target.read_bytes() == b'data'
    assert target.stat().st_mode & 0o777 == 0o640
    assert target.parent.stat().st_mode & 0o777 == 0o700
    assert [p.name for p in target.parent.iterdir()] == ['file']


def test_a_file_that_can_t_be_written_leaves_nothing(tmp_path):
    target = tmp_path / 'file'
    target.mkdir()
    (target / 'inside').write_text('')
    script = command_line.write_script(f'{target}/inside/x', 0o600)
    assert subprocess.run(['sh', '-ec', script], input=b'data', check=False,
                          stderr=subprocess.DEVNULL).returncode != 0
    assert sorted(os.listdir(target)) == ['inside']


@pytest.mark.parametrize('code, stderr, words', [
    (1, 'cat: write error: No space left on device', 'is full'),
    (1, 'sudo: a terminal is required to read the password\nsudo: a password is required\n',
     'without a password'),
    (1, 'sudo: Ein Passwort ist notwendig\n', 'without a password'),
    (1, 'sudo: パスワードが必要です\n', 'without a password'),
    (1, 'sudo: unable to resolve host gpu: Name or service not known\n', ''),
    (1, 'sudo: colcon: command not found\n', 'install what is missing'),
    (1, 'sudo: colcon: Befehl nicht gefunden\n', 'install what is missing'),
    (127, 'bash: line 1: colcon: command not found', 'install what is missing'),
    (127, 'bash: Zeile 1: colcon: Kommando nicht gefunden.', 'install what is missing'),
    (1, 'something else', ''),
    (1, '', ''),
])
def test_common_failures_have_a_hint(code, stderr, words):
    hint = command_line.hint_for(
        Command(('colcon',), sudo=True), Result(code, '', stderr), "'planner'")
    assert words in hint if words else not hint


def test_paramiko_is_imported_late_and_without_invoke():
    code = (
        'import sys\n'
        'from fogros2.shell import ssh, ssh_connection\n'
        "assert 'paramiko' not in sys.modules\n"
        'ssh_connection.warm().join()\n'
        "assert 'paramiko' in sys.modules and 'invoke' not in sys.modules\n"
        'import invoke\n')
    subprocess.run([sys.executable, '-c', code], check=True)


@pytest.mark.parametrize(('kind', 'library'), [('ssh', 'paramiko'), ('kubernetes', 'kubernetes')])
def test_exit_waits_for_import_of_library(tmp_path, kind, library):
    (tmp_path / f'{library}.py').write_text(
        "import threading\nthreading.main_thread().join()\nprint('imported', flush=True)\n")
    code = (
        'import sys\nfrom fogros2 import shell, waiting\n'
        f'shell.warm({kind!r})\n'
        f"waiting.wait_until(lambda: {library!r} in sys.modules, timeout=60.0, what='its begin')\n"
        'sys.setswitchinterval(9)\n')
    done = subprocess.run([sys.executable, '-c', code], check=True, capture_output=True, text=True,
                          env={**os.environ, 'PYTHONPATH': str(tmp_path)})
    assert done.stdout == 'imported\n' and done.stderr == ''


def test_warnings_of_paramikos_import_are_not_shown(tmp_path):
    """Its older versions name a cipher of which newer versions of cryptography warn."""
    (tmp_path / 'paramiko.py').write_text(
        "import warnings\nwarnings.warn('TripleDES has moved', UserWarning)\n")
    code = 'from fogros2.shell import ssh_connection; ssh_connection.warm().join()'
    done = subprocess.run([sys.executable, '-c', code], check=True, capture_output=True, text=True,
                          env={**os.environ, 'PYTHONPATH': str(tmp_path)})
    assert done.stderr == ''
