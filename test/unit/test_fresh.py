# SPDX-License-Identifier: Apache-2.0
"""The tool that tries the README's commands on newly installed systems, by value."""

from __future__ import annotations

import importlib
import os
from pathlib import Path
import signal
import subprocess
import sys

import pytest

from fogros2.waiting import wait_until

ROOT = Path(__file__).resolve().parents[2]
README = """
```console
$ make demo       # shows it
$ make test-fast
$ make test ARGS='-k a'
```
```console
$ make docs
```
"""


@pytest.fixture(scope='module')
def tools():
    """Return the modules of the tool, which are no part of a package."""
    names = ('clean_system', 'fresh', 'leftovers', 'closing_line')
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / 'tools'))
        yield {name: importlib.import_module(name) for name in names}
    for name in names:
        sys.modules.pop(name, None)


def test_commands_are_the_first_block_of_the_readme(tools):
    assert tools['fresh'].readme_commands(README) == [
        'make demo', 'make test-fast', "make test ARGS='-k a'"]


@pytest.mark.parametrize('variant, wanted', [
    ('debian-12-password', ['make demo', 'make test']),
    ('debian-12', ['make test-fast', 'make demo']),
    ('debian-13', ['make test-fast', 'make demo'])])
def test_variant_runs_all_tests_or_the_fast_ones(tools, variant, wanted):
    readme = (ROOT / 'README.md').read_text()
    assert tools['fresh'].VARIANTS[variant].commands(readme) == wanted


def test_mirror_and_its_pockets_become_another_release(tools, monkeypatch):
    clean = tools['clean_system']
    monkeypatch.setattr(clean.platform, 'freedesktop_os_release', lambda: {
        'ID': 'debian', 'VERSION_CODENAME': 'bookworm'})
    monkeypatch.setattr(clean, '_run', lambda words: (
        'http://mirror.test/security/ bookworm-security main\n'
        'http://mirror.test/debian/ bookworm main\n'
        'http://mirror.test/debian/ bookworm contrib\n'
        'http://other.test/ bookworm-tools main\n'
        'http://other.test/ stable main\n'))
    assert clean._sources(clean.Suite('trixie', 'Debian 13')) == [
        'deb http://mirror.test/debian/ trixie main',
        'deb http://mirror.test/security/ trixie-security main']
    with pytest.raises(clean.CleanSystemError, match='no mirror of Ubuntu'):
        clean._sources(clean.Suite('noble', 'Ubuntu 24.04', 'ubuntu'))


def cases(path: Path, **results: str) -> Path:
    """Write a JUnit file: names of tests, and what their entries hold."""
    path.write_text('<testsuites><testsuite>' + ''.join(
        f'<testcase classname="test.test_a" name="{name}">{result}</testcase>'
        for name, result in results.items()) + '</testsuite></testsuites>')
    return path


def test_tests_are_counted_and_named(tools, tmp_path):
    report = cases(tmp_path / 'test-fast.xml', **{
        'good[a@b]': '', 'good[a@c]': '', 'bad[1]@/x.py': '<failure/>',
        'skipped': '<skipped message="no y"/>', 'other@g': '<skipped message="no y"/>'})
    read = tools['closing_line'].read([report])
    assert read.counts == (2, 1, 2)
    assert read.failed == ['test.test_a::bad[1]']
    assert read.skipped == {'no y': ['test.test_a::skipped', 'test.test_a::other']}


def test_what_passes_when_run_again_is_named(tools, tmp_path, capsys, monkeypatch):
    first = cases(tmp_path / 'test-x.xml', good='', chance='<failure/>',
                  teardown='<error/>', bad='<failure/>')
    cases(tmp_path / 'again-test-x.xml', good='', chance='', teardown='', bad='<error/>')
    monkeypatch.setattr(sys, 'argv', ['closing_line.py', str(first)])
    assert tools['closing_line'].main() == 1
    assert capsys.readouterr().out.splitlines() == [
        'passed only when run again: test.test_a::chance',
        'passed only when run again: test.test_a::teardown',
        'failed: test.test_a::bad', '3 passed, 1 failed, 0 skipped']


def test_sudo_ticket_is_kept_while_a_script_runs(tmp_path):
    said = tmp_path / 'said'
    for name, text in (('id', 'echo 1000'), ('sudo', f'echo "$*" >>{said}')):
        (tmp_path / name).write_text(f'#!/bin/sh\n{text}\n')
        (tmp_path / name).chmod(0o755)
    # a build of Kubernetes takes longer than sudo remembers the password
    script = subprocess.Popen(
        ['sh', '-c', '. tools/common.sh; keep_ticket; read -r line'], cwd=ROOT,
        stdin=subprocess.PIPE, env={**os.environ, 'PATH': f'{tmp_path}:{os.environ["PATH"]}'})
    try:
        wait_until(lambda: said.exists() and '-n -v' in said.read_text().splitlines(),
                   timeout=60.0, what='sudo to be asked for more time')
    finally:
        script.communicate(b'\n')


@pytest.mark.parametrize('line, counted', [
    ('control group memory/libpod_parent', False), ('control group memory/libpod_parent/x', True),
    ('file /home/robot/.ros/log/x', False), ('file /home/robot/.local/share/fogros2/x', True)])
def test_only_what_is_ours_counts_as_left_behind(tools, line, counted):
    assert (tools['leftovers']._OTHERS.fullmatch(line) is None) == counted


SLIRP4NETNS = """
import os, sys
ready, watched = (int(word.partition('=')[2]) for word in sys.argv if '-fd=' in word)
with open(os.environ['STARTED'], 'a') as file:
    file.write(f'{os.getpid()}\\n')
os.write(ready, b'1')
os.close(ready)
os.read(watched, 1)
"""


@pytest.mark.skipif(os.geteuid() != 0, reason='network namespaces need root')
def test_network_returns_when_its_program_dies(tools, tmp_path, monkeypatch):
    program, started = tmp_path / 'slirp4netns', tmp_path / 'started'
    program.write_text(f'#!{sys.executable}\n{SLIRP4NETNS}')
    program.chmod(0o755)
    monkeypatch.setenv('PATH', f'{tmp_path}:{os.environ["PATH"]}')
    monkeypatch.setenv('STARTED', str(started))
    with subprocess.Popen(['unshare', '--net', 'sh', '-c', 'echo ready; exec sleep 60'],
                          stdout=subprocess.PIPE) as first:
        assert first.stdout.readline() == b'ready\n'
        with tools['clean_system']._network(first.pid):
            os.kill(int(started.read_text()), signal.SIGSEGV)
            wait_until(lambda: len(started.read_text().splitlines()) == 2, timeout=20.0,
                       what='slirp4netns runs again')
            for device in ('tap0', 'default via 10.0.2.2'):
                assert device in subprocess.run(
                    ['nsenter', f'--net=/proc/{first.pid}/ns/net', 'sh', '-c',
                     'ip address; ip route'], stdout=subprocess.PIPE, text=True, check=True).stdout
        first.kill()
    assert not any(Path('/proc', pid).exists() for pid in started.read_text().split())
