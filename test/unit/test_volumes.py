# SPDX-License-Identifier: Apache-2.0
"""Volumes: how they are written, what is refused, and which one a verb deletes."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
import subprocess
from types import SimpleNamespace
from typing import Any

import pytest

from fogros2 import feature
from fogros2.deploy import checks
from fogros2.errors import (
    Cancelled,
    ConfigurationError,
    DeadlineExceeded,
    FogError,
    NameTaken,
    ShellError,
)
from fogros2.model import Command, MachineSpec, NodeSpec, Volume
from fogros2.provider import Attached, container, ssh, TAG_ROBOT
from fogros2.provider.container import machine as container_machine
from fogros2.provider.kubernetes import claims, names
from fogros2_features.replacement import Replacement
from fogros2_features.volumes import _detach, Volumes
from fogros2_features.volumes.verbs import _named
from fogros2_testing.fakes import FakeRunning


def test_a_volume_has_a_path_and_a_size() -> None:
    assert Volumes.options({'models': '/data/', 'maps': '/var/fog/maps:200GB'}) == {
        'models': ('/data', 50), 'maps': ('/var/fog/maps', 200)}


@pytest.mark.parametrize(('given', 'error'), [
    ({'../x': '/data'}, "'../x' is no name of a volume"),
    ({'Models': '/data'}, "'Models' is no name"),
    ({f'm{number}': f'/data{number}' for number in range(11)}, '11 volumes'),
    ({'m': 'data'}, "no folder and size, but 'data'"),
    ({'m': '~/data'}, 'no folder'),
    ({'m': '/data/../usr'}, 'no folder'),
    ({'m': '/data//x'}, 'no folder'),
    ({'m': '/data,x'}, 'no folder'),
    ({'m': '/'}, 'no folder'),
    ({'m': '/usr'}, 'would hide /usr of the system'),
    ({'m': '/etc/x'}, 'would hide /etc/x'),
    ({'m': '/home/ubuntu'}, 'would hide'),
    ({'m': '/var/lib'}, 'would hide'),
    ({'m': '/opt/ros/jazzy'}, 'would hide'),
    ({'m': '/data:0GB'}, "can't have 0 GB"),
    ({'m': '/data:99999GB'}, "can't have 99999 GB"),
    ({'m': '/data:5TB'}, 'no folder and size'),
    ({'a': '/data', 'b': '/data'}, "'a' and 'b' have one path /data"),
    ({'a': '/data', 'b': '/data/x'}, 'have one path'),
    ({'a': '/data/x', 'b': '/data'}, 'have one path'),
])
def test_wrong_volumes_are_refused(given: dict[str, str], error: str) -> None:
    with pytest.raises(ConfigurationError, match=error):
        Volumes.options(given)


@pytest.mark.parametrize(('provider', 'more', 'error'), [
    ('joined', {}, "provider 'joined' has no volumes"),
    ('ssh', {'workspace': '/data/ws'}, 'would hide the workspace'),
    ('aws', {'wanted': {'region': 'nearest'}}, 'may be at another cloud'),
])
def test_machines_that_cannot_have_a_volume(
    provider: str, more: dict[str, Any], error: str,
) -> None:
    with pytest.raises(FogError, match=error):
        Volumes().check(MachineSpec('a', provider, **more), Volumes.options({'m': '/data'}))


@pytest.mark.parametrize(('provider', 'first', 'second', 'name', 'error'), [
    ('aws', {'region': 'us-west-1'}, {'region': 'us-west-1', 'spot': True}, 'm',
     "'a' and 'b' have one volume 'm'.*give each machine a volume of its own"),
    ('container', {}, {'image': 'mine'}, 'm', "'a' and 'b' have one volume 'm'"),
    ('aws', {'region': 'us-west-1'}, {'region': 'us-west-1'}, 'n', ''),
    ('aws', {'region': 'us-west-1'}, {'region': 'us-west-2'}, 'm', ''),
    ('gcp', {'zone': 'us-west1-a'}, {'zone': 'us-east1-b'}, 'm', ''),
    ('hosted', {'on': 'lab'}, {'on': 'attic'}, 'm', ''),
    ('ssh', {'host': 'lab'}, {'host': 'lab', 'user': 'other'}, 'm', '')])
def test_two_machines_of_one_place_need_two_volumes(
    provider: str, first: dict[str, Any], second: dict[str, Any], name: str, error: str,
) -> None:
    specs = [MachineSpec('a', provider, first, features={'volumes': {'volumes': {'m': '/data'}}}),
             MachineSpec('b', provider, second, features={'volumes': {'volumes': {name: '/x'}}})]
    with pytest.raises(ConfigurationError, match=error) if error else contextlib.nullcontext():
        checks.check_together([*specs, MachineSpec('c', provider, first)])


def test_volumes_are_mounted_as_long_as_others_use_them() -> None:
    """Results are fetched after the nodes have ended; containers mount folders of volumes."""
    spec = MachineSpec('a', 'aws', features={
        'containers': {'docker_containers': ['docker run -v /data:/data db']},
        'results': {'fetch': ['/data']}, 'volumes': {'volumes': {'m': '/data'}}})
    assert feature.names(spec)[:3] == ['volumes', 'containers', 'results']
    assert isinstance(next(feature.used(spec))[0], Volumes)


@pytest.mark.parametrize(('folder', 'error'), [
    ('/data', "gets the volume 'm' at /data, and the checkpoint /data would write an older copy"),
    ('/data/map', 'the checkpoint /data/map would'),
    ('/home/ubuntu', "the volume 'n' at /home/ubuntu/maps, and the checkpoint /home/ubuntu"),
    ('$HOME/maps/a', "the volume 'n' at /home/ubuntu/maps, and the checkpoint ~/maps/a"),
    ('$HOME/data', ''), ('/data2', '')])
def test_checkpoint_is_not_written_over_a_volume(folder: str, error: str) -> None:
    volumes = {'volumes': {'volumes': {'m': '/data', 'n': '/home/ubuntu/maps'}}}
    alone = Replacement.options(on_interrupt='replace')
    node = NodeSpec('a/1', 'slam', features={'replacement': {'checkpoint': folder}})
    with pytest.raises(ConfigurationError, match=error) if error else contextlib.nullcontext():
        Replacement().check(MachineSpec('a', 'aws', features=volumes), Replacement.options(
            on_interrupt='replace', checkpoint=folder))
    with pytest.raises(ConfigurationError, match=error) if error else contextlib.nullcontext():
        Replacement().check_node(MachineSpec('a', 'aws', features=volumes), node, alone)


def test_a_name_of_several_volumes_deletes_none() -> None:
    volumes = [Volume('aws:x/1', 'models', 'aws'), Volume('gcp:y/2', 'models', 'gcp')]
    with pytest.raises(ConfigurationError, match="2 volumes 'models'.*aws:x/1, gcp:y/2"):
        _named(volumes, ['models'])
    assert _named(volumes, ['gcp:y/2']) == volumes[1:]
    with pytest.raises(ConfigurationError, match="no volume 'maps'"):
        _named(volumes, ['maps'])


@pytest.mark.parametrize(('containers', 'error'), [
    ('fogros2-one', ''),
    ('fogros2-two fogros2-one', "'two' has the volume 'models' .*or: ros2 fog delete two"),
    ('fogros2-two-1a2b3c4d', "'two' of the robot lab-1 has .*there: ros2 fog delete two"),
    ('', "'one' of an earlier launch has no volume 'models'"),
])
def test_container_has_a_volume_alone(
    monkeypatch: pytest.MonkeyPatch, containers: str, error: str,
) -> None:
    """Of two launches at once, each may have created a container; a kept one may lack it."""
    def report(name: str) -> dict[str, Any]:
        _, machine, *hosted = name.split('-')
        return {'Name': f'/{name}', 'Config': {'Labels': {
            container_machine.MACHINE: machine, TAG_ROBOT: 'lab-1',
            **dict(zip([container_machine.HOSTED], hosted))}}}

    engine = SimpleNamespace(call=lambda *_, **__: SimpleNamespace(stdout=containers),
                             inspect=lambda names: [report(name) for name in names])
    monkeypatch.setattr(container, '_inspected', lambda machine_id: (
        engine, 'id', {'Config': {'Labels': {container_machine.MACHINE: 'one'}}}))
    with pytest.raises(NameTaken, match=error) if error else contextlib.nullcontext():
        container.ContainerProvider().attach('podman:id', 'models', 50)


def test_first_of_two_pods_has_the_volume() -> None:
    pods = [{'metadata': {'name': f'{job}-x', 'uid': job, 'creationTimestamp': f'{time}Z',
                          'labels': {names.MACHINE: job}}, 'status': {'phase': 'Running'},
             'spec': {'volumes': [{'persistentVolumeClaim': {'claimName': 'fogros2-volume-m'}}]}}
            for job, time in (('b', '10:00'), ('a', '10:00'), ('c', '10:01'))]
    api: Any = SimpleNamespace(request=lambda *_, **__: {'items': pods})
    assert claims.users(api, 'default') == {'fogros2-volume-m': 'a'}


def test_folder_that_cannot_be_deleted_is_not_in_use(tmp_path: Path) -> None:
    (tmp_path / '.local/share/fogros2-volumes/models').mkdir(parents=True)
    (tmp_path / 'rm').write_text('#!/bin/sh\necho denied >&2; exit 1\n')
    (tmp_path / 'rm').chmod(0o755)
    result = subprocess.run(
        ['sh', '-c', ssh._DELETE, 'sh', 'models'], capture_output=True, text=True, check=False,
        env={'HOME': str(tmp_path), 'PATH': f"{tmp_path}:{os.environ['PATH']}"})
    assert (result.returncode, result.stderr) == (1, 'denied\n')


def test_volume_is_detached_when_its_attachment_is_interrupted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The disk may have been attached by then; nothing of it is mounted."""
    calls: list[tuple[str, ...]] = []

    def attach(machine_id: str, name: str, size_gb: int) -> None:
        calls.append(('attach', machine_id, name))
        raise Cancelled('attach')

    running: Any = FakeRunning(spec=MachineSpec('a', 'aws', on_exit='stop'))
    running.provider = None
    monkeypatch.setattr('fogros2_features.volumes._keeper', lambda provider: SimpleNamespace(
        attach=attach, detach=lambda *words: calls.append(('detach', *words))))
    with pytest.raises(Cancelled), Volumes().machine(running, {'models': ('/data', 50)}):
        raise AssertionError('no node may start')
    assert calls == [('attach', 'fake-1', 'models'), ('detach', 'fake-1', 'models')]


@pytest.mark.parametrize(('seconds', 'error'), [
    (25e9 / 125e6, ''), (1e5, "'a' may not have written all files to the volume 'models': late")])
def test_volume_has_time_to_be_written(seconds: float, error: str) -> None:
    """A machine may have written a fifth of its memory, such as 25 GB, to no disk yet."""
    class Slow(FakeRunning):
        def run(self, command: Command, *, timeout: float) -> str:
            if timeout < seconds:
                raise DeadlineExceeded('late')
            return ''

    running: Any = Slow(spec=MachineSpec('a', 'aws'))
    keeper: Any = None
    with pytest.raises(ShellError, match=error) if error else contextlib.nullcontext():
        _detach(running, keeper, 'models', '/data', [Attached(('/dev/x',))])


def test_host_lists_no_volume_of_another_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ssh.SSHProvider, '_run', lambda *_: (
        'models used\nmaps free\na folder free\n../x free\n\x1b[2J free\n'))
    assert [(volume.name, bool(volume.user)) for volume in ssh.SSHProvider().volumes(['lab'])] == [
        ('models', True), ('maps', False)]
