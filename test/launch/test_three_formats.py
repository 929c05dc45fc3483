# SPDX-License-Identifier: Apache-2.0
"""Examples that exist in Python, XML and YAML: the three are one plan."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from launch import LaunchDescription
from launch.actions import ExecuteLocal, IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import AnyLaunchDescriptionSource
import pytest
import yaml

from fogros2.launch_internals import private
from fogros2.runtime import added_process
from fogros2.runtime.coordinator import Coordinator

FOLDER = Path(__file__).parents[2] / 'fogros2_examples' / 'launch'
EXAMPLES = {
    'talker.container': {'name': 'other', 'on_exit': 'stop', 'network': 'net', 'count': '7'},
    'two_clouds': {'name': 'one', 'second_name': 'two', 'on_exit': 'keep', 'network': 'net',
                   'count': '7'},
    'video.container': {'name': 'other', 'source': '/dev/null', 'count': '7'},
}


@dataclasses.dataclass
class Plan:
    """What a launch asks for, without what differs from run to run."""

    machines: dict = dataclasses.field(default_factory=dict)
    nodes: list = dataclasses.field(default_factory=list)
    streams: list = dataclasses.field(default_factory=list)
    robot: list = dataclasses.field(default_factory=list)


@pytest.fixture
def plan(run, fake, monkeypatch):
    """Return a function that plans a launch file: its machines are air, the robot runs nothing."""
    found = Plan()
    waited = []

    async def stay(action, context):
        if not isinstance(action, added_process.AddedProcess):
            found.robot.append((*words(action.process_details['cmd']), required(action)))
        private.completed(action).set_result(None)

    def on_start(machine, node):
        found.nodes.append((machine.spec.name, plain(node)))
        machine.say('exited', node, returncode=0, respawns=False)

    def look(context):
        waited.append(Coordinator.of(context))

    def plan(path, arguments):
        fake.on_start = on_start
        monkeypatch.setattr(ExecuteLocal, private.EXECUTE_PROCESS, stay)
        assert run(LaunchDescription([
            IncludeLaunchDescription(AnyLaunchDescriptionSource(str(path)),
                                     launch_arguments=list(arguments.items())),
            OpaqueFunction(function=look)])) == 0
        found.machines = {name: machine.spec for name, machine in fake.machines.items()}
        found.streams = waited[0].parts._parts['stream_topics']._streams._streams
        found.nodes.sort(key=repr)
        found.robot.sort(key=repr)
        return found

    return plan


def words(command):
    """Return a command line and its parameters, from whatever files they are in."""
    files = [word for word in command if 'launch_params_' in word]
    return ([Path(word).name if '/lib/' in word else word for word in command
             if word not in files and word != '--params-file'],
            parameters(Path(file).read_text() for file in files))


def required(action):
    """Return whether the end of the process is the launch's."""
    return any(name.endswith('__on_exit') and value for name, value in vars(action).items())


def parameters(files):
    found = {}
    for file in files:
        for node, values in yaml.safe_load(file).items():
            found.setdefault(node, {}).update(values['ros__parameters'])
    return found


def plain(node):
    """Return a node without the numbers that launch gives its processes."""
    return dataclasses.replace(
        node, id='', name=node.name.rpartition('-')[0] or node.name,
        files=parameters(node.files.values()), arguments=tuple(
            'a file' if isinstance(word, tuple) else word for word in node.arguments))


plans: dict[str, Plan] = {}


@pytest.mark.parametrize('kind', ['py', 'xml', 'yaml'])
@pytest.mark.parametrize('name', sorted(EXAMPLES))
def test_python_xml_and_yaml_describe_the_same_plan(plan, name, kind):
    """The next test shows that their defaults are the same."""
    found = plan(FOLDER / f'{name}.launch.{kind}', EXAMPLES[name])
    assert found.machines and found.nodes
    assert [ends for _, _, ends in found.robot] == [True]
    if name.startswith('video'):
        assert [stream.topic for stream in found.streams] == ['/camera', '/annotated']
    assert EXAMPLES[name]['name'] in found.machines
    assert "'count': 7" in repr(found.robot)
    # the first of the three that is planned is what the others are held to
    assert found == plans.setdefault(name, found)


@pytest.mark.parametrize('kind', ['xml', 'yaml'])
@pytest.mark.parametrize('name', sorted(EXAMPLES))
def test_xml_and_yaml_declare_the_arguments_of_python(name, kind):
    def arguments(kind):
        source = AnyLaunchDescriptionSource(str(FOLDER / f'{name}.launch.{kind}'))
        from launch import LaunchContext
        return {one.name: (one.description, ''.join(part.text for part in one.default_value))
                for one in source.get_launch_description(LaunchContext()).get_launch_arguments()}

    python, own = arguments('py'), arguments(kind)
    assert set(own) == set(EXAMPLES[name])
    for argument, (description, default) in own.items():
        assert default == python[argument][1]
        assert description
