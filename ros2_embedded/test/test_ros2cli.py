# SPDX-License-Identifier: Apache-2.0
"""The commands ros2 launch, run and pkg, and how ros2 finds commands."""

import contextlib
import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
import textwrap

import launch.logging
import pytest
from ros2cli.cli import main
from ros2cli.plugin_system import PluginException, satisfies_version

ROS2 = shutil.which('ros2', path=os.pathsep.join([os.path.dirname(sys.executable), os.environ[
    'PATH']]))

embedded_alone = pytest.mark.skipif(
    importlib.util.find_spec('embedded_default') is None,
    reason='ROS 2 itself differs')

LAUNCH_FILE = '''
import sys
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, LogInfo
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

def generate_launch_description():
    return LaunchDescription([
        DeclareLaunchArgument('word', default_value=['hel', 'lo'], description='what to say'),
        DeclareLaunchArgument('needed', condition=IfCondition(LaunchConfiguration('word'))),
        LogInfo(msg=['says ', LaunchConfiguration('word')]),
        Node(package='pkg', executable='sleeper', name='one', output='screen'),
        Node(package='pkg', executable='sleeper', name='two', output='screen')])
'''

SLEEPER = '''#!/usr/bin/env python3
import os, sys, time
deadline = time.monotonic() + 300
try:
    print('ready', *sys.argv[1:], flush=True)
    while time.monotonic() < deadline:
        time.sleep(0.05)
except KeyboardInterrupt:
    sys.exit(0)
'''


@pytest.fixture
def package(package, tmp_path, monkeypatch):
    """Add executables and launch files to the package 'pkg'; return its prefix."""
    share, lib = package / 'share/pkg', package / 'lib/pkg'
    for folder in ('launch', 'other'):
        (share / folder).mkdir()
    for path in ('launch/a.launch.py', 'launch/twice.launch.py', 'other/twice.launch.py'):
        (share / path).write_text(LAUNCH_FILE)
    (share / 'launch' / 'say.launch.xml').write_text(
        '<launch><arg name="word"/><log message="says $(var word)"/></launch>')
    for name, text in (('sleeper', SLEEPER), ('status', '#!/bin/sh\necho "$@"; exit 7\n'),
                       ('killed', '#!/bin/sh\nkill -USR1 $$\n')):
        (lib / name).write_text(text)
        (lib / name).chmod(0o755)
    (lib / 'data').write_text('')
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    monkeypatch.setenv('TMPDIR', str(tmp_path))
    return package


@pytest.fixture
def ros2(capfd, monkeypatch):
    """Return what runs a command of ros2 here, and returns its status, output and errors."""
    monkeypatch.setenv('PATH', os.environ['PATH'])

    def run(*words):
        launch.logging.reset()
        monkeypatch.setattr(sys, 'argv', ['ros2', *words])
        try:
            status = main()
        except SystemExit as end:
            status = end.code
        if isinstance(status, str):  # as sys.exit() does
            status, _ = 1, sys.stderr.write(f'{status}\n')
        return (status or 0, *capfd.readouterr())

    yield run
    launch.logging.reset()


def test_pkg_verbs_find_packages_and_executables(package, ros2):
    status, out, err = ros2('pkg', 'list')
    assert status == 0 and 'pkg' in out.split() and out.split() == sorted(out.split())
    assert ros2('pkg', 'prefix', 'pkg') == (0, f'{package}\n', '')
    assert ros2('pkg', 'prefix', '--share', 'pkg')[:2] == (0, f'{package}/share/pkg\n')
    assert ros2('pkg', 'prefix', 'no-such-package') == (1, '', 'Package not found\n')
    assert ros2('pkg', 'executables', 'pkg')[:2] == (
        0, 'pkg exe\npkg killed\npkg sleeper\npkg status\n')
    assert ros2('pkg', 'executables', '--full-path', 'pkg')[1].splitlines()[0] == (
        f'{package}/lib/pkg/exe')
    assert ros2('pkg', 'executables', 'nope') == (1, '', "Package 'nope' not found\n")


def test_run_passes_arguments_and_exit_status(package, ros2):
    assert ros2('run', 'pkg', 'status', 'a', '--b') == (
        7, 'a --b\n[ros2run]: Process exited with failure 7\n', '')
    status, out, _ = ros2('run', 'pkg', 'killed')
    assert status == -signal.SIGUSR1 and out.startswith('[ros2run]: User defined signal 1')
    assert ros2('run', '--prefix', 'echo before', 'pkg', 'status', 'x')[:2] == (
        0, f'before {package}/lib/pkg/status x\n')
    assert ros2('run', 'pkg', 'data') == (1, '', 'No executable found\n')
    assert ros2('run', 'nope', 'x') == (1, '', "Package 'nope' not found\n")


def test_help_lists_the_commands(package, ros2):
    status, out, _ = ros2('--help')
    assert status == 0 and out.startswith('usage: ros2 [-h]')
    for line in ('launch', 'run', 'pkg'):
        assert f'\n  {line} ' in out
    assert 'Run a launch file' in out
    assert 'prefix ' in ros2('pkg', '-h')[1]
    assert ros2()[1] == out
    status, _, err = ros2('no-such-command')
    assert status == 2 and "invalid choice: 'no-such-command'" in err


@embedded_alone
@pytest.mark.parametrize('words', [
    ('bag', 'record', '-a'), ('topic', 'delay', '/x')])
def test_missing_command_names_ros2(words, ros2):
    status, out, err = ros2(*words)
    name = 'bag' if words[0] == 'bag' else 'topic delay'
    assert (status, out) == (1, '') and err.startswith(
        f"'ros2 {name}' is not part of the embedded default; ROS 2 Jazzy has it: https://")
    assert '\n  bag ' not in ros2('-h')[1]


def test_launch_arguments_are_shown(package, ros2):
    status, out, _ = ros2('launch', '-s', 'pkg', 'a.launch.py')
    assert status == 0
    assert out == textwrap.dedent('''\
        Arguments (pass arguments as '<name>:=<value>'):

            'word':
                what to say
                (default: 'hel' + 'lo')

            'needed':*
                no description given

        * argument(s) which are only used if specific conditions occur
        ''')
    empty = package / 'empty.launch.xml'
    empty.write_text('<launch/>')
    assert ros2('launch', '--show-args', str(empty))[1].endswith('\n\n  No arguments.\n')


@pytest.mark.parametrize(('option', 'name', 'text', 'why'), [
    ('-s', 'a.launch.xml', '<launch><nod/></launch>', 'Unrecognized entity of the type: nod'),
    ('-p', 'a.launch.py', 'def generate_launch_description():\n    pass\n',
     "generate_launch_description() of '{}' returned NoneType, no LaunchDescription")])
def test_file_that_is_no_launch_file_is_one_line(package, ros2, option, name, text, why):
    path = package / name
    path.write_text(text)
    status, out, err = ros2('launch', option, str(path))
    assert (status, out, err.count('\n')) == (1, '', 1) and why.format(path) in err


def test_launch_description_is_printed(package, ros2):
    status, out, _ = ros2('launch', '-p', 'pkg', 'a.launch.py')
    assert status == 0 and "── LogInfo('says ' + LaunchConfig('word'))" in out
    assert "ExecuteProcess(cmd=[ExecInPkg(pkg='pkg', exec='sleeper'), '--ros-args', '-r', " in out


@embedded_alone
def test_terminal_that_lacks_a_character_gets_its_number(package):
    done = subprocess.run([ROS2, 'launch', '-p', 'pkg', 'a.launch.py'], capture_output=True,
                          env={**os.environ, 'PYTHONIOENCODING': 'latin-1'}, timeout=60)
    assert (done.returncode, done.stderr) == (0, b'') and rb'\u2500\u2500 LogInfo' in done.stdout


def test_launch_file_runs_with_arguments(package, ros2):
    status, out, err = ros2('launch', 'pkg', 'say.launch.xml', 'word:=one', 'word:=two')
    assert (status, err) == (0, '') and '[INFO] [launch.user]: says two' in out.splitlines()
    path = package / 'share' / 'pkg' / 'launch' / 'say.launch.xml'
    status, out, _ = ros2('launch', str(path), 'word:=a:=b')
    assert status == 0 and '[INFO] [launch.user]: says a:=b' in out
    status, out, _ = ros2('launch', str(path))
    assert status == 1 and "missing required argument 'word'" in out


@pytest.mark.parametrize('arguments, error', [
    (['nope', 'x'], "Package 'nope' not found: "),
    (['pkg', 'x'], "file 'x' was not found in the share directory of package 'pkg' which is at "),
    (['pkg', 'twice.launch.py'], "file 'twice.launch.py' was found more than once in the share"),
    (['pkg', 'a.launch.py', 'a=b'], "malformed launch argument 'a=b', expected format "
                                    "'<name>:=<value>'"),
])
def test_launch_error_is_one_line_and_status_1(package, ros2, arguments, error):
    status, out, err = ros2('launch', *arguments)
    assert (status, len(err.splitlines())) == (1, 1) and err.startswith(error)


@embedded_alone
def test_absent_launch_file_is_one_error(ros2):
    status, out, err = ros2('launch', './nope.launch.py')
    assert (status, len(err.splitlines())) == (1, 1)
    assert err.startswith("there is no launch file './nope.launch.py' (")


def test_interrupt_ends_both_nodes_of_a_launch(package):
    process = subprocess.Popen(
        [ROS2, 'launch', 'pkg', 'a.launch.py', 'word:=false'], stdout=subprocess.PIPE, text=True,
        start_new_session=True, stdin=subprocess.DEVNULL)
    lines = []
    try:
        while sum('] ready' in line for line in lines) < 2:
            lines.append(process.stdout.readline())
            assert lines[-1], ''.join(lines)
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate(timeout=60)
    finally:
        # Its children are in its group, also when it is gone.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()
    out = ''.join(lines) + rest
    assert process.returncode == 0
    assert '[sleeper-1] ready --ros-args -r __node:=one' in out.splitlines()
    assert '[sleeper-2] ready --ros-args -r __node:=two' in out.splitlines()
    assert out.count('process has finished cleanly') == 2
    assert 'All log files can be found below' in lines[0]


def test_launch_prefix_precedes_each_executable(package):
    out = subprocess.run(
        [ROS2, 'launch', '--launch-prefix', 'echo prefixed', '-a', 'pkg', 'a.launch.py',
         'word:=0'], capture_output=True, text=True, check=True).stdout
    assert f'prefixed {package}/lib/pkg/sleeper --ros-args -r __node:=one' in out


def test_commands_come_from_entry_points(tmp_path, commands, monkeypatch):
    site = tmp_path / 'site'
    metadata = site / 'fogtest-1.0.dist-info'
    metadata.mkdir(parents=True)
    (metadata / 'METADATA').write_text('Metadata-Version: 2.1\nName: fogtest\nVersion: 1.0\n')
    (metadata / 'entry_points.txt').write_text(textwrap.dedent('''\
        [ros2cli.command]
        fogtest = fogtest:Command
        broken = fogtest_that_is_not_there:Command

        [fogtest.verb]
        say = fogtest:Say
        fail = fogtest:Fail
        '''))
    (site / 'fogtest.py').write_text(textwrap.dedent('''\
        from ros2cli.command import add_subparsers_on_demand, CommandExtension
        from ros2cli.verb import VerbExtension

        class Command(CommandExtension):
            """Test something."""

            def add_arguments(self, parser, cli_name, *, argv=None):
                self._subparser = parser
                add_subparsers_on_demand(
                    parser, cli_name, '_verb', 'fogtest.verb', required=False, argv=argv)

            def main(self, *, parser, args):
                if not hasattr(args, '_verb'):
                    self._subparser.print_help()
                    return 0
                return args._verb.main(args=args)

        class Say(VerbExtension):
            """Say something."""

            def add_arguments(self, parser, cli_name):
                parser.add_argument('word', help=cli_name)

            def main(self, *, args):
                print(args.word, self.NAME)

        class Fail(VerbExtension):
            """Fail."""

            def main(self, *, args):
                raise RuntimeError('one line')
        '''))
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(
        filter(None, [str(site), os.environ.get('PYTHONPATH')])))
    with commands() as run:
        assert run('fogtest', 'say', 'hello') == [0, 'hello say\n']
        assert run('fogtest', 'fail') == [1, 'one line']
        assert re.search('fogtest +Test something', run('-h')[1])
        assert re.search('say +Say something', run('fogtest')[1])
        assert 'usage: ros2 fogtest say [-h] word' in run('fogtest', 'say', '-h')[1]
        status, out = run('broken')
        assert status == 1 and "No module named 'fogtest_that_is_not_there'" in out


def test_incompatible_extension_point_is_refused():
    satisfies_version('0.1', '^0.1')
    satisfies_version('1.4', '^1.2')
    for version, caret_range in (('0.1', '^0.2'), ('0.2', '^0.1'), ('2.0', '^1.2')):
        with pytest.raises(PluginException):
            satisfies_version(version, caret_range)


@embedded_alone
@pytest.mark.parametrize('module', ['argparse', 'ros2cli.command'])
def test_ctrl_c_during_an_import_is_no_traceback(module):
    code = textwrap.dedent(f"""
        import builtins, os, signal
        found = builtins.__import__

        def interrupted(name, *words):
            if name == {module!r}:
                os.kill(os.getpid(), signal.SIGINT)
            return found(name, *words)

        signal.signal(signal.SIGINT, signal.default_int_handler)
        builtins.__import__ = interrupted
        from ros2cli.script import main
        """)
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (-signal.SIGINT, '')


@embedded_alone
@pytest.mark.parametrize('handler', ['default_int_handler', 'SIG_IGN'])
def test_script_gives_ctrl_c_back(handler):
    """A shell starts a program in the background with SIGINT ignored."""
    code = textwrap.dedent(f"""
        import signal
        signal.signal(signal.SIGINT, signal.{handler})
        from ros2cli import cli, script
        cli.main = lambda: signal.getsignal(signal.SIGINT)
        print(script.main() is signal.{handler})
        """)
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert done.stdout == 'True\n', done.stderr
