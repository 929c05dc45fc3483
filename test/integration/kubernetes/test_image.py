# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog image create`` with a real builder, and a registry that does not answer."""

from __future__ import annotations

import os
import shutil

import pytest

from fogros2.model import Command
from fogros2.process import run
from fogros2.provider.container.root import Archive
from rigs.cluster.images import static_busybox
from rigs.launched import ros2

pytestmark = [
    pytest.mark.skipif(shutil.which('ros2') is None, reason='needs ros2 on PATH'),
    pytest.mark.skipif(os.geteuid() != 0, reason='builds images as root'),
]

BASE = 'localhost/fogt-base:1'
APPLETS = ('cat chmod chown cp echo grep kill ls mkdir rm sh sleep test true').split()
#: Stands for the packages, which nobody has here: notes which were asked for.
APT = b'#!/bin/sh\necho "$*" >>/asked\n'


def test_image_has_the_packages_and_is_pushed(engine, tmp_path):
    base = Archive()
    base.file('bin/busybox', static_busybox().read_bytes(), 0o755)
    for name in APPLETS:
        base.link(f'bin/{name}', 'busybox')
    base.file('bin/apt-get', APT, 0o755)
    base.file('etc/passwd', b'root:x:0:0::/root:/bin/sh\nfog:x:1729:1729::/root:/bin/sh\n')
    (tmp_path / 'base.tar').write_bytes(base.data())
    settings = tmp_path / 'storage.conf'
    settings.write_text(f'[storage]\ndriver = "vfs"\ngraphroot = "{tmp_path}/store"\n'
                        f'runroot = "{tmp_path}/run"\n')
    environment = {'CONTAINERS_STORAGE_CONF': str(settings)}
    run(Command((engine, 'import', '-q', '-c', 'ENV PATH=/bin', f'{tmp_path}/base.tar', BASE),
                environment=environment), timeout=60.0)
    made = ros2('fog', 'image', 'create', '--base', BASE, '--workspace', '', '--engine', engine,
                '--folder', str(tmp_path / 'context'), '--registry', 'localhost:9/robots',
                environment={**os.environ, **environment})
    assert made.returncode != 0 and 'pushing localhost:9/robots/fogros2:' in made.stderr, made
    assert 'is localhost:9 right, and reachable from here?' in made.stderr, made
    asked = [line for layer in (tmp_path / 'store').rglob('asked')
             for line in layer.read_text().splitlines()]
    assert asked[0].endswith(' update')
    installs = next(line for line in asked if ' install ' in line)
    assert {'ros-jazzy-ros-base', 'ros-jazzy-rmw-fastrtps-cpp', 'rsync', 'wireguard-tools',
            'wireguard-go'} <= set(installs.split())
