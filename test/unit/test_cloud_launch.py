# SPDX-License-Identifier: Apache-2.0
"""How a NodeSpec becomes a process on the machine: markers, executables, files, refusals."""

from __future__ import annotations

import json
import os
from pathlib import Path
import re
import socket
import subprocess
import sys

import pytest

pytest.importorskip('ament_index_python.packages', reason='launch is not installed')
pytest.importorskip('launch.actions', reason='launch is not installed')

from launch import LaunchContext

from fogros2 import cloud_launch
from fogros2.cloud_launch import RefusedNode, resolve


@pytest.fixture
def prefix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Install a package ``pack`` with an executable and a file that isn't one."""
    root = tmp_path / 'prefix'
    (root / 'share/ament_index/resource_index/packages').mkdir(parents=True)
    (root / 'share/ament_index/resource_index/packages/pack').write_text('')
    (root / 'share/pack').mkdir()
    (root / 'lib/pack').mkdir(parents=True)
    (root / 'lib/pack/talker').write_text('#!/bin/sh\n')
    (root / 'lib/pack/talker').chmod(0o755)
    (root / 'lib/pack/notes').write_text('')
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(root))
    return root


@pytest.fixture
def obey(tmp_path: Path):
    ours, theirs = socket.socketpair()
    action = cloud_launch.ObeyAgent(theirs, str(tmp_path))
    yield action
    ours.close()
    theirs.close()


def test_markers_become_paths_of_this_machine(prefix):
    assert resolve('plain', {}) == 'plain'
    assert resolve(['a ', {'share': 'pack'}, '/x'], {}) == f'a {prefix}/share/pack/x'
    assert resolve([{'prefix': 'pack'}], {}) == str(prefix)
    assert resolve(['@', {'file': 'k'}], {'k': '/t/k'}) == '@/t/k'
    assert resolve([], {}) == ''


@pytest.mark.parametrize('text', [[{'file': 'k'}], [{'new': 'x'}], [{}]])
def test_unknown_markers_are_refused(prefix, text):
    with pytest.raises(RefusedNode, match='means nothing'):
        resolve(text, {})


def test_unknown_package_is_refused_with_the_nearest_name(prefix):
    with pytest.raises(RefusedNode) as caught:
        resolve([{'share': 'packk'}], {})
    assert "package 'packk' not found" in str(caught.value)
    assert caught.value.hint == "did you mean 'pack'?"
    with pytest.raises(RefusedNode, match="package '../x' not found"):
        resolve([{'prefix': '../x'}], {})


def test_executable_is_found_in_its_package(prefix):
    assert cloud_launch.find_executable('pack', 'talker') == f'{prefix}/lib/pack/talker'
    for name in ('listener', 'notes', ''):
        with pytest.raises(RefusedNode) as caught:
            cloud_launch.find_executable('pack', name)
        assert caught.value.hint == 'it has: notes, talker'


def test_spec_becomes_a_process_of_launch(prefix, obey):
    process = obey._process({
        'id': '1', 'name': 'talker-7', 'package': 'pack', 'executable': 'talker',
        'prefix': ['nice', '-n', '5'], 'environment': {'A': [{'share': 'pack'}]},
        'arguments': ['--ros-args', '-r', 'x:=y $(not a substitution)'],
        'sigterm_timeout': 1.5})
    words = [''.join(part.text for part in word) for word in process.cmd] if hasattr(
        process, 'cmd') else []
    assert words == ['nice', '-n', '5', f'{prefix}/lib/pack/talker', '--ros-args', '-r',
                     'x:=y $(not a substitution)']
    assert process.output == {}


def test_files_are_private_and_have_readable_names(prefix, obey):
    process = obey._process({
        'id': '1', 'name': 'n', 'arguments': ['true', [{'file': '/home/me/params.yaml'}],
                                              [{'file': '../../evil'}]],
        'files': {'/home/me/params.yaml': ['dir: ', {'share': 'pack'}],
                  '../../evil': ['see ', {'file': '/home/me/params.yaml'}]}})
    paths = [''.join(part.text for part in word) for word in process.cmd][1:]
    folder = Path(paths[0]).parent
    assert folder.stat().st_mode & 0o777 == 0o700
    assert [Path(path).parent for path in paths] == [folder, folder]
    assert [Path(path).stat().st_mode & 0o777 for path in paths] == [0o600, 0o600]
    assert Path(paths[0]).name.endswith('params.yaml')
    assert Path(paths[0]).read_text() == f'dir: {prefix}/share/pack'
    assert Path(paths[1]).read_text() == f'see {paths[0]}'


@pytest.mark.parametrize('spec, reason', [
    ({}, 'nothing to run'),
    ({'arguments': ['no-such-program']}, "'no-such-program' not found"),
    ({'arguments': ['/proc/version']}, "isn't executable"),
    ({'arguments': ['true'], 'cwd': '/no/such'}, "'/no/such' isn't there"),
    ({'arguments': ['true'], 'environment': {'PATH': '/no/such'}}, "'true' not found"),
    ({'package': 'pack', 'executable': 'none'}, "'none' not found in package 'pack'"),
])
def test_missing_program_is_refused_before_launch_starts_it(prefix, obey, spec, reason):
    with pytest.raises(RefusedNode, match=reason):
        obey._process({'id': '1', 'name': 'n', **spec})


def test_shell_command_is_not_checked(obey):
    assert obey._process({'id': '1', 'name': 'n', 'shell': True, 'arguments': ['a | b']}).shell


def test_launch_file_imports_nothing_of_fogros2():
    text = Path(cloud_launch.__file__).read_text()
    assert re.findall(r'^.*(?:import|from) fogros2.*', text, re.MULTILINE) == [
        '    from fogros2.events import NodeEvent']
    assert 'if TYPE_CHECKING:\n    from fogros2.events' in text


def test_launch_file_runs_alone_and_ends_with_its_agent(tmp_path):
    path = tmp_path / 'cloud.launch.py'
    path.write_bytes(Path(cloud_launch.__file__).read_bytes())
    ours, theirs = socket.socketpair()
    ours.settimeout(30)
    child = subprocess.Popen(
        [sys.executable, str(path)], pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL,
        env={**os.environ, 'FOGROS2_AGENT_FD': str(theirs.fileno()),
             'FOGROS2_AGENT_DIRECTORY': str(tmp_path), 'ROS_LOG_DIR': str(tmp_path)},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    theirs.close()
    with ours, ours.makefile('rb') as lines:
        ours.sendall(json.dumps({'command': 'start', 'nodes': [{
            'id': 'a', 'name': 'a-1', 'arguments': ['cat', [{'file': 'f'}], '-'],
            'files': {'f': 'text\n'}}]}).encode() + b'\n')
        events = [json.loads(lines.readline()) for _ in range(2)]
        assert [e['event'] for e in events] == ['started', 'output']
        assert events[1]['text'] == 'text\n'
        ours.shutdown(socket.SHUT_WR)
        last = json.loads(lines.readline())
        assert (last['event'], last['respawns']) == ('exited', False)
        assert lines.readline() == b''
    assert child.wait(30) == 0
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith('files-')] == []


def test_full_disk_refuses_only_the_node(prefix, obey, monkeypatch):
    def full(key, text):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(obey, '_write', full)
    told = []
    monkeypatch.setattr(obey, '_report', told.append)
    obey._start(None, {'id': '1', 'name': 'n', 'arguments': ['true'], 'files': {'k': 'text'}})
    event, = told
    assert event['event'] == 'refused' and 'No space left' in event['error']


def test_start_by_hand_explains_the_launch_file():
    environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)}
    environment.pop('FOGROS2_AGENT_FD', None)
    done = subprocess.run(
        [sys.executable, '-m', 'fogros2.cloud_launch'], env=environment, capture_output=True,
        text=True, timeout=60)
    assert done.returncode == 1
    (line,) = [line for line in (done.stdout + done.stderr).splitlines() if 'ERROR' in line]
    assert 'cloud.launch.py is for the agent of a cloud machine' in line
    assert 'talker.container.launch.py' in line
    assert 'Traceback' not in done.stderr and 'KeyError' not in done.stderr


def program(folder, first, text='import sys; print(sys.executable)'):
    path = folder / 'program'
    path.write_text(f'#!{first}\n{text}\n')
    path.chmod(0o755)
    return str(path)


@pytest.mark.parametrize('lost', ['/gone/.venv/bin/python', '/gone/bin/python3.12'])
def test_program_of_a_missing_python_runs_with_this_one(tmp_path, obey, lost):
    process = obey._process({
        'id': 'p', 'name': 'p', 'arguments': [program(tmp_path, lost)]})
    context = LaunchContext()
    process.prepare(context)
    said = subprocess.run(process.process_description.final_cmd, capture_output=True, text=True)
    assert said.stdout.strip() == sys.executable, said.stderr


def test_program_keeps_an_existing_interpreter(tmp_path):
    assert cloud_launch.interpreter([program(tmp_path, '/bin/sh')]) == []
    assert cloud_launch.interpreter([program(tmp_path, '/usr/bin/env python3')]) == []
    assert cloud_launch.interpreter(['/bin/sh']) == cloud_launch.interpreter([]) == []


def test_program_of_another_missing_interpreter_is_refused(tmp_path, obey):
    with pytest.raises(RefusedNode, match="is for the interpreter '/gone/bin/ruby'"):
        obey._process({'id': 'p', 'name': 'p', 'arguments': [program(tmp_path, '/gone/bin/ruby')]})


def test_package_with_a_broken_link_gets_no_suggestion(prefix, tmp_path):
    index = prefix / 'share/ament_index/resource_index/packages'
    (index / 'rob_tools').symlink_to(tmp_path / 'gone')
    with pytest.raises(RefusedNode) as error:
        resolve([{'share': 'rob_tools'}], {})
    assert error.value.hint == 'is its workspace the one that travels?'
