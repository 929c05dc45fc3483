# SPDX-License-Identifier: Apache-2.0
"""Images for pods: what they are built of, and by which commands."""

from __future__ import annotations

import os

import pytest

from fogros2 import process
from fogros2.errors import ConfigurationError, PrerequisiteError, ProviderError
from fogros2.model import CreateRequest
from fogros2.provider.kubernetes import image, manifests
from fogros2.provider.kubernetes.options import Options
from fogros2_testing.shell_contract import raised

HASH = '0123456789abcdef'


def recipe(**changes):
    return image.recipe(**{
        'registry': 'registry.example/robots', 'dependencies': HASH,
        'script': 'true\n', **changes})


def test_the_tag_is_the_hash_of_what_is_in_it():
    assert recipe().reference == f'registry.example/robots/fogros2:{HASH}'
    assert recipe(registry='localhost:5000').reference == f'localhost:5000/fogros2:{HASH}'


def test_a_launch_takes_the_image_that_fits():
    options = Options.parse({'container_image': 'registry.example/fogros2:{dependencies}'})
    assert manifests.image_for(options, HASH) == f'registry.example/fogros2:{HASH}'
    assert manifests.image_for(Options(), HASH) == Options().container_image
    assert CreateRequest('t', '', {}, 1, dependencies=HASH).dependencies == HASH


def test_the_containerfile_runs_the_script():
    lines = recipe(script='echo "a"\ntrue\n').containerfile.splitlines()
    assert lines[1] == 'FROM docker.io/library/ros:jazzy-ros-base'
    assert f'LABEL fogros2-dependencies={HASH}' in lines
    assert r'RUN ["sh", "-ec", "echo \"a\"\ntrue\n"]' in lines
    assert lines[-1].endswith('useradd -m -u 1729 fog')


@pytest.mark.parametrize('changes', [
    {'registry': 'Registry/x'}, {'registry': '--all'}, {'base': 'a b'}, {'base': '-x'}])
def test_words_that_would_do_something_else_are_refused(changes):
    raised(ConfigurationError, lambda: recipe(**changes))


def test_commands(tmp_path):
    what = recipe()
    build, push = image.commands(what, tmp_path, 'podman')
    assert build.argv == ('podman', 'build', '-t', what.reference, '-f',
                          f'{tmp_path}/Containerfile', str(tmp_path))
    assert push.argv == ('podman', 'push', what.reference)
    assert len(image.commands(what, tmp_path, 'podman', push=False)) == 1


@pytest.fixture
def engine(tmp_path, monkeypatch):
    """Return a folder on PATH with a buildah that notes its arguments, and may fail."""
    folder = tmp_path / 'bin'
    folder.mkdir()
    program = folder / 'buildah'
    program.write_text('#!/bin/sh\n'
                       f'echo "$*" >>{tmp_path}/told\n'
                       f'[ "$1" != push ] || [ ! -e {tmp_path}/refuse ] || '
                       '{ echo "unauthorized: access denied" >&2; exit 125; }\n')
    program.chmod(0o755)
    monkeypatch.setitem(process._ENVIRONMENT, 'PATH', f'{folder}:{os.environ["PATH"]}')
    return tmp_path


def test_it_is_built_and_pushed(engine):
    what = recipe()
    assert image.build(what, engine / 'context', program='buildah') == what.reference
    told = (engine / 'told').read_text().splitlines()
    assert [line.split()[0] for line in told] == ['build', 'push']
    assert (engine / 'context/Containerfile').read_text() == what.containerfile


def test_registry_that_needs_a_login_is_reported(engine):
    (engine / 'refuse').touch()
    error = raised(ProviderError, lambda: image.build(
        recipe(), engine / 'context', program='buildah'))
    assert 'pushing registry.example/robots/fogros2' in str(error)
    assert error.hint == 'buildah login registry.example'


def test_missing_program_is_reported_with_its_name(monkeypatch):
    monkeypatch.setattr(process, 'which', lambda name: None)
    assert 'podman, docker, buildah' in str(raised(PrerequisiteError, lambda: image.engine()))
    monkeypatch.setattr(process, 'which', lambda name: name == 'docker')
    assert image.engine() == 'docker'
    monkeypatch.setattr(process, 'which', lambda name: None)
    assert raised(PrerequisiteError, lambda: image.engine('docker')).hint.endswith(' docker.io')
