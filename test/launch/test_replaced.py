# SPDX-License-Identifier: Apache-2.0
"""A machine that another one replaces: its nodes move to the robot, and to the new machine."""

from __future__ import annotations

import dataclasses
import threading

from launch import LaunchDescription
from launch.actions import ExecuteProcess, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit, OnProcessIO
from launch.events import Shutdown as ShutdownEvent
import pytest

from fogros2 import CloudNode, ContainerInstance
from fogros2.errors import ConfigurationError, ConnectError, DeadlineExceeded, ProviderError
from fogros2.model import Endpoint, MachineSpec, NodeSpec
from fogros2.process import which
from fogros2.runtime.coordinator import Coordinator
from fogros2.runtime.remote_process import process_on, remote_of
from fogros2.shell.local import LocalShell
from fogros2.store import Store
from fogros2.waiting import wait_until
from fogros2_features.replacement import Replacement, session, snapshots, steps
from rigs.launching import end, says

THERE = '/there/program'


@pytest.fixture
def planner():
    return ContainerInstance(name='planner', ros_workspace='', on_interrupt='replace')


def held(fake, event, handler=OnProcessIO):
    """Hold the next creation of the machine back until the process has said something here."""
    gate = threading.Event()

    def wait(found):
        fake.waits['planner'] = gate
        return event(found)
    if handler is OnProcessExit:
        return wait, RegisterEventHandler(OnProcessExit(on_exit=lambda found, _: gate.set()))
    return wait, RegisterEventHandler(OnProcessIO(
        on_stdout=lambda found: gate.set() if b'here' in found.text else None))


def test_nodes_run_here_until_a_new_machine_runs_them(run, fake, package, planner, talker, watch):
    node = talker(machine=planner, name='mapper', namespace='arm')
    notice, free = held(fake, says(fake, 'notice', reason='at 12:00'))
    watch.at_start = {1: notice, 3: end}
    assert run(LaunchDescription([*watch(), free, node])) == 0
    assert [cmd for _, cmd in watch.starts] == [THERE, str(package / 'lib/demo/says'), THERE]
    first, second = fake.noted('up'), [note[0] for note in fake.notes]
    assert first == [('planner',), ('planner',)]
    order = [what for what in second if what in ('start', 'stop', 'retire', 'up')]
    assert order[:6] == ['up', 'start', 'stop', 'retire', 'up', 'start']
    # the same process to launch, which ended once: with the launch
    assert [name for name, _ in watch.exits] == ['says']


@pytest.mark.parametrize('kind', ['notice', 'lost'])
def test_node_that_the_robot_lacks_waits_for_the_machine(run, fake, planner, watch, kind):
    planner._options['image'] = 'mine'  # a machine with packages of its own
    node = CloudNode(machine=planner, package='absent', executable='says')
    watch.at_start = {1: says(fake, kind, reason='at 12:00'), 2: end}
    assert run(LaunchDescription([*watch(), node])) == 0
    assert [cmd for _, cmd in watch.starts] == [THERE, THERE]
    assert [name for name, _ in watch.exits] == ['says']


def test_lost_machine_is_deleted_before_nodes_start_here(
        run, fake, package, planner, talker, watch, monkeypatch):
    monkeypatch.setattr(steps, 'RETRY', 0.01)
    fake.retire_errors += [ConnectError('no network'), ConnectError('no network')]
    lost, free = held(fake, says(fake, 'lost', reason='no answer'))

    def here(event):
        fake.note('here')

    watch.at_start = {1: lost, 2: here, 3: end}
    assert run(LaunchDescription([*watch(), free, talker(machine=planner)])) == 0
    order = [note[0] for note in fake.notes if note[0] in ('retire', 'here')]
    assert order[:4] == ['retire', 'retire', 'retire', 'here']
    assert len(watch.starts) == 3


def test_creations_that_fail_end_a_launch_whose_nodes_wait(
        run, fake, planner, watch, monkeypatch, capfd):
    monkeypatch.setattr(steps, 'RETRY', 0.01)
    planner._options['image'] = 'mine'
    node = CloudNode(machine=planner, package='absent', executable='says')

    def full(event):
        fake.errors['planner'] = ProviderError('no capacity')
        return says(fake, 'lost', reason='deleted')(event)

    watch.at_start = {1: full}
    assert run(LaunchDescription([*watch(), node])) == 1
    assert len(fake.noted('up')) == 4
    said = capfd.readouterr()
    assert 'max_replacements=3 is reached' in said.out + said.err


@pytest.mark.parametrize('elsewhere', [True, False])
def test_nodes_of_the_last_lost_machine(run, fake, package, talker, watch, capfd, elsewhere):
    """They stay on the robot, or end a launch that can run them nowhere."""
    planner = ContainerInstance(
        name='planner', ros_workspace='', on_interrupt='replace', max_replacements=1)
    lost = says(fake, 'lost', reason='deleted')
    if elsewhere:
        first, free = held(fake, lost)
        watch.at_start = {1: first, 3: lost, 4: end}
        actions = [free, talker(machine=planner)]
    else:
        planner._options['image'] = 'mine'
        watch.at_start = {1: lost, 2: lost}
        actions = [CloudNode(machine=planner, package='absent', executable='says')]
    assert run(LaunchDescription([*watch(), *actions])) == (0 if elsewhere else 1)
    here = [str(package / 'lib/demo/says')] * elsewhere
    assert [cmd for _, cmd in watch.starts] == [THERE, *here] * 2
    said = capfd.readouterr()
    rest = 'its nodes stay on the robot' if elsewhere else "can't run on the robot"
    assert 'max_replacements=1 is reached' in said.out + said.err
    assert rest in said.out + said.err


@pytest.mark.parametrize('how', ['replace', 'shutdown'])
def test_machine_at_the_end_of_its_lifetime_is_not_replaced(run, fake, watch, capfd, how):
    planner = ContainerInstance(name='planner', ros_workspace='', on_interrupt=how)
    node = CloudNode(machine=planner, package='absent', executable='says')
    planner._options['image'] = 'mine'

    def ended(event):
        fake.machines['planner'].time_left = -1.0
        return says(fake, 'lost', reason='deleted')(event)

    watch.at_start = {1: ended}
    assert run(LaunchDescription([*watch(), node])) == 1
    assert len(fake.noted('up')) == 1
    said = capfd.readouterr()
    assert 'raise lifetime=' in said.out + said.err


def test_replica_that_is_not_replaced_again_leaves_the_others(run, fake, watch, capfd):
    planner = ContainerInstance(
        name='planner', ros_workspace='', on_interrupt='replace', max_replacements=1)
    planner._options['image'] = 'mine'
    lost = says(fake, 'lost', reason='deleted')
    watch.at_start = {1: lost, 2: lost}

    def replicate(context):
        Coordinator.of(context).session('planner').rename({}, 'the other replicas')

    node = CloudNode(machine=planner, package='absent', executable='says')
    remote_of(node).needed = False
    assert run(LaunchDescription(
        [*watch(), node, OpaqueFunction(function=replicate)])) == 0
    said = capfd.readouterr()
    assert 'max_replacements=1 is reached; the other replicas go on' in said.out + said.err


def test_program_of_a_feature_keeps_no_node_from_staying(
        run, fake, package, talker, watch, capfd):
    planner = ContainerInstance(
        name='planner', ros_workspace='', on_interrupt='replace', max_replacements=1)
    lost = says(fake, 'lost', reason='deleted')
    first, free = held(fake, lost)
    (package / 'lib/demo/says').write_text('#!/bin/sh\necho here; exec sleep 60\n')
    added = process_on(NodeSpec(id='', name='record', arguments=('record',)), 'planner')

    watch.at_start = {2: first, 5: lost, 6: end}
    assert run(LaunchDescription([*watch(), free, talker(machine=planner), added])) == 0
    said = capfd.readouterr()
    assert 'its nodes stay on the robot' in said.out + said.err


def test_node_that_ended_on_the_robot_stays_ended(run, fake, package, planner, talker, watch):
    program = package / 'lib/demo/says'
    notice, free = held(fake, says(fake, 'notice', reason='at 12:00'), OnProcessExit)
    node = talker(machine=planner)
    program.write_text('#!/bin/sh\necho "here"\n')
    other = ExecuteProcess(cmd=['sleep', '60'], name='other')
    watch.at_start = {2: notice}
    fake_up = fake.up

    def up(spec):
        found = fake_up(spec)
        if len(fake.noted('up')) == 2:
            loop = run.context.asyncio_loop
            loop.call_soon_threadsafe(
                loop.call_later, 0.5, run.context.emit_event_sync, ShutdownEvent(reason='over'))
        return found

    fake.up = up
    assert run(LaunchDescription([*watch(), free, other, node])) == 0
    assert fake.noted('start') == [('planner', node.process_details['name'])]


@pytest.mark.parametrize('when', [1, 2])
def test_nodes_start_when_the_network_is_back(
        run, fake, planner, watch, monkeypatch, when, capfd):
    """On the first machine, or on the one in its place."""
    monkeypatch.setattr(session, '_AGAIN', 0.01)
    planner._options['image'] = 'mine'
    node = CloudNode(machine=planner, package='absent', executable='says')
    cut = [DeadlineExceeded("the agent didn't answer 'start' within 30 s"), ConnectError('cut')]

    def lost(event):
        fake.start_errors += cut if when == 2 else []
        return says(fake, 'lost', reason='no answer')(event)

    fake.start_errors += cut if when == 1 else []
    watch.at_start = {1: lost, 2: end}
    assert run(LaunchDescription([*watch(), node])) == 0
    assert [cmd for _, cmd in watch.starts] == [THERE, THERE] and fake.start_errors == []
    assert len(fake.noted('up')) == 2
    assert capfd.readouterr().out.count('nodes did not start: ') == 2


def test_machine_that_is_lost_while_nodes_come_back_is_replaced(
        run, fake, package, planner, talker, watch):
    """The loss comes before the launch listens to the new machine."""
    up = fake.up

    def second_is_lost(spec):
        machine = up(spec)
        machine.lost = 'no answer' if len(fake.noted('up')) == 2 else ''
        return machine

    fake.up = second_is_lost
    watch.at_start = {1: says(fake, 'lost', reason='no answer')}

    def at_third(machine, node):
        if len(fake.noted('up')) == 3:
            run.context.asyncio_loop.call_soon_threadsafe(
                run.context.emit_event_sync, ShutdownEvent(reason='over'))

    fake.on_start = at_third
    assert run(LaunchDescription([*watch(), talker(machine=planner)])) == 0
    assert len(fake.noted('up')) == 3 and len(fake.noted('start')) == 2
    assert [cmd for _, cmd in watch.starts][-1] == THERE
    assert [name for name, _ in watch.exits] == ['says']


class There(LocalShell):
    """A shell to a machine whose folders are beside those of the robot."""

    def __init__(self, folder, other):
        super().__init__(Endpoint('local'), name='planner')
        self.folder, self.other = str(folder), str(other)

    def moved(self, text):
        return text.replace(self.folder, self.other)

    def run(self, command, **words):
        return super().run(dataclasses.replace(
            command, argv=tuple(map(self.moved, command.argv))), **words)

    def fetch(self, source, target, **words):
        super().fetch(self.moved(source), target, **words)

    def sync(self, source, target, **words):
        return super().sync(source, self.moved(target), **words)


@pytest.mark.skipif(which('rsync') is None, reason='needs rsync')
@pytest.mark.parametrize('whose', ['machine', 'node'])
def test_files_go_along_to_the_robot_and_to_the_new_machine(
        run, fake, package, talker, watch, tmp_path, monkeypatch, whose):
    """What the node wrote before its end, and what it wrote on the robot."""
    fake.store = Store(tmp_path / 'state')
    folder = tmp_path / 'map'
    folder.mkdir()
    (folder / 'old').write_text("the robot's own")
    machines = [tmp_path / 'first', tmp_path / 'second']
    machines[0].mkdir()
    up = fake.up

    def with_shell(spec):
        machine = up(spec)
        machine.shell = There(folder, machines[len(fake.noted('up')) - 1])
        return machine

    fake.up = with_shell
    program = package / 'lib/demo/says'
    program.write_text(f'#!/bin/sh\necho more >{folder}/there; cat {folder}/state\n'
                       'echo here; exec sleep 60\n')

    def notice(event):
        (machines[0] / 'state').write_text('one\n')
        return says(fake, 'notice', reason='at 12:00')(event)

    wait, free = held(fake, notice)
    texts = []

    def end_there(event):
        texts.extend((path.name, path.read_text()) for path in sorted(machines[1].iterdir()))
        return end()

    watch.at_start = {1: wait, 3: end_there}
    words = {'checkpoint': str(folder)}
    machine = ContainerInstance(name='planner', ros_workspace='', on_interrupt='replace',
                                **(words if whose == 'machine' else {}))
    node = talker(machine=machine, **(words if whose == 'node' else {}))
    assert run(LaunchDescription([*watch(), free, node])) == 0
    assert texts == [('state', 'one\n'), ('there', 'more\n')]
    assert (tmp_path / 'map.before-abcdef/old').read_text() == "the robot's own"


@pytest.mark.skipif(which('rsync') is None, reason='needs rsync')
def test_folder_is_copied_at_intervals(run, fake, watch, tmp_path, capfd, monkeypatch):
    """Until then it may be missing; a folder that is too large is reported once."""
    fake.store = Store(tmp_path / 'state')
    folder = tmp_path / 'map'
    up = fake.up

    def with_shell(spec):
        machine = up(spec)
        machine.shell = LocalShell(Endpoint('local'), name='planner')
        return machine

    fake.up = with_shell
    machine = ContainerInstance(
        name='planner', ros_workspace='', on_interrupt='replace', checkpoint=str(folder),
        checkpoint_interval=0.05)
    machine._options['image'] = 'mine'
    node = CloudNode(machine=machine, package='absent', executable='says')

    tries = []
    save = snapshots.Checkpoint.save
    monkeypatch.setattr(snapshots.Checkpoint, 'save', lambda kept, shell, **words: (
        tries.append(snapshots.LIMIT), save(kept, shell, **words))[1])

    def wait_for(what):
        wait_until(what, timeout=60, what='a snapshot', longest=0.05)

    def write(context):
        def work():
            try:
                folder.mkdir()
                (folder / 'state').write_text('one')
                wait_for(lambda: [*fake.store.root.rglob('0*1/state')] or None)
                monkeypatch.setattr(snapshots, 'LIMIT', 1)
                (folder / 'state').write_text('two')
                wait_for(lambda: tries.count(1) > 3)
                monkeypatch.setattr(snapshots, 'LIMIT', 1 << 20)
                wait_for(lambda: [*fake.store.root.rglob('0*2/state')] or None)
            finally:
                run.context.asyncio_loop.call_soon_threadsafe(
                    run.context.emit_event_sync, ShutdownEvent(reason='over'))
        worked.append(context.asyncio_loop.run_in_executor(None, work))

    worked = []
    watch.at_start = {1: lambda event: [OpaqueFunction(function=write)]}
    assert run(LaunchDescription([*watch(), node])) == 0
    assert worked[0].exception() is None
    said = capfd.readouterr()
    assert (said.out + said.err).count('a checkpoint at most') == 1


@pytest.mark.skipif(which('rsync') is None, reason='needs rsync')
def test_machine_that_was_given_up_is_copied_no_more(run, fake, watch, tmp_path):
    fake.store = Store(tmp_path / 'state')
    up, looks = fake.up, []

    class Noted(LocalShell):
        def run(self, command, **words):
            looks.append(command)
            return super().run(command, **words)

    def with_shell(spec):
        machine = up(spec)
        machine.shell = Noted(Endpoint('local'), name='planner')
        return machine

    fake.up = with_shell
    machine = ContainerInstance(
        name='planner', ros_workspace='', on_interrupt='replace', checkpoint=str(tmp_path / 'map'),
        checkpoint_interval=0.05)
    machine._options['image'] = 'mine'
    node = CloudNode(machine=machine, package='absent', executable='says')
    other = ExecuteProcess(cmd=['sleep', '60'], name='other')

    def give_up(event):
        def wait(context):
            if not looks:
                context.asyncio_loop.call_later(0.01, wait, context)
                return
            fake.machines['planner'].say('given_up', reason='idle')
        return [OpaqueFunction(function=lambda context: wait(context))]

    def ended(name, *what):
        note(name, *what)
        if name == 'end':
            before = len(looks)
            loop = run.context.asyncio_loop

            def compare():
                later.append(len(looks) - before)
                run.context.emit_event_sync(ShutdownEvent(reason='over'))
            # six intervals
            loop.call_soon_threadsafe(loop.call_later, 0.3, compare)

    later = []
    note, fake.note = fake.note, ended
    watch.at_start = {2: give_up}
    assert run(LaunchDescription([*watch(), other, node])) == 0
    assert later in ([0], [1]), 'at most the end of a copy that had begun'


@pytest.mark.parametrize('folders', [
    ({'checkpoint': '~/map'}, {'checkpoint': '$HOME/map/a'}, {}),
    ({'checkpoint': '~/map'}, {}, {'checkpoint': '$HOME/map'}),
    ({}, {'checkpoint': '~/map'}, {'checkpoint': '~/map'})])
def test_machines_with_one_checkpoint_folder_are_refused(run, fake, package, capfd, folders):
    first, second, of_node = folders
    machines = [ContainerInstance(name=f'slam-{letter}', ros_workspace='', on_interrupt='replace',
                                  **own) for letter, own in zip('ab', (first, second))]
    words = {'package': 'demo', 'executable': 'talker'}
    nodes = [CloudNode(machine=machines[0], **words, **({} if first else of_node)),
             CloudNode(machine=machines[1], **words, **({} if second else of_node))]
    assert run(LaunchDescription(nodes)) == 1
    assert fake.noted('up') == []
    assert "'slam-a' and 'slam-b' have one checkpoint folder, which both would use on the rob" in (
        capfd.readouterr().out.replace('\n', ''))


def test_one_machine_may_have_a_checkpoint_folder_twice(run, fake, package, watch):
    machine = ContainerInstance(
        name='slam-a', ros_workspace='', on_interrupt='replace', checkpoint='~/map')
    node = CloudNode(machine=machine, package='demo', executable='talker', checkpoint='~/map/a')
    watch.at_start = {1: end}
    assert run(LaunchDescription([*watch(), node])) == 0


def test_checkpoint_of_a_node_needs_a_replacement(run, fake, package, capfd):
    machine = ContainerInstance(name='planner', ros_workspace='', on_interrupt='robot')
    assert run(LaunchDescription([CloudNode(
        machine=machine, package='demo', executable='talker', checkpoint='$HOME/map')])) == 1
    assert fake.noted('up') == []
    assert "a node of 'planner' has a checkpoint, and nothing" in capfd.readouterr().out


def test_node_in_an_image_has_no_checkpoint_of_its_own(run, fake, capfd):
    machine = ContainerInstance(
        name='planner', ros_workspace='', on_interrupt='replace', containers=True)
    assert run(LaunchDescription([CloudNode(
        machine=machine, package='demo', executable='talker', image='ros:jazzy',
        checkpoint='$HOME/map')])) == 1
    assert fake.noted('up') == []
    assert "the checkpoint ~/map of a node on 'planner'" in capfd.readouterr().out


@pytest.mark.parametrize('words, message', [
    ({'on_interrupt': 'shutdown', 'checkpoint': '~/map'}, 'nothing would restore it'),
    ({'on_loss_after': 60}, 'on_loss_after=60 s is shorter than robot_timeout=120 s'),
    ({'provider': 'ssh'}, 'exists already: no launch can replace it'),
    ({'max_replacements': 0}, 'max_replacements=0 is no number of machines')])
def test_what_can_replace_nothing_is_refused(words, message):
    own = {'on_interrupt': 'replace', **words}
    spec = MachineSpec('planner', own.pop('provider', 'container'))
    with pytest.raises(ConfigurationError, match=message):
        Replacement().check(spec, Replacement.options(**own))
