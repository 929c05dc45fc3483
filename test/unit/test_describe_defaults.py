# SPDX-License-Identifier: Apache-2.0
"""Files with defaults of machines: of the user, of a workspace, below a launch file."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
import subprocess
import sys

from launch import LaunchContext
import pytest

from fogros2 import AWSCloudInstance, ContainerInstance, SSHInstance
from fogros2.describe import defaults
from fogros2.describe.overrides import Overrides
from fogros2.errors import ConfigurationError, PrerequisiteError
from fogros2.provider.aws.provider import AWSProvider
from fogros2.provider.container import ContainerProvider
from fogros2_testing.plugins import instead
from ros2fog_cli.api import doctor

pytestmark = pytest.mark.skipif(
    not any(map(importlib.util.find_spec, ('tomllib', 'tomli'))),
    reason='needs Python 3.11 or tomli')


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Return the user's file, which is empty."""
    monkeypatch.setenv('XDG_CONFIG_HOME', str(tmp_path / 'config'))
    for name in ('COLCON_PREFIX_PATH', 'AMENT_PREFIX_PATH'):
        monkeypatch.setenv(name, '')
    path = tmp_path / 'config/fogros2/fogros2.toml'
    path.parent.mkdir(parents=True)
    path.touch()
    return path


def spec(machine, *overrides):
    context = LaunchContext()
    context.environment.update(os.environ)
    return defaults.resolved(machine, Overrides(overrides) if overrides else None, context)


def workspace(folder, text):
    """Make a sourced workspace with a file of defaults; return its prefix."""
    (folder / 'src').mkdir(parents=True)
    (folder / 'install').mkdir()
    (folder / 'install/.colcon_install_layout').write_text('merged\n')
    (folder / 'fogros2.toml').write_text(text)
    return str(folder / 'install')


def test_defaults_fill_what_a_launch_file_leaves_open(own):
    own.write_text("""\
lifetime = '2h'
tags = {team = 'slam'}
ssh_from = ['198.51.100.0/24']
[aws]
region = 'eu-central-1'
disk_size = 40
[container]
memory = '2g'
""")
    found = spec(AWSCloudInstance(name='a', ros_workspace=''))
    assert (found.lifetime, found.robot_timeout) == (7200.0, 120.0)
    assert found.options == {'region': 'eu-central-1', 'disk_size': 40, 'tags': {'team': 'slam'},
                             'ssh_from': ['198.51.100.0/24']}
    assert spec(ContainerInstance(name='a')).options['memory'] == '2g'
    assert spec(SSHInstance(name='a', host='h')).lifetime == 7200.0


def test_provider_without_its_library_breaks_no_other(own, monkeypatch):
    instead(monkeypatch, 'fogros2.machine', {
        'container': ContainerInstance, 'nosdk': PrerequisiteError('no module fancysdk')})
    own.write_text("lifetime = '2h'\n")
    assert spec(ContainerInstance(name='a')).lifetime == 7200.0
    own.write_text("name = 'a'\n")
    with pytest.raises(ConfigurationError, match='only a launch file'):
        spec(ContainerInstance(name='a'))


@pytest.mark.parametrize('lifetime', [28800, '8h', 28800.0, '1h'])
def test_launch_file_wins_over_defaults(own, lifetime):
    own.write_text("lifetime = '2h'\non_interrupt = 'robot'\n[aws]\nregion = 'eu-central-1'\n")
    found = spec(AWSCloudInstance(name='a', lifetime=lifetime, region='us-east-1',
                                  on_interrupt='shutdown'))
    assert found.lifetime in (28800.0, 3600.0)
    assert found.features == {'replacement': {'on_interrupt': 'shutdown'}}
    assert found.options == {'region': 'us-east-1'}
    # an argument of a launch file that nobody gives leaves it open
    assert spec(AWSCloudInstance(name='a', region='')).options == {'region': 'eu-central-1'}


def test_command_line_wins_over_defaults(own):
    own.write_text("lifetime = '2h'\n[container]\nmemory = '2g'\n[aws]\nregion = 'eu-central-1'\n")
    machine = AWSCloudInstance(name='a', region='us-east-1')
    found = spec(machine, 'a=aws,disk_size=40')
    assert found.options == {'region': 'us-east-1', 'disk_size': 40}
    found = spec(machine, 'a=container,lifetime=5h')
    assert found.lifetime == 18000.0
    assert found.options['memory'] == '2g' and 'region' not in found.options


def test_workspace_wins_over_user_and_overlay_over_underlay(own, tmp_path, monkeypatch):
    own.write_text("lifetime = '1h'\nrobot_timeout = '200s'\nidle_timeout = '5m'\n")
    prefixes = [workspace(tmp_path / 'overlay', "lifetime = '3h'\n"),
                workspace(tmp_path / 'underlay', "lifetime = '2h'\nidle_timeout = '6m'\n")]
    monkeypatch.setenv('COLCON_PREFIX_PATH', os.pathsep.join(prefixes))
    found = spec(ContainerInstance(name='a', ros_workspace=''))
    assert (found.lifetime, found.robot_timeout, found.features) == (
        10800.0, 200.0, {'idle': {'idle_timeout': '6m'}})


@pytest.mark.parametrize(('text', 'message', 'hint'), [
    ("lifetme = '2h'", "has no 'lifetme'", "did you mean 'lifetime'?"),
    ("[aws]\nregoin = 'x'", r"\[aws\] has no 'regoin'", "did you mean 'region'?"),
    ("on_exit = 'keep'", "only a launch file can set 'on_exit'", ''),
    ("name = 'a'", "only a launch file can set 'name'", ''),
    ("[ssh]\nhost = 'a'", "only a launch file can set 'host'", ''),
    ("[AWS]\nregion = 'a'", "there is no provider 'AWS'", 'there are: aws'),
    ("[machines]\nlifetime = '2h'", "there is no provider 'machines'", ''),
    ('lifetime = [1]', 'wrong type', ''), ("ssh_from = 'a'", 'is no list', "ssh_from=['a']"),
    ('[aws]\ndisk_size = true', 'wrong type', 'number'),
    ('lifetime = ', "can't be read", 'TOML'), (f"x = {'[' * 5000}", "can't be read", ''),
    ("lifetime = 'soon'", 'lifetime', ''), ("on_loss_after = 'soon'", 'on_loss_after', '')])
def test_wrong_file_is_an_error(own, text, message, hint):
    own.write_text(text)
    with pytest.raises(ConfigurationError, match=message) as wrong:
        spec(ContainerInstance(name='a'))
    assert hint in wrong.value.hint


@pytest.mark.parametrize(('provider', 'text', 'name'), [
    (ContainerProvider, "[container]\nmemory = '2x'", 'memory'),
    (ContainerProvider, "[container]\nports = ['a:b']", 'ports'),
    (AWSProvider, "ssh_from = ['nowhere']", 'ssh_from'),
    (AWSProvider, '[aws]\ndisk_size = 1', 'disk_size')])
def test_option_that_a_provider_refuses_names_the_file(own, provider, text, name):
    own.write_text(f"lifetime = '2h'\n{text}")
    machine = spec({'container': ContainerInstance, 'aws': AWSCloudInstance}[provider.name](
        name='a', ros_workspace=''))
    with pytest.raises(ConfigurationError) as wrong, defaults.named(os.environ):
        provider().check(machine)
    assert wrong.value.hint.endswith(f'; {own} sets {name}')


def test_file_is_utf_8_in_any_locale(own):
    own.write_text("container_image = 'lab/Größe'", 'utf-8')
    code = ('import pathlib, sys\nfrom fogros2.describe import defaults\n'
            'print(ascii(defaults._parsed(pathlib.Path(sys.argv[1]))))')
    done = subprocess.run(
        [sys.executable, '-X', 'utf8=0', '-c', code, own], capture_output=True, text=True,
        env={**os.environ, 'LC_ALL': 'C', 'PYTHONCOERCECLOCALE': '0'})
    assert done.stdout == r"{'container_image': 'lab/Gr\xf6\xdfe'}" + '\n', done.stderr


def test_python_without_toml_names_the_remedy(own, monkeypatch):
    for name in ('tomllib', 'tomli'):
        monkeypatch.setitem(sys.modules, name, None)
    own.write_text("lifetime = '2h'")
    with pytest.raises(PrerequisiteError, match="can't read") as wrong:
        spec(ContainerInstance(name='a'))
    assert wrong.value.hint == 'pip install tomli'
    own.unlink()
    assert spec(ContainerInstance(name='a')).lifetime == 28800.0


def test_doctor_shows_defaults(own: Path):
    assert doctor.machine_defaults().verdict == 'ok'
    own.write_text("lifetime = '2h'\n[aws]\nregion = 'eu-central-1'\n")
    assert doctor.machine_defaults().detail == \
        f"{own}: lifetime='2h', aws.region='eu-central-1'"
    own.write_text('lifetime')
    assert doctor.machine_defaults().verdict == 'failed'
