# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog image create`` with a real builder and a real registry, where the pod gets it."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import os
import shutil
import socket
import subprocess
import tarfile

import pytest

from fogros2.model import Command, MachineSpec
from fogros2.process import run
from fogros2.provider.kubernetes import KubernetesProvider
from fogros2.waiting import wait_until
from fogros2_testing import request_for
from rigs.cluster import services
from rigs.cluster.images import static_busybox
from rigs.launched import ros2

pytestmark = [
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
    pytest.mark.skipif(os.geteuid() != 0, reason='builds images as root'),
]

BASE = 'localhost/fogt-base:1'
APPLETS = ('cat chmod chown cp echo grep kill ls mkdir rm sh sleep test true').split()
#: Stands for the packages, which nobody has here: notes which were asked for.
APT = '#!/bin/sh\necho "$*" >>/asked\n'


def base_layer(target):
    """Write a system that consists of one program, as an archive."""
    with tarfile.open(target, 'w') as layer:
        def put(name, data, mode=0o755, **more):
            info = tarfile.TarInfo(name)
            info.size, info.mode = len(data), mode
            for key, value in more.items():
                setattr(info, key, value)
            layer.addfile(info, io.BytesIO(data))

        put('bin/busybox', static_busybox().read_bytes())
        for name in APPLETS:
            put(f'bin/{name}', b'', type=tarfile.SYMTYPE, linkname='busybox')
        put('bin/apt-get', APT.encode())
        put('etc/passwd', b'root:x:0:0::/root:/bin/sh\nfog:x:1729:1729::/root:/bin/sh\n', 0o644)


class Registry:
    """A registry on this computer's end of the cluster's cable."""

    def __init__(self, folder, cluster, stack):
        self.host = cluster.layout.host
        with socket.socket() as probe:
            probe.bind((self.host, 0))
            self.name = f'{self.host}:{probe.getsockname()[1]}'
        folder.mkdir()
        config = folder / 'config.yml'
        config.write_text(
            f'version: 0.1\nstorage: {{filesystem: {{rootdirectory: {folder}/data}}}}\n'
            f"http: {{addr: '{self.name}', secret: none}}\n")
        # gone with this process, even if that is killed
        self.child = subprocess.Popen(
            ['setpriv', '--pdeathsig', 'KILL', 'docker-registry', 'serve', str(config)],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        stack.callback(self.child.wait)
        stack.callback(self.child.kill)
        wait_until(self.listens, timeout=30.0, what='the registry')
        known = cluster.folder / services.REGISTRIES / self.name
        known.mkdir(parents=True)
        stack.callback(shutil.rmtree, known)
        (known / 'hosts.toml').write_text(
            f'[host."http://{self.name}"]\n  capabilities = ["pull", "resolve"]\n')

    def listens(self):
        host, port = self.name.split(':')
        with socket.socket() as probe:
            return probe.connect_ex((host, int(port))) == 0


@pytest.fixture(scope='module')
def builder(engine, kubernetes, tmp_path_factory):
    """Return what makes an image, with a store and settings of the test's own, and a registry."""
    folder = tmp_path_factory.mktemp('builder')
    settings = {'CONTAINERS_STORAGE_CONF': folder / 'storage.conf',
                'CONTAINERS_REGISTRIES_CONF': folder / 'registries.conf'}
    settings['CONTAINERS_STORAGE_CONF'].write_text(
        f'[storage]\ndriver = "vfs"\ngraphroot = "{folder}/store"\nrunroot = "{folder}/run"\n')
    base_layer(folder / 'base.tar')
    with contextlib.ExitStack() as stack:
        registry = Registry(folder / 'open', kubernetes, stack)
        settings['CONTAINERS_REGISTRIES_CONF'].write_text(
            f'[[registry]]\nlocation = "{registry.name}"\ninsecure = true\n')
        environment = {name: str(path) for name, path in settings.items()}
        run(Command((engine, 'import', '-q', '-c', 'ENV PATH=/bin', f'{folder}/base.tar', BASE),
                    environment=environment), timeout=60.0)

        def create(*words):
            return ros2('fog', 'image', 'create', '--base', BASE, '--workspace', '',
                        '--engine', engine, '--folder', str(folder / 'context'), *words,
                        environment={**os.environ, **environment})

        create.registry, create.folder = registry, folder
        yield create


def test_pod_runs_an_image_that_was_built_and_pushed(builder, namespace):
    made = builder('--registry', f'{builder.registry.name}/robots')
    assert made.returncode == 0, made
    reference = made.stdout.splitlines()[0].removeprefix('pushed ')
    assert reference.startswith(f'{builder.registry.name}/robots/fogros2:'), made
    tag = reference.rpartition(':')[2]
    assert f"container_image='{builder.registry.name}/robots/fogros2:{{dependencies}}'" \
        in made.stdout
    provider = KubernetesProvider()
    # no Python in it, so nobody there could answer the question for a node's port
    spec = MachineSpec('built', provider.name, {
        'container_image': reference.replace(tag, '{dependencies}'), 'expose': 'pod_dials_robot'})
    machine_id = provider.create(
        spec, dataclasses.replace(request_for(spec), dependencies=tag))
    try:
        provider.reachable(machine_id, name='built', timeout=60.0)
        (pod,) = namespace.all('pods')
        status, = pod['status']['containerStatuses']
        assert status['image'] == reference and 'running' in status['state']
    finally:
        provider.destroy(machine_id)


@pytest.mark.skipif(shutil.which('buildah') is None, reason='needs buildah')
def test_buildah_builds_and_pushes_an_image(builder):
    made = builder('--registry', f'{builder.registry.name}/buildah', '--engine', 'buildah')
    assert made.returncode == 0, made
    assert made.stdout.startswith(f'pushed {builder.registry.name}/buildah/fogros2:'), made


def test_image_has_the_requested_packages(builder):
    made = builder('--registry', 'localhost/fogt', '--no-push')
    assert made.returncode == 0 and made.stdout.startswith('built localhost/fogt/fogros2:'), made
    asked = [line for layer in (builder.folder / 'store').rglob('asked')
             for line in layer.read_text().splitlines()]
    assert asked[0].endswith(' update')
    installs = next(line for line in asked if ' install ' in line)
    assert {'ros-jazzy-ros-base', 'ros-jazzy-rmw-fastrtps-cpp', 'rsync', 'wireguard-tools',
            'wireguard-go'} <= set(installs.split())
