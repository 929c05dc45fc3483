# SPDX-License-Identifier: Apache-2.0
"""Tests of fogros2.store: on real files, with real processes."""

import contextlib
import errno
import functools
import json
import operator
import os
from pathlib import Path
import re
import resource
import stat
import subprocess
import sys
import tempfile
import threading
import types

import pytest

from fogros2 import store as store_module
from fogros2.errors import Cancelled, ConfigurationError, NameTaken, StoreError
from fogros2.model import Endpoint, MachineSpec, OtherVpn, Peer, to_json, VpnInterface
from fogros2.store import (
    boot_id,
    is_another_robot,
    launch_process,
    Made,
    process_alive,
    process_start,
    Record,
    robot_id,
    robot_name,
    Store,
    write_private,
)

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / 'state')


def record(name='planner', **changes):
    spec = MachineSpec(name, 'container', {'ports': ['80:80']}, apt=('x',))
    return Record(name, 'container', spec, **changes)


def test_a_record_comes_back_as_it_was_saved(store):
    saved = record(
        endpoint=Endpoint('ssh', '198.51.100.7', user='fog', host_key='ssh-ed25519 AAAA'),
        vpn=VpnInterface('fog1m0', '198.18.0.2', '198.18.0.0/24', 50000, '/run/k'),
        machine_id='abc', asked={'size': 'cheapest'})
    store.save(saved)
    assert store.load('planner') == saved


def test_files_are_for_the_user_alone(store):
    store.save(record())
    directory = store.machine('planner')
    assert stat.S_IMODE((directory / 'record.json').stat().st_mode) == 0o600
    for folder in (directory, directory.parent):
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700


@pytest.mark.parametrize('name', [
    'a b', 'a;rm', '../x', 'Upper', '', '-a', 'a-', 'x' * 41, 'a.b', 'ä', '$(x)', 'a\n'])
def test_names_that_a_shell_or_dns_would_trip_over_are_refused(store, name):
    with pytest.raises(ConfigurationError, match='no name for a machine'):
        store.machine(name)


@pytest.mark.parametrize('content', ['', '{', '[]', '{"name": 1}', '{"spec": {}}', '\0'])
def test_damaged_record_is_listed_and_loads_with_a_hint(store, content):
    store.save(record())
    (store.machine('planner') / 'record.json').write_text(content)
    with pytest.raises(StoreError, match='ros2 fog delete planner'):
        store.load('planner')
    assert 'damaged' in store.machines()[0].damage


@pytest.mark.parametrize('place', [
    (), ('spec',), ('endpoint',), ('vpn',), ('robot_vpn',), ('made', 0)])
def test_unknown_keys_of_a_later_version_are_left_aside(store, place):
    vpn = VpnInterface('fog1m0', '198.18.0.2', '198.18.0.0/24', 50000, '/run/k')
    saved = store.save(record(
        endpoint=Endpoint('ssh', '198.51.100.7'), vpn=vpn, robot_vpn=vpn, made=(Made('VPN'),)))
    path = store.machine('planner') / 'record.json'
    data = json.loads(path.read_text())
    functools.reduce(operator.getitem, place, data)['from_the_future'] = 1
    path.write_text(json.dumps(data))
    assert store.load('planner') == saved


def test_vpn_of_a_later_version_is_read(tmp_path):
    vpn = VpnInterface('fog1', '198.18.0.2', '198.18.0.0/24', 50000, '/run/k')
    other = OtherVpn(Peer('a', 'key', '198.18.0.3'), vpn, vpn, 5000)
    data = json.loads(to_json(other))
    for place in ('machine', 'interface', 'own'):
        data[place]['from_the_future'] = 1
    (tmp_path / store_module.OTHER_VPN).write_text(json.dumps(data))
    assert store_module.other_vpn(tmp_path) == other


def test_missing_values_of_an_earlier_version_are_empty(store):
    store.save(record())
    path = store.machine('planner') / 'record.json'
    data = json.loads(path.read_text())
    for key in ('underlays', 'apt', 'pip'):
        del data['spec'][key]
    path.write_text(json.dumps({**data, 'asked': None}))
    assert store.load('planner').spec.apt == () and store.load('planner').asked == {}


def test_a_name_is_held_by_one_at_a_time(store):
    with store.lock('planner'):
        with pytest.raises(NameTaken):
            with store.lock('planner'):
                pass
        with store.lock('slam'):
            pass
    with store.lock('planner'):
        pass
    assert list(store.machine('planner').parent.iterdir()) == []


def test_launch_waits_for_a_command_and_for_no_launch(store):
    class Waiting(threading.Event):
        def wait(self, timeout=None):
            command.close()
            return False

    with contextlib.ExitStack() as command:
        command.enter_context(store.lock('planner'))
        with pytest.raises(Cancelled):
            ended = threading.Event()
            ended.set()
            with store.lock('planner', cancel=ended):
                pass
        with store.lock('planner', cancel=Waiting()):
            with pytest.raises(NameTaken, match='another launch'):
                with store.lock('planner', cancel=Waiting()):
                    pass


def test_a_name_that_cannot_be_held_is_a_clear_error(store, monkeypatch):
    def full(*arguments, **options):
        raise OSError(errno.ENOSPC, 'No space left on device')

    monkeypatch.setattr('builtins.open', full)
    with pytest.raises(StoreError, match='No space left'):
        with store.lock('planner'):
            pass


def test_name_is_held_while_no_file_can_grow(store):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
    try:
        with store.lock('planner'):
            with pytest.raises(NameTaken, match='another launch'):
                with store.lock('planner'):
                    pass
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_killed_holder_frees_the_name(store):
    code = (
        'import sys; from pathlib import Path; from fogros2.store import Store\n'
        f'with Store(Path({str(store.root)!r})).lock("planner"):\n'
        '    print("held", flush=True); sys.stdin.read()')
    child = subprocess.Popen([sys.executable, '-c', code], stdin=subprocess.PIPE,
                             stdout=subprocess.PIPE)
    assert child.stdout.readline() == b'held\n'
    with pytest.raises(NameTaken):
        with store.lock('planner'):
            pass
    child.kill()
    child.communicate()
    assert [p.name for p in (store.root / 'machines').iterdir()] == ['.planner.lock']
    store.sweep()
    assert list((store.root / 'machines').iterdir()) == []
    with store.lock('planner'):
        store.sweep()
        with pytest.raises(NameTaken):
            with store.lock('planner'):
                pass


def test_sweep_removes_what_killed_writers_left(store, monkeypatch):
    """An unfinished file, and the folder of a machine whose first record it was."""
    code = (
        'import os, sys; from pathlib import Path; from fogros2 import store\n'
        'store.os.replace = lambda *paths: os.kill(os.getpid(), 9)\n'
        'store.write_private(Path(sys.argv[1]), b"{}")')
    first, later = store.machine('first') / 'record.json', store.machine('later') / 'record.json'
    write_private(later, b'{}')
    for path in (first, later):
        subprocess.run([sys.executable, '-c', code, str(path)])
        assert len(list(path.parent.glob('.record.json.*'))) == 1
    with monkeypatch.context() as patch:
        patch.setattr(store_module.os, 'replace', lambda *paths: store.sweep() or fail())
        with pytest.raises(KeyboardInterrupt):
            write_private(later, b'{}')
    store.sweep()
    assert [path.name for path in (store.root / 'machines').rglob('*')] == ['later', 'record.json']


def fail():
    raise KeyboardInterrupt


def test_process_differs_from_another_with_its_id():
    child = subprocess.Popen([sys.executable, '-c', 'import sys; sys.stdin.read()'],
                             stdin=subprocess.PIPE)
    start = process_start(child.pid)
    assert record(pid=child.pid, pid_start=start).launch_alive
    assert not record(pid=child.pid, pid_start=start - 1).launch_alive
    child.communicate()
    assert not record(pid=child.pid, pid_start=start).launch_alive
    assert not record().launch_alive


@pytest.mark.usefixtures('name_of_no_text')
def test_name_of_a_process_may_be_no_text():
    assert process_start(os.getpid()) is not None


def test_after_a_boot_no_process_is_one_from_before(monkeypatch):
    mine = {'pid': os.getpid(), 'pid_start': process_start(os.getpid())}
    assert record(boot=boot_id(), **mine).launch_alive
    assert not record(boot='another boot', **mine).launch_alive


def test_launch_of_another_container_runs(store):
    """Containers that share the state folder do not see each other's processes."""
    code = (
        'import os; from fogros2 import model, store\n'
        'folder = store.Store().launch_folder("a1b2c3")\n'
        'store.hold(folder); store.process_folder()\n'
        'store.write_private(folder / "process.json",'
        ' model.to_json({**store.this_process(), "pid": 2 ** 22}).encode())\n'
        'print("runs", flush=True); input()')
    folder = store.launch_folder('a1b2c3')
    with subprocess.Popen(
            [sys.executable, '-c', code],
            env={**os.environ, 'FOGROS2_STATE_HOME': str(store.root)},
            stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout.readline() == b'runs\n'
        (unfinished,) = store.root.glob('.process.*')
        private = unfinished.rename(unfinished.with_name(
            re.sub('[0-9]+', str(2 ** 22), unfinished.name, count=1)))
        store.sweep()
        assert launch_process(folder) == (2 ** 22, True) and private.is_dir()
        child.kill()
    store.sweep()
    assert launch_process(folder) == (2 ** 22, False) and not private.exists()


def test_a_zombie_counts_as_gone():
    child = subprocess.Popen([sys.executable, '-c', ''])
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    assert process_start(child.pid) is None
    child.wait()


def test_a_failed_write_leaves_the_old_file_and_nothing_else(store, tmp_path):
    path = tmp_path / 'x' / 'file'
    write_private(path, b'old')
    with pytest.raises(TypeError):
        write_private(path, 'text')
    assert path.read_bytes() == b'old'
    assert os.listdir(path.parent) == ['file']


def test_a_state_folder_that_cannot_be_made_is_a_clear_error(tmp_path):
    (tmp_path / 'file').touch()
    with pytest.raises(StoreError, match='FOGROS2_STATE_HOME'):
        Store(tmp_path / 'file').save(record())


@pytest.mark.skipif(os.geteuid() != 0, reason='only root can give a folder to another account')
def test_launch_by_sudo_leaves_the_users_folders_to_the_user(monkeypatch, tmp_path):
    for name in ('XDG_STATE_HOME', 'XDG_CONFIG_HOME', 'FOGROS2_STATE_HOME'):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv('HOME', str(tmp_path))
    os.chown(tmp_path, 65534, 65534)
    Store().launch_folder('x')
    robot_id()
    assert {path.name for path in tmp_path.rglob('*') if path.stat().st_uid == 0} == {
        'fogros2', 'launches', 'x', 'robot.json'}
    assert all(path.stat().st_gid == 65534 for path in (tmp_path / '.local', tmp_path / '.config'))


@pytest.mark.skipif(os.geteuid() != 0, reason='takes root, to become another user')
def test_closed_folder_of_the_users_home_is_the_one_to_give_back(monkeypatch):
    with tempfile.TemporaryDirectory() as home:
        Path(home).chmod(0o755)
        (Path(home) / '.local').mkdir(mode=0o700)
        monkeypatch.setenv('HOME', home)
        os.seteuid(65534)
        try:
            with pytest.raises(StoreError, match=rf'sudo chown -R 65534 {home}/.local\)'):
                Store(Path(home) / '.local/state/fogros2')
        finally:
            os.seteuid(0)


def test_robot_that_cannot_write_has_a_name_to_read_with(monkeypatch):
    monkeypatch.setenv('XDG_CONFIG_HOME', '/dev/null')
    monkeypatch.setenv('FOGROS2_STATE_HOME', '/dev/null/state')
    assert robot_id(new=False) == robot_name()
    assert is_another_robot(f'{robot_name()}-0123abcd')
    with pytest.raises(StoreError, match=r'robot\.json can.t be written'):
        robot_id()


def test_readers_find_digits_that_they_may_not_write(monkeypatch, tmp_path):
    monkeypatch.setenv('XDG_CONFIG_HOME', str(tmp_path))
    known = robot_id()
    (tmp_path / 'fogros2/robot.json').chmod(0o400)
    monkeypatch.setattr(store_module.os, 'open', read_only(os.open))
    assert robot_id(new=False) == robot_id() == known and not is_another_robot(known)


@pytest.mark.parametrize(('kernel', 'number'), [
    ('6.8.0-49-generic', 2), ('5.15.153.1-microsoft-standard-WSL2', 1)])
def test_computers_with_one_home_keep_their_ids(monkeypatch, tmp_path, kernel, number):
    monkeypatch.setenv('XDG_CONFIG_HOME', str(tmp_path))
    monkeypatch.setattr(os, 'uname', lambda: types.SimpleNamespace(nodename='pc', release=kernel))
    ids = []
    for end in 'aba':
        monkeypatch.setattr(store_module, 'mac_addresses', lambda end=end: [f'02::{end}'])
        ids.append(robot_id())
    assert ids[0] == ids[2] and len({*ids}) == number


def test_id_of_an_older_version_stays(monkeypatch, tmp_path):
    monkeypatch.setenv('XDG_CONFIG_HOME', str(tmp_path))
    robot_id()
    file = tmp_path / 'fogros2/robot.json'
    ((computer, _),) = json.loads(file.read_text()).items()
    machine_id, _, mac = computer.partition(' ')
    file.write_text(json.dumps({'digits': '0123abcd', 'machine_id': machine_id, 'mac': mac}))
    assert robot_id(new=False) == robot_id() == f'{robot_name()}-0123abcd'
    monkeypatch.setattr(store_module, 'mac_addresses', lambda: ['02::b'])  # a copy of the file
    assert robot_id(new=False) == robot_name() and '0123abcd' not in robot_id()


def test_volume_of_the_docker_command_keeps_id_and_state(monkeypatch):
    file = (ROOT / 'packaging/Dockerfile').read_text()
    (volume,) = re.findall(r'-v fogros2:(\S+)', (ROOT / 'doc/install.md').read_text())
    for name in ('XDG_CONFIG_HOME', 'XDG_STATE_HOME', 'FOGROS2_STATE_HOME'):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv('HOME', '/root')
    for name, value in re.findall('^ENV (.*)=(.*)$', file, re.MULTILINE):
        monkeypatch.setenv(name, value)
    folders = []

    def digits(folder, *, new):
        folders.append(folder)
        return '0123abcd'

    monkeypatch.setattr(store_module, '_digits', digits)
    monkeypatch.setattr(store_module, '_check_readable', lambda _: None)  # HOME is root's
    assert robot_id().endswith('-0123abcd')
    assert [folder for folder in (*folders, Store().root)
            if not folder.is_relative_to(volume)] == [] and folders


def read_only(opened):
    """Return ``os.open`` for a file system that is mounted read-only."""
    def opener(path, flags, *mode, **place):
        if flags & (os.O_WRONLY | os.O_RDWR):
            raise OSError(errno.EROFS, 'Read-only file system')
        return opened(path, flags, *mode, **place)
    return opener


def test_first_process_runs_where_nobody_may_see_it(monkeypatch):
    monkeypatch.setattr(store_module, 'process_start', lambda pid: None)
    assert process_alive(1, 0, boot_id()) and not process_alive(1, 0, 'another boot')
    assert not process_alive(1, 5, boot_id()) and not process_alive(2, 0, boot_id())


def test_home_that_is_no_folder_has_no_records():
    with pytest.raises(StoreError, match="no record of a machine 'a'"):
        Store(Path('/dev/null/state')).load('a')


def test_name_whose_lock_was_removed_is_locked_anew(store, monkeypatch):
    """A former holder removes the file between the open and the lock of the next one."""
    flock, removed = store_module.fcntl.flock, []

    def late(handle, how):
        flock(handle, how)
        if not removed:
            removed.append(handle.name)
            os.unlink(handle.name)

    monkeypatch.setattr(store_module.fcntl, 'flock', late)
    with store.lock('planner'):
        with pytest.raises(NameTaken):
            with store.lock('planner'):
                pass
    assert removed


def test_request_that_cannot_be_kept_leaves_the_record(store, monkeypatch):
    saved = store.save(record(token='t1', last='abc123'))

    def full(path, data):
        raise StoreError('No space left on device')

    monkeypatch.setattr(store_module, 'write_private', full)
    with pytest.raises(StoreError, match='No space left'):
        store.set_aside(saved)
    assert store.load('planner') == saved
