# SPDX-License-Identifier: Apache-2.0
"""A deployment that starts nothing, for launches run in the test's own process."""

from __future__ import annotations

import functools
import math
import os
import stat
import tempfile
import threading
from types import SimpleNamespace

import pytest

from fogros2 import CloudNode, ContainerInstance, events
from fogros2.deploy.context import programs_of
from fogros2.errors import AgentError, Cancelled
from fogros2.provider import Capabilities
from fogros2.report import step
from fogros2.store import Store
from rigs.launching import HERE, Watch


class FakeMachine:
    """A RunningMachine that notes its requests."""

    def __init__(self, launch, spec):
        self.launch = launch
        self.spec = spec
        self.machine = SimpleNamespace(vpn_host='192.0.2.7', endpoint=None)
        self.vpn_address = '10.99.0.2'
        self.callback = None
        self.nodes = {}
        self.all = []
        self.stops = []
        self.signals = []
        self.announced = False
        self.exits_on_stop = True
        #: Why the machine is gone, '' while it is there.
        self.lost = ''
        self.time_left = math.inf
        #: Whether the provider confirms a notice: its answers, of which the last stays.
        self.confirms = [True]
        self.pids = iter(range(4001, 5000))
        #: The states of nodes in the agent's status.
        self.statuses = []

    def start(self, nodes):
        if self.lost:
            raise AgentError('the connection to the agent was closed')
        if self.launch.start_errors:
            raise self.launch.start_errors.pop(0)
        self.launch.on_request(nodes)
        if self.launch.start_error is not None:
            raise self.launch.start_error
        for node in nodes:
            self.launch.note('start', self.spec.name, node.name)
            self.all.append(node)
            self.nodes[node.executable or node.arguments[0]] = node
            if len(self.all) - 1 not in self.launch.silent:
                self.say('started', node, pid=next(self.pids), cmd=['/there/program'])
            on_start = self.launch.on_start
            if on_start is not None:
                on_start(self, node)

    def restore(self):
        self.launch.note('restore', self.spec.name)
        if self.launch.restore_error is not None:
            raise self.launch.restore_error

    def stop(self, ids=None):
        self.stops.append(list(ids))
        self.launch.note('stop', self.spec.name, *ids)
        if self.exits_on_stop:
            for node in self.all:
                if node.id in ids:
                    self.say('exited', node, returncode=-2, respawns=False)

    def reclaimed(self, timeout):
        self.launch.note('reclaimed', self.spec.name, timeout)
        return self.confirms.pop(0) if len(self.confirms) > 1 else self.confirms[0]

    def end(self, reason):
        self.launch.note('end', self.spec.name, reason)
        return True

    def note(self, key, value):
        self.launch.note('note', key, value)

    def open_port(self, port, allowed):
        self.launch.note('open', port, *allowed)
        return '192.0.2.7', port

    def signal(self, node, name):
        self.signals.append((node, name))

    def node_states(self):
        return self.statuses

    def subscribe(self, callback):
        self.callback = callback
        if self.lost:
            callback({'event': 'lost', 'reason': self.lost})

    def say(self, name, node=None, **fields):
        """Send an event, from another thread as the agent's connection does."""
        event = {'event': name, **fields}
        if node is not None:
            event.update(node=node.id, name=node.name)
        if name not in ('connection', 'gap', 'lost', 'given_up'):
            assert events.event(event) is not None  # as the agent's connection checks it
        thread = threading.Thread(target=self.callback, args=(event,))
        thread.start()
        thread.join()


class FakeLaunch:
    """A fogros2.deploy.Launch without machines."""

    id = 'abcdef'

    def __init__(self):
        self.notes = []
        self.machines = {}
        self.lock = threading.Lock()
        self.report = None
        self.cancel = None
        self.store = Store()
        self.environment = {}
        #: The VPNs of other robots, by the names of their machines.
        self.other_vpns = {}
        #: Called with the machine and the node when a node was started.
        self.on_start = None
        #: Names of machines whose ``up`` waits until the event is set, or the launch ends.
        self.waits = {}
        self.errors = {}
        #: Errors of the next calls of ``retire``, one for each call.
        self.retire_errors = []
        self.here_error = None
        #: Called with the nodes of each request, and the numbers of nodes whose start gets lost.
        self.on_request = lambda nodes: None
        self.silent = set()
        #: What machines refuse nodes with.
        self.start_error = None
        #: Why machines do not restore an agent.
        self.restore_error = None
        #: Errors of the next requests to start nodes, one for each.
        self.start_errors = []
        self.prepare_error = None
        self.ros2 = None
        self.down_errors = []
        self.spent = []

    def __call__(self, *, report, environment, cancel):
        self.report = report
        self.environment = environment
        self.cancel = cancel
        return self

    def use_dds(self, name):
        self.note('dds', name)

    def note(self, *what):
        with self.lock:
            self.notes.append(what)

    def noted(self, what):
        with self.lock:
            return [note[1:] for note in self.notes if note[0] == what]

    def provider(self, name):
        return SimpleNamespace(has_own_packages=lambda spec: 'image' in spec.options,
                               shared_folders=lambda spec: ['/shared'],
                               check_containers=lambda spec: None,
                               other_vpn=lambda spec: self.other_vpns.get(spec.name),
                               capabilities=Capabilities())

    def expect(self, names):
        self.note('expect', *names)

    def drops(self, environment):
        """Take 101 as the only other domain."""
        return environment.get('ROS_DOMAIN_ID') == '101'

    def join(self, spec):
        """Join nothing: all machines are the launch's own."""

    def check_here(self, specs, programs):
        self.note('check here', [spec.name for spec in specs], programs)
        if self.here_error is not None:
            raise self.here_error

    def robot_environment(self):
        self.note('robot environment')
        return {'RMW_IMPLEMENTATION': 'rmw_fastrtps_cpp', 'CYCLONEDDS_URI': '<CycloneDDS/>'}

    def programs(self):
        return self.ros2

    def prepare(self, specs, nodes):
        self.note('prepare', [spec.name for spec in specs],
                  {name: programs_of(some) for name, some in nodes.items()})
        if self.prepare_error is not None:
            raise self.prepare_error

    def up(self, spec):
        self.note('up', spec.name)
        with step(self.report, spec.name, 'machine') as detail:
            wait = self.waits.get(spec.name)
            while wait is not None and not wait.wait(0.01):
                if self.cancel.is_set():
                    raise Cancelled(spec.name)
            if spec.name in self.errors:
                raise self.errors[spec.name]
            detail.append('made of air')
        machine = self.machines[spec.name] = FakeMachine(self, spec)
        self.note('is up', spec.name)
        return machine

    def retire(self, name):
        self.note('retire', name)
        if self.retire_errors:
            raise self.retire_errors.pop(0)

    def down(self):
        self.note('down')
        return self.down_errors

    def costs(self):
        return self.spent


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Return the prefix of an ament package ``demo`` with a program ``talker``."""
    prefix = tmp_path / 'prefix'
    marker = prefix / 'share/ament_index/resource_index/packages/demo'
    marker.parent.mkdir(parents=True)
    marker.touch()
    (prefix / 'share/demo').mkdir()
    program = prefix / 'lib/demo/talker'
    program.parent.mkdir(parents=True)
    program.write_text('#!/bin/sh\necho here; exec sleep 60\n')
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    before = os.environ.get('AMENT_PREFIX_PATH')
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'{prefix}:{before}' if before else str(prefix))
    return prefix


@pytest.fixture
def talker(package):
    """Return what makes a cloud node that says on the robot how it was called."""
    program = package / 'lib/demo/says'
    program.write_text(HERE)
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    return functools.partial(CloudNode, package='demo', executable='says', output='screen')


@pytest.fixture
def watch():
    return Watch()


@pytest.fixture
def planner():
    """Return a machine without a workspace."""
    return ContainerInstance(name='planner', ros_workspace='')


@pytest.fixture
def fake():
    """Return a FakeLaunch."""
    return FakeLaunch()


@pytest.fixture
def run(fake, package, monkeypatch, tmp_path):
    """Return a function that runs a launch description on the fake and returns its status."""
    from launch import LaunchService
    import launch.logging

    from fogros2.runtime.coordinator import Coordinator

    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    # launch leaves the parameter files it makes
    monkeypatch.setattr(tempfile, 'tempdir', str(tmp_path))
    before = dict(os.environ)
    # earlier loggers wrote to streams and folders of another test
    launch.logging.reset()

    def run(description, **arguments):
        service = LaunchService(noninteractive=True, **arguments)
        Coordinator(service.context, make_launch=fake)
        service.include_launch_description(description)
        run.context = service.context
        run.service = service
        return service.run()

    yield run
    launch.logging.reset()
    os.environ.clear()
    os.environ.update(before)
