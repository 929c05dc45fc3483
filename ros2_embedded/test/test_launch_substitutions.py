# SPDX-License-Identifier: Apache-2.0
"""launch's substitutions, typed values and launch files in XML and YAML, by value."""

import os
import re
from typing import List

from launch import LaunchContext, LaunchDescription, LaunchService
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription, LogInfo
from launch.frontend import expose_action, Parser
from launch.frontend.parse_substitution import parse_substitution
import launch.logging
from launch.substitutions import (
    AndSubstitution,
    Command,
    EnvironmentVariable,
    EqualsSubstitution,
    FileContent,
    FindExecutable,
    LaunchConfiguration,
    LocalSubstitution,
    NotEqualsSubstitution,
    NotSubstitution,
    OrSubstitution,
    PathJoinSubstitution,
    PythonExpression,
    SubstitutionFailure,
    TextSubstitution,
)
from launch.utilities import perform_substitutions
from launch.utilities.type_utils import (
    coerce_to_type,
    get_typed_value,
    is_instance_of,
    is_substitution,
    normalize_typed_substitution,
    perform_typed_substitution,
)
import pytest


@pytest.fixture
def context(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    monkeypatch.setenv('FOG_ENV', 'from env')
    launch.logging.reset()
    made = LaunchContext()
    made.launch_configurations.update(a='1', word='hello', quote="it's")
    made.extend_locals({'pair': {'x': 'y'}})
    yield made
    launch.logging.reset()


A = LaunchConfiguration('a')


@pytest.mark.parametrize('substitution, text', [
    (TextSubstitution(text='t'), 't'),
    (LaunchConfiguration(['wo', 'rd']), 'hello'),
    (LaunchConfiguration('no', default=5), '5'),
    (LaunchConfiguration('no', default=['x', A]), 'x1'),
    (EnvironmentVariable('FOG_ENV'), 'from env'),
    (EnvironmentVariable('FOG_NO', default_value=A), '1'),
    (LocalSubstitution("pair['x']"), 'y'),
    (PathJoinSubstitution(['/a', A, 'b']), '/a/1/b'),
    (PythonExpression(['1 + ', A]), '2'),
    (PythonExpression('pi > math.e'), 'True'),
    (PythonExpression('os.sep', ['os']), '/'),
    (Command('echo "a  b"'), 'a  b\n'),
    (Command(['sh -c "echo e >&2"'], on_stderr='capture'), 'e\n'),
    (Command(['sh -c "echo e >&2; echo o"'], on_stderr='ignore'), 'o\n'),
    (NotSubstitution(A), 'false'), (NotSubstitution('false'), 'true'),
    (AndSubstitution(A, 'true'), 'true'), (AndSubstitution(A, '0'), 'false'),
    (OrSubstitution('0', A), 'true'), (OrSubstitution('0', 'false'), 'false'),
    (EqualsSubstitution(A, 'true'), 'true'), (EqualsSubstitution(A, 1.0), 'true'),
    (EqualsSubstitution(True, 'TRUE'), 'true'), (EqualsSubstitution(None, ''), 'true'),
    (EqualsSubstitution('a', 'b'), 'false'), (NotEqualsSubstitution('a', 'b'), 'true'),
    (NotEqualsSubstitution('1.0', '1'), 'false'),
])
def test_substitution_returns_its_value(context, substitution, text):
    assert substitution.perform(context) == text
    assert context.perform_substitution(substitution) == text


@pytest.mark.parametrize('substitution, error', [
    (LaunchConfiguration('no'), "launch configuration 'no' does not exist"),
    (EnvironmentVariable('FOG_NO'), "environment variable 'FOG_NO' does not exist"),
    (FileContent('/no/file'), 'File not found: /no/file'),
    (FindExecutable(name='no-such-thing'), 'not found on the PATH'),
    (Command('false'), 'executed command failed. Command: false'),
    (Command('no-such-thing'), 'file not found'),
    (Command('sh -c "echo e >&2"'), 'executed command showed stderr output'),
    (Command('true', on_stderr='what'), "expected 'on_stderr' to be one of"),
    (NotSubstitution('maybe'), 'Failed to convert|Cannot convert'),
])
def test_failing_substitution_has_a_reason(context, substitution, error):
    with pytest.raises(SubstitutionFailure, match=error):
        substitution.perform(context)


def test_substitutions_read_files_and_find_programs(context, tmp_path):
    (tmp_path / 'file').write_text('content')
    assert FileContent(str(tmp_path / 'file')).perform(context) == 'content'
    assert os.access(FindExecutable(name='sh').perform(context), os.X_OK)
    assert launch.logging.launch_config.log_dir.startswith(str(tmp_path / 'log'))


@pytest.mark.parametrize('substitution, text', [
    (TextSubstitution(text='t'), "'t'"), (A, "LaunchConfig('a')"),
    (EnvironmentVariable(['a', 'b']), "EnvVar('a' + 'b')"),
    (LocalSubstitution('x', 'what'), "LocalVar('what')"),
    (PathJoinSubstitution(['a', 'b']), "PathJoin(''a' + 'b'')"),
    (Command('ls'), "Command('ls')"), (FindExecutable(name='a'), "FindExec('a')"),
    (PythonExpression('1 + 1', ['os', 'sys']), "PythonExpr('1 + 1', ['os', 'sys'])"),
])
def test_substitution_describes_itself(substitution, text):
    assert substitution.describe() == text


def test_wrong_argument_of_a_substitution_is_refused():
    with pytest.raises(TypeError, match='TextSubstitution expected Text object'):
        TextSubstitution(text=1)


@pytest.mark.parametrize('text, expected', [
    ('', ''), ('plain text', 'plain text'), ('$', '$'), ('a$b', 'a$b'), (r'\$(var a)', '$(var a)'),
    ('$(var a)', '1'), ('<$(var a)/$(var word)>', '<1/hello>'), ('(x)', '(x)'),
    ('$(var no default)', 'default'), ("$(var no 'two words')", 'two words'),
    ('$(var no "it\'s $(var a) (x)")', "it's 1 (x)"), (r'$(var no a\)b)', 'a)b'),
    ('$(var no $(var a))', '1'), ("$(var no '$(var word) you')", 'hello you'),
    ('$(var no x$(var a)y)', 'x1y'), ('$(env FOG_ENV)', 'from env'),
    ("$(eval '1 + $(var a)')", '2'), ('$(eval "\'$(var word)\' == \'hello\'")', 'True'),
    ('$(not $(var a))', 'false'), ('$(and 1 $(var a))', 'true'), ('$(or 0 0)', 'false'),
    ('$(equals $(var word) hello)', 'true'), ('$(not-equals 1 2)', 'true'),
    ("$(command 'echo x')", 'x\n'),
    ('$(var quote)', "it's"), ("it's $(var a) o'clock", "it's 1 o'clock"),
    (r'back\\slash', 'back\\slash'), ('two\nlines $(var a)', 'two\nlines 1'),
    ('$(var a)$(var a)', '11'), ('$(var a ignored)', '1'), ("$(eval 'os.sep' 'os, sys')", '/'),
    ('$(eval "1 + 1" "")', '2'),
])
def test_text_with_substitutions_is_parsed(context, text, expected):
    assert perform_substitutions(context, parse_substitution(text)) == expected


@pytest.mark.parametrize('text', [
    '$(var a', '$(', '$()', "$(var 'a)", '$(var  a)', '$(1a)', '$(no-such-thing)', '$(var)',
    '$(var a b c)', '$(dirname x)'])
def test_invalid_substitution_text_is_refused(text):
    with pytest.raises(Exception, match='.'):
        parse_substitution(text)


@pytest.mark.parametrize('text, data_type, value', [
    ('1', int, 1), ('1', float, 1.0), ('1', str, '1'), ('1', bool, True), ('false', bool, False),
    ('1', None, 1), ('a', None, 'a'), ('[1, 2]', None, [1, 2]), ('[1, 2]', List[int], [1, 2]),
    ('[a, b]', List[str], ['a', 'b']), ('1.5', None, 1.5), ('true', None, True)])
def test_text_is_converted_to_a_type(text, data_type, value):
    assert coerce_to_type(text, data_type) == value
    assert type(coerce_to_type(text, data_type)) is type(value)
    assert is_instance_of(value, data_type)


@pytest.mark.parametrize('text, data_type', [
    ('x', int), ('1.5', int), ('2', bool), ('[1, a]', List[int]), ('1', List[int]),
    ('{a: 1}', None), ('[1, a]', None), ('x', dict)])
def test_text_of_another_type_is_refused(text, data_type):
    with pytest.raises(ValueError):
        coerce_to_type(text, data_type)


def test_typed_substitutions_are_resolved(context):
    assert get_typed_value(['1', '2'], List[int]) == [1, 2]
    with pytest.raises(TypeError):
        get_typed_value(['1'], int)
    assert is_substitution(A) and is_substitution(['a', A]) and not is_substitution(['a'])
    assert not is_substitution('a') and not is_substitution(1)

    def resolve(value, data_type):
        return perform_typed_substitution(
            context, normalize_typed_substitution(value, data_type), data_type)

    assert resolve(True, bool) is True
    assert resolve(A, int) == 1 and resolve(['1', A], int) == 11 and resolve(A, None) == 1
    assert resolve([1, 2.5], List[float]) == [1.0, 2.5]
    assert resolve([[A], 2], List[int]) == [1, 2]
    assert resolve(['a', 'b'], List[str]) == ['a', 'b']
    for wrong, data_type in ((1, str), ([1], int), ([1, 'a'], None), ([1], List[str]),
                             (object(), None), (['a', object()], None)):
        with pytest.raises(TypeError):
            normalize_typed_substitution(wrong, data_type)


XML = '''<launch>
  <arg name="word" default="hello" description="a word"/>
  <arg name="kind" default="a"><choice value="a"/><choice value="b"/></arg>
  <let name="said" value="$(var word) there"/>
  <group if="true" scoped="false">
    <set_env name="FOG_XML" value="$(var said)"/>
    <append_env name="FOG_XML" value="more" separator="-"/>
  </group>
  <group><keep name="said" value="inner"/><log message="in group: $(var said)"/></group>
  <log message="said: $(var said) $(env FOG_XML)" unless="0"/>
  <log message="never" if="$(not $(var yes true))"/>
  <executable cmd="echo 'two  words' $(var word)! $(dirname)" output="screen" shell="false">
    <env name="X" value="y"/>
  </executable>
  <timer period="0.01"><log message="timer"/></timer>
  <executable cmd="sleep 60" on_exit="shutdown" sigterm_timeout="2.5" respawn="false"/>
  <timer period="1.0"><shutdown reason="enough"/></timer>
</launch>
'''

YAML = '''
launch:
- arg: {name: word, default: hello, description: a word}
- arg: {name: kind, default: a, choice: [{value: a}, {value: b}]}
- let: {name: said, value: $(var word) there}
- group:
    if: 'true'
    scoped: false
    children:
    - set_env: {name: FOG_XML, value: $(var said)}
    - append_env: {name: FOG_XML, value: more, separator: '-'}
- group:
    keep: [{name: said, value: inner}]
    children:
    - log: {message: 'in group: $(var said)'}
- log: {message: 'said: $(var said) $(env FOG_XML)', unless: '0'}
- log: {message: never, if: $(not $(var yes true))}
- executable: {cmd: echo 'two  words' $(var word)! $(dirname), output: screen, shell: false,
               env: [{name: X, value: y}]}
- timer: {period: 0.01, children: [log: {message: timer}]}
- executable: {cmd: sleep 60, on_exit: shutdown, sigterm_timeout: 2.5, respawn: 'false'}
- timer: {period: 1.0, children: [shutdown: {reason: enough}]}
'''


def launch_file(path):
    # Standard output isn't the one there was when the context was made.
    launch.logging.reset()
    service = LaunchService(noninteractive=True)
    service.include_launch_description(LaunchDescription([
        IncludeLaunchDescription(str(path))]))
    return service.run()


@pytest.mark.parametrize('name, content', [
    ('a.xml', XML), ('a_launch.yaml', YAML), ('a.launch', XML)],
    ids=lambda value: value.partition('\n')[0])
def test_xml_and_yaml_launch_files_run(context, tmp_path, monkeypatch, capsys, name, content):
    monkeypatch.delenv('FOG_XML', raising=False)
    (tmp_path / name).write_text(content)
    assert launch_file(tmp_path / name) == 0
    monkeypatch.delenv('FOG_XML')
    out = capsys.readouterr().out
    for text in ('said: hello there hello there-more', 'in group: inner', 'timer'):
        assert f'[INFO] [launch.user]: {text}' in out.splitlines()
    assert f'] two  words hello! {tmp_path}' in out
    assert 'never' not in out


@pytest.mark.parametrize('content, error', [
    ('<launch><nothing/></launch>', 'Unrecognized entity of the type: nothing'),
    ('<launch><log message="a" colour="b"/></launch>', 'Unexpected attribute.*colour'),
    ('<launch><log/></launch>', "Attribute 'message' of type .* not found in Entity 'log'"),
    ('<launch><log message="a"><log message="b"/></log></launch>', 'Unexpected nested tag'),
    ('<start/>', "Expected 'launch' as root tag"),
    ('<launch>\n<log message=/>\n</launch>', 'not well-formed.*line 2'),
    ('<launch><executable cmd="a" respawn_delay="-1"/></launch>', 'non-negative value'),
    ('<launch><log message="a" if="1" unless="1"/></launch>', "can't be used simultaneously"),
])
def test_invalid_launch_file_is_reported(context, tmp_path, capsys, content, error):
    path = tmp_path / 'bad.launch.xml'
    path.write_text(content)
    assert launch_file(path) == 1
    out = capsys.readouterr().out
    assert 'Caught exception in launch (see debug for traceback)' in out
    assert re.search(error, out)


def test_exposed_action_is_an_element(context, tmp_path, capsys):
    @expose_action('fog_test_action')
    class Exposed(LogInfo):
        @classmethod
        def parse(cls, entity, parser):
            _, kwargs = super().parse(entity, parser)
            numbers = entity.get_attr('numbers', data_type=List[int])
            kwargs['msg'] = [*kwargs['msg'], str(sum(numbers))]
            return cls, kwargs

    (tmp_path / 'a.launch.xml').write_text(
        '<launch><fog_test_action message="sum " numbers="1,2" numbers-sep=","/></launch>')
    (tmp_path / 'b.launch.yaml').write_text(
        'launch: [fog_test_action: {message: "sum ", numbers: [1, 2]}]')
    assert launch_file(tmp_path / 'a.launch.xml') == 0
    assert launch_file(tmp_path / 'b.launch.yaml') == 0
    assert capsys.readouterr().out.count('[launch.user]: sum 3') == 2
    with pytest.raises(RuntimeError, match="Did not find a class method called 'parse'"):
        expose_action('fog_test_other')(object)


def test_parser_reads_an_open_file(tmp_path):
    assert Parser.is_filename_valid('x.launch.xml') and Parser.is_filename_valid('x.yaml')
    assert not Parser.is_filename_valid('x.launch.py')
    assert set(Parser.get_available_extensions()) >= {'xml', 'yaml'}
    path = tmp_path / 'a.launch.xml'
    path.write_text('<launch><arg name="a"/><group><arg name="b" default="$(var a)"/></group>'
                    '</launch>')
    with open(path) as file:
        entity, parser = Parser.load(file)
    description = parser.parse_description(entity)
    argument, group = description.entities
    assert isinstance(argument, DeclareLaunchArgument) and isinstance(group, GroupAction)
    assert [a.name for a in description.get_launch_arguments()] == ['a', 'b']
