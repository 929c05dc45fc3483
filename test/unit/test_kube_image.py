# SPDX-License-Identifier: Apache-2.0
"""Images for pods: what they are built of, and by which commands."""

from __future__ import annotations

import os

import pytest

from fogros2 import process
from fogros2.errors import ConfigurationError, PrerequisiteError, ProviderError
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


@pytest.fixture
def engine(tmp_path, monkeypatch):
    """Return a folder on PATH with a buildah that notes its arguments, and may fail."""
    folder = tmp_path / 'bin'
    folder.mkdir()
    program = folder / 'buildah'
    program.write_text('#!/bin/sh\n'
                       f'echo "$*" >>{tmp_path}/told\n'
                       f'[ ! -e {tmp_path}/"$1" ] || {{ cat {tmp_path}/"$1" >&2; exit 125; }}\n')
    program.chmod(0o755)
    monkeypatch.setitem(process._ENVIRONMENT, 'PATH', f'{folder}:{os.environ["PATH"]}')
    return tmp_path


def test_it_is_built_and_pushed(engine):
    what = recipe()
    assert image.build(what, engine / 'context', program='buildah') == what.reference
    build, push = (engine / 'told').read_text().splitlines()
    folder = engine / 'context'
    assert build == f'build -t {what.reference} -f {folder}/Containerfile {folder}'
    assert push == f'push {what.reference}'
    assert (folder / 'Containerfile').read_text() == what.containerfile
    image.build(what, folder, program='buildah', push=False)
    assert (engine / 'told').read_text().splitlines() == [build, push, build]


@pytest.mark.parametrize('step, said, hint', [
    ('push', 'unauthorized: access denied', 'buildah login registry.example'),
    ('push', 'Error: trying to reuse blob\nError: pinging container registry: dial tcp '
     '198.51.100.1:443: connect: connection refused', 'is registry.example right, and reachable'),
    ('push', 'Error: http: server gave HTTP response to HTTPS client', 'speaks no TLS'),
    ('build', 'Error: reading manifest: manifest unknown', 'is there an image '),
    ('build', 'permission denied', 'let this user use buildah'),
    ('build', '', '')])
def test_failing_step_is_reported_with_its_remedy(engine, step, said, hint):
    (engine / step).write_text(said)
    error = raised(ProviderError, lambda: image.build(
        recipe(), engine / 'context', program='buildah'))
    what = 'pushing' if step == 'push' else 'building'
    assert str(error).startswith(f'{what} registry.example/robots/fogros2:{HASH} failed: ')
    assert (said.split('\n')[-1] or 'it says nothing') in str(error)
    assert hint in error.hint if hint else not error.hint


def test_missing_program_is_reported_with_its_name(monkeypatch):
    monkeypatch.setattr(process, 'which', lambda name: None)
    assert 'podman, docker, buildah' in str(raised(PrerequisiteError, lambda: image.engine()))
    monkeypatch.setattr(process, 'which', lambda name: name == 'docker')
    assert image.engine() == 'docker'
    monkeypatch.setattr(process, 'which', lambda name: None)
    assert raised(PrerequisiteError, lambda: image.engine('docker')).hint.endswith(' docker.io')
