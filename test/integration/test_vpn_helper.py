# SPDX-License-Identifier: Apache-2.0
"""
The VPN's helper with real users, real sudo and real interfaces.

All of it happens on a copy of this computer: its files below a throw-away layer, in namespaces of
their own with no way out. Users, rights and programs are put there as an administrator would.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import json
import os
from pathlib import Path
import re
import shlex
import subprocess
import sys
import threading
from typing import Any

import pytest

from fogros2 import process
from fogros2.model import Command, Result
from fogros2.vpn.helped import PROTOCOL
from fogros2.waiting import wait_until

ROOT = Path(__file__).resolve().parents[2]
HELPER = '/usr/libexec/fogros2/vpn'
RULES = '/etc/sudoers.d/fogros2-vpn'
NAME, OTHER = 'fog0a1b2c', 'fog0a1b2d'
KEY = 'Sg3Q0Y1Y0bZ2v6q0ZkzJbb0pRk3S8u1u4hJ0lWm8VHo='
#: What finds this Python and, where it is sourced, ROS 2.
PASSED = [f'PATH={Path(sys.executable).parent}:{os.environ["PATH"]}', *(
    f'{name}={os.environ[name]}' for name in (
        'PYTHONPATH', 'LD_LIBRARY_PATH', 'AMENT_PREFIX_PATH', 'ROS_DISTRO', 'ROS_VERSION',
        'ROS_PYTHON_VERSION') if name in os.environ)]
#: Everything is there as on this computer, and nothing that is written reaches it.
ENTER = """\
# by the numbers of the outside, whose /proc this still is
read -r pid rest </proc/self/stat
mount -t tmpfs tmpfs "$1"
mkdir "$1/upper" "$1/work" "$1/root"
mount -t overlay overlay -o "lowerdir=/,upperdir=$1/upper,workdir=$1/work" "$1/root"
cd "$1/root"
mount -t proc proc proc
mount -t sysfs sysfs sys
mount --rbind /dev dev
mount -t tmpfs -o mode=755 tmpfs run
ip link set lo up
trap exit TERM
echo $pid
sleep 600 &
wait
"""
#: Rights as a new computer has them, and two users in the group and one beside it.
USERS = """\
printf 'Defaults env_reset\\nroot ALL=(ALL:ALL) ALL\\n@includedir /etc/sudoers.d\\n' >/etc/sudoers
rm -rf /etc/sudoers.d/*
getent group fogros2 >/dev/null && groupdel fogros2
for user in fogada fogbob fogeve; do useradd -m -s /bin/sh $user; done
"""



class Copy:
    """A copy of this computer, entered through a process in its namespaces."""

    def __init__(self, pid: int, root: str) -> None:
        self.pid = pid
        self.root = root

    def argv(self, user: str, *words: str) -> list[str]:
        inside = ['nsenter', '-t', str(self.pid), '-m', '-n', '-p', '-i', 'chroot', self.root]
        if user == 'root':
            # as at boot: the helper asks sudo who has called it
            return [*inside, 'env', '-u', 'SUDO_UID', *words]
        # not su, which takes the terminal away
        return [*inside, 'setpriv', f'--reuid={user}', f'--regid={user}', '--init-groups',
                'env', '-i', *PASSED, f'HOME=/home/{user}', *words]

    def run(self, user: str, *words: str, data: bytes = b'', check: bool = False) -> Result:
        return process.run(Command(tuple(self.argv(user, *words)), sudo=True, input=data or b' '),
                           timeout=90.0, check=check)

    def ask(self, user: str, verb: str, *more: str, **request: Any) -> Result:
        """Ask the helper for something, as the product does for a launch."""
        if verb == 'keys':
            request = {'private': '', **request}
        elif verb == 'up':
            first = request['network'].replace('.0/', '.1/').partition('/')[0]
            request = {'address': first, **request}
        return self.run(user, 'sudo', '-n', '--', HELPER, verb, *more,
                        data=json.dumps(request).encode())

    def links(self) -> set[str]:
        return set(self.run('root', 'ls', '/sys/class/net', check=True).stdout.split())

    def launch(self, user: str) -> int:
        """Start what stands for a user's launch, and return its id in the copy."""
        # the terminal that sudo makes for it by use_pty goes with sudo
        return int(self.run(user, 'sh', '-c', 'trap "" HUP; '
                            'sleep 500 >/dev/null 2>&1 </dev/null & echo $!', check=True).stdout)


@pytest.fixture(scope='module')
def copy(tun: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Copy]:
    """Return a copy with the helper installed and no interface; all of it goes afterwards."""
    for program in ('sudo', 'visudo', 'useradd', 'setpriv', 'nsenter'):
        if process.which(program) is None:
            pytest.skip(f'needs {program}')
    folder = tmp_path_factory.mktemp('copy')
    words = process.argv(Command((
        'unshare', '--mount', '--net', '--pid', '--ipc', '--fork', '--kill-child',
        'sh', '-ec', ENTER, 'sh', str(folder)), sudo=True))
    child = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                             preexec_fn=os.setpgrp)
    assert child.stdout is not None
    try:
        first = child.stdout.readline()
        if not first:
            pytest.skip(f'no layer over / is to be had here: {child.communicate()[1]}')
        found = Copy(int(first), f'{folder}/root')
        found.run('root', 'sh', '-c', USERS, check=True)
        for path in (ROOT, Path(sys.executable), Path(sys.executable).resolve()):
            # a home is closed to others, on the copy too unless it is opened there
            found.run('root', 'chmod', 'a+x', *map(str, path.parents), check=True)
        found.run('root', str(ROOT / 'packaging/vpn_helper/install'), 'fogada', 'fogbob',
                  check=True)
        yield found
        for link in found.links():
            if link.startswith('fog'):
                found.run('root', HELPER, 'down', data=json.dumps({'name': link}).encode())
    finally:
        process.end(child, sudo=words[0] == 'sudo')
        child.communicate()


@contextlib.contextmanager
def interface(copy: Copy, user: str, name: str, network: str, port: int) -> Iterator[str]:
    """Have an interface of a user's, and yield its public key."""
    made = copy.ask(user, 'keys', name=name, pid=copy.launch(user))
    assert made.returncode == 0, made.stderr
    try:
        up = copy.ask(user, 'up', name=name, network=network, port=port, ports=[],
                      asked=[], peers=[])
        assert up.returncode == 0, up.stderr
        yield made.stdout.strip()
    finally:
        gone = copy.ask(user, 'down', name=name)
        assert gone.returncode == 0, gone.stderr
        assert name not in copy.links()


def peer(address: str, key: str = KEY) -> dict[str, object]:
    return {'key': key, 'address': address, 'endpoint': '127.0.0.1:9'}


def test_a_user_makes_changes_and_takes_away_an_interface(copy: Copy) -> None:
    assert copy.ask('fogada', 'check').stdout == f'{PROTOCOL}\n'
    with interface(copy, 'fogada', NAME, '198.18.7.0/24', 51820) as key:
        assert re.fullmatch('[A-Za-z0-9+/]{43}=', key)
        assert NAME in copy.links()
        shown = copy.run('root', 'ip', '-4', 'addr', 'show', NAME).stdout
        assert 'inet 198.18.7.1/24' in shown
        told = copy.ask('fogada', 'peers', name=NAME, peers=[peer('198.18.7.2')])
        assert told.returncode == 0, told.stderr
        assert copy.ask('fogada', 'status', name=NAME).stdout.count(KEY) == 2
        # a guest takes another invitation, or the port is taken
        again = copy.ask('fogada', 'up', name=NAME, network='198.18.7.0/24', port=51821,
                         ports=[], asked=[], peers=[peer('198.18.7.2')])
        assert again.returncode == 0, again.stderr
        assert copy.run('root', 'wg', 'show', NAME, 'listen-port').stdout == '51821\n'
        # the program that serves it dies, and is got going again
        copy.run('root', 'sh', '-c', f'kill -9 $(pgrep -f "^wireguard-go {NAME}$")')
        again = copy.ask('fogada', 'repair', name=NAME, peers=[peer('198.18.7.2')])
        assert again.returncode == 0, again.stderr
        assert copy.ask('fogada', 'status', name=NAME).stdout.count(KEY) == 2
        # another program deletes the filter
        copy.run('root', 'nft', 'flush', 'ruleset', check=True)
        said = copy.ask('fogada', 'status', name=NAME)
        assert said.returncode == 1 and 'filter' in said.stderr, said
        again = copy.ask('fogada', 'repair', name=NAME, peers=[peer('198.18.7.2')])
        assert again.returncode == 0, again.stderr
        assert copy.ask('fogada', 'status', name=NAME).returncode == 0
        # the private key is root's alone, and so is the folder of the records
        assert copy.run('fogada', 'cat', f'/run/fogros2-vpn/{NAME}/key').returncode != 0
        assert copy.run('fogada', 'touch', '/run/fogros2-vpn/x').returncode != 0
        assert f'table inet {NAME}' in copy.run('root', 'nft', 'list', 'tables').stdout
    assert copy.run('root', 'ls', '-A', '/run/fogros2-vpn').stdout == ''
    assert f'{NAME}' not in copy.run('root', 'nft', 'list', 'tables').stdout
    assert copy.ask('fogada', 'down', name=NAME).returncode == 0  # as often as one likes


def test_interfaces_of_others_are_refused(copy: Copy) -> None:
    copy.run('root', 'ip', 'tuntap', 'add', 'dev', OTHER, 'mode', 'tun', check=True)
    try:
        with interface(copy, 'fogada', NAME, '198.18.7.0/24', 51820):
            pid = copy.launch('fogbob')
            for verb, more in (
                    ('keys', {'pid': pid}), ('down', {}), ('status', {}),
                    ('peers', {'peers': []}), ('repair', {'peers': []}),
                    ('up', {'network': '198.18.8.0/24', 'port': 5000, 'ports': [],
                            'asked': [], 'peers': []})):
                said = copy.ask('fogbob', verb, name=NAME, **more)
                assert said.returncode == 2 and 'another user' in said.stderr, (verb, said)
                said = copy.ask('fogbob', verb, name=OTHER, **more)
                assert said.returncode == 2 and 'not made here' in said.stderr, (verb, said)
            for name in ('lo', '../fog0a1b2c', 'fog0a1b2cm0'):
                said = copy.ask('fogbob', 'down', name=name)
                assert said.returncode == 2 and 'six hexadecimal' in said.stderr, said
            # networks that lead somewhere already, or aren't the pool's
            assert copy.ask('fogbob', 'keys', name='fogbbbbbb', pid=pid).returncode == 0
            for network, why in (('198.18.7.0/24', 'in use'), ('127.0.0.0/24', 'not in'),
                                 ('10.0.0.0/24', 'not in'), ('0.0.0.0/0', '24 bits')):
                said = copy.ask('fogbob', 'up', name='fogbbbbbb', network=network, port=5000,
                                ports=[], asked=[], peers=[])
                assert said.returncode == 2 and why in said.stderr, said
            said = copy.ask('fogbob', 'up', name='fogbbbbbb', network='198.18.9.0/24', port=53,
                            ports=[], asked=[], peers=[])
            assert said.returncode == 2 and '1024' in said.stderr
            assert copy.ask('fogbob', 'down', name='fogbbbbbb').returncode == 0
            # somebody else's process would keep it for ever
            said = copy.ask('fogbob', 'keys', name='fogbbbbbb', pid=1)
            assert said.returncode == 2 and 'another user' in said.stderr
            assert {NAME, OTHER} <= copy.links()
    finally:
        copy.run('root', 'ip', 'link', 'delete', OTHER)


def test_nothing_else_is_allowed(copy: Copy) -> None:
    copy.run('root', 'visudo', '-c', check=True)
    for words in (['true'], ['sh'], [HELPER], [HELPER, 'tidy'], [HELPER, 'down', 'x'],
                  [HELPER, '-h'], ['/usr/bin/python3', HELPER, 'check'],
                  ['/run/../usr/libexec/fogros2/vpn', 'tidy'], ['--preserve-env', HELPER, 'check'],
                  ['PYTHONPATH=/tmp', HELPER, 'check'], ['-u', 'fogbob', HELPER, 'check']):
        assert copy.run('fogada', 'sudo', '-n', *words).returncode != 0, words
    # who isn't in the group, and who goes past sudo
    assert copy.ask('fogeve', 'check').returncode != 0
    assert copy.run('fogada', HELPER, 'check').returncode == 2
    # nobody but root may change what is run
    for path in (HELPER, RULES, '/usr/libexec/fogros2/fogros2/vpn/wireguard.py'):
        assert copy.run('fogada', 'test', '-w', path).returncode != 0, path
        assert copy.run('fogada', 'test', '-w', str(Path(path).parent)).returncode != 0, path


def test_what_the_caller_has_set_is_forgotten(copy: Copy, tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    (tmp_path / 'json.py').write_text('raise SystemExit(77)')
    for parent in tmp_path.parents[:3]:
        if parent.name.startswith(('pytest-', 'popen-')):
            parent.chmod(0o755)
    script = (f'cd {shlex.quote(str(tmp_path))}; ulimit -S -f 0; umask 0; trap "" CHLD PIPE; '
              f'PYTHONPATH={shlex.quote(str(tmp_path))} PATH=/nowhere SUDO_UID=0 '
              f'/usr/bin/sudo -n {HELPER} ')
    made = copy.run('fogada', 'sh', '-c', script + 'keys', data=json.dumps(
        {'name': NAME, 'pid': copy.launch('fogada'), 'private': ''}).encode())
    assert made.returncode == 0 and len(made.stdout) == 45, made
    assert copy.run('root', 'stat', '-c%a', '/run/fogros2-vpn', f'/run/fogros2-vpn/{NAME}',
                    f'/run/fogros2-vpn/{NAME}/key').stdout.split() == ['711', '700', '600']
    said = copy.run('fogbob', 'sh', '-c', f'SUDO_UID=0 sudo -n {HELPER} down',
                    data=json.dumps({'name': NAME}).encode())
    assert 'another user' in said.stderr
    assert copy.ask('fogada', 'down', name=NAME).returncode == 0


def test_so_many_interfaces_and_no_more(copy: Copy) -> None:
    pid = copy.launch('fogada')
    assert copy.ask('fogada', 'keys', name='fog000010', pid=pid).returncode == 0
    copy.run('root', 'sh', '-ec', 'cd /run/fogros2-vpn; '
             'for n in 1 2 3 4 5 6 7 8 9 a b c d e f; do '
             'cp -r fog000010 fog00000$n; sed -i s/fog000010/fog00000$n/ fog00000$n/record; done',
             check=True)
    said = copy.ask('fogada', 'keys', name='fog000000', pid=pid)
    assert said.returncode == 2 and '16 interfaces' in said.stderr
    assert copy.ask('fogada', 'keys', name='fog000010', pid=pid).returncode == 0  # its own
    # none of them was brought up: their launch ends, and the timer's service takes them away
    assert copy.run('root', HELPER, 'tidy').stdout == ''
    copy.run('root', 'kill', '-9', str(pid))
    wait_until(lambda: copy.run('root', 'kill', '-0', str(pid)).returncode != 0, timeout=60.0,
               what='the launch to be gone')
    assert copy.run('root', HELPER, 'tidy').stdout.count('is gone') == 16
    if process.which('systemd-analyze'):
        units = [f'/etc/systemd/system/fogros2-vpn-tidy.{kind}' for kind in ('service', 'timer')]
        copy.run('root', 'systemd-analyze', 'verify', *units, check=True)
    assert copy.run('root', 'ls', '-A', '/run/fogros2-vpn').stdout == ''


@pytest.fixture
def product(copy: Copy) -> None:
    """Skip where users of the copy cannot import FogROS2."""
    if copy.run('fogada', sys.executable, '-c', 'import fogros2').returncode != 0:
        pytest.skip("this Python's folder is on a disk of its own, and no layer over / has it")


PRODUCT = """\
import json, os, sys
from pathlib import Path
from fogros2.deploy import check_robot, Launch
from fogros2.store import Store
check_robot()
launch = Launch(store=Store(Path(sys.argv[1])))
robot = launch.robot_vpn()
robot.ensure()
print(json.dumps([robot.interface.name, robot.interface.key_file, os.getpid()]), flush=True)
sys.stdin.readline()
"""


@pytest.mark.parametrize('tidied', [False, True])
def test_what_a_killed_launch_has_made_goes_by_gc(
    copy: Copy, product: None, tidied: bool,
) -> None:
    words = process.argv(Command(tuple(copy.argv(
        'fogada', sys.executable, '-c', PRODUCT, '/home/fogada/state')), sudo=True))
    child = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert child.stdin is not None and child.stdout is not None
    timer = threading.Timer(300.0, child.kill)
    timer.start()
    try:
        name, key, pid = json.loads(child.stdout.readline())
        assert key == f'/run/fogros2-vpn/{name}/key' and name in copy.links()
        copy.run('fogada', 'kill', '-9', str(pid), check=True)
        child.wait(60.0)
        if tidied:  # by the timer
            assert name in copy.run('root', HELPER, 'tidy', check=True).stdout
        said = copy.run('fogada', 'env', 'FOGROS2_STATE_HOME=/home/fogada/state', 'ros2', 'fog',
                        'gc')
        assert said.returncode == 0, said
        assert name not in copy.links()
        assert copy.run('root', 'ls', '/home/fogada/state/launches').stdout == ''
    finally:
        timer.cancel()
        child.kill()
        child.communicate()


LAUNCH = """\
from fogros2 import CloudNode, FogROSLaunchDescription, SSHInstance
from launch_ros.actions import Node


def generate_launch_description():
    machine = SSHInstance(name='fogm', host='192.0.2.2', user='fogeve')
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='talker'),
        Node(package='fogros2_examples', executable='listener', output='screen')])
"""
#: The machine: a network of its own, where another user may do all.
MACHINE = """\
mkdir -p /run/sshd
echo 'fogeve ALL=(ALL) NOPASSWD: ALL' >/etc/sudoers.d/eve
setpriv --reuid=fogada --regid=fogada --init-groups env HOME=/home/fogada sh -ec '
umask 077; mkdir -p ~/.ssh; ssh-keygen -q -t ed25519 -N "" -f ~/.ssh/id_ed25519'
ssh-keygen -q -t ed25519 -N '' -f /run/sshd/key
install -d -m 700 -o fogeve -g fogeve /home/fogeve/.ssh
cd /home/fogada/.ssh
install -m 600 -o fogeve -g fogeve id_ed25519.pub /home/fogeve/.ssh/authorized_keys
echo "192.0.2.2 $(cat /run/sshd/key.pub)" >known_hosts
chown fogada: known_hosts
usermod -p '*' fogeve
ip netns add machine
ip link add e0 type veth peer name e1 netns machine
ip address add 192.0.2.1/30 dev e0
ip link set e0 up
ip -n machine address add 192.0.2.2/30 dev e1
ip -n machine link set e1 up
ip -n machine link set lo up
ip netns exec machine /usr/sbin/sshd -h /run/sshd/key -o PidFile=none
"""


def test_a_whole_launch_of_a_user_without_rights(copy: Copy, product: None) -> None:
    """A talker on a machine and a listener here; ``ros2 launch`` runs as one of the group."""
    copy.run('root', 'sh', '-ec', MACHINE, check=True)
    copy.run('fogada', 'sh', '-c', 'cat >~/first.launch.py', data=LAUNCH.encode(), check=True)
    script = ('cd; export ROS_DOMAIN_ID=31; sudo -n true && exit 99; '
              # a shell without a terminal has what it starts beside it ignore Ctrl-C
              'env --default-signal=INT ros2 launch ./first.launch.py >said 2>&1 </dev/null & '
              'for n in $(seq 60); do grep -q "I heard" said && break; sleep 1; done; '
              'kill -INT $!; wait $!; echo status $?; cat said')
    said = copy.run('fogada', 'sh', '-c', script).stdout
    assert 'I heard: [Hello World from' in said and 'status 0' in said, said
    assert not {link for link in copy.links() if link.startswith('fog')}


#: Runs its words at a terminal, types the password and prints what is seen there. Root runs it, as
#: the ticket of the user who runs the tests is not valid at another terminal.
AT_TERMINAL = """\
import contextlib, os, pty, sys
pid, terminal = pty.fork()
if pid == 0:
    os.execvp(sys.argv[1], sys.argv[1:])
said = b''
with contextlib.suppress(OSError):  # the end of a terminal
    while chunk := os.read(terminal, 1000):
        said += chunk
        if b'for the VPN interface: ' in said and b'words' not in said:
            os.write(terminal, b'words\\n')
            said += b'(words)'
sys.stdout.buffer.write(said)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
"""


def test_without_it_the_question_comes_first(copy: Copy, product: None) -> None:
    """A user who may use sudo with a password, at a terminal, is asked before anything is made."""
    copy.run('root', 'sh', '-c', 'echo fogeve:words | chpasswd; '
             'echo "fogeve ALL=(ALL) ALL" >/etc/sudoers.d/eve', check=True)
    twice = 'from fogros2.deploy import check_robot; check_robot(); check_robot(); print("ready")'
    said = process.run(Command((sys.executable, '-c', AT_TERMINAL, *copy.argv(
        'fogeve', sys.executable, '-c', twice)), sudo=True), timeout=60.0, check=False)
    assert said.returncode == 0, said
    assert said.stdout.count('password for fogeve, for the VPN interface') == 1
    assert 'ready' in said.stdout


def test_it_is_removed_without_a_trace(copy: Copy) -> None:
    install = str(ROOT / 'packaging/vpn_helper/install')
    with contextlib.suppress(AssertionError), \
            interface(copy, 'fogada', NAME, '198.18.7.0/24', 51820):
        # of an administrator's sudo
        copy.run('root', 'env', 'SUDO_UID=4711', install, '--remove', check=True)
        assert NAME not in copy.links()
        for path in (HELPER, str(Path(HELPER).parent), RULES, '/run/fogros2-vpn'):
            assert copy.run('root', 'test', '-e', path).returncode == 1, path
        assert copy.run('root', 'getent', 'group', 'fogros2').returncode != 0
        copy.run('root', install, 'fogada', 'fogbob', check=True)
    assert copy.ask('fogada', 'check').stdout == f'{PROTOCOL}\n'
