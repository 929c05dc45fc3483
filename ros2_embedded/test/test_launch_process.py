# SPDX-License-Identifier: Apache-2.0
"""Processes under launch, through ROS 2's public API alone."""

import os
from pathlib import Path
import re
import signal
import subprocess
import sys

import launch
from launch import LaunchContext, LaunchDescription, LaunchService
from launch.actions import (
    EmitEvent,
    ExecuteLocal,
    ExecuteProcess,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
    SetLaunchConfiguration,
    Shutdown,
)
from launch.descriptions import Executable
from launch.event_handlers import OnProcessExit, OnProcessIO, OnProcessStart
from launch.events import matches_action
from launch.events.process import (
    matches_executable,
    matches_name,
    matches_pid,
    ProcessExited,
    ProcessStarted,
    ShutdownProcess,
    SignalProcess,
)
from launch.substitutions import LaunchConfiguration
import pytest

# Says 'ready', then sleeps; what a signal does is given as arguments.
SLEEPER = '''
import signal, sys, time
for name in sys.argv[1:]:
    signal.signal(getattr(signal, name), lambda *args: print("ignored", flush=True))
print("ready", flush=True)
deadline = time.monotonic() + 300
while time.monotonic() < deadline:
    time.sleep(0.05)
'''


pytestmark = pytest.mark.usefixtures('own_log')


def python(code, *arguments, **kwargs):
    return ExecuteProcess(cmd=[sys.executable, '-u', '-c', code, *arguments], **kwargs)


def run(*entities, **kwargs):
    service = LaunchService(**{'noninteractive': True, **kwargs})
    service.include_launch_description(LaunchDescription(entities))
    return service.run()


def when_ready(action, entities):
    """Return a handler that visits entities once the process has said 'ready'."""
    return RegisterEventHandler(OnProcessIO(target_action=action, on_stdout=lambda event: (
        entities if b'ready' in event.text else None)))


def on_exit(action, notes):
    return RegisterEventHandler(OnProcessExit(
        target_action=action, on_exit=lambda event, context: notes.append(event.returncode)))


def test_process_reports_start_output_and_exit(capsys):
    notes = []
    action = python(
        'import sys; print("out"); print("err", file=sys.stderr); print("end", end=""); '
        'sys.exit(3)', output='screen', name='tester')

    def on_start(event, context):
        notes.append((type(event), event.action is action, event.pid))

    def on_end(event, context):
        notes.append((type(event), event.process_name, event.returncode, event.pid))

    assert run(
        RegisterEventHandler(OnProcessStart(target_action=action, on_start=on_start)),
        RegisterEventHandler(OnProcessExit(target_action=action, on_exit=on_end)), action) == 0
    name, pid = action.process_details['name'], action.process_details['pid']
    assert notes == [(ProcessStarted, True, pid), (ProcessExited, name, 3, pid)]
    assert name.startswith('tester-') and action.return_code == 3
    out = capsys.readouterr().out.splitlines()
    assert {f'[{name}] out', f'[{name}] err', f'[{name}] end',
            f'[INFO] [{name}]: process started with pid [{pid}]'} <= set(out)
    assert any(line.startswith(
        f"[ERROR] [{name}]: process has died [pid {pid}, exit code 3, cmd '") for line in out)


def test_output_goes_to_the_log_and_errors_to_the_screen(capsys, tmp_path):
    action = python('import sys; print("out"); print("err", file=sys.stderr)')
    assert run(action) == 0
    out = capsys.readouterr().out
    assert '] err' in out and '] out' not in out
    log = next((tmp_path / 'log').glob('*/launch.log')).read_text()
    assert '] err' in log and '] out' in log
    assert 'process has finished cleanly' in log and 'process has finished cleanly' in out


def test_output_goes_where_it_is_configured(capsys, tmp_path):
    assert run(
        python('print("full")', output='full', name='a'),
        python('print("dict")', output={'stdout': 'own_log', 'stderr': {'screen'}}, name='b'),
        python('print("formatted")', output='screen', output_format='<{line}>')) == 0
    out = capsys.readouterr().out
    assert '] full' in out and '] dict' not in out and '<formatted>' in out.splitlines()
    directory = next((tmp_path / 'log').glob('*/launch.log')).parent
    # the number that launch gave the process has as many digits as there were processes before
    texts = {re.sub(r'-\d+', '', path.name, count=1): path.read_text()
             for path in directory.glob('[ab]-*.log')}
    assert all('full' in texts[name] for name in ('a.log', 'a-stdout.log'))
    assert 'dict' in texts['b-stdout.log']
    with pytest.raises(ValueError, match='never is not a valid standard output config'):
        launch.logging.get_output_loggers('x', 'never')


def test_process_has_its_directory_environment_and_shell(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv('FOG_OUTER', 'outer')
    show = ('import os; print(os.environ.get("FOG_OUTER"), os.environ.get("FOG_SET"), '
            'os.environ.get("FOG_MORE"), os.getcwd())')
    path = os.environ['PATH']
    additional = {'FOG_MORE': LaunchConfiguration('more')}
    assert run(
        SetLaunchConfiguration('more', 'm'), SetEnvironmentVariable('FOG_SET', 's'),
        python(show, output='screen', cwd=str(tmp_path), additional_env=additional),
        python(show, output='screen', cwd='/', env={'PATH': path}, additional_env=additional),
        ExecuteProcess(  # noqa: S604
            cmd=['echo', ['sh', 'ell'], '$FOG_SET', '&&', 'true'], shell=True,
            output='screen'),
        ExecuteLocal(process_description=Executable(
            cmd=['echo'], arguments=['local', 'hero']), output='screen')) == 0
    lines = [line.partition('] ')[2] for line in capsys.readouterr().out.splitlines()]
    assert f'outer s m {tmp_path}' in lines and 'None None m /' in lines
    assert 'shell s' in lines and 'local hero' in lines


def test_launch_prefix_has_a_filter():
    context = LaunchContext()

    def command(*cmd, **kwargs):
        executable = Executable(cmd=cmd, **kwargs)
        executable.prepare(context, None)
        return executable.final_cmd, executable.final_name.rpartition('-')[0]

    assert command('/bin/ls', '-l') == (['/bin/ls', '-l'], 'ls')
    assert command('ls', prefix='nice -n 5') == (['nice', '-n', '5', 'ls'], 'nice')
    context.launch_configurations.update({
        'launch-prefix': "xterm -e 'a b'", 'launch-prefix-filter': 'l.$'})
    assert command('/bin/ls') == (['xterm', '-e', 'a b', '/bin/ls'], 'xterm')
    assert command('/bin/cat', name='dog') == (['/bin/cat'], 'dog')


def test_process_has_substitutions_until_it_runs():
    action = ExecuteProcess(
        cmd=['ls', LaunchConfiguration('a')], name='n', respawn=LaunchConfiguration('r'))
    assert [[sub.describe() for sub in word] for word in action.cmd] == [
        ["'ls'"], ["LaunchConfig('a')"]]
    assert action.name[0].text == 'n' and action.cwd is None and action.env is None
    assert action.process_details is None and action.return_code is None
    context = LaunchContext()
    context.launch_configurations.update(a='/', r='true')
    action.prepare(context)
    assert action.cmd == ['ls', '/'] and action.name.startswith('n-')
    assert action.env == dict(os.environ)
    with pytest.raises(RuntimeError, match='cached output must be true'):
        action.get_stdout()


def test_output_is_kept_on_request():
    action = python('import sys; print("a\\nb", end=""); print("c", file=sys.stderr)',
                    cached_output=True)
    assert run(action) == 0
    assert (action.get_stdout(), action.get_stderr()) == ('a\nb', 'c\n')


def test_terminal_is_emulated_on_request(capsys):
    show = 'import sys; print(sys.stdout.isatty(), sys.stderr.isatty())'
    assert run(python(show, output='screen'),
               python(show, output='screen', emulate_tty=True)) == 0
    lines = [line.partition('] ')[2].strip() for line in capsys.readouterr().out.splitlines()]
    assert 'False False' in lines and 'True True' in lines
    assert run(SetLaunchConfiguration('emulate_tty', 'true'), python(show, output='screen')) == 0
    assert '] True True' in capsys.readouterr().out


def test_launch_goes_on_after_a_failed_start(capsys):
    notes = []
    action, other = ExecuteProcess(cmd=['/no/such/executable']), python('pass', output='screen')
    assert run(on_exit(action, notes), action, other) == 0
    out = capsys.readouterr().out
    assert 'exception occurred while executing process:' in out
    assert "FileNotFoundError: [Errno 2] No such file or directory: '/no/such/executable'" in out
    assert 'process has finished cleanly' in out and notes == []
    assert run(other) == 1
    assert 'executed more than once' in capsys.readouterr().out


def test_end_of_a_required_process_ends_the_launch(capsys):
    other = python(SLEEPER)
    action = python('pass', on_exit=[LogInfo(msg='exited'), Shutdown()])
    assert run(other, when_ready(other, [action])) == 0
    out = capsys.readouterr().out
    assert '[INFO] [launch.user]: exited' in out
    assert f'process[{action.name}] was required: shutting down launched system' in out
    assert other.return_code == -signal.SIGINT


def test_process_respawns_as_often_as_allowed():
    notes = []
    often = python('print("x", flush=True)', respawn=True, respawn_delay=0.01,
                   respawn_max_retries=2)
    assert run(on_exit(often, notes), often) == 0
    assert notes == [0, 0, 0]
    notes = []
    forever = python('print("ready", flush=True)', respawn=LaunchConfiguration('r'))

    def enough(event, context):
        notes.append(event.returncode)
        return [Shutdown()] if len(notes) == 4 else None

    assert run(SetLaunchConfiguration('r', 'true'), forever, RegisterEventHandler(OnProcessExit(
        target_action=forever, on_exit=enough))) == 0
    assert len(notes) in (4, 5)  # The fifth may have been under way.


def test_shutdown_during_the_delay_ends_respawning():
    notes = []
    action = python('pass', respawn=True, respawn_delay=60.0, on_exit=[Shutdown()])
    assert run(on_exit(action, notes), action) == 0
    assert notes == [0]


def test_signals_escalate_to_sigkill(capsys):
    action = python(SLEEPER, 'SIGINT', 'SIGTERM', sigterm_timeout='0.2', sigkill_timeout='0.3')
    assert run(action, when_ready(action, [Shutdown()])) == 0
    assert action.return_code == -signal.SIGKILL
    out = capsys.readouterr().out
    name = action.name
    order = [out.index(text) for text in (
        f"sending signal 'SIGINT' to process[{name}]",
        f"process[{name}] failed to terminate '0.2' seconds after receiving 'SIGINT', "
        "escalating to 'SIGTERM'",
        f"sending signal 'SIGTERM' to process[{name}]",
        f"process[{name}] failed to terminate '0.5' seconds after receiving 'SIGTERM', "
        "escalating to 'SIGKILL'",
        f"sending signal 'SIGKILL' to process[{name}]",
        f'process has died [pid {action.process_details["pid"]}, exit code -9')]
    assert order == sorted(order)


def test_one_process_is_shut_down():
    action = python(SLEEPER, respawn=True)

    def matched(other):
        return all(matcher(other) for matcher in (
            matches_action(action), matches_name(action.name),
            matches_pid(action.process_details['pid']),
            matches_executable(os.path.basename(sys.executable))))

    assert run(action, when_ready(action, [
        EmitEvent(event=ShutdownProcess(process_matcher=matched))])) == 0
    assert action.return_code == -signal.SIGINT
    assert not matches_name('other')(action) and not matches_pid(1)(action)


def test_one_process_gets_a_signal(capsys):
    action = python(SLEEPER)
    event = SignalProcess(signal_number=signal.SIGUSR1, process_matcher=matches_action(action))
    assert event.signal_name == 'SIGUSR1' and event.signal == signal.SIGUSR1
    assert run(action, when_ready(action, [EmitEvent(event=event)])) == 0
    assert action.return_code == -signal.SIGUSR1
    assert f"sending signal 'SIGUSR1' to process[{action.name}]" in capsys.readouterr().out
    with pytest.raises(TypeError, match="'SignalProcess' expected 'signal_number'"):
        SignalProcess(signal_number=2, process_matcher=matches_action(action))


def test_shutdown_reaches_a_starting_process():
    # no Python: one that is interrupted before it is up exits with 1
    action = ExecuteProcess(cmd=['sleep', '30'])
    assert run(action, Shutdown()) == 0
    assert action.return_code in (None, -signal.SIGINT)


def test_no_process_starts_after_a_shutdown():
    action = python('pass')
    assert run(Shutdown(), OpaqueFunction(function=lambda context: context._set_is_shutdown(
        True)), action) == 0
    assert action.return_code is None


def test_handler_refuses_an_action_without_a_process():
    with pytest.raises(TypeError, match="action_matcher must be an 'ExecuteLocal' instance"):
        OnProcessExit(target_action=LogInfo(msg=''), on_exit=[])
    with pytest.raises(TypeError, match="expected all items in 'on_exit'|'on_event'"):
        OnProcessExit(on_exit=['text'])


SCRIPT = '''
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import ExecuteProcess
service = LaunchService(noninteractive={noninteractive})
service.include_launch_description(LaunchDescription([
    ExecuteProcess(cmd=[sys.executable, '-u', '-c', {sleeper!r}, *{ignored!r}], output='screen',
                   sigterm_timeout='600')]))
sys.exit(service.run())
'''


class Script:
    """A script that launches the sleeper, in a session of its own as a terminal's is."""

    def __init__(self, tmp_path, ignored=(), noninteractive=True):
        path = Path(tmp_path, 'script.py')
        path.write_text(SCRIPT.format(
            noninteractive=noninteractive, sleeper=SLEEPER, ignored=list(ignored)))
        self.process = subprocess.Popen(
            [sys.executable, '-u', str(path)], stdout=subprocess.PIPE, text=True,
            start_new_session=True)
        self.lines = []
        while '] ready' not in (line := self.process.stdout.readline()):
            assert line, ''.join(self.lines)
            self.lines.append(line)

    def __enter__(self):
        return self

    def finish(self):
        rest, _ = self.process.communicate(timeout=60)
        return self.process.returncode, ''.join(self.lines) + rest

    def __exit__(self, *args):
        # The child is in its group, also when the launch is gone.
        try:
            os.killpg(self.process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
        self.process.wait()
        self.process.stdout.close()


def test_launch_sends_no_second_sigint_in_a_terminal(tmp_path):
    with Script(tmp_path, noninteractive=False) as script:
        os.killpg(script.process.pid, signal.SIGINT)
        status, out = script.finish()
    assert status == 0 and 'exit code -2' in out
    assert "sending signal 'SIGINT'" not in out


def test_second_sigint_is_ignored(tmp_path):
    with Script(tmp_path, ignored=['SIGINT']) as script:
        for said in ('] ignored', 'user interrupted with ctrl-c (SIGINT) again, ignoring...'):
            script.process.send_signal(signal.SIGINT)
            while said not in (line := script.process.stdout.readline()):
                script.lines.append(line)
                assert line, ''.join(script.lines)
        (sleeper,) = re.findall(r'process started with pid \[(\d+)', ''.join(script.lines))
        os.kill(int(sleeper), signal.SIGTERM)
        status, out = script.finish()
    assert status == 0 and "sending signal 'SIGINT'" in out
    assert f'exit code -{int(signal.SIGTERM)}' in out


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGQUIT])
def test_sigterm_and_sigquit_end_the_launch_at_once(tmp_path, number):
    with Script(tmp_path) as script:
        script.process.send_signal(number)
        assert script.process.wait(timeout=60) == -number
