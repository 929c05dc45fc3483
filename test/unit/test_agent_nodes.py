# SPDX-License-Identifier: Apache-2.0
"""How a NodeSpec becomes a process on the machine: markers, executables, files, refusals."""

from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path
import signal
import subprocess
from typing import Any

import pytest

from fogros2.agent import programs
from fogros2.agent.loop import Loop
from fogros2.agent.nodes import Node, Nodes
from fogros2.agent.processes import Identity, Processes
from fogros2.agent.protocol import Refused

Prepared = Callable[..., tuple[list[str], dict[str, Any]]]


@pytest.fixture
def prefix(tmp_path: Path) -> str:
    """Install a package ``pack`` with an executable and a file that isn't one."""
    root = tmp_path / 'prefix'
    (root / programs.INDEX).mkdir(parents=True)
    (root / programs.INDEX / 'pack').write_text('')
    (root / 'lib/pack').mkdir(parents=True)
    (root / 'lib/pack/talker').write_text('#!/bin/sh\n')
    (root / 'lib/pack/talker').chmod(0o755)
    (root / 'lib/pack/notes').write_text('')
    return str(root)


@pytest.fixture
def nodes(tmp_path: Path, prefix: str) -> Nodes:
    found = Nodes(Processes(Loop(), Identity('')), str(tmp_path), {
        'setup': [], 'environment': {'AMENT_PREFIX_PATH': prefix, 'PATH': os.environ['PATH']},
    }, lambda lines: None)
    found.source(lambda failure: None)
    return found


@pytest.fixture
def prepared(nodes: Nodes) -> Prepared:
    """Return the command line and the options of Popen for a spec."""
    def prepare(**spec: Any) -> tuple[list[str], dict[str, Any]]:
        node = Node({'id': '1', 'name': 'n', **spec})
        nodes._prepare(node)
        return node.command, node.options
    return prepare


def test_markers_become_paths_of_this_machine(prefix: str) -> None:
    def resolve(text: Any, files: Any = ()) -> str:
        return programs.resolve(text, files, f'/none:{prefix}')

    assert resolve('plain') == 'plain'
    assert resolve(['a ', {'share': 'pack'}, '/x']) == f'a {prefix}/share/pack/x'
    assert resolve([{'prefix': 'pack'}]) == prefix
    assert resolve(['@', {'file': 'k'}], {'k': '/t/k'}) == '@/t/k'
    assert resolve([]) == ''


@pytest.mark.parametrize('text', [[{'file': 'k'}], [{'new': 'x'}], [{}]])
def test_unknown_markers_are_refused(text: Any) -> None:
    with pytest.raises(Refused, match='means nothing'):
        programs.resolve(text, {}, '')


def test_unknown_package_is_refused(prefix: str) -> None:
    with pytest.raises(Refused, match="package 'packk' not found") as caught:
        programs.prefix_of('packk', f'/none:{prefix}')
    assert caught.value.answer['hint'] == 'is its workspace the one that travels?'
    with pytest.raises(Refused, match="package '../x' not found"):
        programs.prefix_of('../x', prefix)


@pytest.mark.parametrize(('program', 'hint'), [
    ('talker', 'the executable of a package needs package='), ('./talker', '')])
def test_program_without_a_package_names_the_keyword(
    program: str, hint: str, tmp_path: Path,
) -> None:
    with pytest.raises(Refused) as caught:
        programs.check_program(program, '/bin', str(tmp_path))
    assert caught.value.answer.get('hint', '') == hint


def test_first_prefix_with_a_package_wins(prefix: str, tmp_path: Path) -> None:
    overlay = tmp_path / 'overlay'
    (overlay / programs.INDEX).mkdir(parents=True)
    (overlay / programs.INDEX / 'pack').touch()
    assert programs.prefix_of('pack', f'{overlay}:{prefix}') == str(overlay)


def test_executable_is_found_in_its_package(prefix: str) -> None:
    assert programs.find_executable('pack', 'talker', prefix) == f'{prefix}/lib/pack/talker'
    for name in ('listener', 'notes', '', '../pack/talker'):
        with pytest.raises(Refused, match=f"executable '{name}' not found in package 'pack'"):
            programs.find_executable('pack', name, prefix)


def test_spec_becomes_a_command_line(prefix: str, prepared: Prepared, tmp_path: Path) -> None:
    words = ['--ros-args', '-r', 'x:=y $(not a substitution)']
    command, options = prepared(
        package='pack', executable='talker', prefix=['nice', '-n', '5'], arguments=words,
        environment={'A': [{'share': 'pack'}]}, cwd=str(tmp_path))
    assert command == ['nice', '-n', '5', f'{prefix}/lib/pack/talker', *words]
    assert options['env']['A'] == f'{prefix}/share/pack'
    assert options['cwd'] == str(tmp_path)


def test_files_are_private_and_have_readable_names(prefix: str, prepared: Prepared) -> None:
    command, _ = prepared(
        arguments=['true', [{'file': '/home/me/params.yaml'}], [{'file': '../../evil'}]],
        files={'/home/me/params.yaml': ['dir: ', {'share': 'pack'}],
               '../../evil': ['see ', {'file': '/home/me/params.yaml'}]})
    first, second = map(Path, command[1:])
    assert first.parent == second.parent and first.parent.stat().st_mode & 0o777 == 0o700
    assert [path.stat().st_mode & 0o777 for path in (first, second)] == [0o600, 0o600]
    assert first.name.endswith('params.yaml')
    assert first.read_text() == f'dir: {prefix}/share/pack'
    assert second.read_text() == f'see {first}'


def test_folders_come_before_the_lists_of_the_machine(
    nodes: Nodes, prepared: Prepared, prefix: str,
) -> None:
    nodes.environment = {**nodes.environment, 'PATH': '/usr/bin:/bin', 'LD_LIBRARY_PATH': ''}
    variables = prepared(arguments=['true'], folders={
        'PATH': [{'share': 'pack'}, '/bin'], 'LD_LIBRARY_PATH': '/a:/b'})[1]['env']
    assert variables['PATH'] == f'{prefix}/share/pack/bin:/usr/bin:/bin'
    assert variables['LD_LIBRARY_PATH'] == '/a:/b'


def test_prefix_and_working_directory_may_have_markers(prepared: Prepared, prefix: str) -> None:
    share = f'{prefix}/share/pack'
    os.mkdir(share)
    command, options = prepared(
        prefix=['echo', [{'share': 'pack'}]], arguments=['x'], cwd=[{'share': 'pack'}])
    assert (command, options['cwd']) == (['echo', share, 'x'], share)


@pytest.mark.parametrize('spec, reason', [
    ({}, 'nothing to run'),
    ({'arguments': ['no-such-program']}, "'no-such-program' not found"),
    ({'arguments': ['/proc/version']}, "isn't executable"),
    ({'arguments': ['true'], 'cwd': '/no/such'}, "'/no/such' isn't there"),
    ({'arguments': ['true'], 'environment': {'PATH': '/no/such'}}, "'true' not found"),
    ({'package': 'pack', 'executable': 'none'}, "'none' not found in package 'pack'"),
])
def test_missing_program_is_refused(prepared: Prepared, spec: Any, reason: str) -> None:
    with pytest.raises(Refused, match=reason):
        prepared(**spec)


def test_shell_command_is_not_checked(prepared: Prepared) -> None:
    assert prepared(**{'shell': True, 'arguments': ['a | b']})[0] == ['a | b']


@pytest.mark.parametrize('spec', [
    {'sigterm_timeout': -1}, {'sigkill_timeout': float('nan')}, {'respawn_delay': 1e9}, {'id': 7}])
def test_invalid_spec_is_refused(spec: Any) -> None:
    with pytest.raises(Refused):
        Node({'id': '1', 'name': 'n', **spec})


def test_marker_that_is_too_deep_refuses_only_the_node(nodes: Nodes) -> None:
    deep: list[Any] = []
    for _ in range(100_000):
        deep = [deep]
    node = Node({'id': '1', 'name': 'n', 'arguments': [['x', {'new': deep}]]})
    nodes.start([node])
    assert node.status['state'] == 'refused'


def test_named_pipe_as_argument_is_not_read(prepared: Prepared, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / 'pipe')
    words = ['cat', f'{tmp_path}/pipe']
    assert prepared(prefix=words[:1], arguments=words[1:])[0] == words


def test_full_disk_refuses_only_the_node(
    nodes: Nodes, prepared: Prepared, monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*arguments: Any) -> None:
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'mkdir', full)
    with pytest.raises(Refused, match='No space left'):
        prepared(arguments=['true'], files={'k': 'text'})


def program(folder: Path, first: str) -> str:
    path = folder / 'program'
    path.write_text(f'#!{first}\nimport sys\nprint("ran")\n')
    path.chmod(0o755)
    return str(path)


@pytest.mark.parametrize('lost', ['/gone/.venv/bin/python', '/gone/bin/python3.12'])
def test_program_of_a_missing_python_runs_with_another(
    tmp_path: Path, prepared: Prepared, lost: str,
) -> None:
    command, options = prepared(arguments=[program(tmp_path, lost)])
    assert subprocess.run(command, env=options['env'], capture_output=True).stdout == b'ran\n'


def test_program_keeps_an_existing_interpreter(tmp_path: Path) -> None:
    assert programs.interpreter([program(tmp_path, '/bin/sh')]) == []
    assert programs.interpreter([program(tmp_path, '/usr/bin/env python3')]) == []
    assert programs.interpreter(['/bin/sh']) == programs.interpreter([]) == []


def test_program_of_another_missing_interpreter_is_refused(
    tmp_path: Path, prepared: Prepared,
) -> None:
    with pytest.raises(Refused, match="is for the interpreter '/gone/bin/ruby'"):
        prepared(arguments=[program(tmp_path, '/gone/bin/ruby')])


def test_unknown_node_keeps_no_other_from_its_end(
    nodes: Nodes, monkeypatch: pytest.MonkeyPatch,
) -> None:
    sent: list[tuple[int, int]] = []
    monkeypatch.setattr(nodes.processes, 'kill', lambda pid, number: sent.append((pid, number)))
    nodes.known['a'] = Node({'id': 'a', 'name': 'n'})
    nodes.known['a'].status['pid'] = 4711
    nodes.stop(['a', 'nobody'])
    assert sent == [(-4711, signal.SIGINT)]


def test_node_that_passes_signals_on_gets_sigint_alone(
    nodes: Nodes, monkeypatch: pytest.MonkeyPatch,
) -> None:
    sent: list[tuple[int, int]] = []
    monkeypatch.setattr(nodes.processes, 'kill', lambda pid, number: sent.append((pid, number)))
    nodes.known['a'] = Node({'id': 'a', 'name': 'n', 'passes_signals': True})
    nodes.known['a'].status['pid'] = 4711
    nodes.stop(['a'])
    assert sent == [(4711, signal.SIGINT)]


def test_nodes_that_ended_long_ago_are_forgotten(
    nodes: Nodes, monkeypatch: pytest.MonkeyPatch,
) -> None:
    exits: list[Callable[[int], None]] = []

    def start(argv: list[str], exited: Callable[[int], None], **options: Any) -> int:
        exits.append(exited)
        return 4711

    monkeypatch.setattr(nodes.processes, 'start', start)
    monkeypatch.setattr('fogros2.agent.nodes.ENDED', 2)
    started = [Node({'id': number, 'name': 'n', 'arguments': ['true', [{'file': 'k'}]],
                     'files': {'k': 'text'}}) for number in 'abcd']
    nodes.start(started)
    folders = [Path(node.folder) for node in started]
    for index in (3, 1, 0):
        exits[index](0)
    assert list(nodes.known) == ['a', 'b', 'c']
    assert [folder.exists() for folder in folders] == [True, True, True, False]
    assert [bool(node.spec) for node in started] == [False, False, True, False]
    assert nodes.start(started[:3]) == ['a', 'b', 'c']
    # another launch uses an id again
    nodes.clear()
    nodes.start([Node({'id': number, 'name': 'n', 'arguments': ['true']}) for number in 'bxyz'])
    for run in exits[-3:]:
        run(0)
    assert list(nodes.known) == ['b', 'y', 'z']
