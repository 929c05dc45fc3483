# SPDX-License-Identifier: Apache-2.0
"""A machine takes ROS's packages only by ROS's key, however the key's package was replaced."""

from __future__ import annotations

from pathlib import Path
import shutil
import subprocess

import pytest

from fogros2.host import bootstrap

pytestmark = pytest.mark.skipif(
    not all(map(shutil.which, ('apt-get', 'gpg', 'dpkg-deb'))),
    reason='needs apt-get, gpg and dpkg-deb')


@pytest.fixture
def machine(tmp_path: Path) -> tuple[Path, str]:
    """Return a root folder whose download is a package with another key, and that key."""
    home, content = tmp_path / 'gpg', tmp_path / 'package'
    home.mkdir(mode=0o700)
    gpg = ('gpg', '--homedir', str(home), '--batch', '--passphrase', '')
    subprocess.run([*gpg, '--quick-gen-key', 'another', 'ed25519'], check=True,
                   capture_output=True)
    said = subprocess.run([*gpg, '--list-keys', '--with-colons'], check=True, text=True,
                          capture_output=True).stdout
    key = next(line.split(':')[9] for line in said.splitlines() if line.startswith('fpr'))
    keyring = content / 'usr/share/keyrings/ros2-archive-keyring.gpg'
    keyring.parent.mkdir(parents=True)
    keyring.write_bytes(subprocess.run([*gpg, '--export'], check=True,
                                       capture_output=True).stdout)
    subprocess.run(['gpgconf', '--homedir', str(home), '--kill', 'all'], check=True)
    (content / 'DEBIAN').mkdir()
    (content / 'DEBIAN/control').write_text(
        'Package: ros2-apt-source\nVersion: 9\nArchitecture: all\nMaintainer: x <x@x>\n'
        'Description: x\n')
    script = content / 'DEBIAN/postinst'
    script.write_text(f'#!/bin/sh\ntouch {tmp_path}/ran\n')
    script.chmod(0o755)
    subprocess.run(['dpkg-deb', '-b', str(content), str(tmp_path / 'source.deb')], check=True,
                   capture_output=True)
    programs = tmp_path / 'bin'
    programs.mkdir()
    for name, text in {
            'apt-get': f'exec {shutil.which("apt-get")} -o Dir::Etc={tmp_path}/root/etc/apt "$@"',
            'dpkg': f'touch {tmp_path}/ran',
            'curl': f'for each; do case $each in */source.deb) cp {tmp_path}/source.deb "$each"; '
                    'exit;; esac; done; echo https://example.org/9'}.items():
        (programs / name).write_text(f'#!/bin/sh\n{text}\n')
        (programs / name).chmod(0o755)
    for folder in ('etc/apt/sources.list.d', 'usr/share/keyrings'):
        (tmp_path / 'root' / folder).mkdir(parents=True)
    return tmp_path, key


def run(folder: Path, script: str) -> subprocess.CompletedProcess[str]:
    root = folder / 'root'
    script = script.replace('/etc/apt', f'{root}/etc/apt').replace('"/$', f'"{root}/$')
    return subprocess.run(['sh', '-ec', script], capture_output=True, text=True, timeout=60,
                          env={'PATH': f'{folder}/bin:/usr/sbin:/usr/bin:/sbin:/bin'})


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / 'root').rglob('*') if path.is_file())


def test_package_with_another_key_is_refused(machine: tuple[Path, str]) -> None:
    folder, key = machine
    done = run(folder, bootstrap._APT_SOURCE)
    assert not (folder / 'ran').exists(), 'a script of the package ran as root'
    assert done.returncode != 0 and files(folder) == []
    assert done.stderr.strip().splitlines()[-1] == (
        f"ros2-apt-source 9 has the key {key}, which is not ROS's")


def test_known_key_signs_the_only_source(machine: tuple[Path, str]) -> None:
    folder, key = machine
    done = run(folder, bootstrap._APT_SOURCE.replace(bootstrap.ROS_KEY, key))
    assert done.returncode == 0, done.stderr
    assert files(folder) == ['ros2-archive-keyring.gpg', 'ros2.sources']
    assert not (folder / 'ran').exists()
    text = (folder / 'root/etc/apt/sources.list.d/ros2.sources').read_text()
    assert 'Suites: noble\n' in text
    assert 'Signed-By: /usr/share/keyrings/ros2-archive-keyring.gpg\n' in text
    # what a second launch finds
    assert run(folder, bootstrap._APT_SOURCE).returncode == 0


ROS = 'http://packages.ros.org/ros2/ubuntu'
DEB822 = 'Types: deb\nURIs: {}\nSuites: {}\nComponents: main\nSigned-By: /k.gpg\nEnabled: {}\n'


@pytest.mark.parametrize(('name', 'text', 'present'), [
    ('a.list', f'deb [arch=amd64,arm64 signed-by=/k.gpg] {ROS} noble main', True),
    ('a.list', 'deb [signed-by=/k.gpg] https://packages.ros.org/ros2/ubuntu/ noble main', True),
    ('ros-latest.sources', DEB822.format(ROS, 'noble', 'yes'), True),
    ('ros-latest.sources', DEB822.format(ROS, 'noble', 'no'), False),
    ('a.list', f'# deb {ROS} noble main', False),
    ('a.list', f'deb {ROS} jammy main', False),
    ('a.list', 'deb http://packages.ros.org/ros2-testing/ubuntu noble main', False)])
def test_source_under_another_name_is_kept_alone(
        machine: tuple[Path, str], name: str, text: str, present: bool) -> None:
    folder, key = machine
    (folder / 'root/etc/apt/sources.list.d' / name).write_text(f'{text}\n')
    done = run(folder, bootstrap._APT_SOURCE.replace(bootstrap.ROS_KEY, key))
    assert done.returncode == 0, done.stderr
    assert ('ros2.sources' in files(folder)) is not present
    said = run(folder, 'apt-get indextargets')
    assert said.returncode == 0 and said.stderr == ''


def test_source_that_apt_refuses_is_removed(machine: tuple[Path, str]) -> None:
    folder, key = machine
    (folder / 'root/etc/apt/sources.list.d/a.list').write_text(
        f'deb-src [signed-by=/k.gpg] {ROS} noble main\n')
    done = run(folder, bootstrap._APT_SOURCE.replace(bootstrap.ROS_KEY, key))
    assert done.returncode == 1 and 'Signed-By' in done.stderr
    assert 'ros2.sources' not in files(folder)
