# SPDX-License-Identifier: Apache-2.0
"""A viewer chooses the names of a robot model's files; they lead to nothing else."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from fogros2.errors import FogError

assets = pytest.importorskip('fogros2_monitor.assets', reason='rclpy is not installed')
SECRET, MESH = b'secret', b'solid arm'


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a workspace with a package ``arm``, and files beside it that no viewer may have."""
    for folder in ('ws/install/arm', 'ws/install/armory'):
        prefix = tmp_path / folder
        index = prefix / 'share/ament_index/resource_index/packages'
        index.mkdir(parents=True)
        (index / prefix.name).touch()
    (tmp_path / 'ws/src/arm/meshes').mkdir(parents=True)
    (tmp_path / 'ws/src/arm/meshes/linked.dae').write_bytes(MESH)
    share = tmp_path / 'ws/install/arm/share/arm'
    (share / 'meshes/deep.stl').mkdir(parents=True)
    (share / 'meshes/upper arm.STL').write_bytes(MESH)
    (share / 'config.yaml').write_bytes(SECRET)
    for path in (share.parent / 'other.stl', tmp_path / 'key.stl', tmp_path / 'key',
                 tmp_path / 'ws/src/key'):
        path.write_bytes(SECRET)
    for name, target in {
            'out.stl': tmp_path / 'key.stl', 'key.stl': tmp_path / 'ws/src/key',
            'up': share.parent, 'root': Path('/'), 'round.stl': share / 'meshes/round.stl',
            'linked.dae': tmp_path / 'ws/src/arm/meshes/linked.dae'}.items():
        (share / 'meshes' / name).symlink_to(target)
    os.mkfifo(share / 'meshes/pipe.stl')
    monkeypatch.setenv('AMENT_PREFIX_PATH', os.pathsep.join(
        str(tmp_path / 'ws/install' / name) for name in ('arm', 'armory')))
    return tmp_path / 'ws'


@pytest.mark.parametrize('uri', [
    'package://arm/meshes/upper arm.STL', 'package://arm/meshes/upper%20arm.STL'])
def test_mesh_of_a_package_is_read(workspace: Path, uri: str) -> None:
    assert assets.read(uri) == MESH


@pytest.mark.parametrize('uri', [
    '', 'package://', 'package://arm', 'package://arm/', 'package:///arm/a.stl', 'arm/a.stl',
    'file:///etc/passwd', '/etc/passwd', 'http://127.0.0.1/a.stl', 'PACKAGE://arm/a.stl',
    ' package://arm/meshes/upper arm.STL', 'package://arm/meshes/upper arm.STL\n',
    'package://../a.stl', 'package://./a.stl', 'package://%61rm/a.stl', 'package://a\0/a.stl',
    'package://\u0430rm/a.stl', 'package://arm\\..\\x/a.stl', f'package://{"a" * 500}/a.stl',
    *(f'package://arm/{path}' for path in (
        '../other.stl', 'meshes/../../other.stl', '..%2fother.stl', '%2e%2e/other.stl',
        '%2E%2E%2Fother.stl', '.%2e/other.stl', '%252e%252e/other.stl', '..\\other.stl',
        '..%5cother.stl', '/key.stl', '//key.stl', '%2fetc/a.stl', './meshes/upper arm.STL',
        'meshes//upper arm.STL', 'meshes/./upper arm.STL', 'meshes/upper arm.STL/',
        'meshes/upper arm.STL%00.stl', 'config.yaml%00.stl', 'config.yaml\0.stl', '%00',
        '%ff.stl', '%', '%2', 'meshes/%0aupper.stl', 'meshes/\u202eupper.stl', '~/a.stl',
        '$HOME/a.stl', 'config.yaml', 'config.yaml?.stl', 'config.yaml#.stl', 'meshes', 'meshes/',
        'meshes/upper arm', '.stl', 'meshes/.stl', 'package.xml', 'meshes/no.stl',
        'a' * 300 + '.stl', 'a/' * 400 + 'a.stl', 'a' * 20_000_000 + '.stl')),
    *(f'package://arm/meshes/{path}' for path in (
        'out.stl', 'key.stl', 'up/other.stl', 'root/etc/passwd', 'round.stl', 'deep.stl',
        'pipe.stl', 'root/dev/zero.stl', 'upper arm.STL/x.stl')),
    'package://no_such_package/a.stl', 'package://armory/meshes/upper arm.STL',
    'package://ament_index/resource_index/packages/arm.stl',
], ids=lambda uri: repr(uri)[:40])
def test_no_other_file_is_read(workspace: Path, uri: str) -> None:
    with pytest.raises(FogError):
        assets.read(uri)


def test_link_is_followed_in_a_workspace_of_colcon_alone(workspace: Path) -> None:
    """``colcon build --symlink-install`` links installed files to the sources."""
    uri = 'package://arm/meshes/linked.dae'
    with pytest.raises(FogError, match='leads out of'):
        assets.read(uri)
    (workspace / 'install/.colcon_install_layout').write_text('isolated\n')
    assert assets.read(uri) == MESH
    for name in ('out', 'key', 'root/etc/other'):
        with pytest.raises(FogError):
            assets.read(f'package://arm/meshes/{name}.stl')


def test_large_file_is_refused(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(assets, 'LARGEST', len(MESH))
    assert assets.read('package://arm/meshes/upper%20arm.STL') == MESH
    monkeypatch.setattr(assets, 'LARGEST', len(MESH) - 1)
    with pytest.raises(FogError, match='at most'):
        assets.read('package://arm/meshes/upper%20arm.STL')
