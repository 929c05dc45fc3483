# SPDX-License-Identifier: Apache-2.0
"""
What a command leaves behind in a system that nothing else uses.

Packages and their own files are not leftovers, nor are the project's folder and the cache of the
user, which the README names.
"""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import re
import time

from clean_system import PROJECT, System, USER

#: Folders where a launch or a test could put files. Elsewhere, the scripts of packages do.
_FOLDERS = ('dev/shm', 'etc/cni', 'etc/containers', 'etc/netns', 'etc/sudoers.d', 'etc/systemd',
            'etc/wireguard', 'home', 'mnt', 'opt', 'root', 'run', 'srv', 'tmp', 'usr/local',
            'var/lib/cni', 'var/lib/containers', 'var/spool', 'var/tmp')
_EXPECTED = re.compile(rf'/home/{USER}/({PROJECT}|\.cache)')
#: What podman keeps when the last container is gone, for the next one.
_PODMAN = (
    r'control group \w+/libpod_parent(/conmon)?', r'file /dev/shm/libpod_.*',
    r'file /(etc/cni/net\.d/cni\.lock|etc/containers/networks)(/.*)?',
    r'file /var/lib/containers/(cache|storage)(/.*)?',
    r'file /run/(containers|libpod|lock/netavark\.lock|netns|runc)(/.*)?', r'mount /run/netns',
    r'iptables rule .*(NETAVARK|netavark).*', r'file /var/lib/cni(/.*)?',
    r'nftables table table (ip (filter|nat)|inet netavark)')
#: What the scripts of packages make without dpkg's knowledge, through systemd for the most part.
_PACKAGES = (
    r'file /etc/systemd/.*', r'file /root/\.ssh', r'file /tmp/\.(ICE|X11|font|XIM)-unix',
    r'file /run/(adduser|dbus|log|runit|sendsigs\.omit\.d|shm|sshd|systemd|user|wireguard)(/.*)?',
    r'file /run/lock/subsys', r'file /usr/local/(lib/python3[.\d]*|share/fonts)(/.*)?')
#: The records of ROS 2 and sudo, and what pytest keeps of its last three runs.
_TOOLS = (rf'file /home/{USER}/(\.ros|\.sudo_as_admin_successful)(/.*)?', r'file /run/sudo(/.*)?',
          rf'file /tmp/pytest-of-({USER}|root)(/.*)?',
          # of LTTng, which rclpy's tracing loads: one for each of its versions and users
          r'file /dev/shm/lttng-ust-wait-\d+(-\d+)?')
#: The folders of FogROS2's own state, as long as they are empty, and the robot's id, which stays.
_STATE = (rf'file /home/{USER}/\.local(/state(/fogros2(/(machines|launches))?)?)?',
          rf'file /home/{USER}/\.config(/fogros2(/robot\.json)?)?')
_OTHERS = re.compile('|'.join((*_PODMAN, *_PACKAGES, *_TOOLS, *_STATE)), re.DOTALL)
#: For the page with the results.
NOT_COUNTED = (
    "Not counted as left behind: the project's folder, the user's cache, podman's own (storage, "
    'locks, an empty control group, its firewall chains), what scripts of packages make, the logs '
    "of ROS 2, LTTng's files of each user that has run a node, FogROS2's state folder while it is "
    "empty, the file of the robot's id, and the folder in which pytest keeps its last runs.")
#: Seconds for processes that are ending by themselves.
_GRACE = 15.0
_COMMANDS = {
    'container': 'podman ps -a --format "{{.ID}} {{.Names}}"',
    'image': 'podman images --format "{{.ID}} {{.Repository}}"',
    'volume': 'podman volume ls -q',
    'container network': 'podman network ls -q | grep -vx podman',
    'nftables table': 'nft list tables',
    'iptables rule': 'iptables-save | grep ^-A',
    'routing rule': 'ip rule | grep -v "lookup \\(local\\|main\\|default\\)"',
    'route': 'ip route show table all | grep -v "table local\\|dev tap0\\|dev lo"',
}


def look(system: System) -> set[str]:
    """Return everything in a system that a command can leave, a line each."""
    files = system.files
    owned = set(system.run('sh', '-c', 'cat /var/lib/dpkg/info/*.list').splitlines())
    found = {f'file {path}' for name in _FOLDERS for path in _walk(files, f'/{name}', owned)}
    found |= {f'interface {path.name}' for path in (files / 'sys/class/net').iterdir()}
    found |= {f'control group {Path(folder).relative_to(files / "sys/fs/cgroup")}'
              for folder, _, _ in os.walk(files / 'sys/fs/cgroup')}
    mounts = Path(f'/proc/{system.first}/mounts').read_text()
    found |= {f'mount {line.split(" ")[1]}' for line in mounts.splitlines()}
    found |= {f'process {words}' for words in _processes(files)}
    for what, command in _COMMANDS.items():
        lines = system.run('sh', '-c', f'{command} 2>/dev/null', check=False).splitlines()
        found |= {f'{what} {line.strip()}' for line in lines}
    return found


def after(system: System, before: set[str]) -> list[str]:
    """Return what is there now and was not before."""
    deadline = time.monotonic() + _GRACE
    while True:
        left = {each for each in look(system) - before if not _OTHERS.fullmatch(each)}
        if not left or time.monotonic() > deadline:
            # a new folder says enough of what is in it
            return sorted(each for each in left if each.rpartition('/')[0] not in left)
        time.sleep(1.0)


def _processes(files: Path) -> Iterator[str]:
    for folder in (files / 'proc').glob('[0-9]*'):
        try:
            words = (folder / 'cmdline').read_bytes().decode(errors='replace')
        except OSError:
            continue  # it has ended
        yield words.replace('\0', ' ').strip()


def _walk(files: Path, folder: str, owned: set[str]) -> Iterator[str]:
    """Return the paths below a folder that no package owns."""
    try:
        entries = list(os.scandir(f'{files}{folder}'))
    except OSError:
        return
    for entry in entries:
        path = f'{folder}/{entry.name}'
        if _EXPECTED.fullmatch(path):
            continue
        if path not in owned:
            yield path
        if entry.is_dir(follow_symlinks=False):
            yield from _walk(files, path, owned)
