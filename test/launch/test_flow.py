# SPDX-License-Identifier: Apache-2.0
"""The order of things: up, events while it runs, failure, shutdown."""

from __future__ import annotations

from importlib.util import find_spec
import os
import threading

from launch import LaunchContext, LaunchDescription
from launch.actions import (
    AppendEnvironmentVariable,
    EmitEvent,
    ExecuteProcess,
    GroupAction,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
    ResetEnvironment,
    SetEnvironmentVariable,
    SetLaunchConfiguration,
    Shutdown,
    TimerAction,
    UnsetEnvironmentVariable,
)
from launch.event_handlers import OnProcessExit, OnProcessIO, OnProcessStart
from launch.events import matches_action
from launch.events.process import ShutdownProcess, SignalProcess
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import (
    Node,
    PushROSNamespace,
    SetParameter,
    SetRemap,
    SetROSLogDir,
)
import pytest

from fogros2 import CloudGroup, CloudNode, ContainerInstance, FogROSLaunchDescription
from fogros2.errors import (
    AgentError,
    ConfigurationError,
    ConnectError,
    DeadlineExceeded,
    PrerequisiteError,
    ProviderError,
    VpnError,
)
from fogros2.launch_internals import private
from fogros2.model import NodeSpec
from fogros2.runtime import remote_run, session
from fogros2.runtime.coordinator import Coordinator
from fogros2.waiting import wait_until
from rigs.launching import ends
from ros2fog_cli.api.preview import Preview


def talker(machine, **kwargs):
    return CloudNode(machine=machine, package='demo', executable='talker', **kwargs)


def robot(fake, *cmd, **kwargs):
    """Return a process of the robot's, and what notes its start and end."""
    process = ExecuteProcess(cmd=cmd or ['true'], **kwargs)
    return [
        RegisterEventHandler(OnProcessStart(
            target_action=process, on_start=lambda event, context: fake.note('robot starts'))),
        RegisterEventHandler(OnProcessExit(
            target_action=process, on_exit=lambda event, context: fake.note('robot ends'))),
        process,
    ]


def order(fake, *whats):
    return [note[0] for note in fake.notes if note[0] in whats]


def test_launch_leaves_the_environment_unchanged(run, fake, planner, monkeypatch):
    """Another launch of the same process would take leftovers for the user's own settings."""
    monkeypatch.setenv('RMW_IMPLEMENTATION', 'rmw_cyclonedds_cpp')
    monkeypatch.delenv('CYCLONEDDS_URI', raising=False)
    fake.on_start = ends
    before, during = dict(os.environ), []
    assert run(LaunchDescription([
        talker(planner), OpaqueFunction(function=lambda context: during.append(
            context.environment['CYCLONEDDS_URI']))])) == 0
    assert during == ['<CycloneDDS/>'] and dict(os.environ) == before


def test_second_launch_in_a_process_that_has_one_is_refused(run, fake, planner):
    fake.on_start = ends
    errors = []

    def second(context):
        try:
            Coordinator(LaunchContext(), make_launch=fake).engage()
        except ConfigurationError as error:
            errors.append(str(error.args[0]))

    for number in (1, 2):
        assert run(LaunchDescription([talker(planner), OpaqueFunction(function=second)])) == 0
        assert errors == number * ['another launch of this process has machines already']


# -- up ------------------------------------------------------------------------------------------


def test_robot_nodes_wait_for_the_cloud(run, fake, planner):
    fake.on_start = ends
    fake.waits['planner'] = go = threading.Event()
    description = FogROSLaunchDescription([
        *robot(fake), talker(planner),
        # timers of the robot count from when the cloud is up; this runs at once
        OpaqueFunction(function=lambda context: context.asyncio_loop.call_later(0.2, go.set)
                       and None),
    ])
    assert run(description) == 0
    assert order(fake, 'up', 'start', 'robot starts', 'down') == [
        'up', 'start', 'robot starts', 'down']


def test_robot_nodes_start_immediately_if_so_wanted(run, fake, planner):
    fake.on_start = ends
    # the machine comes up only when the robot's process has started
    fake.waits['planner'] = go = threading.Event()
    process = ExecuteProcess(cmd=['true'])
    assert run(FogROSLaunchDescription([
        RegisterEventHandler(OnProcessStart(
            target_action=process, on_start=lambda event, context: go.set())),
        process, talker(planner),
    ], robot_nodes='immediately')) == 0
    assert fake.noted('is up')


def test_robot_nodes_alone_do_not_wait(run, fake):
    assert run(FogROSLaunchDescription(robot(fake))) == 0
    assert [note[0] for note in fake.notes] == ['robot starts', 'robot ends']


@pytest.mark.parametrize('kind', [LaunchDescription, FogROSLaunchDescription])
@pytest.mark.parametrize('within', [
    lambda machine: machine, lambda machine: GroupAction([machine]),
    lambda machine: TimerAction(period=0.0, actions=[machine]),
    lambda machine: OpaqueFunction(function=lambda context: [machine])])
def test_machine_without_a_node_is_an_error(run, planner, caplog, kind, within):
    assert run(kind([within(planner)])) == 1
    assert 'a machine alone does nothing in a launch description' in caplog.text


def test_machine_without_a_node_is_an_error_of_a_preview(planner):
    description = LaunchDescription([planner])
    for look in (description.get_launch_arguments, lambda: Preview(description, {})):
        with pytest.raises(ConfigurationError, match='a machine alone does nothing'):
            look()


def test_waiting_process_keeps_its_configuration(run, fake, planner, capfd):
    """A held process has the configuration of its place, not of the moment it starts."""
    fake.on_start = ends
    entities = []
    for value in ('one', 'two'):
        entities += [
            SetLaunchConfiguration('x', value),
            ExecuteProcess(cmd=['echo', 'x is', LaunchConfiguration('x')], output='screen')]
    assert run(FogROSLaunchDescription([*entities, talker(planner)])) == 0
    output = capfd.readouterr().out
    assert 'x is one' in output and 'x is two' in output


def test_machines_come_up_in_parallel_and_once(run, fake, planner):
    fake.on_start = ends
    other = ContainerInstance(name='other', ros_workspace='')

    class Both:
        def wait(self, timeout):
            return len(fake.noted('up')) == 2

    fake.waits = {'planner': Both(), 'other': Both()}
    assert run(LaunchDescription([talker(planner), talker(other), talker(planner)])) == 0
    assert fake.noted('prepare') == [(
        ['planner', 'other'],
        {'planner': [('demo', 'talker')], 'other': [('demo', 'talker')]})]
    assert sorted(machine for machine, _ in fake.noted('start')) == ['other', 'planner', 'planner']


def test_a_later_node_joins_a_running_machine(run, fake, planner):
    fake.on_start = ends
    first, second = talker(planner), talker(planner)
    assert run(LaunchDescription([
        first,
        RegisterEventHandler(OnProcessExit(target_action=first, on_exit=[second])),
    ])) == 0
    assert len(fake.noted('up')) == 1 and len(fake.noted('start')) == 2


@pytest.mark.parametrize(('second', 'reason'), [
    (lambda: talker('planer'), "no machine named 'planer' (did you mean 'planner'?)"),
    (lambda: talker(ContainerInstance(name='planner', ros_workspace='', memory='1g')),
     "two machines of this launch have the name 'planner'"),
    (lambda: CloudNode(machine=ContainerInstance(name='other', ros_workspace=''), package='dmo',
                       executable='talker'), "there is no package 'dmo' (did you mean 'demo'?)")])
def test_wrong_second_node_is_refused_before_any_machine(
        run, fake, planner, capfd, second, reason):
    assert run(LaunchDescription([talker(planner), second()])) == 1
    assert reason in capfd.readouterr().out and not fake.noted('up')


def test_description_shows_that_its_machine_exists(run, fake, planner):
    told = []

    def look(machine, node):
        told.append(planner.is_created)
        ends(machine, node)

    fake.on_start = look
    assert (planner.is_created, planner.ip, planner.vpn_ip) == (False, None, None)
    assert run(LaunchDescription([talker(planner)])) == 0
    assert told == [True]
    assert (planner.ip, planner.vpn_ip) == ('192.0.2.7', '10.99.0.2')
    assert planner.info()['public_ip'] == '192.0.2.7'


def test_equal_machines_are_created_once(run, fake, planner):
    """A launch file included twice makes its machine twice."""
    fake.on_start = ends
    twin = ContainerInstance(name='planner', ros_workspace='')
    first = talker(planner)
    assert run(LaunchDescription([
        first, RegisterEventHandler(OnProcessExit(target_action=first, on_exit=[talker(twin)])),
    ])) == 0
    assert len(fake.noted('up')) == 1 and planner.is_created and twin.is_created


def test_steps_are_shown_once(run, fake, planner, capfd):
    fake.on_start = ends
    assert run(LaunchDescription([talker(planner)])) == 0
    output = capfd.readouterr().out
    assert '[INFO] [fogros2]: planner: machine 0.' in output and '(made of air)' in output
    assert output.count('planner: machine ...') == 1 and output.count('planner: machine') == 2
    assert '\r' not in output and '\x1b' not in output


# -- the environment -----------------------------------------------------------------------------


@pytest.mark.parametrize('description', [LaunchDescription, FogROSLaunchDescription])
@pytest.mark.parametrize('place', ['before', 'after'])
def test_robot_nodes_have_the_dds_environment(run, fake, planner, capfd, description, place):
    """And the deployment has that of the launch file."""
    fake.on_start = ends
    process = ExecuteProcess(cmd=['sh', '-c', 'echo dds is $CYCLONEDDS_URI'], output='screen')
    entities = [process, talker(planner)]
    assert run(description([SetEnvironmentVariable('ROS_DOMAIN_ID', '7'), *(
        entities if place == 'before' else entities[::-1])])) == 0
    assert 'dds is <CycloneDDS/>' in capfd.readouterr().out
    assert fake.environment['ROS_DOMAIN_ID'] == '7'


@pytest.mark.parametrize('first', [
    SetParameter('use_sim_time', True), SetRemap('a', 'b'), PushROSNamespace('robot'),
    SetROSLogDir('/dev/null'),
    RegisterEventHandler(OnProcessExit(on_exit=[SetLaunchConfiguration('x', 'y')])),
])
def test_launch_has_the_domain_set_after_other_settings(run, fake, planner, first):
    fake.on_start = ends
    assert run(FogROSLaunchDescription([
        first, SetEnvironmentVariable('ROS_DOMAIN_ID', '7'), talker(planner)])) == 0
    assert fake.environment['ROS_DOMAIN_ID'] == '7'
    # an action of an event may change a machine's values
    assert (fake.noted('check here')[0] == ([], {})) == isinstance(first, RegisterEventHandler)


def test_dds_environment_outlives_its_group(run, fake, planner, capfd):
    fake.on_start = ends
    process = ExecuteProcess(cmd=['sh', '-c', 'echo dds is $CYCLONEDDS_URI'], output='screen')
    assert run(LaunchDescription([
        GroupAction([talker(planner)]), GroupAction([process], forwarding=False)])) == 0
    assert 'dds is <CycloneDDS/>' in capfd.readouterr().out


def test_a_cloud_node_of_a_timer_prepares_the_robot_nodes(run, fake, planner, capfd):
    fake.on_start = ends
    process = ExecuteProcess(cmd=['sh', '-c', 'echo dds is $CYCLONEDDS_URI'], output='screen')
    assert run(FogROSLaunchDescription([
        RegisterEventHandler(OnProcessExit(target_action=process, on_exit=[
            TimerAction(period=0.01, actions=[talker(planner)])])),
        process,
    ])) == 0
    assert 'dds is <CycloneDDS/>' in capfd.readouterr().out
    assert order(fake, 'start', 'down') == ['start', 'down']


def test_robot_node_started_before_the_dds_is_warned_about(run, fake, planner, capfd):
    fake.on_start = ends
    process = ExecuteProcess(cmd=['sleep', '60'], name='early')
    cloud = talker(planner, on_exit=[Shutdown()])
    assert run(LaunchDescription([
        RegisterEventHandler(OnProcessStart(target_action=process, on_start=[cloud])), process,
    ])) == 0
    assert f'{process.name} runs already' in capfd.readouterr().out


def test_processes_of_the_robot_use_the_ros2_of_the_launch(run, fake, planner, tmp_path, capfd):
    fake.on_start = ends
    fake.ros2 = tmp_path / 'bin'
    before = os.environ['PATH']
    process = ExecuteProcess(cmd=['sh', '-c', 'echo path is $PATH'], output='screen')
    assert run(LaunchDescription([process, talker(planner)])) == 0
    assert not fake.machines['planner'].nodes['talker'].folders
    assert f'path is {fake.ros2}:{before}' in capfd.readouterr().out
    assert os.environ['PATH'] == before


@pytest.mark.parametrize('first', [True, False])
def test_dds_settings_of_a_part_of_the_launch_are_warned_about(run, fake, planner, capfd, first):
    fake.on_start = ends
    process = ExecuteProcess(cmd=['sh', '-c', 'echo dds is $CYCLONEDDS_URI'], output='screen')
    group = GroupAction([SetEnvironmentVariable('CYCLONEDDS_URI', '<mine/>'), process])
    cloud = talker(planner)
    assert run(FogROSLaunchDescription([cloud, group] if first else [
        TimerAction(period=0.0, actions=[]), group, cloud])) == 0
    out = capfd.readouterr().out
    assert out.count(f'{process.name} has another CYCLONEDDS_URI' if first
                     else f'replace CYCLONEDDS_URI of {process.name}') == 1
    assert f"dds is {'<mine/>' if first else '<CycloneDDS/>'}" in out


def test_ros_node_of_launch_before_the_dds_is_warned_about(run, fake, planner, capfd):
    fake.on_start = ends
    made = OpaqueFunction(function=lambda context: context.extend_globals({'ros_adapter': None}))
    other = ContainerInstance(name='other', ros_workspace='')
    assert run(LaunchDescription([made, talker(planner), talker(other)])) == 0
    assert capfd.readouterr().out.count("launch's own ROS node runs already") == 1
    assert run(LaunchDescription([talker(planner), made, talker(other)])) == 0
    assert 'runs already' not in capfd.readouterr().out


@pytest.mark.parametrize('within', [
    lambda *actions: actions, lambda *actions: [GroupAction(actions, scoped=False)]])
def test_variables_that_are_set_as_they_are_here_are_sent(
    run, fake, planner, monkeypatch, within,
):
    monkeypatch.setenv('TOKEN', 'secret')
    monkeypatch.setenv('FOLDERS', '/b')
    monkeypatch.setenv('ROS_HOME', '/robot')
    fake.on_start = ends
    assert run(LaunchDescription([*within(
        SetEnvironmentVariable('TOKEN', EnvironmentVariable('TOKEN')),
        SetEnvironmentVariable('ROS_HOME', EnvironmentVariable('ROS_HOME')),
        UnsetEnvironmentVariable('FOLDERS'), AppendEnvironmentVariable('FOLDERS', '/b')),
        talker(planner)])) == 0
    assert fake.machines['planner'].nodes['talker'].environment == {
        'TOKEN': 'secret', 'FOLDERS': '/b'}


@pytest.mark.parametrize('before', [
    lambda setting: GroupAction([setting]),
    lambda setting: GroupAction([setting], forwarding=False),
    lambda setting: GroupAction([SetEnvironmentVariable('TOKEN', ''), ResetEnvironment()],
                                scoped=False),
])
def test_variables_of_another_scope_are_not_sent(run, fake, planner, monkeypatch, before):
    monkeypatch.setenv('TOKEN', 'secret')
    fake.on_start = ends
    assert run(LaunchDescription([
        before(SetEnvironmentVariable('TOKEN', EnvironmentVariable('TOKEN'))),
        talker(planner)])) == 0
    assert fake.machines['planner'].nodes['talker'].environment == {}


def test_environment_of_the_launch_file_is_sent(run, fake, planner, monkeypatch):
    fake.on_start = ends
    monkeypatch.setenv('FROM_THE_SHELL', 'stays')
    monkeypatch.setenv('SAME', 'as here')
    assert run(LaunchDescription([
        SetEnvironmentVariable('SET', 'by the launch file'),
        SetEnvironmentVariable('PATH', '/robot/bin:/usr/bin:/bin'),
        talker(planner, additional_env={'MORE': '1', 'SAME': 'as here'}),
    ])) == 0
    assert fake.machines['planner'].nodes['talker'].environment == {
        'SET': 'by the launch file', 'MORE': '1', 'SAME': 'as here'}
    assert fake.machines['planner'].nodes['talker'].folders == {'PATH': '/robot/bin'}


# -- while it runs -------------------------------------------------------------------------------


def test_output_is_prefixed_by_machine_and_process(run, fake, planner, capfd):
    def speaks(machine, node):
        machine.say('output', node, stream='stdout', text='half a ')
        machine.say('output', node, stream='stdout', text='line\nand another\n')
        machine.say('output', node, stream='stderr', text='trouble\n')
        ends(machine, node)

    fake.on_start = speaks
    texts = []
    node = talker(planner, output='screen', exec_name='speaker', cached_output=True)
    quiet = talker(planner, output='log', exec_name='quiet')
    assert run(LaunchDescription([
        RegisterEventHandler(OnProcessIO(
            target_action=node, on_stderr=lambda event: texts.append(event.text))),
        node, quiet,
    ])) == 0
    lines = capfd.readouterr().out.splitlines()
    name = node.name
    for text in ('half a line', 'and another', 'trouble'):
        assert f'[planner.{name}] {text}' in lines
    assert texts == [b'trouble\n'] and 'half a line' in node.get_stdout()
    assert [line for line in lines if line.startswith(f'[planner.{quiet.name}] ')] == [
        f'[planner.{quiet.name}] trouble']


def test_node_that_opens_a_window_gets_one_hint(run, fake, planner, capfd):
    def fails(machine, node):
        for text in ('qt.qpa.xcb: could not connect to display\n',
                     '(view): Gtk-WARNING: cannot open display: \n'):
            machine.say('output', node, stream='stderr', text=text)
        machine.say('exited', node, returncode=-6, respawns=False)

    fake.on_start = fails
    assert run(LaunchDescription([talker(planner)])) == 0
    said = capfd.readouterr()
    assert (said.out + said.err).count('a machine has no screen: run the node on the robot') == 1


def test_remote_exit_status_is_reported(run, fake, planner, capfd):
    """A node that dies is reported; the launch's own status is as with local nodes."""
    fake.on_start = lambda machine, node: machine.say(
        'exited', node, returncode=3, respawns=False)
    node = talker(planner, on_exit=[Shutdown()])
    assert run(LaunchDescription([*robot(fake, 'sleep', '60'), node])) == 0
    assert order(fake, 'robot ends', 'down') == ['robot ends', 'down'] and node.return_code == 3
    assert "process has died [pid 4001, exit code 3, cmd '/there/program']" in (
        capfd.readouterr().out)


def test_machine_respawns_and_the_launch_sees_it(run, fake, planner):
    starts, exits = [], []

    def dies(machine, node):
        assert node.respawn and node.respawn_delay == 0.5 and node.respawn_max_retries == 2
        machine.say('exited', node, returncode=1, respawns=True)
        machine.say('started', node, pid=4990, cmd=['/there/program'])

    def started(event, context):
        starts.append(event.pid)
        if event.pid == 4990:
            assert node.return_code is None
            machine = fake.machines['planner']
            machine.say('exited', *machine.all, returncode=0, respawns=False)

    fake.on_start = dies
    node = talker(planner, respawn=True, respawn_delay=0.5, respawn_max_retries=2)
    assert run(LaunchDescription([
        RegisterEventHandler(OnProcessStart(
            target_action=node, on_start=started)),
        RegisterEventHandler(OnProcessExit(
            target_action=node,
            on_exit=lambda event, context: exits.append(event.returncode))),
        node,
    ])) == 0
    assert starts == [4001, 4990] and exits == [1, 0]


def test_signals_reach_the_node(run, fake, planner, capfd):
    node = talker(planner)
    early = EmitEvent(event=SignalProcess(
        signal_number='SIGUSR1', process_matcher=matches_action(node)))
    assert run(LaunchDescription([
        node, early,
        RegisterEventHandler(OnProcessStart(target_action=node, on_start=[
            EmitEvent(event=SignalProcess(
                signal_number='SIGUSR2', process_matcher=matches_action(node))),
            TimerAction(period=0.5, actions=[Shutdown()])])),
    ])) == 0
    machine = fake.machines['planner']
    assert machine.signals == [(machine.nodes['talker'].id, 'SIGUSR2')]
    assert "'SIGUSR1' not sent: the process hasn't started yet" in capfd.readouterr().out


def test_shutdown_process_ends_one_node(run, fake, planner):
    first, second = talker(planner, exec_name='first'), talker(planner, exec_name='second')
    fake.on_start = lambda machine, node: 'second' in node.name and ends(machine, node)
    assert run(LaunchDescription([
        first, second,
        RegisterEventHandler(OnProcessExit(target_action=second, on_exit=[EmitEvent(
            event=ShutdownProcess(process_matcher=matches_action(first)))])),
    ])) == 0
    (_, name), = fake.noted('stop')
    assert 'first' in name and first.return_code == -2


@pytest.mark.parametrize('reported', [False, True])
def test_nodes_respawn_after_the_death_of_their_agent(
    run, fake, planner, monkeypatch, reported,
):
    monkeypatch.setattr(session, '_RESPAWN_DELAY', 0.01)
    lives = []

    def lives_twice(machine, node):
        lives.append(node)
        if len(lives) > 2:
            ends(machine, node)
            return
        if reported:
            machine.say('exited', node, returncode=-2, respawns=True)
        machine.say('restarted')

    fake.on_start = lives_twice
    node = talker(planner, respawn=True, respawn_max_retries=5)
    seen = []
    assert run(LaunchDescription([
        node,
        *(RegisterEventHandler(handler(**{'target_action': node, name: [
            OpaqueFunction(function=lambda context, name=name: seen.append(name))]}))
          for handler, name in ((OnProcessStart, 'on_start'), (OnProcessExit, 'on_exit')))])) == 0
    assert seen == ['on_start', 'on_exit'] * 3
    kinds = [kind for kind, *_ in fake.notes if kind in ('start', 'restore')]
    assert kinds == ['start', 'restore'] * 2 + ['start']
    assert len({life.id for life in lives}) == 3
    assert [life.respawn_max_retries for life in lives] == [5, 4, 3]


@pytest.mark.parametrize(('error', 'status'), [
    (AgentError('no', 'never'), 0), (ConnectError('it is lost'), 0),
    (DeadlineExceeded("the agent didn't answer 'start'"), 0),
    # the user has to add it: no machine says this
    (PrerequisiteError('the machine lacks numpy', 'pip=[...]'), 1)])
def test_agent_that_starts_no_node_ends_no_launch(run, fake, planner, capfd, error, status):
    """It may be hijacked."""
    fake.start_error = error
    assert run(LaunchDescription([talker(planner)])) == status
    assert (f"process can't be started: {error}" in capfd.readouterr().out) == (not status)


@pytest.fixture()
def until_noted(fake, tmp_path, monkeypatch):
    """Return a function that makes a process of the robot's, which ends at a note."""
    def process(word):
        def note(*words):
            before(*words)
            if words[0] == word:
                noted.touch()

        before, noted = fake.note, tmp_path / word
        monkeypatch.setattr(fake, 'note', note)
        return ExecuteProcess(cmd=[
            'sh', '-c', f'until [ -e {noted} ]; do sleep 0.05; done'], on_exit=Shutdown())
    return process


@pytest.mark.parametrize('restored', [True, False])
def test_launch_makes_up_for_lost_events(run, fake, planner, capfd, restored, until_noted):
    def status(node, state, **changes):
        return {'id': node.id, 'name': node.name, 'state': state, 'pid': None,
                'returncode': None, 'restarts': 0, **changes}

    def flood(machine, node):
        """Lose the end of the first node, and the start of the second."""
        if node is sent[-1]:
            machine.statuses = [
                status(sent[0], 'exited', returncode=7), status(sent[1], 'running', pid=4711),
                status(sent[2], 'refused', error='no room'), status(node, 'exited', id='unknown')]
            machine.say('gap', count=3)

    sent: list[NodeSpec] = []
    fake.on_request = sent.extend
    fake.silent = {1, 2}
    fake.on_start = flood
    fake.restore_error = None if restored else AgentError('gone')
    ended, started = [], []
    first, late, refused = (talker(planner, exec_name=f'n{number}') for number in range(3))

    def on_start(event, context):
        started.append(event.pid)
        machine = fake.machines['planner']
        # what the agent has said of it before comes late
        machine.say('started', sent[1], pid=4711, cmd=['/there/program'])
        machine.say('exited', sent[1], returncode=0, respawns=False)

    run(LaunchDescription([
        first, late, refused,
        RegisterEventHandler(OnProcessExit(
            target_action=first, on_exit=lambda event, context: ended.append(event.returncode))),
        RegisterEventHandler(OnProcessStart(target_action=late, on_start=on_start)),
        *([] if restored else [until_noted('restore')])]))
    output = capfd.readouterr().out
    assert 'planner: 3 events of its agent, such as output, were lost' in output
    if restored:
        assert (ended, started) == ([7], [4711]) and 'no room' in output
    else:
        assert 'planner: lost events are not made up for: gone' in output


def test_lost_restart_of_the_agent_is_made_up_for(run, fake, planner, monkeypatch):
    def lose(machine, node):
        if len(machine.all) == 1:
            machine.say('gap', count=1)  # its status has no nodes
        else:
            ends(machine, node)

    monkeypatch.setattr(session, '_RESPAWN_DELAY', 0.01)
    fake.on_start = lose
    assert run(LaunchDescription([talker(planner, respawn=True)])) == 0
    assert len(fake.noted('start')) == 2


def test_node_that_starts_after_its_refusal_is_stopped(run, fake, planner, capfd, until_noted):
    def start(nodes):
        wait_until(lambda: private.completed(node).done(), timeout=60.0, what='the refusal')
        for _ in range(2):
            fake.machines['planner'].say('started', nodes[0], pid=4711, cmd=[])

    fake.start_error = DeadlineExceeded("the agent didn't answer 'start'")
    fake.on_request = lambda nodes: threading.Thread(target=start, args=(nodes,)).start()
    node = talker(planner)
    assert run(LaunchDescription([node, until_noted('stop')])) == 0
    (_, stopped), = fake.noted('stop')
    assert 'talker' in stopped and 'started too late, and was stopped' in capfd.readouterr().out


def test_node_that_has_started_needs_no_answer(run, fake, planner, capfd):
    def started(nodes):
        machine = fake.machines['planner']
        machine.say('started', nodes[0], pid=4711, cmd=[])
        threading.Timer(0.3, machine.say, ('exited', nodes[0]), {
            'returncode': 3, 'respawns': False}).start()

    fake.start_error = DeadlineExceeded("the agent didn't answer 'start'")
    fake.on_request = started
    node = talker(planner)
    assert run(LaunchDescription([node])) == 0
    assert node.return_code == 3 and not fake.noted('stop')
    assert "can't be started" not in capfd.readouterr().out


def test_nodes_respawn_at_most_as_often_as_they_may(run, fake, planner, monkeypatch, capfd):
    monkeypatch.setattr(session, '_RESPAWN_DELAY', 0.01)
    fake.on_start = lambda machine, node: len(machine.all) > 1 and machine.say('restarted')
    fake.restore_error = AgentError('no')
    once = talker(planner)
    assert run(LaunchDescription([
        talker(planner, respawn=True, respawn_max_retries=1), once])) == 0
    assert len(fake.noted('start')) == 3 and once.return_code == -9
    output = capfd.readouterr().out
    assert 'planner: its agent died and was started again; the nodes have ended' in output
    assert 'planner: the new agent does not check the VPN: no' in output


def test_shutdown_before_a_node_respawns(run, fake, planner):
    fake.on_start = lambda machine, node: machine.say('restarted')
    node = talker(planner, respawn=True, respawn_delay=60.0)
    assert run(LaunchDescription([
        node, RegisterEventHandler(OnProcessExit(target_action=node, on_exit=[Shutdown()])),
    ])) == 0
    assert len(fake.noted('start')) == 1 and not fake.noted('stop')


def test_agent_that_stays_away_fails_nodes_with_respawn(run, fake, planner, capfd):
    fake.on_start = lambda machine, node: len(machine.all) > 1 and machine.say(
        'connection', state='absent', error='nobody answers')
    once = talker(planner)
    assert run(LaunchDescription([once, talker(planner, respawn=True)])) == 1
    output = capfd.readouterr().out
    assert "can't respawn: the agent of 'planner' is gone" in output
    assert 'planner: the agent is gone: nobody answers' in output and once.return_code == -9
    assert 'Traceback' not in output


def test_events_of_the_agent_are_logged(run, fake, planner, capfd):
    def says(machine, node):
        machine.say('watchdog', reason='lifetime', action='delete')
        machine.say('vpn_repaired', what='vpn', seconds=1.25)
        machine.say('connection', state='lost')
        ends(machine, node)

    fake.on_start = says
    assert run(LaunchDescription([talker(planner)])) == 0
    assert fake.machines['planner'].announced
    output = capfd.readouterr().out
    for line in (
            '[ERROR] [fogros2]: planner: the agent ends everything: lifetime',
            '[WARNING] [fogros2]: planner: the VPN was down for 1.2 s and is up again',
            '[WARNING] [fogros2]: planner: the connection to its agent is lost; trying again'):
        assert line in output


# -- failure -------------------------------------------------------------------------------------


@pytest.mark.parametrize('description', [LaunchDescription, FogROSLaunchDescription])
def test_a_failure_ends_the_launch_with_status_1(run, fake, planner, description, capfd):
    fake.errors['planner'] = ProviderError('no room for planner', 'take a smaller one')
    assert run(description([
        talker(planner), talker(planner), *robot(fake, 'sleep', '60')])) == 1
    output = capfd.readouterr().out
    assert 'no room for planner (take a smaller one)' in output
    assert 'Traceback' not in output and 'seconds' not in output
    assert len(fake.noted('down')) == 1 and not fake.noted('start')
    if description is FogROSLaunchDescription:
        assert not fake.noted('robot starts')


def test_a_failure_cancels_the_other_machines(run, fake, planner):
    other = ContainerInstance(name='other', ros_workspace='')
    fake.errors['planner'] = ProviderError('no room')
    fake.waits['other'] = threading.Event()
    assert run(LaunchDescription([talker(planner), talker(other)])) == 1
    assert not fake.noted('is up') and len(fake.noted('down')) == 1


@pytest.mark.skipif(not any(map(find_spec, ('tomllib', 'tomli'))),
                    reason='needs Python 3.11 or tomli')
@pytest.mark.parametrize('when', ['here', 'prepare'])
def test_wrong_option_of_a_file_names_the_file(
    run, fake, planner, capfd, monkeypatch, tmp_path, when,
):
    monkeypatch.setenv('XDG_CONFIG_HOME', str(tmp_path))
    file = tmp_path / 'fogros2/fogros2.toml'
    file.parent.mkdir()
    file.write_text("[container]\nmemory = '2x'\n")
    setattr(fake, f'{when}_error', ConfigurationError('no memory', 'write 2g'))
    assert run(LaunchDescription([talker(planner)])) == 1
    assert f'no memory (write 2g; {file} sets memory)' in capfd.readouterr().out
    assert not fake.noted('up')


@pytest.mark.parametrize('description', [LaunchDescription, FogROSLaunchDescription])
@pytest.mark.parametrize('what', ['node', 'group', 'timer'])
def test_cheap_checks_come_before_the_vpn(run, fake, planner, capfd, description, what):
    fake.here_error = PrerequisiteError('there is no podman', 'install it')
    inner = Node(package='demo', executable='talker')
    assert run(description([{
        'node': lambda: talker(planner),
        'group': lambda: CloudGroup(planner, [GroupAction([inner])]),
        'timer': lambda: TimerAction(period=0.1, actions=[talker(planner)]),
    }[what]()])) == 1
    assert fake.noted('check here') == [(['planner'], {'planner': [('demo', 'talker')]})]
    assert not fake.noted('robot environment') and not fake.noted('up')
    assert 'there is no podman' in capfd.readouterr().out


def test_wrong_defaults_end_a_launch_first(run, fake, planner, capfd, tmp_path, monkeypatch):
    pytest.importorskip('tomllib')
    monkeypatch.setenv('XDG_CONFIG_HOME', str(tmp_path))
    (tmp_path / 'fogros2').mkdir()
    (tmp_path / 'fogros2/fogros2.toml').write_text("lifetime = 'soon'")
    assert run(LaunchDescription([talker(planner)])) == 1
    assert fake.notes == []
    assert f'{tmp_path}/fogros2/fogros2.toml: ' in capfd.readouterr().out


@pytest.mark.parametrize('later', [False, True])
def test_early_checks_take_only_values_that_stay(run, fake, later):
    """A configuration that is set after the first node may belong to a machine's values."""
    fake.on_start = ends
    machine = ContainerInstance(name='planner', ros_workspace='', image=LaunchConfiguration('x'))
    settings = [SetLaunchConfiguration('x', 'first'), ExecuteProcess(cmd=['true'])]
    if later:
        settings.append(SetLaunchConfiguration('x', 'second'))
    assert run(FogROSLaunchDescription([*settings, talker(machine)])) == 0
    assert fake.noted('check here') == [
        ([], {}) if later else (['planner'], {'planner': [('demo', 'talker')]})]
    assert machine.spec(None).options['image'] == ('second' if later else 'first')


def test_failing_undo_gives_status_1(run, fake, planner, capfd):
    fake.on_start = ends
    fake.down_errors = [VpnError('the interface would not go', 'ip link delete fog1')]
    assert run(LaunchDescription([talker(planner)])) == 1
    assert 'the interface would not go (ip link delete fog1)' in capfd.readouterr().out


def test_unknown_error_is_shown(run, fake, planner, capfd):
    fake.errors['planner'] = ZeroDivisionError('a bug')
    assert run(LaunchDescription([talker(planner)])) == 1
    assert 'a bug' in capfd.readouterr().out
    assert fake.noted('down')


# -- down ----------------------------------------------------------------------------------------


def test_rollback_comes_after_all_nodes_have_ended(run, fake, planner):
    """Cloud nodes are stopped, the robot's nodes exit, then the VPN goes."""
    node = talker(planner)
    assert run(FogROSLaunchDescription([
        node, *robot(fake, 'sleep', '60'),
        RegisterEventHandler(OnProcessStart(
            target_action=lambda action: action.name.startswith('sleep'),
            on_start=[Shutdown()])),
    ])) == 0
    assert order(fake, 'stop', 'robot ends', 'down')[-1] == 'down'
    assert set(order(fake, 'stop', 'robot ends', 'down')) == {'stop', 'robot ends', 'down'}
    assert len(fake.noted('down')) == 1


def test_one_request_stops_several_nodes(run, fake, planner):
    nodes = [talker(planner) for _ in range(5)]
    assert run(LaunchDescription([
        *nodes,
        RegisterEventHandler(OnProcessStart(target_action=nodes[-1], on_start=[Shutdown()])),
    ])) == 0
    (ids,) = fake.machines['planner'].stops
    assert len(ids) == 5
    assert len(fake.noted('start')) == 5


@pytest.mark.parametrize(('returncode', 'text', 'half'), [
    (-2, 'its Traceback', True), (-15, '', True), (1, 'KeyboardInterrupt', True),
    (1, 'Traceback (most recent call last):\nImportError: numpy', True),
    (-6, 'what(): the given context is not valid, as rcl_shutdown() was called', True),
    (1, 'out of memory', False), (0, 'Traceback (most recent call last):', False),
    (0, 'bye', False)])
def test_node_that_ended_while_it_started_is_a_warning(
        run, fake, planner, capfd, returncode, text, half):
    def on_start(machine, node):
        def stop(ids):
            machine.say('output', node, stream='stderr', text=f'{text}\n')
            machine.say('exited', node, returncode=returncode, respawns=False)
        machine.stop = stop

    fake.on_start = on_start
    node = talker(planner)
    assert run(LaunchDescription([
        node, RegisterEventHandler(OnProcessStart(target_action=node, on_start=[Shutdown()])),
    ])) == 0
    said = capfd.readouterr().out
    assert ('was ended while it started [pid 4001]' in said) == half
    assert ('ERROR' in said) == (returncode == 1 and not half)
    assert bool(text and text in said) != half and node.return_code == returncode


def test_output_without_an_end_is_passed_on_in_lines(run, fake, planner):
    part, lines = 'x' * 40_000, ['']

    def collect(event):
        first, *others = event.text.decode().split('\n')
        lines[-1] += first
        lines.extend(others)

    def on_start(machine, node):
        def stop(ids):
            for _ in range(30):
                machine.say('output', node, stream='stderr', text=part)
            machine.say('exited', node, returncode=-2, respawns=False)
        machine.stop = stop

    fake.on_start = on_start
    node = talker(planner)
    assert run(LaunchDescription([
        RegisterEventHandler(OnProcessIO(target_action=node, on_stderr=collect)),
        node, RegisterEventHandler(OnProcessStart(target_action=node, on_start=[Shutdown()])),
    ])) == 0
    assert lines == [2 * part] * 15 + ['']


def test_shutdown_cancels_a_machine_that_comes_up(run, fake, planner):
    fake.waits['planner'] = threading.Event()
    assert run(FogROSLaunchDescription([
        talker(planner), *robot(fake, 'sleep', '60'),
        RegisterEventHandler(OnProcessStart(
            target_action=lambda action: False, on_start=[LogInfo(msg='')])),
        OpaqueFunction(function=lambda context: context.asyncio_loop.call_later(
            0.1, context.emit_event_sync, shutdown_event()) and None),
    ])) == 0
    assert order(fake, 'is up', 'start', 'robot starts', 'down') == ['down']


def shutdown_event():
    from launch.events import Shutdown
    return Shutdown(reason='a test')


def test_launch_ends_though_the_machine_is_silent(run, fake, planner, monkeypatch, capfd):
    monkeypatch.setattr(remote_run, 'GRACE', 0.0)
    node = talker(planner, sigterm_timeout='0.05', sigkill_timeout='0.05')

    def mute(machine, spec):
        machine.exits_on_stop = False

    fake.on_start = mute
    assert run(LaunchDescription([
        node, RegisterEventHandler(OnProcessStart(target_action=node, on_start=[Shutdown()])),
    ])) == 0
    assert "machine 'planner' did not report the end of the process" in capfd.readouterr().out
    assert fake.noted('down')


def test_group_runs_all_kinds_of_nodes(run, fake, planner):
    from launch_ros.actions import ComposableNodeContainer, LifecycleNode
    fake.on_start = ends
    words = {'package': 'demo', 'executable': 'talker', 'namespace': ''}
    node = LifecycleNode(name='arm', **words)
    assert run(LaunchDescription([CloudGroup(planner, [
        node, ComposableNodeContainer(name='box', **words)])])) == 0
    assert node.node_name == '/arm'
    there = [word for spec in fake.machines['planner'].all for word in spec.arguments]
    assert {'__node:=arm', '__node:=box'} <= {*map(str, there)}
