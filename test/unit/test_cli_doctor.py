# SPDX-License-Identifier: Apache-2.0
"""``ros2 fog doctor``: each check by what it finds, and the search for others on the LAN."""

from __future__ import annotations

import ast
import json
import os
from pathlib import Path
import shutil
import socket
import subprocess
import sys
import tempfile
import types
from unittest.mock import Mock

import pytest
from ros2cli.cli import main

from fogros2 import process
from fogros2.errors import PrerequisiteError, StoreError
from fogros2.model import Result
from fogros2.store import Store
from fogros2_testing import FakeProvider
from fogros2_testing.plugins import instead
from ros2fog_cli.api import doctor, lan


def test_doctor_passes_on_this_computer(capsys: pytest.CaptureFixture[str]) -> None:
    status = main(argv=['fog', 'doctor', '--json', '--lan-seconds', '0'])
    checks = json.loads(capsys.readouterr().out)['checks']
    assert len(checks) >= 15
    assert {check['verdict'] for check in checks} <= {'ok', 'warning', 'failed'}
    failed = [check for check in checks if check['verdict'] == 'failed']
    assert status == (1 if failed else 0)
    for check in checks:
        assert check['detail']
        if check['verdict'] == 'failed':
            assert check['remedy']


def test_check_is_printed_with_its_remedy(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv('RMW_IMPLEMENTATION', 'rmw_nobody_cpp')
    assert main(argv=['fog', 'doctor', '--lan-seconds', '0']) == 1
    lines = capsys.readouterr().out.splitlines()
    at = next(n for n, line in enumerate(lines) if 'RMW_IMPLEMENTATION' in line)
    assert lines[at].startswith('[FAIL]') and 'rmw_nobody_cpp' in lines[at]
    assert 'unset it' in lines[at + 1]


def test_missing_python_package_is_named() -> None:
    """In a process of its own: doctor itself runs without paramiko."""
    found = subprocess.run(
        [sys.executable, '-c', "import sys; sys.modules['paramiko'] = None\n"
         'from ros2fog_cli.api import doctor; check = doctor.packages()\n'
         'print(check.verdict, check.detail, check.remedy)'],
        capture_output=True, text=True, check=True)
    assert found.stdout.startswith('failed paramiko not found')
    assert 'python3-paramiko,' in found.stdout


def test_ros2_without_rclpy_is_one_line(tmp_path: Path) -> None:
    program = Path(__file__).parents[2] / 'tools' / 'ros2.py'
    said = subprocess.run(
        [sys.executable, '-I', '-S', str(program), 'topic', 'list'], capture_output=True,
        text=True, timeout=60)
    assert said.returncode == 1 and said.stdout == ''
    assert said.stderr.splitlines() == [
        'ros2: ROS 2 is not sourced here: run ". /opt/ros/jazzy/setup.bash" first']


def test_missing_programs_are_named_with_their_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    which = process.which
    monkeypatch.setattr(process, 'which', lambda p: None if p in ('wg', 'rsync') else which(p))
    check = doctor.programs()
    assert check.verdict == 'failed' and 'wg, rsync' in check.detail
    assert 'apt-get install rsync wireguard-tools' in check.remedy


@pytest.mark.parametrize(('in_kernel', 'sizes', 'remedy'), [
    (True, (212992, 4 << 20), ''), (True, (212992, 212992), 'net.core.rmem_max=4194304'),
    (False, (212992, 4 << 20), 'net.core.rmem_default=7340032 net.core.rmem_max=7340032'),
    (False, (212992, 7 << 20), 'net.core.rmem_default=7340032'), (False, (7 << 20, 8 << 20), '')])
def test_small_receive_buffers_are_named_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_kernel: bool, sizes: tuple[int, int],
    remedy: str,
) -> None:
    monkeypatch.setattr(doctor.deploy, 'kernel_wireguard', lambda: in_kernel)
    for name, size in zip(('rmem_default', 'rmem_max'), sizes):
        (tmp_path / name).write_text(f'{size}\n')
    check = doctor.receive_buffer(tmp_path)
    assert check.remedy == (f'sudo sysctl -w {remedy}' if remedy else '')
    assert check.verdict == ('warning' if remedy else 'ok')
    assert doctor.receive_buffer(tmp_path / 'none').verdict == 'warning'


def test_missing_wireguard_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, 'exists', lambda self: False)
    monkeypatch.setattr(process, 'which', lambda program: None)
    check = doctor.wireguard()
    assert check.verdict == 'failed' and 'apt-get install wireguard-go' in check.remedy


@pytest.mark.parametrize(('uri', 'verdict'), [
    ('', 'ok'), ('<CycloneDDS/>', 'ok'), ('<CycloneDDS>', 'failed'),
    ('file:///nowhere/x.xml', 'failed'), ('/nowhere/x.xml', 'failed')])
def test_cyclone_configuration_of_the_user_is_checked(
    uri: str, verdict: str, monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv('CYCLONEDDS_URI', uri)
    assert doctor.cyclone_uri().verdict == verdict


CHAIN = ('table inet filter {\n\tchain input {\n\t\ttype filter hook input priority filter; '
         'policy drop;\n\t\t%s\n\t}\n}\n')
FIREWALLD = (CHAIN % 'ct state { established, related } accept\n\t\tjump zones\n\t\t'
             'reject with icmpx admin-prohibited').replace('policy drop', 'policy accept')


@pytest.mark.parametrize(('answer', 'verdict'), [
    (CHAIN % 'ct state established accept', 'warning'), (FIREWALLD, 'warning'),
    (FIREWALLD.replace('reject', 'tcp dport 22 reject'), 'ok'),
    (FIREWALLD.replace('inet filter', 'inet foga1b2c3'), 'ok'),
    (FIREWALLD.replace('jump zones', 'iifname "fog*" goto filter_IN_trusted'), 'ok'),
    (CHAIN % 'iifname "fog*" accept', 'ok'), ('', 'ok'),
    (CHAIN.replace('inet', 'ip6') % 'ct state established accept', 'ok'),
    (PrerequisiteError('sudo not found on this computer', 'install it'), 'warning')])
def test_dropping_firewall_is_reported(
    monkeypatch: pytest.MonkeyPatch, answer: str | Exception, verdict: str,
) -> None:
    monkeypatch.setattr(process, 'run', Mock(side_effect=[
        answer if isinstance(answer, Exception) else Result(0, answer, '')]))
    check = doctor.firewall()
    assert check.verdict == verdict
    assert not isinstance(answer, Exception) or str(answer.args[0]) in check.detail


def test_participants_are_counted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for another computer answers an announcement from an address of its own."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(('127.0.0.2', 0))
        monkeypatch.setattr(lan, 'addresses', lambda: ['127.0.0.1'])

        def announce(link: socket.socket, address: str, port: int, prefix: bytes,
                     domain: int) -> None:
            for guid in (b'a' * 12, b'b' * 12, b'a' * 12):
                peer.sendto(b'RTPS\x02\x03\x01\x10' + guid + b'rest', ('127.0.0.1', port))
            peer.sendto(b'noise', ('127.0.0.1', port))

        monkeypatch.setattr(lan, '_announce', announce)
        assert lan.participants(0, 0.3) == {'127.0.0.2': 2}


@pytest.mark.parametrize(('counts', 'ros_range', 'verdict', 'detail'), [
    ({'10.1.2.3': 2}, '', 'ok', '10.1.2.3 (2)'),
    ({'10.1.2.3': 2}, 'LOCALHOST', 'warning', '10.1.2.3 (2)'),
    ({lan.HERE: doctor.PARTICIPANTS}, '', 'ok', 'no other computer'),
    ({lan.HERE: doctor.PARTICIPANTS, '10.1.2.3': 1}, '', 'warning',
     f'{doctor.PARTICIPANTS + 1} participants')])
def test_participants_on_the_lan_are_reported(
    monkeypatch: pytest.MonkeyPatch, counts: dict[str, int], ros_range: str, verdict: str,
    detail: str,
) -> None:
    monkeypatch.setattr(lan, 'participants', lambda domain, seconds: {**counts})
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', ros_range)
    check = doctor.lan_peers(1)
    assert check.verdict == verdict and detail in check.detail


def test_domain_without_ports_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv('ROS_DOMAIN_ID', '240')
    assert doctor.lan_peers(0.1) == doctor.Check(
        'ROS 2 on the LAN', 'warning',
        'can not be looked for: ROS_DOMAIN_ID is 240, not 0 to 232')


def test_check_that_cannot_be_made_ends_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: object, **__: object) -> None:
        raise FileNotFoundError

    def unreadable() -> doctor.Check:
        raise PermissionError(13, 'Permission denied')

    monkeypatch.setattr(process, 'start', missing)
    monkeypatch.setattr(doctor, 'clocks', unreadable)
    unreadable.__name__ = 'clocks'
    checks = {check.name: check for check in doctor.examine(lan_seconds=0.1)}
    assert len(checks) >= 15
    lan_check = checks['ROS 2 on the LAN']
    assert lan_check.verdict == 'failed' and lan_check.remedy == 'sudo apt-get install iproute2'
    assert checks['clocks'].verdict == 'failed' and 'Permission denied' in checks['clocks'].detail


def test_defective_provider_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    class Older(FakeProvider):
        def answers(self) -> str:
            raise TypeError('answers() got an unexpected keyword argument')

    instead(monkeypatch, 'fogros2.provider', {'older': Older})
    check = doctor.provider('older')
    assert check.verdict == 'warning' and check.detail.startswith('TypeError: answers() got')


def test_state_folder_of_root_fails_its_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a launch by root."""
    state = Path(tempfile.mkdtemp(dir='/tmp'))  # pytest's own folders are the user's alone
    try:
        state.chmod(0o755)
        (state / 'fogros2').mkdir(mode=0o700)
        monkeypatch.setenv('FOGROS2_STATE_HOME', str(state / 'fogros2'))
        if os.geteuid() != 0:
            pytest.skip('takes root, to become another user')
        os.seteuid(65534)
        try:
            with pytest.raises(StoreError, match='sudo chown -R 65534'):
                Store()
            found = {check.name: check for check in map(
                doctor._result, (doctor.state, doctor.clocks, doctor.vpn_paths))}
        finally:
            os.seteuid(0)
    finally:
        shutil.rmtree(state)
    assert {check.verdict for check in found.values()} == {'failed'}
    assert f'sudo chown -R 65534 {state}/fogros2' in found['clocks'].remedy


_PEER = """
import sys, time
from cyclonedds.domain import DomainParticipant
participant = DomainParticipant(0)
print('up', flush=True)
sys.stdin.read()
"""


def test_participants_here_and_on_another_computer_are_found(tmp_path: Path) -> None:
    """Two network namespaces on one wire: Cyclone DDS as it is out of the box in both."""
    pytest.importorskip('cyclonedds', reason='this interpreter has no Cyclone DDS of its own')
    if os.geteuid() != 0:
        pytest.skip('network namespaces need root')
    made = subprocess.run(['unshare', '-n', 'true'], capture_output=True)
    if made.returncode:
        pytest.skip('no network namespaces here')
    script = tmp_path / 'both.sh'
    # everything lives in one new namespace and goes with it; nothing of it is on this computer
    script.write_text(f"""\
set -e
ip link set lo up
unshare -n sleep 60 & other=$!
trap 'kill $other $peer $own 2>/dev/null || true' EXIT
until [ "$(readlink /proc/$other/ns/net)" != "$(readlink /proc/self/ns/net)" ]; do :; done
ip link add here type veth peer name there netns $other
ip addr add 198.51.100.1/24 dev here
ip link set here up
nsenter -t $other -n ip addr add 198.51.100.2/24 dev there
nsenter -t $other -n ip link set there up
nsenter -t $other -n ip link set lo up
mkfifo {tmp_path}/hold {tmp_path}/up
exec 3<>{tmp_path}/hold
nsenter -t $other -n {sys.executable} -c "$1" <{tmp_path}/hold >{tmp_path}/up & peer=$!
read -r _ <{tmp_path}/up
{sys.executable} -c "$1" <{tmp_path}/hold >{tmp_path}/up & own=$!
read -r _ <{tmp_path}/up
{sys.executable} -c "$2"
""")
    environment = {key: value for key, value in os.environ.items()
                   if key not in ('CYCLONEDDS_URI', 'ROS_DOMAIN_ID')}
    ask = ('from fogros2.waiting import wait_until; from ros2fog_cli.api import lan; '
           'print(wait_until(lambda: len(both := lan.participants(0, 0.6)) == 2 and both, '
           'timeout=60.0, what="both"))')
    done = subprocess.run(['unshare', '-n', 'sh', str(script), _PEER, ask], text=True, timeout=60,
                          capture_output=True, env=environment, cwd=tmp_path)
    assert ast.literal_eval(done.stdout) == {'198.51.100.2': 1, lan.HERE: 1}, done.stderr


@pytest.mark.parametrize(('mode', 'disk', 'verdict', 'text'), [
    (0o700, {}, 'ok', ''), (0o755, {}, 'warning', 'chmod 700'), (None, {}, 'ok', 'will be made'),
    # not that it belongs to somebody else; btrfs has no number of files
    (0o700, {'f_flag': os.ST_RDONLY}, 'failed', 'is on a read-only file system'),
    (0o700, {'f_bavail': 0}, 'failed', 'is on a full disk'),
    (None, {'f_ffree': 0}, 'failed', 'is on a full disk'),
    (None, {'f_files': 0, 'f_ffree': 0}, 'ok', '')])
def test_state_folder_is_private_and_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: int | None, disk: dict[str, int],
    verdict: str, text: str,
) -> None:
    folder = tmp_path / 'state'
    monkeypatch.setenv('FOGROS2_STATE_HOME', str(folder))
    if mode is not None:
        folder.mkdir()
        folder.chmod(mode)
    monkeypatch.setattr(os, 'statvfs', lambda path: types.SimpleNamespace(**{
        'f_flag': 0, 'f_blocks': 9, 'f_bavail': 9, 'f_files': 9, 'f_ffree': 9, **disk}))
    check = doctor.state()
    assert check.verdict == verdict and text in f'{check.detail} {check.remedy}'


def test_doctor_honours_no_color(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(doctor, 'examine', lambda **_: [doctor.Check('it', 'failed', 'is old')])
    monkeypatch.setattr('sys.stdout.isatty', lambda: True, raising=False)
    monkeypatch.setenv('TERM', 'xterm')
    for value, coloured in (('', True), ('1', False)):
        monkeypatch.setenv('NO_COLOR', value)
        assert main(argv=['fog', 'doctor']) == 1
        assert ('\x1b[31m' in capsys.readouterr().out) == coloured
