# SPDX-License-Identifier: Apache-2.0
"""What ``stream_topics`` starts where, and what it does to remappings."""

from __future__ import annotations

import functools
import re
import threading

from launch import LaunchDescription
from launch.actions import (
    ExecuteProcess,
    GroupAction,
    RegisterEventHandler,
    SetLaunchConfiguration,
    TimerAction,
)
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit, OnProcessStart
from launch.substitutions import LaunchConfiguration
from launch.utilities import perform_substitutions
from launch_ros.actions import (
    ComposableNodeContainer,
    LoadComposableNodes,
    Node,
    PushROSNamespace,
    SetRemap,
)
from launch_ros.descriptions import ComposableNode
import pytest

from fogros2 import (
    CloudGroup,
    CloudNode,
    ContainerInstance,
    FogROSLaunchDescription,
    Replicated,
    StreamTopic,
)
from fogros2.actions.override import OverrideMachines
from fogros2.describe.overrides import Overrides
from fogros2.errors import ConfigurationError
from fogros2.model import OtherVpn, Peer, VpnInterface
from fogros2_testing.plugins import instead
from rigs.launching import end, Harmless, says

BACK = StreamTopic('/seen', 'h264', 'to_robot', bitrate=500_000)


@pytest.fixture(autouse=True)
def transports(monkeypatch):
    instead(monkeypatch, 'fogros2.image_transport', {'h264': Harmless, 'raw': Harmless})


@pytest.fixture
def mapper():
    return ContainerInstance(name='mapper', ros_workspace='')


def talker(machine, **kwargs):
    return CloudNode(machine=machine, package='demo', executable='talker', exec_name='own',
                     **kwargs)


def own_ends(machine, node):
    if node.name.startswith('own'):
        machine.say('exited', node, returncode=0, respawns=False)


def watched(fake, kind=LaunchDescription, *entities, **kwargs):
    """Return a description that notes the starts of all processes, which machines name theirs."""
    return kind([RegisterEventHandler(OnProcessStart(
        on_start=lambda event, context: fake.note('starts', plain(event.process_name)))),
        *entities], **kwargs)


def plain(name):
    return name.rpartition('-')[0]


def there(fake, machine):
    return sorted(plain(node.name) for node in fake.machines[machine].all)


def here(fake):
    """Return what was started on the robot: all that isn't on a machine."""
    names = [name for name, in fake.noted('starts')]
    for machine in fake.machines.values():
        for node in machine.all:
            names.remove(plain(node.name))
    return sorted(names)


def rules(fake, machine, name='own'):
    node, = (node for node in fake.machines[machine].all if plain(node.name) == name)
    words = node.arguments
    return [word for before, word in zip(words, words[1:]) if before == '-r']


def ends_when_all_started(fake, count):
    """Have machines' own nodes end when ``count`` processes have started, here and there."""
    lock = threading.Lock()
    original = fake.note

    def note(*what):
        original(*what)
        with lock:
            if what[0] == 'starts' and len(fake.noted('starts')) == count:
                for machine in fake.machines.values():
                    for node in list(machine.all):
                        own_ends(machine, node)

    fake.note = note


def test_streams_run_in_both_directions(run, fake, planner):
    """The launch ends with its own processes: those that carry its streams don't keep it."""
    ends_when_all_started(fake, 5)
    assert run(watched(fake, LaunchDescription, talker(
        planner, stream_topics=[('/camera', 'h264'), BACK]))) == 0
    assert there(fake, 'planner') == ['camera_h264_decoder', 'own', 'seen_h264_encoder']
    assert here(fake) == ['camera_h264_encoder', 'seen_h264_decoder_from_planner']
    assert rules(fake, 'planner') == [
        '/camera:=/fogros2/planner/camera', '/camera_info:=/fogros2/planner/camera_info',
        '/seen:=/fogros2/planner/seen']
    encoder, = (node for node in fake.machines['planner'].all if 'encoder' in node.name)
    assert 'bitrate:=500000' in encoder.arguments and encoder.respawn
    assert encoder.id.endswith('.abcdef')
    assert 'image:=/fogros2/planner/seen' in encoder.arguments


def test_remapped_topic_is_streamed(run, fake, planner):
    ends_when_all_started(fake, 3)
    assert run(watched(fake, LaunchDescription, GroupAction([
        PushROSNamespace('arm'), SetRemap('image', 'camera'),
        talker(planner, remappings=[('picture', '/arm/camera'), ('a', 'b')],
               stream_topics=[('camera', 'h264')]),
    ]))) == 0
    assert rules(fake, 'planner')[-5:] == [
        'image:=/fogros2/planner/arm/camera', 'picture:=/fogros2/planner/arm/camera', 'a:=b',
        '/arm/camera:=/fogros2/planner/arm/camera',
        '/arm/camera_info:=/fogros2/planner/arm/camera_info']
    # what the group says is for its nodes, not for those that carry streams
    decoder = rules(fake, 'planner', 'arm_camera_h264_decoder')
    assert decoder[:2] == ['__node:=arm_camera_h264_decoder_on_planner',
                           'image:=/fogros2/planner/arm/camera']
    assert not [rule for rule in decoder if '__ns' in rule or rule.startswith('image:=camera')]


def test_launch_streams_apply_to_every_machine(run, fake, planner, mapper):
    ends_when_all_started(fake, 9)
    assert run(watched(
        fake, FogROSLaunchDescription, talker(planner), talker(mapper),
        stream_topics=[('/camera', 'h264'), BACK])) == 0
    assert here(fake) == ['camera_h264_encoder', 'seen_h264_decoder_from_mapper',
                          'seen_h264_decoder_from_planner']
    for machine in ('planner', 'mapper'):
        assert there(fake, machine) == ['camera_h264_decoder', 'own', 'seen_h264_encoder']
        assert f'/seen:=/fogros2/{machine}/seen' in rules(fake, machine)


def test_group_streams_apply_to_all_its_nodes(run, fake, planner):
    """Its nodes all know the topic's new name; the robot's side of the stream stays there."""
    ends_when_all_started(fake, 4)
    assert run(watched(fake, FogROSLaunchDescription, CloudGroup(planner, [
        Node(package='demo', executable='talker', exec_name='own', remappings=[('i', '/camera')]),
        Node(package='demo', executable='talker', exec_name='own_too', namespace='arm'),
    ], stream_topics=[('/camera', 'h264')]))) == 0
    assert there(fake, 'planner') == ['camera_h264_decoder', 'own', 'own_too']
    assert here(fake) == ['camera_h264_encoder']
    assert 'i:=/fogros2/planner/camera' in rules(fake, 'planner')
    assert '/camera:=/fogros2/planner/camera' in rules(fake, 'planner', 'own_too')


def test_earlier_node_takes_the_stream_of_a_later_one(run, fake, planner):
    """It would find the robot's topic otherwise, and take it over the VPN as it is."""
    ends_when_all_started(fake, 4)
    assert run(watched(
        fake, LaunchDescription, talker(planner),
        talker(planner, stream_topics=[('/camera', 'h264')]))) == 0
    for node in fake.machines['planner'].all:
        if node.name.startswith('own'):
            assert '/camera:=/fogros2/planner/camera' in node.arguments


def test_node_that_runs_before_its_stream_is_named(run, fake, planner, caplog):
    first = talker(planner, name='first')
    late = talker(planner, stream_topics=[('/camera', 'h264')])
    runs_on = CloudNode(machine=planner, package='demo', executable='talker', exec_name='early')

    def on_start(machine, node):
        own_ends(machine, node)
        if 'decoder' in node.name:
            for other in machine.all:
                if other.name.startswith('early'):
                    machine.say('exited', other, returncode=0, respawns=False)

    fake.on_start = on_start
    assert run(LaunchDescription([
        runs_on, first,
        RegisterEventHandler(OnProcessExit(target_action=first, on_exit=[late]))])) == 0
    assert re.search(r'planner: early-\d+ started before /camera, /camera_info became a stream',
                     caplog.text)


def test_encoder_of_the_robot_waits_for_the_machine(run, fake, planner):
    ends_when_all_started(fake, 3)
    fake.waits['planner'] = go = threading.Event()
    threading.Timer(0.3, go.set).start()
    assert run(watched(fake, LaunchDescription, talker(
        planner, stream_topics=[('/camera', 'h264')]))) == 0
    order = [note[0] for note in fake.notes if note[0] in ('is up', 'starts')]
    assert order[0] == 'is up'


def test_failed_machine_starts_no_encoder(run, fake, planner):
    from fogros2.errors import ProviderError
    fake.errors['planner'] = ProviderError('no room')
    assert run(watched(fake, LaunchDescription, talker(
        planner, stream_topics=[('/camera', 'h264')]))) == 1
    assert not fake.noted('starts')


@pytest.mark.parametrize('make', [
    lambda machine, streams: talker(machine, stream_topics=streams),
    lambda machine, streams: TimerAction(
        period=60.0, actions=[talker(machine, stream_topics=streams)]),
    lambda machine, streams: CloudGroup(machine, [talker(machine)], stream_topics=streams),
    lambda machine, streams: FogROSLaunchDescription([talker(machine)], stream_topics=streams)])
def test_unknown_transport_is_refused_first(run, fake, planner, make, capfd):
    made = make(planner, [('/camera', 'h265')])
    assert run(made if isinstance(made, LaunchDescription)
               else FogROSLaunchDescription([talker(planner), made])) == 1
    assert "there is no image transport 'h265' (did you mean 'h264'? there are: h264, raw)" in (
        capfd.readouterr().out)
    assert not fake.noted('up')


@pytest.mark.parametrize('first', ['source', 'target'])
def test_stream_runs_from_machine_to_machine(run, fake, planner, mapper, first):
    """Both nodes know the topic's new name, whichever of them the launch file has first."""
    ends_when_all_started(fake, 4)
    nodes = [talker(mapper), talker(planner, stream_topics=[StreamTopic('/map', source=mapper)])]
    if first == 'target':
        nodes.reverse()
    assert run(watched(fake, LaunchDescription, *nodes)) == 0
    assert here(fake) == []
    assert there(fake, 'mapper') == ['map_h264_encoder', 'own']
    assert there(fake, 'planner') == ['map_h264_decoder_from_mapper', 'own']
    assert rules(fake, 'mapper') == ['/map:=/fogros2/mapper/map']
    assert rules(fake, 'planner') == ['/map:=/fogros2/planner/map']


def test_unknown_source_of_a_stream_is_refused(run, fake, planner, capfd):
    assert run(LaunchDescription([
        talker(planner, stream_topics=[StreamTopic('/map', source='mapper')])])) == 1
    assert "this launch has no machine named 'mapper'" in capfd.readouterr().out
    assert not fake.noted('up')


def test_program_without_ros_arguments_is_named(run, fake, planner, caplog):
    """It may be a node that would take the raw images over the VPN; or ``sleep``."""
    ends_when_all_started(fake, 4)
    assert run(watched(fake, FogROSLaunchDescription, CloudGroup(planner, [
        ExecuteProcess(cmd=['true'], name='own_plain'),
        ExecuteProcess(cmd=['true', '--ros-args'], name='own_node'),
    ], stream_topics=[('/camera', 'h264')]))) == 0
    said = [record.getMessage() for record in caplog.records
            if 'takes no ROS arguments' in record.getMessage()]
    assert len(said) == 1
    assert re.match(
        r'planner: own_plain(-\d+)? takes .* the stream of /camera, /camera_info', said[0])
    assert '/camera:=/fogros2/planner/camera' in rules(fake, 'planner', 'own_node')


class Loading(LoadComposableNodes):
    """Notes what launch_ros would tell a container, and asks none."""

    told = ()

    def execute(self, context):
        words = functools.partial(perform_substitutions, context)
        rules = [*context.launch_configurations.get('ros_remaps', ())]
        type(self).told += ([*rules, *(
            (words(old), words(new)) for old, new in self.node.remappings or ())],)

    def __init__(self, node, **kwargs):
        super().__init__(
            target_container='/box', composable_node_descriptions=[node], **kwargs)
        self.node = node


@pytest.fixture
def box(monkeypatch):
    """Return a container."""
    monkeypatch.setattr(Loading, 'told', ())
    return ComposableNodeContainer(
        package='demo', executable='talker', exec_name='own', name='box', namespace='')


@pytest.mark.parametrize('streams', ['group', 'launch'])
def test_composable_nodes_get_their_streams(run, fake, planner, caplog, box, streams):
    """They are made by a service call, whose remappings are rewritten as a process's are."""
    ends_when_all_started(fake, 3)
    topics = [('/camera', 'h264')]
    view = ComposableNode(
        package='demo', plugin='demo::View', name='view', namespace='arm',
        remappings=[('image', '/camera'), ('x', LaunchConfiguration('which'))])
    load = Loading(view)
    group = CloudGroup(planner, [
        box, SetRemap('seen', '/camera'), PushROSNamespace('left'),
        SetLaunchConfiguration('which', '/y'), load, load,
        Loading(ComposableNode(package='demo', plugin='demo::View', condition=IfCondition('0'))),
    ], stream_topics=topics if streams == 'group' else [])
    assert run(watched(fake, FogROSLaunchDescription, group,
                       stream_topics=topics if streams == 'launch' else [])) == 0
    here = '/fogros2/planner/camera'
    assert Loading.told[:2] == 2 * ([
        ('seen', here), ('image', here), ('x', '/y'), ('/camera', here),
        ('/camera_info', '/fogros2/planner/camera_info')],)
    # nothing of it stays, and what isn't loaded isn't looked at
    assert len(list(view.remappings)) == 2 and Loading.told[2] == []
    assert not [record for record in caplog.records if 'components were' in record.getMessage()]


def test_group_of_components_starts_their_streams(run, fake, planner, box, caplog):
    """Into a container that another group has; its streams are known when they are loaded."""
    ends_when_all_started(fake, 3)
    load = Loading(ComposableNode(package='demo', plugin='demo::View', name='view'))
    assert run(watched(
        fake, FogROSLaunchDescription, CloudGroup(planner, [box]),
        CloudGroup(planner, [load, load], stream_topics=[('/camera', 'h264')]))) == 0
    assert there(fake, 'planner') == ['camera_h264_decoder', 'own']
    assert here(fake) == ['camera_h264_encoder']
    assert Loading.told == 2 * ([
        ('/camera', '/fogros2/planner/camera'),
        ('/camera_info', '/fogros2/planner/camera_info')],)
    assert not [record for record in caplog.records if 'components were' in record.getMessage()]


def test_components_on_the_robot_have_streams_from_machines(run, fake, mapper):
    ends_when_all_started(fake, 3)
    load = Loading(ComposableNode(package='demo', plugin='demo::View', name='view'))
    description = watched(
        fake, LaunchDescription, talker(mapper), CloudGroup(
            ContainerInstance(name='here'), [load],
            stream_topics=[StreamTopic('/map', source=mapper), ('/camera', 'h264')]))
    here_too = OverrideMachines(Overrides(['here=robot']), [description])
    assert run(LaunchDescription([here_too])) == 0
    assert there(fake, 'mapper') == ['map_h264_encoder', 'own']
    assert here(fake) == ['map_h264_decoder_from_mapper']
    assert Loading.told == ([],)


@pytest.mark.parametrize('how', ['robot', 'replace'])
def test_components_that_move_have_the_robots_names(run, fake, box, watch, how):
    machine = ContainerInstance(
        name='planner', ros_workspace='', on_interrupt=how, deny_topics=['/costmap'])
    load = Loading(ComposableNode(package='demo', plugin='demo::View'))
    watch.at_start = {1: says(fake, 'lost', reason='evicted'), 2: end}
    assert run(LaunchDescription([*watch(), CloudGroup(machine, [box, RegisterEventHandler(
        OnProcessStart(target_action=box, on_start=[load]))])])) == 0
    assert Loading.told == ([('/costmap', '/fogros2/planner/costmap')], [])


@pytest.mark.parametrize('condition', ['true', 'false'])
def test_components_loaded_before_a_stream_are_named(
        run, fake, planner, caplog, box, condition):
    ends_when_all_started(fake, 4)
    assert run(watched(
        fake, FogROSLaunchDescription,
        CloudGroup(planner, [box, Loading(
            ComposableNode(package='demo', plugin='demo::View'),
            condition=IfCondition(condition))]),
        talker(planner, stream_topics=[('/camera', 'h264')]))) == 0
    said = [record.getMessage() for record in caplog.records
            if 'components were loaded before /camera, /camera_info' in record.getMessage()]
    assert len(said) == (condition == 'true')


def test_without_the_feature_its_keyword_is_unknown(run, fake, planner, monkeypatch):
    instead(monkeypatch, 'fogros2.feature', {})
    topics = [('/camera', 'h264')]
    with pytest.raises(ConfigurationError, match="a CloudNode has no 'stream_topics'"):
        talker(planner, stream_topics=topics)
    with pytest.raises(ConfigurationError, match='one machine, and the rest by keywords'):
        CloudNode(planner, topics, package='demo', executable='talker')
    fake.on_start = own_ends
    assert run(LaunchDescription([talker(planner)])) == 0


def test_group_without_processes_creates_no_machine(run, fake, planner):
    assert run(LaunchDescription([CloudGroup(planner, [
        Node(package='demo', executable='talker', condition=IfCondition('false'))])])) == 0
    assert fake.notes == [] and fake.report is None


def test_denied_and_limited_topics_are_renamed_on_their_machine(
        run, fake, mapper, box, caplog):
    """Programs pass the limited ones at both ends; components have the names too."""
    ends_when_all_started(fake, 4)
    limited = ContainerInstance(name='planner', ros_workspace='', deny_topics=['/costmap'],
                                limit_topics={'/tf': '20 Hz'})
    load = Loading(ComposableNode(package='demo', plugin='demo::View', name='view'))
    assert run(watched(
        fake, FogROSLaunchDescription, CloudGroup(limited, [box, load]), talker(mapper))) == 0
    assert there(fake, 'planner') == ['limits_planner', 'own']
    assert there(fake, 'mapper') == ['own'] and here(fake) == ['limits_planner']
    names = {'/costmap': '/fogros2/planner/costmap', '/tf': '/fogros2/planner/tf'}
    assert rules(fake, 'planner')[-2:] == [f'{old}:={new}' for old, new in names.items()]
    assert Loading.told == ([*names.items()],) and rules(fake, 'mapper') == []
    assert 'takes no ROS arguments' not in caplog.text


@pytest.mark.parametrize(('keyword', 'value'), [
    ('limit_topics', lambda topic: {topic: 5}), ('share', lambda topic: [topic])])
@pytest.mark.parametrize(('topic', 'streams'), [
    ('/seen', lambda planner: [StreamTopic('/seen', 'h264', source=planner)]),
    ('/camera_info', lambda planner: [StreamTopic('/camera', 'h264', camera_info=True)])])
def test_topic_of_a_stream_is_neither_limited_nor_shared(
        run, fake, capfd, keyword, value, topic, streams):
    """What a decoder publishes would be sent back; a relay would get the topic unencoded."""
    fake.on_start = own_ends
    own = ContainerInstance(name='planner', ros_workspace='', **{keyword: value(topic)})
    machine = ContainerInstance(name='mapper', ros_workspace='') if topic == '/seen' else own
    assert run(FogROSLaunchDescription([
        talker(own), talker(machine, stream_topics=streams(own))])) == 1
    place = 'share=' if keyword == 'share' else keyword
    assert f"{topic} can't be in {place} of 'planner'" in capfd.readouterr().out
    assert fake.noted('up') == []


@pytest.mark.parametrize('networks', [('', 'a'), ('a', ''), ('a', 'b'), ('a', 'a')])
def test_streams_between_machines_of_two_robots_are_refused(
        run, fake, planner, mapper, capfd, networks):
    fake.other_vpns = {name: OtherVpn(
        Peer(name, '', ''), VpnInterface('', '', network, 0, ''), VpnInterface('', '', '', 0, ''),
        0) for name, network in zip(('planner', 'mapper'), networks) if network}
    ends_when_all_started(fake, 4)
    refused = networks != ('a', 'a')
    assert run(watched(fake, FogROSLaunchDescription, talker(mapper), talker(
        planner, stream_topics=[StreamTopic('/map', source=mapper)]))) == refused
    words = "/map can't be streamed from 'mapper' to 'planner': machines of different robots"
    assert (words in capfd.readouterr().out) == refused
    assert bool(fake.noted('up')) != refused


def test_topic_of_replicas_is_neither_denied_nor_limited(run, fake, mapper, capfd):
    limited = ContainerInstance(name='planner', ros_workspace='', limit_topics={'/seen': 5})
    assert run(FogROSLaunchDescription([Replicated(
        machines=[limited, mapper], topics=[('/camera', '/seen')],
        actions=[Node(package='demo', executable='talker')])])) == 1
    assert "/seen can't be in deny_topics or limit_topics of 'planner'" in capfd.readouterr().out
    assert fake.noted('up') == []
