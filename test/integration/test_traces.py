# SPDX-License-Identifier: Apache-2.0
"""The look at what a test leaves behind: it misses nothing of ours, and minds nobody else's."""

from __future__ import annotations

import json
import os
from pathlib import Path
import secrets
import shutil
import subprocess
import sys
import tempfile

import pytest

from fogros2.model import Command
from fogros2.process import run
from fogros2.waiting import wait_until
from rigs.traces import nothing_left, RUN, Traces

#: A program that waits to be killed, whatever its file is called.
WAITS = 'import sys; sys.stdin.read()'


@pytest.fixture
def launch_id():
    return secrets.token_hex(3)


@pytest.fixture
def elsewhere():
    """Return a folder that says nothing of a run of tests."""
    path = tempfile.mkdtemp(prefix='fogt')
    yield Path(path)
    shutil.rmtree(path)


@pytest.fixture
def look(root, state_home, tmp_path_factory, own_domain):
    return lambda: Traces(state_home, tmp_path_factory.getbasetemp(), os.environ[RUN])


@pytest.fixture
def start(children):
    """Start processes that wait, and return them when they have their names and variables."""
    def start(*words, **variables):
        child = subprocess.Popen(
            [sys.executable, *words], stdin=subprocess.PIPE, env={**os.environ, **variables})
        children.append(child)
        wait_until(lambda: words[0].encode() in Path(f'/proc/{child.pid}/cmdline').read_bytes(),
                   timeout=60, what='the program to be loaded')
        return child

    return start


@pytest.fixture
def interface(launch_id, tun):
    """Make a VPN interface of a launch, on which no program runs."""
    name = f'fog{launch_id}'
    run(Command(('ip', 'tuntap', 'add', 'mode', 'tun', 'name', name), sudo=True), timeout=60)
    yield name
    run(Command(('ip', 'link', 'delete', name), sudo=True), timeout=60)


def store(folder, launch_id):
    """Make what a launch keeps of itself."""
    (folder / 'launches' / launch_id).mkdir(parents=True)


def fake_agent(folder, launch_id, *, first=True):
    """Return the words of a process that looks like the agent of a launch."""
    program, config = folder / 'agent.py', folder / 'first.json'
    program.write_text(WAITS)
    if first:
        config.write_text(json.dumps({'directory': str(folder), 'launch': ''}))
    (folder / 'config.json').write_text(json.dumps({'launch': launch_id}))
    return str(program), 'serve', '--config', str(config)


def test_leftover_file_is_found(look, interface, state_home):
    assert look().left() == set(), 'it was there before'
    traces = look()
    (state_home / 'forgotten').write_text('')
    assert traces.left() == {'state forgotten'}
    with pytest.raises(AssertionError, match='left behind.*another'):
        with nothing_left(look(), timeout=0.1):
            (state_home / 'another').write_text('')
    with nothing_left(look(), timeout=0.1):
        pass


def test_leftover_interface_is_found(look, tun, launch_id, state_home, request):
    """Though the launch's folder has gone."""
    traces = look()
    with pytest.raises(AssertionError, match=f'left behind.*interface fog{launch_id}'):
        with nothing_left(traces, timeout=0.1):
            store(state_home, launch_id)
            wait_until(lambda: launch_id in traces.marks, timeout=60, what='a look')
            request.getfixturevalue('interface')
            shutil.rmtree(state_home / 'launches')


def test_launch_with_its_own_state_folder_is_found(
    look, tun, start, elsewhere, launch_id, request,
):
    traces = look()
    name = request.getfixturevalue('interface')
    (elsewhere / 'waits.py').write_text(WAITS)
    start(str(elsewhere / 'waits.py'), FOGROS2_STATE_HOME=str(elsewhere))
    store(elsewhere, launch_id)
    traces.find_folders()
    assert traces.left() == {f'interface {name}'}


@pytest.mark.parametrize('of_ours', [True, False])
def test_leftover_machine_is_found_with_its_owner(
    look, engine, launch_id, state_home, tmp_path, of_ours,
):
    """A container without a launch's label comes from the test of a provider alone."""
    traces = look()
    if of_ours:
        store(state_home, launch_id)
    names = [f'fogros2-{launch_id}a', f'fogros2-{launch_id}b']
    try:
        for name, label in zip(names, (f'fogros2-launch={launch_id}', 'fogros2-token=x')):
            run(Command((engine, 'create', '--name', name, '--label', label, '--network', 'none',
                         '--ulimit', 'nofile=1024', '--ulimit', 'nproc=1024',
                         '--rootfs', str(tmp_path), 'true'), sudo=True), timeout=30)
        assert traces.left() == ({f'container {names[0]}'} if of_ours else set())
    finally:
        run(Command((engine, 'rm', '-f', *names), sudo=True), timeout=30, check=False)


@pytest.mark.parametrize('by', ['place', 'run', 'launch', 'launch told later'])
def test_leftover_agent_is_found(look, start, tmp_path, elsewhere, state_home, launch_id, by):
    traces = look()
    words = fake_agent(tmp_path if by == 'place' else elsewhere, launch_id,
                       first=by != 'launch told later')
    if by.startswith('launch'):
        store(state_home, launch_id)
    child = start(*words, **({} if by == 'run' else {RUN: 'another'}))
    (found,) = traces.left()
    assert found.startswith(f'process {child.pid} ') and words[0] in found
