# SPDX-License-Identifier: Apache-2.0
"""Machines that don't answer, and computers that two robots want at the same moment."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import dataclasses
import functools
import json
import os
from pathlib import Path
import shutil
import sys
import threading
import time
import uuid

import pytest

from fogros2.agent_client import agent_program, AgentClient
from fogros2.deploy import Launch, undo
from fogros2.deploy.machine_job import MachineJob
from fogros2.deploy.steps import arming
from fogros2.deploy.steps.arming import Arming
from fogros2.errors import AgentError, FogError
from fogros2.model import Command, Endpoint, Machine, MachineSpec, MachineState
from fogros2.process import _ENVIRONMENT, run
from fogros2.provider.container import machine as container_machine
from fogros2.shell.local import LocalShell
from fogros2.store import Store

pytestmark = [
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
]

#: Other runs of these tests may be under way on the same computer.
RUN = uuid.uuid4().hex[:6]

#: What a cut does on the way to a machine.
CUT = """\
table inet cut {
  chain input { type filter hook input priority -200; policy accept; iifname != "lo" drop; }
  chain output { type filter hook output priority -200; policy accept; oifname != "lo" drop; }
}
"""


def test_end_does_not_wait_for_an_unreachable_machine(cloud_network):
    store = Store()
    spec = MachineSpec(f'away-{RUN}', 'container', {'network': cloud_network}, on_exit='keep')
    launch = Launch(store=store)
    machine = launch.up(spec)
    engine, identity, _ = container_machine.parse_id(machine.machine.id)
    engine.call('exec', identity, 'sh', '-c', 'printf %s "$1" | nft -f -', 'sh', CUT,
                what='cut the way')
    begin = time.monotonic()
    launch.cancel.set()
    with pytest.raises(FogError):
        machine.stop()
    failures = launch.down()
    seconds = time.monotonic() - begin
    engine.call('exec', identity, 'nft', 'delete', 'table', 'inet', 'cut', what='mend the way')
    # the next launch knows the one that died, whatever its agent believes
    again = Launch(store=store)
    try:
        assert again.up(MachineSpec(spec.name, spec.provider, spec.options)).machine.id \
            == machine.machine.id
    finally:
        assert again.down() == []
    # a command of a machine that answers has 60 s
    assert seconds < 45, f'{seconds:.0f} s'
    told, = failures
    assert f"'{spec.name}' does not answer" in str(told) and '(nodes, VPN)' in str(told)
    assert f'ros2 fog delete {spec.name}' in told.hint


def arm(start, machine, robot):
    """Return the machine's agent, or why it isn't to be had."""
    context, job = robot
    job.record = dataclasses.replace(job.record, last=context.launch_id)
    job.machine, job.shell = machine, LocalShell(Endpoint('local'), name=job.name)
    start.wait(60)
    try:
        Arming(context, job).arm()
        return job.agent
    except FogError as error:
        job.undo.close()
        return error


def test_of_two_robots_that_come_at_once_one_gets_the_computer(root, tmp_path):
    if os.geteuid() != 0:
        pytest.skip('the agent is started here as root')
    name = f'shared-{RUN}'
    machine = Machine('ssh:', name, 'ssh', MachineState.RUNNING, owned=False,
                      endpoint=Endpoint('local', user='root'))
    spec = MachineSpec(name, 'ssh', {'host': 'localhost'})
    contexts = [Launch(store=Store(tmp_path / f'{number}')).context(spec)
                for number in range(2)]
    robots = [(context, MachineJob(context, spec)) for context in contexts]
    with ThreadPoolExecutor(2) as pool:
        outcomes = list(pool.map(functools.partial(arm, threading.Barrier(2), machine), robots))
    winner, = (number for number, one in enumerate(outcomes) if isinstance(one, AgentClient))
    error = outcomes[1 - winner]
    assert isinstance(error, AgentError), error
    assert error.hint and name in str(error) or 'belongs to launch' in str(error), error
    assert outcomes[winner].request('status')['launch'] == contexts[winner].launch_id
    # a third one that comes later takes nothing from the winner
    third = Launch(store=Store(tmp_path / 'third')).context(spec)
    late = arm(threading.Barrier(1), machine, (third, MachineJob(third, spec)))
    assert isinstance(late, AgentError) and 'belongs to launch' in str(late), late
    assert outcomes[winner].request('status')['launch'] == contexts[winner].launch_id
    robots[winner][1].undo.close()
    assert not os.path.exists(f'/run/fogros2/{name}')


def test_agent_is_removed_where_python_is_a_wrapper(root, tmp_path, monkeypatch):
    if os.geteuid() != 0:
        pytest.skip('the agent is started here as root')
    wrapper = tmp_path / 'bin' / 'python3'  # as pyenv has one
    wrapper.parent.mkdir()
    wrapper.write_text(f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    wrapper.chmod(0o755)
    monkeypatch.setitem(_ENVIRONMENT, 'PATH', f"{wrapper.parent}:{_ENVIRONMENT['PATH']}")
    folder = f'/run/fogros2/wrapped-{RUN}'
    config = {'machine': 'wrapped', 'launch': 'first', 'directory': folder, 'user': 'root'}
    run(Command(('sh', '-ec', arming._INSTALL, 'sh', '/run/fogros2', folder, f'{folder}/agent.py',
                 f'{folder}/start-first.json', 'root'),
                input=json.dumps(config).encode() + b'\n' + agent_program().encode()), timeout=30)
    program = Path('/proc', Path(folder, 'agent.pid').read_text().strip(), 'cmdline')
    assert b'agent.py' in program.read_bytes()
    run(Command(('sh', '-ec', undo._REMOVE, 'sh', folder, 'first',
                 f'{folder}/start-first.json')), timeout=30)
    assert not os.path.exists(folder)
    assert not program.exists() or not program.read_bytes()
