# SPDX-License-Identifier: Apache-2.0
"""Check everything that a launch needs on this computer, before a machine costs anything."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
import dataclasses
import functools
from importlib import metadata
import importlib.util
import os
from pathlib import Path
import platform
import sys
import threading
from typing import Literal, Optional

from fogros2 import deploy, plan, plugin_system, process
from fogros2.dds import cyclonedds
from fogros2.describe import defaults
from fogros2.errors import Cancelled, FogError, Unsupported
from fogros2.host.inspection import DISTRO
from fogros2.model import Command
from fogros2.provider import container, Provider
from fogros2.provider.container import engine as container_engine
from fogros2.store import state_home, Store
from fogros2.vpn import addresses, helped
from fogros2.waiting import cancellable
from ros2fog_cli.api import lan, reach

Verdict = Literal['ok', 'warning', 'failed']
#: Python packages that launches import, and the Debian package of each.
_PACKAGES = {'paramiko': 'python3-paramiko', 'yaml': 'python3-yaml'}
_OPTIONAL = {program: process.PACKAGES[program] for program in ('ssh', 'ping')}


@dataclasses.dataclass(frozen=True)
class Check:
    """
    The result of one check.

    :param remedy: what the user should do, '' if nothing.
    """

    name: str
    verdict: Verdict
    detail: str
    remedy: str = ''


#: Providers that have checks of their own.
_LOOKED_AT = ('container', 'hosted')
#: Receive buffer in bytes that releases of wireguard-go since 2023 request: several raw images.
WIREGUARD_BUFFER = 7 << 20
#: DDS participants that know each other within 10 s: see doc/developers/dds_network.md.
PARTICIPANTS = 50
#: Time-out of a provider's answer, in seconds.
TIMEOUT = 8.0


def examine(*, lan_seconds: float = 1.5, providers: Sequence[str] = ()) -> list[Check]:
    """
    Run all checks, and return the results with a detail, in a fixed order.

    :param lan_seconds: how long to look for ROS 2 on other computers of the LAN; 0: not at all.
    :param providers: providers that must work. Other providers are checked if they are configured.
    """
    checks: list[Callable[[], Check]] = [
        python, packages, programs, root, tun, wireguard, engine, overlay, firewall_program, ros,
        rmw, cyclone_uri, machine_defaults, receive_buffer, udp_port, ssh_keys, firewall, state,
        clocks, vpn_paths, functools.partial(lan_peers, lan_seconds)]
    others = [name for name in plugin_system.names('fogros2.provider') if name not in _LOOKED_AT]
    for name in dict.fromkeys([*others, *providers]):
        checks.append(functools.partial(provider, name, needed=name in providers))
    with ThreadPoolExecutor(6, 'fog-doctor') as pool:
        return [done for done in pool.map(_result, checks) if done.detail]


def _result(check: Callable[[], Check]) -> Check:
    """Return the result of a check; a check that can't be made has failed."""
    try:
        return check()
    except (FogError, OSError) as error:
        name = getattr(check, 'func', check).__name__.replace('_', ' ')
        if isinstance(error, FogError):
            return _failed(name, error)
        return Check(name, 'failed', f'can not be looked at: {error}')


def provider(name: str, *, needed: bool = False, timeout: float = TIMEOUT) -> Check:
    """Check that a provider's SDK is installed, and that the provider accepts our credentials."""
    title = f"provider '{name}'"
    wrong: Verdict = 'failed' if needed else 'warning'
    try:
        kind: type[Provider] = plugin_system.load('fogros2.provider', name)
        if not needed and not kind.configured():
            return Check(title, 'ok', 'not set up here')
        answer = _in_time(lambda: kind().answers(), timeout)
    except Unsupported:
        return Check(title, 'ok', 'is there' if needed else '')
    except Exception as error:  # noqa: BLE001 - a plugin's defect must not hide the other checks
        return Check(title, wrong, str(error.args[0]), error.hint) \
            if isinstance(error, FogError) else Check(title, wrong, plugin_system.cause(error))
    if answer is None:
        return Check(title, wrong, f'no answer within {timeout:g} s',
                     'is there a way to the internet, and through a proxy?')
    return Check(title, 'ok', answer)


def _in_time(ask: Callable[[], str], timeout: float) -> Optional[str]:
    """Call ``ask`` and return its answer, or None after ``timeout`` seconds."""
    over = threading.Event()
    timer = threading.Timer(timeout, over.set)
    timer.start()
    try:
        return cancellable(ask, over, what='asking a provider', grace=lambda: 0.0)
    except Cancelled:
        return None
    finally:
        timer.cancel()


def python() -> Check:
    """Show the version of Python and where it is installed."""
    return Check('Python', 'ok', f'{platform.python_version()} in {sys.prefix}')


def packages() -> Check:
    """Check for the Python packages that every launch imports."""
    missing = [name for name in _PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        return Check(
            'Python packages', 'failed', f"{', '.join(missing)} not found by {sys.executable}",
            f"sudo apt-get install {' '.join(_PACKAGES[name] for name in missing)}, or pip "
            'install into the virtual environment that you use')
    return Check('Python packages', 'ok', ', '.join(_PACKAGES))


def programs() -> Check:
    """Check for the programs that every launch calls."""
    missing = [program for program in deploy.ROBOT_PROGRAMS if not process.which(program)]
    less = [program for program in _OPTIONAL if not process.which(program)]
    packages = sorted({deploy.ROBOT_PROGRAMS[p] for p in missing} | {_OPTIONAL[p] for p in less})
    remedy = f"sudo apt-get install {' '.join(packages)}" if packages else ''
    if missing:
        return Check('programs', 'failed', f"{', '.join(missing)} not found", remedy)
    if less:
        return Check('programs', 'warning', f"{', '.join(less)} not found", remedy)
    return Check('programs', 'ok', ', '.join(deploy.ROBOT_PROGRAMS))


def root() -> Check:
    """Check whether commands can run as root without a password."""
    if os.geteuid() == 0:
        return Check('root', 'ok', 'running as root')
    try:
        deploy.check_sudo()
    except FogError as error:
        if helped.permitted():
            return Check('root', 'ok', 'the VPN has a helper of its own; sudo, which container '
                         'machines take, asks')
        return _failed('root', error)
    return Check('root', 'ok', 'sudo asks nothing')


def tun() -> Check:
    """Check for the TUN device."""
    if deploy.TUN.exists():
        return Check('TUN', 'ok', str(deploy.TUN))
    if deploy.kernel_wireguard():
        return Check('TUN', 'warning', f'no {deploy.TUN}, which container machines need',
                     deploy.TUN_REMEDY)
    return Check('TUN', 'failed', f'no {deploy.TUN}', deploy.TUN_REMEDY)


def wireguard() -> Check:
    """Check for WireGuard in the kernel, or as a program."""
    if deploy.kernel_wireguard():
        return Check('WireGuard', 'ok', 'in the kernel')
    if process.which('wireguard-go'):
        return Check('WireGuard', 'ok', 'wireguard-go (the kernel has no module)')
    return Check('WireGuard', 'failed', 'neither in the kernel nor as wireguard-go',
                 'sudo apt-get install wireguard-go')


def engine() -> Check:
    """Check for a container engine that works."""
    name = 'container engine'
    try:
        chosen = container_engine.select('auto')
        # The flags may name a runtime or a cgroup manager that does not work: call with flags.
        result = chosen.call('ps', '--format', '{{.ID}}', what='asking the container engine',
                             timeout=20.0)
    except FogError as error:
        return Check(name, 'warning', str(error.args[0]),
                     f'{error.hint} (needed for ContainerInstance alone)')
    return Check(name, 'ok', f'{chosen.name}, {len(result.stdout.split())} containers run')


def overlay() -> Check:
    """Check whether the root file system of this computer can serve as an image."""
    try:
        container.check_programs()
        container.check_root()
    except FogError as error:
        return Check("container on this computer's root", 'warning', str(error.args[0]),
                     error.hint or "name an image with image='...'")
    return Check("container on this computer's root", 'ok', 'can be overlaid')


def firewall_program() -> Check:
    """Check whether nftables accepts rules; the launch filters the robot's side of the VPN."""
    try:
        deploy.check_net_admin()
        process.run(Command(('nft', 'list', 'tables'), sudo=True, what='ask nftables'),
                    timeout=10.0)
    except FogError as error:
        if helped.permitted():
            return Check('nftables', 'warning', 'can be asked by root alone')
        return Check('nftables', 'failed', str(error.args[0]),
                     error.hint or 'sudo modprobe nf_tables')
    return Check('nftables', 'ok', 'takes rules')


def ros() -> Check:
    """Check for ROS 2 Jazzy, installed or from wheels."""
    name = 'ROS 2'
    if process.which('ros2') is None:
        return Check(name, 'failed', 'ros2 is not on PATH', "source ROS 2's setup.bash")
    try:
        return Check(name, 'ok', f"rclpy {metadata.version('ros-rclpy')} from wheels")
    except metadata.PackageNotFoundError:
        pass
    distro = os.environ.get('ROS_DISTRO', '')
    if importlib.util.find_spec('rclpy') is None:
        return Check(name, 'failed', 'rclpy is not there', f'source /opt/ros/{DISTRO}/setup.bash')
    if distro != DISTRO:
        return Check(name, 'warning', f"ROS_DISTRO is '{distro}'", f'made and tested for {DISTRO}')
    return Check(name, 'ok', f'{distro}')


def rmw() -> Check:
    """Check that the middleware is installed and that FogROS2 can configure it for the VPN."""
    try:
        chosen = plan.choose_rmw(os.environ, plugin_system.names('fogros2.dds'))
    except FogError as error:
        return _failed('RMW_IMPLEMENTATION', error)
    set_here = 'set' if os.environ.get('RMW_IMPLEMENTATION') else 'not set'
    prefixes = [p for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    if any(Path(prefix, 'share', 'rclcpp').is_dir() for prefix in prefixes) \
            and not any(Path(prefix, 'share', chosen).is_dir() for prefix in prefixes):
        return Check('RMW_IMPLEMENTATION', 'failed', f'{chosen} is not installed',
                     f"sudo apt-get install ros-{DISTRO}-{chosen.replace('_', '-')}")
    return Check('RMW_IMPLEMENTATION', 'ok', f'{set_here}: launches use {chosen}')


def cyclone_uri() -> Check:
    """Check that the user's Cyclone configuration is readable; FogROS2 appends its own."""
    name, uri = 'CYCLONEDDS_URI', os.environ.get('CYCLONEDDS_URI', '').strip()
    try:
        list(cyclonedds.fragments(uri, os.environ))
    except FogError as error:
        return _failed(name, error)
    if missing := cyclonedds.closed(uri)[len(uri):]:
        return Check(name, 'failed', f'its XML has no {missing}', f'add {missing} at its end')
    return Check(name, 'ok', 'readable; ours is appended' if uri else 'not set')


def machine_defaults() -> Check:
    """Check the files with defaults of machines; show what they set, of mappings the names."""
    name, paths = 'defaults of machines', defaults.files(os.environ)
    try:
        shown = [f'{path}: ' + ', '.join(
            # a variable of env= may be a secret
            f"{f'{provider}.' * bool(provider)}{keyword}="
            f'{sorted(value) if isinstance(value, dict) else value!r}'
            for provider, table in tables.items() for keyword, value in table.items())
            for path in paths if (tables := defaults.read(path))]
    except FogError as error:
        return _failed(name, error)
    return Check(name, 'ok', '; '.join(shown) or f'none in {paths[0]}')


def receive_buffer(settings: Path = Path('/proc/sys/net/core')) -> Check:
    """Check the kernel's settings of receive buffers; raw images need large ones."""
    name, wanted = 'receive buffer', {'rmem_max': cyclonedds.RECEIVE_BUFFER}
    if not deploy.kernel_wireguard():
        # releases of wireguard-go before 2023 request no size, and get the default
        wanted = dict.fromkeys(('rmem_default', 'rmem_max'), WIREGUARD_BUFFER)
    try:
        sizes = {key: int((settings / key).read_text()) for key in wanted}
    except (OSError, ValueError):
        return Check(name, 'warning', f"net.core.{' and '.join(wanted)} can not be read here")
    shown = ', '.join(f'net.core.{key} is {size}' for key, size in sizes.items())
    small = [f'net.core.{key}={wanted[key]}' for key in wanted if sizes[key] < wanted[key]]
    if small:
        return Check(name, 'warning', f'{shown}: large images get lost on their way',
                     f"sudo sysctl -w {' '.join(small)}")
    return Check(name, 'ok', shown)


def udp_port() -> Check:
    """Check for a free UDP port."""
    try:
        return Check('UDP port', 'ok', f'{addresses.choose_port()} is free')
    except FogError as error:
        return _failed('UDP port', error)
    except OSError as error:
        return Check('UDP port', 'failed', f'none can be opened: {error.strerror}')


def ssh_keys() -> Check:
    """Check for a key of the user that an SSHInstance could log in with."""
    folder = Path('~/.ssh').expanduser()
    keys = [path.name for path in sorted(folder.glob('id_*')) if not path.name.endswith('.pub')] \
        if folder.is_dir() else []
    agent = os.environ.get('SSH_AUTH_SOCK', '')
    if keys or agent:
        return Check('SSH keys', 'ok', ', '.join([*keys, *(['SSH agent'] if agent else [])]))
    return Check('SSH keys', 'warning', f'no key in {folder} and no SSH agent',
                 'ssh-keygen -t ed25519 (needed for SSHInstance without key= alone)')


def firewall() -> Check:
    """Check whether a firewall of the user may block the VPN."""
    try:
        trouble = deploy.firewall_trouble()
    except FogError as error:
        return Check('firewall', 'warning', f'can not be looked at: {error.args[0]}', error.hint)
    if trouble is not None:
        return Check('firewall', 'warning', *trouble)
    return Check('firewall', 'ok', 'lets in what comes through the VPN')


def state() -> Check:
    """Check that the state folder can be written, and by this user alone."""
    folder = state_home()
    ancestor = next(p for p in (folder, *folder.parents) if p.exists())
    disk = os.statvfs(ancestor)
    why = 'is on a read-only file system' if disk.f_flag & os.ST_RDONLY else \
        'is on a full disk' if disk.f_blocks and not disk.f_bavail \
        or disk.f_files and not disk.f_ffree else \
        'is not writable' if ancestor != folder and not os.access(ancestor, os.W_OK) else ''
    if why:
        return Check('state folder', 'failed', f'{ancestor} {why}',
                     'FOGROS2_STATE_HOME names another folder')
    if ancestor != folder:
        return Check('state folder', 'ok', f'{folder} will be made')
    status = folder.stat()
    if status.st_uid != os.geteuid() or not os.access(folder, os.W_OK):
        return Check('state folder', 'failed', f'{folder} belongs to somebody else',
                     f'sudo chown -R {os.geteuid()} {folder}')
    if status.st_mode & 0o077:
        return Check('state folder', 'warning', f'{folder} can be read by others',
                     f'chmod 700 {folder}')
    return Check('state folder', 'ok', str(folder))


def clocks() -> Check:
    """Compare the clocks of machines under a launch with this computer's clock."""
    name, store = 'clocks of machines', Store()
    offsets = {record.name: offset for record in store.machines()
               if (offset := reach.clock(record, store)) is not None}
    detail = '; '.join(f'{machine}: {offset}' for machine, offset in offsets.items())
    if any(offset.exceeds for offset in offsets.values()):
        return Check(name, 'warning', detail, 'sudo apt-get install chrony, here and there')
    return Check(name, 'ok', detail)


def vpn_paths() -> Check:
    """Show how the packets of the VPN get to the machines of running launches."""
    paths = [f"{record.name}: {record.carried or 'UDP'}" for record in Store().machines()
             if record.launch_alive]
    return Check('VPN paths', 'ok', '; '.join(paths))


def lan_peers(seconds: float) -> Check:
    """Find ROS 2 on other computers, and whether a launch's nodes would communicate with it."""
    name = 'ROS 2 on the LAN'
    if seconds <= 0:
        return Check(name, 'ok', 'not looked for')
    try:
        domain = plan.read_domain(os.environ.get('ROS_DOMAIN_ID', ''))
        if not 0 <= domain <= lan.HIGHEST_DOMAIN:
            raise ValueError(f'ROS_DOMAIN_ID is {domain}, not 0 to {lan.HIGHEST_DOMAIN}')
        counts = lan.participants(domain, seconds)
    except FogError as error:
        return _failed(name, error)
    except (ValueError, OSError) as error:
        return Check(name, 'warning', f'can not be looked for: {error}')
    if (total := sum(counts.values())) > PARTICIPANTS:
        return Check(name, 'warning', f'{total} participants answer in domain {domain}: more than '
                     f'{PARTICIPANTS} of DDS find each other slowly',
                     'put several nodes into one process (components), or use rmw_zenoh_cpp')
    counts.pop(lan.HERE, None)
    if not counts:
        return Check(name, 'ok', f'no other computer answers in domain {domain}')
    hosts = ', '.join(f'{host} ({count})' for host, count in sorted(counts.items()))
    if os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE', '').upper() in ('LOCALHOST', 'OFF'):
        return Check(
            name, 'warning', f"participants at {hosts}: a launch's nodes don't talk to them, as "
            f"ROS_AUTOMATIC_DISCOVERY_RANGE is {os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE']}",
            'unset ROS_AUTOMATIC_DISCOVERY_RANGE if they should')
    return Check(name, 'ok', f"participants at {hosts}; a launch's nodes here talk to them")


def _failed(name: str, error: FogError) -> Check:
    return Check(name, 'failed', str(error.args[0]), error.hint)
