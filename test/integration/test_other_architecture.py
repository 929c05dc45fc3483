# SPDX-License-Identifier: Apache-2.0
"""
A machine of another processor architecture than the robot: an arm64 system under qemu-user.

The system's packages are unpacked, not configured: its programs run, and this computer's settings
(the release is the same) stand for its own. The kernel forgets the emulator with the mount.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import fcntl
import hashlib
import os
from pathlib import Path
import platform
import shutil
import subprocess
import sys
import uuid

import pytest

from fogros2 import plan, process
from fogros2.errors import PrerequisiteError
from fogros2.host import bootstrap, workspace
from fogros2.model import Command, MachineSpec
from fogros2.provider.container import debian_root
from fogros2.shell.ssh import SSHShell
from fogros2.waiting import Timeouts
from rigs.bare_computer import bare_computer, BareComputer
from rigs.colcon_workspace import colcon_workspace

ARCHITECTURE, DEBIAN_NAME, ELF_MACHINE = 'aarch64', 'arm64', b'\xb7\x00'
EMULATOR = '/usr/bin/qemu-aarch64-static'
PACKAGES = ('ca-certificates', 'iproute2', 'libc6-dev', 'nftables', 'openssh-client',
            'openssh-server', 'python3', 'python3-venv', 'rsync', 'sudo', 'tcc', 'wireguard-tools')

pytestmark = [
    # a minute to make the system, and three for what is emulated
    pytest.mark.soak,
    pytest.mark.usefixtures('nothing_left'),
    pytest.mark.skipif(platform.machine() != 'x86_64', reason='emulates arm64 on x86_64 alone'),
    pytest.mark.skipif(not os.access(EMULATOR, os.X_OK),
                       reason=f'needs {EMULATOR} (package qemu-user-static)'),
    pytest.mark.skipif(shutil.which('debootstrap') is None, reason='needs debootstrap'),
]

#: Fetches and unpacks a system, in the folder $1: a minute, most of it the network's.
MAKE = """
debootstrap --foreign --variant=minbase --arch="$4" --include="$5" "$2" "$1" "$3" >&2
for package in "$1"/var/cache/apt/archives/*.deb; do
    dpkg-deb --fsys-tarfile "$package" | tar -xf - --keep-directory-symlink -C "$1"
done
rm -rf "$1"/debootstrap "$1"/var/cache/apt/archives/*.deb "$1"/usr/share/doc "$1"/usr/share/locale
"""
#: Has the kernel run programs of the architecture by the emulator, until the input ends. The flag
#: F opens the emulator now, as no other root has it; C lets sudo become root.
EMULATE = r"""
mount -t binfmt_misc binfmt_misc /proc/sys/fs/binfmt_misc
printf '%s' ':fogros2-test-aarch64:M::\x7fELF\x02\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x02'\
'\x00\xb7\x00:\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff:'\
"$1:OCF" >/proc/sys/fs/binfmt_misc/register
echo ready
read -r _ || :
"""
#: Stand for ROS 2 and its tools, which nobody has for this system. The compiler is real.
COLCON = """#!/bin/sh -e
for source in src/*/*.c; do
    package=$(basename "$(dirname "$source")")
    mkdir -p "install/$package/lib/$package"
    tcc -o "install/$package/lib/$package/node" "$source"
done
echo ": built" >install/local_setup.sh
"""
NODE = '#include <stdio.h>\nint main(void) { puts("compiled there"); return 0; }\n'


@pytest.fixture(scope='module')
def arm_system() -> Path:
    """Return an arm64 system's folder, made unless an earlier run has left it."""
    try:
        own = debian_root.release()
    except PrerequisiteError as error:
        pytest.skip(str(error))
    if own.system != 'debian':
        pytest.skip('the system is made from Debian, which this computer is not')
    release, address = own.codename, own.address
    cache = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache', 'fogros2')
    cache.mkdir(parents=True, exist_ok=True)
    key = hashlib.sha256(f'{release} {PACKAGES} {MAKE}'.encode()).hexdigest()[:16]
    target = cache / f'{DEBIAN_NAME}-{key}'
    with open(cache / f'{DEBIAN_NAME}.lock', 'w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not target.is_dir():
            aside = target.with_suffix('.new')
            process.run(Command((
                'sh', '-ec', f'rm -rf "$1"; mkdir "$1"\n{MAKE}\nmv -T "$1" "$6"', 'sh',
                str(aside), release, address, DEBIAN_NAME, ','.join(PACKAGES), str(target)),
                sudo=True, what='make an arm64 system'), timeout=900.0)
    return target


@contextlib.contextmanager
def emulated(root: Path) -> Iterator[None]:
    """Have this computer run the architecture's programs for the time of the block."""
    def runs() -> bool:
        return process.run(Command(('chroot', str(root), '/bin/true'), sudo=True), timeout=30.0,
                           check=False).returncode == 0

    if runs():
        yield
        return
    child = subprocess.Popen(
        ['sudo', '-n', 'unshare', '--mount', 'sh', '-ec', EMULATE, 'sh', EMULATOR][
            2 if os.geteuid() == 0 else 0:],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert child.stdout is not None
        said = child.stdout.readline()
        if said.strip() != 'ready' or not runs():
            pytest.skip(f'this kernel runs no emulator: {said.strip()}')
        yield
    finally:
        child.communicate('', timeout=30.0)


@pytest.fixture(scope='module')
def computer(
    arm_system: Path, cloud_network: str, tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[BareComputer]:
    """Run a computer of the architecture, with the robot's kernel and nothing of FogROS2."""
    with emulated(arm_system), bare_computer(
            f'fogt-arm-{uuid.uuid4().hex[:6]}', tmp_path_factory.mktemp('computer'),
            cloud_network, base=str(arm_system)) as running:
        yield running


@pytest.fixture
def shell(computer: BareComputer) -> Iterator[SSHShell]:
    made = SSHShell(computer.endpoint, name=computer.name, timeout=30.0)
    yield made
    made.close()


@pytest.fixture
def with_ros(computer: BareComputer) -> Iterator[None]:
    """Give the computer what stands for ROS 2 Jazzy."""
    rmw = '/opt/ros/jazzy/share/ament_index/resource_index/rmw_typesupport'
    computer.run(
        f'mkdir -p /usr/local/bin {rmw}; : >{rmw}/rmw_fastrtps_cpp; : >/opt/ros/jazzy/setup.sh\n'
        "printf '#!/bin/sh\\n' >/usr/local/bin/rosdep\n"
        f"cat >/usr/local/bin/colcon <<'END'\n{COLCON}END\n"
        'printf "#!/bin/sh\\n" >/usr/local/bin/wireguard-go\n'
        'chmod 755 /usr/local/bin/*; mkdir -p /etc/ros/rosdep/sources.list.d\n'
        ': >/etc/ros/rosdep/sources.list.d/20-default.list')
    yield
    computer.run('rm -rf /opt/ros /usr/local/bin/colcon /usr/local/bin/rosdep '
                 '/usr/local/bin/wireguard-go /home/fog/.local')


def under() -> plan.Underlay:
    environment = {'PATH': os.environ['PATH'], 'ROS_DISTRO': 'jazzy'}
    return plan.Underlay((sys.prefix,), environment)


def prepared(shell: SSHShell, root: Path) -> bootstrap.RosInstall:
    spec = MachineSpec('m', 'ssh', workspace=str(root))
    install, _ = bootstrap.ensure(shell, under(), spec, timeout=300.0)
    assert install.facts.architecture == ARCHITECTURE != install.robot.architecture
    return install


def moved(shell: SSHShell, install: bootstrap.RosInstall) -> str:
    return workspace.transfer(shell, install.workspaces, timeouts=Timeouts())


def test_python_travels_as_it_is(
    shell: SSHShell, with_ros: None, computer: BareComputer, tmp_path: Path,
) -> None:
    root = tmp_path / 'ws'
    colcon_workspace(root, 'pure', programs={
        'node': 'import platform\nprint(platform.machine())\n'})
    install = prepared(shell, root)
    note = moved(shell, install)
    assert 'built there' not in note and install.kind == 'ros'
    node = f'{root}/install/pure/lib/pure/node'
    assert shell.run(Command((node,)), timeout=60.0).stdout.split() == [ARCHITECTURE]
    # so does FogROS2's own package
    imported = Command((
        'env', f"PYTHONPATH={install.environment['PYTHONPATH']}", 'python3', '-c',
        'import fogros2.events, platform; print(fogros2.events.__file__, platform.machine())'))
    path, machine = shell.run(imported, timeout=60.0).stdout.split()
    assert machine == ARCHITECTURE
    assert any(Path(path).is_relative_to(folder)
               for folder in install.environment['PYTHONPATH'].split(':'))


def test_compiled_programs_are_built_there(
    shell: SSHShell, with_ros: None, tmp_path: Path,
) -> None:
    root = tmp_path / 'ws'
    colcon_workspace(root, 'compiled', programs={})
    (root / 'src/compiled/node.c').write_text(NODE)
    program = root / 'install/compiled/lib/compiled/node'
    program.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy('/bin/true', program)
    install = prepared(shell, root)
    note = moved(shell, install)
    assert (f'built there: install/compiled/lib/compiled/node is built for {platform.machine()}, '
            f'there it is {ARCHITECTURE}') in note
    read = shell.run(Command(('od', '-An', '-tx1', '-j18', '-N2', str(program))), timeout=30.0)
    assert bytes.fromhex(read.stdout) == ELF_MACHINE
    said = shell.run(Command((str(program),)), timeout=30.0).stdout
    assert said == 'compiled there\n'
