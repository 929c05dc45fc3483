# SPDX-License-Identifier: Apache-2.0
"""``machine=`` on launch_ros's nodes: in Python, and below ``<fogros_launch>``."""

from __future__ import annotations

from argparse import Namespace
from concurrent.futures import ThreadPoolExecutor
import dataclasses
import io
import threading

from launch import LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    GroupAction,
    IncludeLaunchDescription,
    RegisterEventHandler,
    TimerAction,
)
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessStart
from launch.events import matches_action
from launch.events.process import ShutdownProcess
from launch.frontend import expose, Parser
from launch.launch_description_sources import AnyLaunchDescriptionSource
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
import launch_ros.actions
from launch_ros.descriptions import ComposableNode
import pytest

from fogros2 import (
    CloudGroup,
    CloudNode,
    ComposableNodeContainer,
    FogROSLaunchDescription,
    LifecycleNode,
    Node,
    plugin_system,
)
from fogros2.actions.launch_description import holder
from fogros2.actions.override import OverrideMachines
from fogros2.describe.overrides import Overrides
from fogros2.errors import ConfigurationError, ShellError
from fogros2.feature import Feature, LaunchPart
from fogros2.model import NodeSpec
from fogros2.runtime.added_process import AddedProcess
from fogros2.runtime.session import Session
from fogros2_testing.plugins import instead
from rigs.launching import ends, Harmless
from ros2fog_cli.option.machine import MachineOption

KINDS = [Node, LifecycleNode, ComposableNodeContainer]


@pytest.fixture
def streams(monkeypatch):
    instead(monkeypatch, 'fogros2.image_transport', {'h264': Harmless})


def node(cls=Node, **kwargs):
    if cls is not Node:
        kwargs = {'name': 'arm', 'namespace': '', **kwargs}
    return cls(package='demo', executable='talker', **kwargs)


def started(fake):
    """Return machine and process of what was started on machines."""
    return sorted((machine, name.rpartition('-')[0] or name)
                  for machine, name in fake.noted('start'))


def stops(action):
    """Return an event handler that ends a process as soon as it runs."""
    return RegisterEventHandler(OnProcessStart(target_action=action, on_start=[
        EmitEvent(event=ShutdownProcess(process_matcher=matches_action(action)))]))


# -- without a machine ---------------------------------------------------------------------------

@pytest.mark.parametrize('cls', KINDS)
@pytest.mark.parametrize('none', [{}, {'machine': None}])
def test_node_without_machine_is_a_launch_ros_node(run, fake, cls, none):
    plain = node(cls, **none)
    assert isinstance(plain, getattr(launch_ros.actions, cls.__name__))
    assert not holder(plain)
    assert run(LaunchDescription([plain, stops(plain)])) == 0
    assert plain.return_code == -2
    assert fake.notes == [] and fake.report is None
    assert 'fogros2' not in str(plain.process_details['env'].get('CYCLONEDDS_URI'))


@pytest.mark.parametrize('option', [
    {'image': 'ros:jazzy'}, {'stream_topics': [('/camera', 'h264')]}])
def test_machine_option_without_machine_is_refused(option):
    with pytest.raises(ConfigurationError, match=f'{next(iter(option))}= of a node is for a mach'):
        node(**option)


# -- with one ------------------------------------------------------------------------------------

@pytest.mark.parametrize('cls', KINDS)
def test_node_runs_on_its_machine(run, fake, planner, cls):
    fake.on_start = ends
    away = node(cls, machine=planner)
    assert isinstance(away, cls)
    assert isinstance(away, getattr(launch_ros.actions, cls.__name__))
    seen = []
    assert run(LaunchDescription([
        RegisterEventHandler(OnProcessStart(
            target_action=away, on_start=lambda event, context: seen.append(
                (event.pid, context.environment['RMW_IMPLEMENTATION'])))),
        away])) == 0
    assert started(fake) == [('planner', 'talker')] and seen == [(4001, 'rmw_fastrtps_cpp')]


def test_timed_node_has_namespace_and_remappings_of_its_group(run, fake, planner):
    fake.on_start = ends
    assert run(LaunchDescription([GroupAction([
        launch_ros.actions.PushROSNamespace('front'), launch_ros.actions.SetRemap('a', 'b'),
        TimerAction(period=0.05, actions=[node(machine=planner)])])])) == 0
    [sent] = fake.machines['planner'].all
    assert {'__ns:=/front', 'a:=b'} <= {*sent.arguments}


@pytest.mark.parametrize('name', [
    'planner', LaunchConfiguration('which'), ['plan', LaunchConfiguration('half')]])
def test_a_machine_is_named_by_text_or_substitution(run, fake, planner, name):
    fake.on_start = ends
    assert run(FogROSLaunchDescription([
        DeclareLaunchArgument('which', default_value='planner'),
        DeclareLaunchArgument('half', default_value='ner'),
        CloudNode(machine=planner, package='demo', executable='talker'),
        node(machine=name, exec_name='named')])) == 0
    assert started(fake) == [('planner', 'named'), ('planner', 'talker')]


@pytest.mark.parametrize('cls', KINDS)
def test_machine_overridden_by_the_robot_is_not_created(run, fake, planner, cls):
    here = node(cls, machine=planner)
    assert run(LaunchDescription([OverrideMachines(
        Overrides(['planner=robot']), [here, stops(here)])])) == 0
    assert here.return_code == -2
    assert fake.noted('up') == []


def test_components_of_a_container_know_the_streams(
        run, fake, planner, monkeypatch, streams):
    loaded = []

    def execute(loading, context):
        (component,) = vars(loading)['_LoadComposableNodes__composable_node_descriptions']
        loaded.extend((old[0].text, new[0].text) for old, new in component.remappings)

    monkeypatch.setattr(launch_ros.actions.LoadComposableNodes, 'execute', execute)
    fake.on_start = ends
    view = ComposableNode(package='demo', plugin='demo::View', name='view', namespace='',
                          remappings=[('image', '/map')])
    assert run(LaunchDescription([ComposableNodeContainer(
        machine=planner, package='demo', executable='talker', name='box', namespace='',
        composable_node_descriptions=[view], stream_topics=[('/map', 'h264')],
        exec_name='box')])) == 0
    assert ('image', '/fogros2/planner/map') in loaded
    assert ('planner', 'box') in started(fake)


@pytest.mark.parametrize(('domain', 'warned'), [('100', 0), ('101', 1)])
def test_node_whose_dds_the_filter_drops_is_reported(
        run, fake, planner, caplog, domain, warned):
    fake.on_start = ends
    local = launch_ros.actions.Node(
        package='demo', executable='talker', additional_env={'ROS_DOMAIN_ID': domain})
    assert run(LaunchDescription([node(machine=planner), stops(local), local])) == 0
    assert caplog.text.count('has another ROS_DOMAIN_ID than the launch') == warned
    assert caplog.text.count('at the beginning of the launch file') == warned


def test_a_machine_of_another_type_is_refused():
    for cls in (Node, CloudNode):
        with pytest.raises(ConfigurationError, match='machine=7 is no machine'):
            node(machine=7) if cls is Node else cls(7, package='demo', executable='talker')
    with pytest.raises(ConfigurationError, match='machine=None is no machine'):
        CloudGroup(None, [])


def test_an_unknown_keyword_gets_the_nearest_name(planner):
    topics = [('/camera', 'h264')]
    for make in (lambda: node(machine=planner, stream_topic=topics),
                 lambda: CloudNode(planner, executable='talker', stream_topic=topics),
                 lambda: CloudGroup(planner, [], stream_topic=topics),
                 lambda: FogROSLaunchDescription(stream_topic=topics)):
        with pytest.raises(ConfigurationError) as error:
            make()
        assert "has no 'stream_topic' (did you mean 'stream_topics'?)" in str(error.value)
    with pytest.raises(ConfigurationError, match="did you mean 'namespace'"):
        node(machine=planner, namspace='/up')


# -- XML and YAML --------------------------------------------------------------------------------

MACHINE = '<fog_machine name="planner" provider="container" ros_workspace=""/>'
TALKER = '<node machine="planner" pkg="demo" exec="talker" exec_name="{}"/>'


def load(text, name='test.launch.xml'):
    source = io.StringIO(text)
    source.name = name
    entity, parser = Parser.load(source)
    return parser.parse_description(entity)


def fogros_launch(text, machine=MACHINE):
    return load(f'<launch><fogros_launch>{machine}{text}</fogros_launch></launch>')


@pytest.mark.parametrize('text', [
    TALKER.format('one'),
    f'<group>{TALKER.format("one")}</group>',
    f'<group if="true"><group>{TALKER.format("one")}</group></group>',
    f'<timer period="0.01">{TALKER.format("one")}</timer>',
    f'<cloud_group machine="other">{TALKER.format("one")}</cloud_group>',
    f'<fogros_launch>{TALKER.format("one")}</fogros_launch>',
    '<let name="which" value="planner"/>'
    '<node machine="$(var which)" pkg="demo" exec="talker" exec_name="one"/>',
    '<node machine="planner" pkg="demo" exec="talker" exec_name="zero" if="false"/>'
    '<node machine="planner" pkg="demo" exec="talker" exec_name="one" unless="false"/>',
    '<node_container machine="planner" pkg="demo" exec="talker" exec_name="one" name="box" '
    'namespace=""><composable_node pkg="demo" plugin="demo::View" name="view" if="false"/>'
    '</node_container>',
    '<lifecycle_node machine="planner" pkg="demo" exec="talker" exec_name="one" name="box" '
    'namespace="" autostart="false"/>',
])
def test_machine_on_an_element_anywhere_below(run, fake, text):
    fake.on_start = ends
    assert run(fogros_launch(text)) == 0
    assert started(fake) == [('planner', 'one')]


def test_xml_node_takes_the_settings_of_a_cloud_node(run, fake, streams):
    fake.on_start = ends
    assert run(fogros_launch('''
      <node machine="planner" pkg="demo" exec="talker" exec_name="one" image="ros:jazzy"
            image_options="--gpus=all, --ipc=host">
        <stream_topic topic="/map" transport="h264"/>
        <param name="rate" value="3"/>
      </node>''', MACHINE.replace('/>', ' containers="true"/>'))) == 0
    (spec,) = [spec for spec in fake.machines['planner'].all if spec.features]
    assert spec.features == {'containers': {
        'image': 'ros:jazzy', 'image_options': ['--gpus=all', '--ipc=host']}}
    assert '/map:=/fogros2/planner/map' in spec.arguments


@pytest.mark.parametrize('where', ['xml', 'yaml', 'xml in xml', 'xml in python'])
def test_included_files_take_machine_on_a_node(run, fake, tmp_path, where):
    fake.on_start = ends
    (tmp_path / 'inner.launch.xml').write_text(f'<launch>{TALKER.format("one")}</launch>')
    (tmp_path / 'inner.launch.yaml').write_text(
        'launch: [{node: {machine: planner, pkg: demo, exec: talker, exec_name: one}}]')
    (tmp_path / 'middle.launch.xml').write_text(
        '<launch><group><include file="$(dirname)/inner.launch.xml"/></group></launch>')
    (tmp_path / 'middle.launch.py').write_text('''
from pathlib import Path

from launch import LaunchDescription
from launch.actions import GroupAction, IncludeLaunchDescription
from launch.conditions import IfCondition


def generate_launch_description():
    inner = str(Path(__file__).with_name('inner.launch.xml'))
    return LaunchDescription([GroupAction(
        [IncludeLaunchDescription(inner)], condition=IfCondition('true'))])
''')
    name = {'xml': 'inner.launch.xml', 'yaml': 'inner.launch.yaml',
            'xml in xml': 'middle.launch.xml', 'xml in python': 'middle.launch.py'}[where]
    assert run(fogros_launch(f'<group><include file="{tmp_path}/{name}"/></group>')) == 0
    assert started(fake) == [('planner', 'one')]


def test_arguments_of_included_files_stay_visible(tmp_path):
    (tmp_path / 'inner.launch.xml').write_text(
        f'<launch><arg name="rate" default="1"/>{TALKER.format("one")}</launch>')
    description = fogros_launch(f'<include file="{tmp_path}/inner.launch.xml"/>')
    assert [argument.name for argument in description.get_launch_arguments()] == ['rate']


@pytest.mark.parametrize(('text', 'said'), [
    ('<node machine="" pkg="demo" exec="talker"/>', 'a node needs a machine'),
    ('<node machine="planner" pkg="demo" exec="talker" imag="a"/>', "did you mean 'image'?"),
])
def test_a_wrong_attribute_is_refused_when_read(text, said):
    with pytest.raises(ConfigurationError) as error:
        fogros_launch(text)
    assert said in str(error.value)


def test_a_node_without_machine_stays_launch_ros_s_in_xml():
    (description,) = load(
        '<launch><fogros_launch><node pkg="demo" exec="talker"/></fogros_launch></launch>',
    ).entities
    (plain,) = description.get_sub_entities()
    assert type(plain) is launch_ros.actions.Node


# -- other launch files --------------------------------------------------------------------------

ONLY_BELOW = 'node takes a machine only below fogros_launch .* or write cloud_node instead'


def fails(text):
    with pytest.raises(ConfigurationError, match=ONLY_BELOW):
        load(f'<launch>{text}</launch>')


@pytest.fixture
def registry():
    """Hold launch's table of elements against what it was before the test."""
    Parser.load_launch_extensions()
    before = dict(expose.action_parse_methods)
    yield
    assert expose.action_parse_methods == before
    assert expose.action_parse_methods['node'].__wrapped__ == launch_ros.actions.Node.parse


def test_machine_is_for_fogros_launch_alone(registry, tmp_path):
    talker = TALKER.format('one')
    fails(talker)
    fogros_launch(talker)
    fails(talker)
    # beside it in one file, too
    fails(f'<fogros_launch>{MACHINE}{talker}</fogros_launch>{talker}')
    # and in a file that is included elsewhere
    (tmp_path / 'inner.launch.xml').write_text(f'<launch>{talker}</launch>')
    source = AnyLaunchDescriptionSource(str(tmp_path / 'inner.launch.xml'))
    IncludeLaunchDescription(source)
    with pytest.raises(Exception, match=ONLY_BELOW):
        source.get_launch_description(LaunchContext())


@pytest.mark.parametrize(('text', 'said'), [
    ('<lifecycle_node machine="p" pkg="a" exec="b" name="c" namespace=""/>',
     'lifecycle_node takes a machine only below fogros_launch'),
    ('<executable cmd="a" machine="p"/>', 'executable takes no machine .put it into a cloud_gro'),
    ('<load_composable_node target="a" machine="p"/>', 'load_composable_node takes no machine'),
    ('<group machine="p"/>', 'group takes no machine .write cloud_group'),
    ('<include file="a" machine="p"/>', 'include takes no machine .put it into a cloud_group')])
def test_element_given_a_machine_says_which_takes_one(registry, text, said):
    with pytest.raises(ConfigurationError, match=said):
        load(f'<launch>{text}</launch>')


class Derived(launch_ros.actions.Node):
    pass


@pytest.mark.parametrize(('cls', 'kwargs', 'said'), [
    (launch_ros.actions.Node, {'executable': 'a'}, r'Node of launch_ros\S* takes no machine '
     r'\(use the Node of fogros2: from fogros2 import Node\)'),
    (Derived, {'executable': 'a'}, 'Derived of .* from fogros2 import Node'),
    (launch_ros.actions.ComposableNodeContainer,
     {'executable': 'a', 'name': 'b', 'namespace': ''},
     'from fogros2 import ComposableNodeContainer'),
    (GroupAction, {'actions': []}, r'GroupAction of launch\S* .*CloudGroup\(machine, '),
    (IncludeLaunchDescription, {'launch_description_source': 'a'}, r'.*CloudGroup\(machine, ')])
def test_action_given_a_machine_says_what_to_import(planner, cls, kwargs, said):
    option = MachineOption()
    option.prestart(Namespace(machine=[]))
    with pytest.raises(ConfigurationError, match=said):
        cls(machine=planner, **kwargs)


@pytest.mark.parametrize('wrong', [
    '<node machine="planner" pkg="demo"/>', '<nod machine="planner"/>', '<fog_machine/>'])
def test_unreadable_launch_file_changes_nothing(registry, wrong):
    with pytest.raises(Exception, match='.'):
        fogros_launch(wrong)
    fails(TALKER.format('one'))


def test_files_are_read_in_several_threads(registry):
    talker = TALKER.format('one')
    with ThreadPoolExecutor(8) as pool:
        for each in [pool.submit(read, talker) for read in 50 * (fogros_launch, fails)]:
            each.result()


def test_home_of_the_robot_is_mentioned_once(run, fake, planner, monkeypatch, capfd):
    monkeypatch.setenv('HOME', '/home/me')
    fake.on_start = lambda machine, node: machine.say(
        'exited', node, returncode=0, respawns=False)
    nodes = [CloudNode(machine=planner, package='demo', executable='talker',
                       arguments=[EnvironmentVariable('HOME'), '/maps']) for _ in range(2)]
    assert run(LaunchDescription(nodes)) == 0
    said = capfd.readouterr().out
    assert said.count('/home/me of this robot, as launch resolves $(env HOME)') == 1
    assert 'name a path of the machine' in said


def test_home_of_the_robot_in_a_component_is_mentioned(
        run, fake, planner, monkeypatch, capfd, tmp_path):
    monkeypatch.setenv('HOME', '/home/me')
    monkeypatch.setattr(launch_ros.actions.LoadComposableNodes, 'execute', lambda *_: None)
    (tmp_path / 'p.yaml').write_text('/**:\n  ros__parameters:\n    a: /home/me/b\n')
    fake.on_start = ends
    some = [ComposableNode(
        package='demo', plugin='demo::Map', name=name, condition=IfCondition(loaded),
        parameters=[str(tmp_path / 'p.yaml'), {'map': [EnvironmentVariable('HOME'), '/', name]}])
        for name, loaded in (('one', 'true'), ('two', 'false'))]
    assert run(LaunchDescription([CloudGroup(planner, [
        launch_ros.actions.Node(package='demo', executable='talker', name='box'),
        launch_ros.actions.LoadComposableNodes(
            target_container='/box', composable_node_descriptions=some)])])) == 0
    said = capfd.readouterr().out
    assert 'planner: one gets /home/me/b, /home/me/one of this robot' in said
    assert 'two' not in said


# -- programs of features ------------------------------------------------------------------------

def test_program_beside_nodes_starts_as_its_feature_says(run, fake, planner, monkeypatch):
    program = NodeSpec(
        'x', 'beside', 'demo', 'talker', ('a',), prefix=('nice', '-n', 'two words'), cwd='/srv',
        environment={'A': 'b'}, emulate_tty=True, respawn=True, respawn_max_retries=2,
        passes_signals=True)

    class Beside(Feature):
        always = True

        def beside(self, spec, own):
            return [program]

    def on_start(machine, node):
        for each in machine.all if len(machine.all) == 2 else ():
            machine.say('exited', each, returncode=0, respawns=False)

    instead(monkeypatch, 'fogros2.feature', {'beside': Beside})
    fake.on_start = on_start
    assert run(LaunchDescription([node(machine=planner)])) == 0
    (started,) = (each for each in fake.machines['planner'].all if each.arguments == ('a',))
    assert dataclasses.replace(started, id='x', name='beside') == program


def test_two_features_with_a_session_are_refused(run, fake, planner, monkeypatch, capfd):
    class Mine(Feature):
        always = True

        def session(self, own):
            return Session

    instead(monkeypatch, 'fogros2.feature', {'mine': Mine, 'more': Mine})
    assert run(LaunchDescription([node(machine=planner)])) == 1
    assert "several features want to handle the events of 'planner'" in ''.join(capfd.readouterr())
    assert not fake.noted('up')


@pytest.mark.parametrize('error', [ShellError('no rows'), KeyError('oops')])
def test_watch_of_a_feature_that_fails_is_reported(
    run, fake, planner, monkeypatch, capfd, error,
):
    failed = threading.Event()

    class Part(LaunchPart):
        def watch(self):
            failed.set()
            raise error

    class Watching(Feature):
        def in_launch(self, launch):
            return Part()

    instead(monkeypatch, 'fogros2.feature', {'watching': Watching})
    fake.on_start = lambda machine, node: (
        failed.wait(60), machine.say('exited', node, returncode=0, respawns=False))
    assert run(LaunchDescription([node(machine=planner)])) == 0
    assert f'watch of {__name__} failed' in (said := ''.join(capfd.readouterr()))
    assert plugin_system.cause(error) in said


@pytest.mark.parametrize('field', [{'files': {'f': 'x'}}, {'folders': {'PATH': '/'}},
                                   {'shell': True}])
def test_program_with_a_field_that_gets_lost_is_refused(field):
    with pytest.raises(ConfigurationError, match=f"'beside' of a feature has {[*field][0]}"):
        AddedProcess(NodeSpec('x', 'beside', 'demo', 'talker', **field))
