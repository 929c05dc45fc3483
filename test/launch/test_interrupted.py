# SPDX-License-Identifier: Apache-2.0
"""A machine that its provider takes away: what becomes of its nodes, and of the launch."""

from __future__ import annotations

from decimal import Decimal
import functools
from pathlib import Path
import re
import stat
import threading

from launch import LaunchDescription
from launch.actions import (
    EmitEvent,
    ExecuteProcess,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
    Shutdown,
    TimerAction,
)
from launch.event_handlers import OnProcessExit, OnProcessIO
from launch.events import matches_action
from launch.events.process import ShutdownProcess
from launch_ros.actions import Node, PushROSNamespace, SetRemap
import pytest

from fogros2 import (
    CloudGroup,
    CloudNode,
    ContainerInstance,
    FogROSLaunchDescription,
    StreamTopic,
)
from fogros2.errors import AgentError, ProviderError
from fogros2.feature import Cost
from fogros2.model import MachineSpec
from fogros2.runtime import remote_run
from fogros2_features.replacement import session
from fogros2_testing.plugins import instead
from rigs.launching import end, Harmless, says

REASON = 'spot instance, at 12:00'


@pytest.fixture
def planner():
    return ContainerInstance(name='planner', ros_workspace='', on_interrupt='robot')


def end_when(true):
    """Return what ends the launch as soon as something is true."""
    def look(context):
        return end() if true() else [TimerAction(period=0.05, actions=do())]

    def do(event=None):
        return [OpaqueFunction(function=look)]
    return do


def test_nodes_continue_on_the_robot(run, fake, package, planner, talker, watch, capfd):
    """With their names, namespaces, remappings, parameters; and launch sees them start again."""
    node = talker(machine=planner, name='mapper', namespace='arm', parameters=[{'rate': 5}],
                  remappings=[('in', 'out')], exec_name='says')
    after = ExecuteProcess(cmd=['true'], name='after')
    watch.at_start = {1: says(fake, 'notice', reason=REASON)}
    started = RegisterEventHandler(OnProcessIO(
        target_action=node, on_stdout=lambda event: [
            after, Shutdown(reason='over')] if b'here' in event.text else None))
    assert run(LaunchDescription([*watch(), started, node])) == 0
    program = str(package / 'lib/demo/says')
    assert watch.starts[:2] == [('says', '/there/program'), ('says', program)]
    # the machine ended its own: no news, as the node goes on
    (spec,) = fake.machines['planner'].all
    assert fake.machines['planner'].stops == [[spec.id]]
    assert len([name for name, _ in watch.exits if name == 'says']) == 1
    here = ''.join(watch.said)
    assert '-r __node:=mapper -r __ns:=/arm' in here and '-r in:=out' in here
    # /tmp is cleaned while a launch runs
    (file,) = re.findall(r'--params-file (\S+)', here)
    assert fake.store.launch_folder(fake.id) in Path(file).parents
    assert watch.interrupted == [('planner', REASON, False)]
    said = capfd.readouterr().out
    assert (f"the machine 'planner' is being reclaimed: {REASON}; "
            'its nodes continue on the robot') in said
    assert re.search(r'\[says-\d+\] here: ', said), 'not as the output of a machine'
    assert said.index(REASON) < said.index('ERROR'), 'the end of the one here, by SIGINT'


def test_interrupted_machine_ends_the_launch_by_default(run, fake, talker, watch, capfd):
    machine = ContainerInstance(name='planner', ros_workspace='')
    watch.at_start = {1: says(fake, 'notice', reason=REASON)}
    assert run(LaunchDescription([*watch(), talker(machine=machine)])) == 1
    (reason,) = watch.shutdowns
    assert f"the machine 'planner' is being reclaimed: {REASON}" in reason
    assert watch.interrupted == [('planner', REASON, False)]
    assert len(watch.starts) == 1 and fake.noted('down')
    lines = capfd.readouterr().out.splitlines()
    (error,) = [line for line in lines if 'ERROR' in line]
    assert "on_interrupt='robot' continues" in error
    assert any('WARNING' in line and 'says-' in line and 'was ended while it started' in line
               for line in lines)


@pytest.mark.parametrize('how', ['shutdown', 'replace'])
@pytest.mark.parametrize('confirmed', [False, True])
def test_notice_that_the_provider_denies_ends_nothing(
        run, fake, talker, watch, capfd, confirmed, how):
    """A node can forge it; the launch acts when the provider confirms it, or it is gone."""
    machine = ContainerInstance(name='planner', ros_workspace='', on_interrupt=how)

    def forged(event):
        fake.machines['planner'].confirms = [False, confirmed]
        return says(fake, 'notice', reason=REASON)(event)

    def later(context):
        context.asyncio_loop.call_later(
            0.3, lambda: fake.machines['planner'].say('lost', reason='it was deleted'))

    after = [] if confirmed else [OpaqueFunction(function=later)]
    watch.at_start = {1: lambda event: [*forged(event), *after], 2: end}
    assert run(LaunchDescription([*watch(), talker(machine=machine)])) == (how == 'shutdown')
    assert watch.interrupted[:1] == [
        ('planner', REASON, False) if confirmed else ('planner', 'it was deleted', True)]
    assert [note[1] for note in fake.noted('reclaimed')] == [0.0, 150.0]
    said = capfd.readouterr().out
    assert ('its provider has not confirmed' in said) == (not confirmed)


@pytest.mark.parametrize('features', [True, False])
def test_lost_machine_ends_the_launch_by_default(
        run, fake, talker, watch, monkeypatch, capfd, features):
    """Without features, a notice alone ends nothing."""
    if not features:
        instead(monkeypatch, 'fogros2.feature', {})
    machine = ContainerInstance(name='planner', ros_workspace='')
    watch.at_start = {1: lambda event: [
        *([] if features else says(fake, 'notice', reason=REASON)()),
        *says(fake, 'lost', reason='it was deleted')()]}
    assert run(LaunchDescription([*watch(), talker(machine=machine)])) == 1
    assert "the machine 'planner' is gone: it was deleted" in watch.shutdowns[0]
    assert watch.interrupted == [('planner', 'it was deleted', True)]
    # nobody is asked there any more, and nobody waits for an answer
    assert fake.machines['planner'].stops == []
    errors = [line for line in capfd.readouterr().out.splitlines() if 'ERROR' in line]
    assert len(errors) == 1


def test_nodes_of_a_lost_machine_continue_on_the_robot(run, fake, package, planner, talker, watch):
    """And end there when launch asks them to."""
    node = talker(machine=planner)
    watch.at_start = {1: says(fake, 'lost', reason='evicted'), 2: lambda event: [EmitEvent(
        event=ShutdownProcess(process_matcher=matches_action(node)))]}
    assert run(LaunchDescription([*watch(), node])) == 0
    assert watch.starts[1][1] == str(package / 'lib/demo/says')
    assert fake.machines['planner'].stops == []
    assert watch.interrupted == [('planner', 'evicted', True)]
    assert [code for _, code in watch.exits] == [-2], 'that of the one here, at the end'
    assert fake.machines['planner'].signals == []


def vanishes(machine, ids):
    machine.say('lost', reason='it was deleted')


def refuses(machine, ids):
    raise AgentError('the agent is gone')


@pytest.mark.parametrize('stop', [vanishes, refuses, lambda machine, ids: None])
def test_machine_that_ends_no_node_holds_none_up(
        run, fake, planner, talker, watch, monkeypatch, stop):
    """After its notice it vanishes, refuses or is silent: its nodes don't wait for it."""
    monkeypatch.setattr(remote_run, 'GRACE', 0.0)

    def on_start(machine, node):
        machine.stop = functools.partial(stop, machine)

    fake.on_start = on_start
    watch.at_start = {1: says(fake, 'notice', reason=REASON), 2: end}
    assert run(LaunchDescription([*watch(), talker(
        machine=planner, sigterm_timeout='0.1', sigkill_timeout='0.1')])) == 0
    assert len(watch.starts) == 2 and watch.interrupted == [('planner', REASON, False)]


def test_robot_respawns_nodes_of_a_lost_machine(run, fake, package, planner, watch):
    program = package / 'lib/demo/fails'
    program.write_text('#!/bin/sh\nexit 3\n')
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    watch.at_start = {1: says(fake, 'lost', reason='evicted')}
    assert run(LaunchDescription([*watch(), CloudNode(
        machine=planner, package='demo', executable='fails', respawn=True, respawn_delay=0.01,
        respawn_max_retries=2)])) == 0
    assert [cmd for _, cmd in watch.starts] == ['/there/program', *[str(program)] * 3]
    assert [code for _, code in watch.exits] == [3, 3, 3]


def test_later_node_of_a_lost_machine_runs_here(run, fake, package, planner, talker, watch):
    late = talker(machine=planner, exec_name='late')
    watch.at_start = {
        1: says(fake, 'lost', reason='evicted'),
        2: lambda event: [TimerAction(period=0.05, actions=[late])], 3: end}
    assert run(LaunchDescription([*watch(), talker(machine=planner)])) == 0
    assert watch.starts[2] == ('late', str(package / 'lib/demo/says'))
    assert len(fake.machines['planner'].all) == 1


def test_groups_continue_with_names_and_plain_programs(run, fake, planner, watch, talker):
    """A group's names, and programs that are no nodes."""
    watch.at_start = {2: says(fake, 'lost', reason='evicted'), 4: end_when(
        lambda: all(words in ''.join(watch.said) for words in ('__ns:=/arm', 'no node')))}
    assert run(LaunchDescription([*watch(), CloudGroup(planner, [
        PushROSNamespace('arm'), SetRemap('a', 'b'),
        Node(package='demo', executable='says', name='mapper'),
        ExecuteProcess(cmd=['sh', '-c', 'echo "no node"; exec sleep 60'], name='plain')])])) == 0
    here = ''.join(watch.said)
    assert '__node:=mapper' in here and '__ns:=/arm' in here and 'a:=b' in here
    assert 'no node' in here


def test_missing_program_of_the_robot_is_found_first(run, fake, planner, capfd):
    machine = ContainerInstance(
        name='planner', ros_workspace='', image='has-it', on_interrupt='robot')
    assert run(LaunchDescription([CloudNode(
        machine=machine, package='there_only', executable='mapper')])) == 1
    said = capfd.readouterr().out
    assert "can't run on the robot: " in said and "on_interrupt='robot' moves it there" in said
    assert "say on_interrupt='shutdown'" in said and not fake.noted('up')


# -- ends that come before the news ---------------------------------------------------------------

def last_words(machine, node, event):
    machine.say(event, reason='SIGTERM', action='leave')
    machine.say('exited', node, returncode=-15, respawns=False)


@pytest.mark.parametrize('event', ['ending', 'watchdog'])
def test_nodes_ended_by_their_machine_continue(run, fake, planner, talker, watch, event):
    """Seconds before it is known that the machine is gone."""
    def on_start(machine, node):
        last_words(machine, node, event)
        machine.say('lost', reason='evicted')

    fake.on_start = on_start
    watch.at_start = {2: end}
    assert run(LaunchDescription([*watch(), talker(machine=planner)])) == 0
    assert len(watch.starts) == 2 and [code for _, code in watch.exits] == [-2]


def test_they_have_ended_if_the_news_never_comes(run, fake, planner, talker, watch, monkeypatch):
    monkeypatch.setattr(session, '_HOLD', 0.1)
    fake.on_start = lambda machine, node: last_words(machine, node, 'ending')
    assert run(LaunchDescription([*watch(), talker(machine=planner)])) == 0
    assert len(watch.starts) == 1 and [code for _, code in watch.exits] == [-15]


@pytest.mark.parametrize('respawn', [False, True])
@pytest.mark.parametrize('reported', [False, True])
def test_agent_of_a_spared_machine_is_restored(
        run, fake, planner, talker, watch, monkeypatch, respawn, reported):
    """It ended by a signal, and was started again; its nodes have ended."""
    monkeypatch.setattr(session, '_HOLD', 0.1)

    def on_start(machine, node):
        if len(machine.all) == 1:
            machine.say('ending', reason='SIGTERM')
            if reported:
                machine.say('exited', node, returncode=-15, respawns=False)
            machine.say('restarted')

    fake.on_start = on_start
    watch.at_start = {2: end}
    assert run(LaunchDescription([*watch(), talker(machine=planner, respawn=respawn)])) == 0
    assert len(watch.starts) == 1 + respawn and fake.noted('restore')
    assert watch.exits[0][1] == (-15 if reported and not respawn else -9)


def test_agent_of_a_spared_machine_that_stays_away_is_gone(
        run, fake, planner, talker, watch, monkeypatch):
    monkeypatch.setattr(session, '_HOLD', 0.1)

    def on_start(machine, node):
        machine.say('ending', reason='SIGTERM')
        machine.say('connection', state='absent', error='no agent')

    fake.on_start = on_start
    assert run(LaunchDescription([*watch(), talker(machine=planner)])) == 0
    assert [code for _, code in watch.exits] == [-9]


# -- streams --------------------------------------------------------------------------------------

@pytest.fixture
def harmless(monkeypatch):
    instead(monkeypatch, 'fogros2.image_transport', {'h264': Harmless, 'raw': Harmless})


def test_the_node_takes_topics_as_they_are(run, fake, harmless, planner, talker, watch):
    """And nobody encodes them any more, unless another machine wants them."""
    other = ContainerInstance(name='other', ros_workspace='')
    both, one = ('/camera', 'h264'), ('/lidar', 'h264')
    node = talker(machine=planner, remappings=[('image', '/camera')], stream_topics=[
        both, one, StreamTopic('/seen', 'h264', 'to_robot')])
    # two of the user's, three decoders, an encoder there; two encoders and a decoder here
    watch.at_start = {
        9: says(fake, 'lost', reason='evicted'),
        10: end_when(lambda: 'image:=/camera' in ''.join(watch.said) and len(watch.exits) >= 2)}
    assert run(FogROSLaunchDescription([
        *watch(), node, talker(machine=other, exec_name='elsewhere', stream_topics=[both])])) == 0
    there = [word for spec in fake.machines['planner'].all if spec.executable == 'says'
             for word in spec.arguments]
    assert 'image:=/fogros2/planner/camera' in there
    here = ''.join(watch.said)
    assert 'image:=/camera' in here and '/fogros2/' not in here
    assert watch.starts[9][0] == 'says'
    ended = [name for name, _ in watch.exits]
    first = {name for name in ended if ended.index(name) < 2}
    assert first == {'lidar_h264_encoder', 'seen_h264_decoder_from_planner'}


def test_other_machines_have_its_topics_from_the_robot_then(
        run, fake, harmless, planner, talker, watch):
    """Its nodes are there now, and those elsewhere keep the names that they have."""
    other = ContainerInstance(name='other', ros_workspace='')
    # three of the user's and a pair for each topic; then two of them here, a pair for what goes
    # out, and a decoder for what comes in
    watch.at_start = {
        7: says(fake, 'lost', reason='evicted'),
        12: end_when(lambda: watch.exits)}
    assert run(FogROSLaunchDescription([
        *watch(), talker(machine=planner, exec_name='maps'),
        talker(machine=other, exec_name='sees', stream_topics=[
            StreamTopic('/map', 'h264', source=planner)]),
        talker(machine=planner, exec_name='looks', stream_topics=[
            StreamTopic('/pose', 'h264', source=other)])])) == 0
    assert sorted(name for name, _ in watch.starts[:7]) == [
        'looks', 'map_h264_decoder_from_planner', 'map_h264_encoder', 'maps',
        'pose_h264_decoder_from_other', 'pose_h264_encoder', 'sees']
    assert sorted(name for name, _ in watch.starts[7:]) == [
        'looks', 'map_h264_decoder', 'map_h264_encoder', 'maps', 'pose_h264_decoder_from_other']
    there = [spec for spec in fake.machines['other'].all if 'decoder' in spec.name]
    assert 'image:=/fogros2/other/map' in there[-1].arguments
    assert 'stream:="/map/h264"' in there[-1].arguments
    ended = [name for name, _ in watch.exits]
    assert 'map_h264_decoder_from_planner' in ended[:1]


def test_streams_that_come_later_know_of_it(run, fake, harmless, planner, talker, watch):
    other = ContainerInstance(name='other', ros_workspace='')
    late = [
        talker(machine=other, exec_name='sees', stream_topics=[
            StreamTopic('/map', 'h264', source=planner)]),
        talker(machine=planner, exec_name='looks', stream_topics=[
            ('/camera', 'h264'), StreamTopic('/pose', 'h264', source=other)])]
    watch.at_start = {
        2: says(fake, 'lost', reason='evicted'),
        3: lambda event: late,
        9: lambda event: [TimerAction(period=0.3, actions=end())]}
    assert run(FogROSLaunchDescription([
        *watch(), talker(machine=planner, exec_name='maps'),
        talker(machine=other, exec_name='idles')])) == 0
    assert sorted(name for name, _ in watch.starts[3:]) == [
        'looks', 'map_h264_decoder', 'map_h264_encoder', 'pose_h264_decoder_from_other',
        'pose_h264_encoder', 'sees']
    # beside the node, nothing more ran on the one that is away
    assert len(fake.machines['planner'].all) == 1


# -- a feature gives it up ------------------------------------------------------------------------

def test_node_for_a_machine_that_has_ended_does_not_start(
    run, fake, talker, watch, capfd,
):
    idle = ContainerInstance(name='planner', ros_workspace='')
    late = talker(machine=idle, exec_name='late')
    watch.at_start = {1: says(fake, 'given_up', reason='nobody uses it')}
    assert run(FogROSLaunchDescription([
        *watch(), talker(machine=idle, exec_name='talks'),
        RegisterEventHandler(OnProcessExit(on_exit=[
            late, TimerAction(period=0.3, actions=end())])),
    ])) == 0
    assert [name for name, _ in watch.starts] == ['talks']
    text = capfd.readouterr().out
    assert 'does not start: the machine has ended, because nobody uses it' in text


# -- money ----------------------------------------------------------------------------------------

def test_a_launch_says_what_it_cost(run, fake, talker, capfd):
    fake.spent = [Cost(MachineSpec('planner', 'aws'), Decimal('0.0416'), 5400.0, True)]
    fake.on_start = lambda machine, node: machine.say(
        'exited', node, returncode=0, respawns=False)
    machine = ContainerInstance(name='planner', ros_workspace='')
    assert run(LaunchDescription([talker(machine=machine)])) == 0
    assert 'planner: 1.50 h at $0.0416 an hour, $0.062' in capfd.readouterr().out


# -- what takes a while to know -------------------------------------------------------------------

def test_choices_are_made_in_threads(run, fake, talker, monkeypatch):
    from fogros2 import AWSCloudInstance, find_nearest_aws_region
    from fogros2.provider.aws.provider import AWSProvider
    where = []

    def nearest(self, regions=()):
        where.append(threading.current_thread())
        return 'eu-north-1'

    monkeypatch.setattr(AWSProvider, 'nearest', nearest)
    fake.on_start = lambda machine, node: machine.say(
        'exited', node, returncode=0, respawns=False)
    machine = AWSCloudInstance(region=find_nearest_aws_region(), name='cloud', ros_workspace='')
    assert run(LaunchDescription([
        talker(machine=machine), talker(machine=machine, exec_name='second')])) == 0
    assert fake.machines['cloud'].spec.options == {'region': 'eu-north-1'}
    assert len(where) == 1 and where[0] is not threading.main_thread()


def test_a_choice_that_cannot_be_made(run, fake, talker, monkeypatch, capfd):
    from fogros2 import AWSCloudInstance, find_nearest_aws_region
    from fogros2.provider.aws.provider import AWSProvider

    def nearest(self, regions=()):
        raise ProviderError('no region answers', 'is there a network?')

    monkeypatch.setattr(AWSProvider, 'nearest', nearest)
    machine = AWSCloudInstance(region=find_nearest_aws_region(), name='cloud', ros_workspace='')
    assert run(LaunchDescription([LogInfo(msg='begins'), talker(machine=machine)])) == 1
    assert 'no region answers (is there a network?)' in capfd.readouterr().out
    assert not fake.noted('up')
