# SPDX-License-Identifier: Apache-2.0
"""Machines, nodes, groups and streams in XML and YAML: what they become, and what is refused."""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import io
from pathlib import Path
import re
from typing import Any, Optional, TYPE_CHECKING

from launch import LaunchContext, LaunchDescription
from launch.actions import OpaqueFunction, SetLaunchConfiguration
from launch.frontend import Parser
import pytest

from fogros2 import (
    AWSCloudInstance,
    CloudInstance,
    ContainerInstance,
    feature,
    JoinedMachine,
    KubeInstance,
    SSHInstance,
    StreamTopic,
)
from fogros2.actions.frontend.entity import complete
from fogros2.describe import keywords, values
from fogros2.errors import ConfigurationError, PrerequisiteError
from fogros2.runtime.coordinator import Coordinator
from fogros2_testing.plugins import instead
from rigs.launching import ends, Harmless

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.describe.machines import Bool, Value

CLASSES = {'aws': AWSCloudInstance, 'container': ContainerInstance, 'joined': JoinedMachine,
           'kubernetes': KubeInstance, 'ssh': SSHInstance}


class Other(Harmless):
    def encoder(self, stream):
        return dataclasses.replace(super().encoder(stream), name='back_other_encoder')


def load(text):
    """Return the description in a text of XML (it begins with <) or YAML."""
    kind = 'xml' if text.lstrip().startswith('<') else 'yaml'
    source = io.StringIO(text.strip())
    source.name = f'test.launch.{kind}'
    entity, parser = Parser.load(source)
    return parser.parse_description(entity)


def xml(text):
    return load(f'<launch>{text}</launch>')


def machine(description, **configurations):
    """Return the spec of the description's first machine."""
    context = LaunchContext()
    context.launch_configurations.update(configurations)
    return description.entities[0].machine.spec(context)


def refused(text):
    with pytest.raises(ConfigurationError) as error:
        xml(text) if text.lstrip().startswith('<') else load(text)
    return str(error.value)


# -- machines ------------------------------------------------------------------------------------

XML_MACHINE = """
  <fog_machine name="planner" provider="aws" region="nearest" ec2_instance_type="cheapest"
      disk_size="40" spot="true" min_memory_gb="7.5" gpu="L4" max_price="0.30"
      regions="eu-west-1, eu-west-2" ssh_from="[198.51.100.0/24]" instance_types="t3.large;t3.nano"
      instance_types-sep=";" on_exit="stop" lifetime="1h30m" robot_timeout="60"
      bandwidth="10Mbit/s"
      launch_foxglove="false" ros_workspace="">
    <tags name="team" value="slam"/>
    <tags name="cost" value="42"/>
    <environment name="RCUTILS_COLORIZED_OUTPUT" value="1"/>
  </fog_machine>"""

YAML_MACHINE = """
launch:
- fog_machine:
    name: planner
    provider: aws
    region: nearest
    ec2_instance_type: cheapest
    disk_size: 40
    spot: true
    min_memory_gb: 7.5
    gpu: L4
    max_price: 0.30
    regions: [eu-west-1, eu-west-2]
    ssh_from: ['198.51.100.0/24']
    instance_types: [t3.large, t3.nano]
    on_exit: stop
    lifetime: 1h30m
    robot_timeout: 60
    bandwidth: 10Mbit/s
    launch_foxglove: false
    ros_workspace: ''
    tags:
    - {name: team, value: slam}
    - {name: cost, value: '42'}
    environment:
    - {name: RCUTILS_COLORIZED_OUTPUT, value: '1'}
"""

PYTHON_MACHINE = {
    'name': 'planner', 'region': 'nearest', 'ec2_instance_type': 'cheapest', 'disk_size': 40,
    'spot': True, 'min_memory_gb': 7.5, 'gpu': 'L4', 'max_price': 0.30,
    'regions': ['eu-west-1', 'eu-west-2'], 'ssh_from': ['198.51.100.0/24'],
    'instance_types': ['t3.large', 't3.nano'], 'on_exit': 'stop', 'lifetime': '1h30m',
    'robot_timeout': 60, 'bandwidth': '10Mbit/s', 'launch_foxglove': False, 'ros_workspace': '',
    'tags': {'team': 'slam', 'cost': '42'}, 'environment': {'RCUTILS_COLORIZED_OUTPUT': '1'}}


@pytest.mark.parametrize('text', [f'<launch>{XML_MACHINE}</launch>', YAML_MACHINE])
def test_a_machine_is_the_one_that_python_makes(text):
    assert machine(load(text)) == AWSCloudInstance(**PYTHON_MACHINE).spec(LaunchContext())


def test_a_pod_s_tolerations_are_elements_of_their_own():
    found = machine(xml("""
      <fog_machine name="pod" provider="kubernetes" ros_workspace="" mcpu="500">
        <tolerations key="gpu" operator="Exists" effect="NoExecute" tolerationSeconds="30"/>
        <env name="A" value="b"/>
        <node_selector name="zone" value="$(var zone)"/>
      </fog_machine>"""), zone='z1')
    assert found == KubeInstance(
        name='pod', ros_workspace='', mcpu=500, env={'A': 'b'}, node_selector={'zone': 'z1'},
        tolerations=[{'key': 'gpu', 'operator': 'Exists', 'effect': 'NoExecute',
                      'tolerationSeconds': 30}]).spec(LaunchContext())


def test_a_value_for_each_region_is_an_element_each():
    text = '''<fog_machine name="planner" provider="aws" region="nearest" ros_workspace="">
        <ami_image name="us-west-1" value="ami-1"/><ami_image name="eu-west-1" value="$(var id)"/>
        </fog_machine>'''
    assert machine(xml(text), id='ami-2') == AWSCloudInstance(
        name='planner', region='nearest', ros_workspace='',
        ami_image={'us-west-1': 'ami-1', 'eu-west-1': 'ami-2'}).spec(LaunchContext())


#: A text, and the Python value it stands for, of each kind.
EXAMPLES = {'text': ('nearest', 'nearest'), 'number': ('2', 2), 'bool': ('true', True),
            'scalar': ('true', True), 'list': ('a,b', ['a', 'b']),
            'text or mapping': ('ami-1', 'ami-1')}
#: Where not every value will do.
CHOICES = {'on_exit': 'keep', 'bootstrap': 'apt', 'on_interrupt': 'robot', 'on_loss_after': '5m',
           'checkpoint': '$HOME/map', 'checkpoint_interval': '5m', 'max_replacements': '2',
           'bandwidth': '10Mbit/s', 'launch_budget': '$20',
           'name': 'planner', 'budget': '5 USD', 'idle_timeout': '5m', 'vpn_path': 'stream',
           'fetch_to': '/results', 'fetch_limit': '2GB', 'lifetime': '90s'}
LISTS = {'docker_containers': ('docker run a, docker run b', ['docker run a', 'docker run b']),
         'fetch': ('~/bags, /var/map', ['~/bags', '/var/map']),
         'record': ('/tf, /scan', ['/tf', '/scan']),
         'monitor_allow': ('198.51.100.0/28,::1', ['198.51.100.0/28', '::1']),
         'share': ('/map, /tf_static', ['/map', '/tf_static']),
         'deny_topics': ('/costmap, /rosout', ['/costmap', '/rosout']),
         'apt': ('libzbar0, g++', ['libzbar0', 'g++']),
         'pip': ('pyzbar==0.1.9, qrcode', ['pyzbar==0.1.9', 'qrcode'])}


@pytest.mark.parametrize('provider', sorted(CLASSES))
def test_keywords_are_attributes_and_take_substitutions(provider):
    needed = {'name': 'planner', 'ros_workspace': '', **(
        {'host': 'here'} if provider == 'ssh' else
        {'invitation': 'fog1.x'} if provider == 'joined' else {})}
    common = keywords.keywords(CloudInstance)
    for keyword in keywords.keywords(CLASSES[provider]).values():
        if keyword.kind in ('mapping', 'table') or (
                provider != 'container' and keyword.name in common):
            continue
        text, value = LISTS.get(keyword.name, EXAMPLES[keyword.kind])
        text = CHOICES.get(keyword.name, text)
        value = CHOICES.get(keyword.name, value)
        expected = CLASSES[provider](**{**needed, keyword.name: value}).spec(LaunchContext())
        for written in (text, '$(var it)'):
            attributes = ' '.join(
                f'{name}="{one}"' for name, one in {**needed, keyword.name: written}.items())
            found = machine(xml(f'<fog_machine provider="{provider}" {attributes}/>'), it=text)
            for spec in (found, expected):
                # what a substitution makes a text, the provider reads as such
                spec.options.update({
                    name: option if isinstance(option, list) else str(option).lower()
                    for name, option in spec.options.items()})
            plain, wanted = ([(name, feature.options(name, given)) for name, given in
                              spec.features.items()] for spec in (found, expected))
            assert plain == wanted, keyword.name
            assert dataclasses.replace(found, features=expected.features) == expected, keyword.name


def test_limits_of_topics_are_elements():
    found = machine(xml("""
      <fog_machine name="planner" provider="container" ros_workspace="" deny_topics="/costmap">
        <limit_topics name="/tf" value="$(var rate)"/>
      </fog_machine>"""), rate='20 Hz')
    policy = feature.options('streams', found.features['streams'])
    assert (policy.denied, policy.limits) == (('/costmap',), {'/tf': 20.0})


def test_container_on_another_computer():
    expected = ContainerInstance(
        name='planner', ros_workspace='', memory='2g', on={'host': 'gpu-box', 'port': '2222'},
    ).spec(LaunchContext())
    assert expected.provider == 'hosted'
    assert machine(xml("""
      <fog_machine name="planner" provider="container" ros_workspace="" memory="2g">
        <on name="host" value="$(var box)"/>
        <on name="port" value="2222"/>
      </fog_machine>"""), box='gpu-box') == expected


def test_the_provider_may_be_a_substitution(run, fake, monkeypatch):
    instead(monkeypatch, 'fogros2.machine', {
        **CLASSES, 'nosdk': PrerequisiteError('no module fancysdk')})
    there = {}
    description = load("""
launch:
- fog_machine: {name: $(var name), provider: $(var provider), ros_workspace: '', host: $(var host),
                memory: 2g}
""")
    run(LaunchDescription([
        *(SetLaunchConfiguration(*pair) for pair in (
            ('name', 'planner'), ('provider', 'container'), ('host', ''))),
        *description.entities,
        OpaqueFunction(function=lambda context: there.update(
            spec=Coordinator.of(context)._by_name('planner').spec(context)))]))
    assert there['spec'] == ContainerInstance(
        name='planner', memory='2g', ros_workspace='').spec(LaunchContext())


@pytest.mark.parametrize('text, expected', [
    ('<fog_machine name="p" provider="awz"/>',
     ["there is no provider 'awz'", "did you mean 'aws'", 'container']),
    ('<fog_machine name="p"/>',
     ['needs a provider', 'aws, azure, cheapest, container, gcp, joined, kubernetes, robot, ssh']),
    ('<fog_machine provider="aws"/>', ['needs a name']),
    ('<fog_machine name="p" provider="aws" on_exit="go"/>', ['p: ']),
    ('<fog_machine name="p" provider="ssh"/>', ["provider 'ssh' needs host"]),
    ('<fog_machine name="p" provider="aws" regoin="x"/>',
     ["provider 'aws'", "'regoin'", "did you mean 'region'"]),
    ('<fog_machine name="p" provider="aws"><tag name="a" value="b"/></fog_machine>',
     ["'tag'", "did you mean 'tags'"]),
    ('<fog_machine name="p" provider="aws"><tags nmae="a" value="b"/></fog_machine>',
     ["tags has no 'nmae'", "did you mean 'name'"]),
    ('<fog_machine name="p" provider="aws"><tags name="a"/></fog_machine>', ['a name', 'a value']),
    ('<fog_machine name="p" provider="aws" spot="perhaps"/>', ['spot:', 'neither true nor false']),
    ('<fog_machine name="p" provider="aws" disk_size="large"/>', ['p: disk_size:', 'no number']),
    ('<fog_machine name="p" provider="aws"><docker_container/></fog_machine>',
     ['a cmd, or an image']),
    ('<fog_machine name="p" provider="aws"><docker_container imag="a"/></fog_machine>',
     ["docker_container has no 'imag'", "did you mean 'image'"]),
    ('<fog_machine name="p" provider="aws"><docker_container cmd="docker run a" name="b"/>'
     '</fog_machine>', ['a cmd, or an image']),
    ('<fog_machine name="p" provider="kubernetes"><tolerations kye="a"/></fog_machine>',
     ["tolerations has no 'kye'", "did you mean 'key'"]),
    ('launch: [{fog_machine: {name: p, provider: aws, spot: 3}}]', ["spot can't be 3",
                                                                    'true or false']),
    ('launch: [{fog_machine: {name: p, provider: aws, region: [a]}}]', ["can't be ['a']"]),
    ('launch: [{fog_machine: {name: p, provider: aws, regions: [1]}}]', ["can't be [1]"]),
    ('launch: [{fog_machine: {name: p, provider: aws, region: {a: b}}}]', ["'region' is no"]),
    ('launch: [{fog_machine: {name: p, provider: aws, tags: {a: b}}}]', ['no list of elements']),
    ('launch: [{fog_machine: {name: p, provider: aws, on: [{name: host, value: b}]}}]',
     ["write 'on' in quotes"]),
    ('<fog_machine name="p" provider="aws" environment="A=1"/>',
     ['no list of elements', '<environment name="..." value="..."/>']),
    ('launch: [{cloud_node: {machine: p, pkg: a, exec: b, stream_topic: {topic: /a}}}]',
     ['no list of elements', '- {...} in YAML']),
    ('<cloud_node pkg="demo" exec="talker"/>', ['needs a machine', 'fog_machine']),
    ('<cloud_node machine="p" pkg="demo" exec="talker" respwan="true"/>',
     ["cloud_node has no 'respwan'", "did you mean 'respawn'"]),
    ('<cloud_group><node pkg="demo" exec="talker"/></cloud_group>', ['needs a machine']),
    ('<cloud_group machine="p" scopde="true"/>', ["did you mean 'scoped'"]),
    ('<stream_topic transport="h264"/>', ['needs a topic']),
    ('<stream_topic topic="/a" bitrate="3"/>', ["stream_topic has no 'bitrate'"]),
    ('<stream_topic topic="/a"><param name="bitrate"/></stream_topic>', ['a name', 'value']),
    ('<stream_topic topic="/a"><param name="topic" value="/b"/></stream_topic>', ['a name']),
    ('<fogros_launch robot_nodes="never"/>', ["robot_nodes='never' is unknown"]),
    ('<cloud_group machine="p"><stream_topic topic="/a" if="true"/></cloud_group>',
     ['/a', 'condition']),
])
def test_what_is_wrong_is_refused_with_a_word_on_what_is_right(text, expected):
    said = refused(text)
    for word in expected:
        assert word in said, said


def test_late_mistake_ends_before_any_machine(run, fake):
    description = xml('<arg name="size" default="large"/>'
                      '<fog_machine name="p" provider="aws" disk_size="$(var size)"/>')
    assert run(description) == 1
    assert fake.notes == []


# -- nodes, groups, streams ----------------------------------------------------------------------

XML_LAUNCH = """
<launch>
  <arg name="machine" default="planner"/>
  <fog_machine name="$(var machine)" provider="container" ros_workspace=""/>
  <cloud_node machine="$(var machine)" pkg="demo" exec="talker" name="one" exec_name="first"
      namespace="up" args="--fast" output="screen" respawn="false">
    <param name="rate" value="3"/>
    <remap from="chatter" to="/talk"/>
    <env name="COLOUR" value="$(var machine)"/>
    <stream_topic topic="camera">
      <param name="bitrate" value="$(eval '2 * 1000000')"/>
    </stream_topic>
  </cloud_node>
  <cloud_group machine="$(var machine)">
    <stream_topic topic="/back" direction="to_robot" transport="other"/>
    <push_ros_namespace namespace="group"/>
    <node pkg="demo" exec="talker" exec_name="second"/>
  </cloud_group>
</launch>"""

def test_nodes_groups_and_streams_run_on_the_machine(run, fake, monkeypatch):
    """The examples, of which some have groups, are the same plan in YAML."""
    instead(monkeypatch, 'fogros2.image_transport', {'h264': Harmless, 'other': Other})

    fake.on_start = ends
    assert run(load(XML_LAUNCH)) == 0
    there = {spec.name.rpartition('-')[0] or spec.name: spec
             for spec in fake.machines['planner'].all}
    first, second = there['first'], there['second']
    assert first.arguments[0] == '--fast'
    assert '__node:=one' in first.arguments and '__ns:=/up' in first.arguments
    assert first.environment['COLOUR'] == 'planner'
    assert 'chatter:=/talk' in first.arguments
    assert any('rate' in str(content) for content in first.files.values())
    assert '/up/camera:=/fogros2/planner/up/camera' in first.arguments
    assert '__ns:=/group' in second.arguments
    assert 'image:=/fogros2/planner/up/camera' in there['up_camera_h264_decoder'].arguments
    assert 'image:=/fogros2/planner/back' in there['back_other_encoder'].arguments


def test_fogros_launch_has_settings_of_the_whole_launch(run, fake):
    coordinators = []
    description = xml("""
      <arg name="when" default="immediately"/>
      <arg name="vendor" default="cyclonedds"/>
      <fog_machine name="planner" provider="container" ros_workspace=""/>
      <fogros_launch robot_nodes="$(var when)" dds="$(var vendor)">
        <stream_topic topic="/camera"/>
        <cloud_node machine="planner" pkg="demo" exec="talker"/>
      </fogros_launch>
      <stream_topic topic="/other" if="$(eval '1 == 2')"/>
      <stream_topic topic="/third"/>""")
    description.add_action(OpaqueFunction(
        function=lambda context: coordinators.append(Coordinator.of(context))))
    fake.on_start = lambda machine, node: machine.say(
        'exited', node, returncode=0, respawns=False)
    assert run(description) == 0
    (coordinator,) = coordinators
    streams = coordinator.parts._parts['stream_topics']
    assert [entries for entries, _ in streams._everywhere] == [
        [StreamTopic('/camera')], [StreamTopic('/third')]]
    assert coordinator.gate is None, 'robot nodes wait'
    assert ('dds', 'cyclonedds') in fake.notes


def test_of_two_machines_of_one_name_the_condition_chooses(run, fake):
    description = xml("""
      <arg name="where" default="b"/>
      <fogros_launch>
        <fog_machine name="planner" provider="container" memory="1g" ros_workspace=""
            if="$(eval '&quot;$(var where)&quot; == &quot;a&quot;')"/>
        <fog_machine name="planner" provider="container" memory="2g" ros_workspace=""
            if="$(eval '&quot;$(var where)&quot; == &quot;b&quot;')"/>
        <cloud_node machine="planner" pkg="demo" exec="talker"/>
      </fogros_launch>""")
    fake.on_start = lambda machine, node: machine.say(
        'exited', node, returncode=0, respawns=False)
    assert run(description) == 0
    assert fake.machines['planner'].spec.options == {'memory': '2g'}


def test_docker_containers_of_a_machine(run, fake):
    there = []
    description = xml("""
      <arg name="image" default="redis"/>
      <fog_machine name="planner" provider="container" ros_workspace="">
        <docker_container cmd="docker run --rm $(var image)"/>
        <docker_container image="$(var image)" name="db" ports="1:2, 3:4" command="serve --fast">
          <environment name="A" value="b $(var image)"/>
        </docker_container>
      </fog_machine>""")
    description.add_action(OpaqueFunction(function=lambda context: there.append(
        Coordinator.of(context)._by_name('planner').spec(context))))
    assert run(description) == 0
    assert there[0].features == {'containers': {'docker_containers': [
        'docker run --rm redis',
        "docker run -p 1:2 -p 3:4 -e 'A=b redis' --name db redis serve --fast"]}}
    assert there[0].options['containers']


# -- machines of others --------------------------------------------------------------------------

class Mine(CloudInstance):
    provider = 'mine'

    def __init__(self, size: Value, *, fast: Optional[Bool] = None,
                 places: Optional[Sequence[SomeSubstitutionsType]] = None, **common: Any) -> None:
        super().__init__(options={
            'size': size, 'fast': fast, 'places': values.items(places)}, **common)


class Unclear(Mine):
    provider = 'unclear'

    def __init__(self, size: NobodyKnows, **common: Any) -> None:  # noqa: F821
        super().__init__(size, **common)


def test_provider_of_another_package_has_attributes(monkeypatch):
    instead(monkeypatch, 'fogros2.machine', {'mine': Mine, 'unclear': Unclear})
    found = machine(xml('<fog_machine name="p" provider="mine" size="3" fast="true" places="a,b" '
                        'ros_workspace=""/>'))
    assert (found.provider, found.options) == (
        'mine', {'size': 3, 'fast': True, 'places': ['a', 'b']})
    assert 'needs size' in refused('<fog_machine name="p" provider="mine"/>')
    assert 'NobodyKnows' in refused('<fog_machine name="p" provider="unclear" size="3"/>')


# -- the documentation ---------------------------------------------------------------------------

DOCUMENT = (Path(__file__).parents[2] / 'doc' / 'launch_xml_yaml.md').read_text()


def test_the_documentation_names_every_element():
    Parser.load_launch_extensions()
    from launch.frontend.expose import action_parse_methods
    assert {name for name, parse in action_parse_methods.items()
            if parse.__module__.startswith('fogros2')} == set(
                re.findall(r'^\| `(\w+)` \| `', DOCUMENT, re.MULTILINE))


def test_name_that_an_older_launch_ros_does_not_read():
    element, _ = Parser.load(io.StringIO('<node name="a" exec_nmae="b"/>'))
    element.get_attr('name')
    with pytest.raises(ConfigurationError) as caught:
        complete(element, ['exec_nmae', 'exec_name', 'name'])
    assert str(caught.value) == "node has no 'exec_nmae' (did you mean 'exec_name'?)"
