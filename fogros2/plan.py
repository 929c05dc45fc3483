# SPDX-License-Identifier: Apache-2.0
"""Pure decisions of a deployment: specs, the robot's environment and facts in, values out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
from decimal import Decimal
import ipaddress
import os
from pathlib import Path
import re
import sys
from typing import Any, Optional

from fogros2.errors import ConfigurationError, DdsError, VpnError
from fogros2.model import host_port, Machine, MachineSpec, Peer, VpnInterface
from fogros2.vpn.addresses import FIRST_FREE

#: Number of the first machine's address; .0 is the network, .1 the robot.
FIRST_MACHINE = 2
#: UDP port of the agent's heartbeat, on the VPN address only.
HEARTBEAT_PORT = 7399
#: ROS 2's own default, and the middleware of the wheels in the package index.
DEFAULT_RMW = 'rmw_fastrtps_cpp'
#: The PATH of a login shell without the user's own additions.
SYSTEM_PATH = '/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin'

#: Variables with lists of folders.
PATH_LISTS = (
    'AMENT_PREFIX_PATH', 'COLCON_PREFIX_PATH', 'CMAKE_PREFIX_PATH', 'PYTHONPATH',
    'LD_LIBRARY_PATH', 'PATH')
#: Variables of the robot that are valid on any machine.
PLAIN_VARIABLES = (
    'ROS_DISTRO', 'ROS_VERSION', 'ROS_PYTHON_VERSION', 'ROS_DOMAIN_ID',
    'ROS_AUTOMATIC_DISCOVERY_RANGE', 'RCUTILS_LOGGING_SEVERITY', 'RCUTILS_COLORIZED_OUTPUT',
    'RCUTILS_CONSOLE_OUTPUT_FORMAT', 'RCUTILS_LOGGING_USE_STDOUT')


def extended(base: Mapping[str, str], variables: Mapping[str, str]) -> dict[str, str]:
    """
    Add a user's variables; lists of folders are prepended to existing lists.

    :param base: variables that nodes need; ``variables`` are those of the launch file.
    """
    longer = {name: os.pathsep.join(filter(None, [variables[name], base[name]]))
              for name in PATH_LISTS if name in variables and name in base}
    return {**base, **variables, **longer}


def choose_rmw(environment: Mapping[str, str], known: Sequence[str]) -> str:
    """
    Choose the RMW of all nodes of the launch: the user's, or ROS 2's default.

    :raises DdsError: no plugin supports the user's RMW.
    """
    rmw = environment.get('RMW_IMPLEMENTATION') or DEFAULT_RMW
    if rmw not in known:
        raise DdsError(f'FogROS2 does not support RMW_IMPLEMENTATION={rmw}',
                       f"use one of {', '.join(known)}, or unset it")
    return rmw


def rmw_of(name: str, known: Sequence[str]) -> str:
    """
    Return the RMW of a launch file's ``dds=``: 'fastdds', or 'rmw_fastrtps_cpp'.

    :raises DdsError: no plugin supports it.
    """
    rmw = {'fastdds': 'rmw_fastrtps_cpp'}.get(name, name)
    rmw = rmw if rmw in known else f'rmw_{rmw}_cpp'
    if rmw not in known:
        raise DdsError(f"FogROS2 does not support dds='{name}'",
                       f"use one of {', '.join(known)}")
    return rmw


def check_rmw(rmw: str, prefixes: Sequence[str], specs: Iterable[MachineSpec]) -> None:
    """
    Check that the launch's RMW is available on the robot and on its machines.

    :param prefixes: the robot's ament prefixes.
    :raises DdsError: nodes here would not start, or would not communicate with a machine's nodes.
    """
    apt = f"ros-jazzy-{rmw.replace('_', '-')}"
    indices = [index for prefix in prefixes if (
        index := Path(prefix, 'share/ament_index/resource_index/rmw_typesupport')).is_dir()]
    if not any((index / rmw).exists() for index in indices):
        if any(has_wheels(prefix) for prefix in prefixes):
            raise DdsError(f'{rmw} is not in the wheels of ROS 2, which have {DEFAULT_RMW} alone',
                           'leave out dds= and RMW_IMPLEMENTATION, or source an installation of '
                           'ROS 2')
        if indices:
            raise DdsError(f'{rmw} is not installed on this computer',
                           f'sudo apt-get install {apt}, or leave out dds= and RMW_IMPLEMENTATION')
    for spec in specs:
        own = spec.environment.get('RMW_IMPLEMENTATION') or rmw
        if own != rmw:
            raise DdsError(
                f"the nodes of machine '{spec.name}' would have RMW_IMPLEMENTATION={own}, those"
                f' here {rmw}: they would not hear each other',
                'set RMW_IMPLEMENTATION for the whole launch, before it')
        if spec.bootstrap == 'pip' and rmw != DEFAULT_RMW:
            raise DdsError(
                f"machine '{spec.name}' would get ROS 2 by pip, which has only {DEFAULT_RMW}, but "
                f'nodes on the robot use {rmw}',
                "use bootstrap='apt' (Ubuntu 24.04), or leave out dds= and RMW_IMPLEMENTATION")


def read_domain(text: str) -> int:
    """
    Return the number in a ROS_DOMAIN_ID, read as rcl does: octal after 0, hexadecimal after 0x.

    :raises ConfigurationError: it is not a number.
    """
    try:
        return int(re.sub('^0+(?=[0-7])', '0o', text.strip() or '0'), 0)
    except ValueError:
        raise ConfigurationError(f'ROS_DOMAIN_ID={text} is no number', 'use 0 to 101') from None


def check_domain(domain: int, specs: Iterable[MachineSpec]) -> None:
    """
    Check that the nodes of machines are in the launch's ROS domain.

    :raises DdsError: they and the robot's nodes would not hear each other.
    """
    for spec in specs:
        own = spec.environment.get('ROS_DOMAIN_ID', str(domain))
        if read_domain(own) != domain:
            raise DdsError(
                f"the nodes of machine '{spec.name}' would have ROS_DOMAIN_ID={own or 0}, those "
                f'here {domain}: they would not hear each other',
                'set ROS_DOMAIN_ID for the whole launch, before it')


def check_security(environment: Mapping[str, str], specs: Iterable[MachineSpec]) -> None:
    """
    Check that the nodes of machines are secured if the robot's are.

    :param environment: the robot's variables.
    :raises DdsError: secured and unsecured nodes would not hear each other.
    """
    for spec in specs:
        if environment.get('ROS_SECURITY_ENABLE') == 'true' and (
                'ROS_SECURITY_ENABLE' not in spec.environment):
            raise DdsError(
                'ROS_SECURITY_ENABLE=true secures the nodes here, but not those of machine '
                f"'{spec.name}', which has no keystore: they would not hear each other",
                f"unset it, or set the ROS_SECURITY variables in env= of '{spec.name}', which "
                'needs a keystore')


def has_wheels(prefix: str) -> bool:
    """Return whether a prefix has ROS 2 from the wheels of the package index."""
    return next(Path(prefix).glob('lib/python3*/site-packages/ros_rclpy-*.dist-info'),
                None) is not None


def robot_interface(
    launch_id: str, network: str, port: int, key_file: str, process: int,
) -> VpnInterface:
    """
    Return the robot's VPN interface, which has a firewall and the first address.

    :param process: id of the launch, whose nodes are its children.
    """
    return VpnInterface(
        name=f'fog{launch_id}', address=_host(network, 1), network=network, port=port,
        key_file=key_file, firewall=True, process=str(process))


def machine_interface(
    launch_id: str, network: str, index: int, port: int, key_file: str, process: str = '',
) -> VpnInterface:
    """
    Return the VPN interface of the ``index``-th machine, counted from 0.

    Its name differs from the robot's, because a machine may be the robot itself.

    :param process: file with the agent's id, where the host has other DDS than the launch's.
    :raises ConfigurationError: the subnet has no free address.
    """
    return VpnInterface(
        name=f'fog{launch_id}m{index}', address=_host(network, FIRST_MACHINE + index),
        network=network, port=port, key_file=key_file, process=process)


def _host(network: str, number: int) -> str:
    subnet = ipaddress.ip_network(network)
    if number >= FIRST_FREE:
        raise ConfigurationError(
            f'{network} has no free address for another machine',
            f'a launch can have {FIRST_FREE - FIRST_MACHINE} machines')
    return str(subnet[number])


def machine_port(launch_id: str) -> int:
    """Return the UDP port of the machines' VPN, in the dynamic range, derived from the id."""
    return 49152 + int(launch_id, 16) % 16000


@dataclasses.dataclass(frozen=True)
class Route:
    """
    A machine's peer data in the VPN, and the endpoints that lead to the machine.

    :param peer: as hosts outside see it; without endpoint if they cannot dial it.
    :param private_network: name of the private network of ``private_endpoint``.
    :param private_endpoint: ``host:port`` for machines of the same private network.
    :param robot_endpoint: ``host:port`` at which it dials the robot, None if the robot dials.
    """

    peer: Peer
    private_network: str = ''
    private_endpoint: Optional[str] = None
    robot_endpoint: Optional[str] = None


def route(machine: Machine, peer: Peer, port: int, robot_port: int) -> Route:
    """
    Determine how a machine is reached, from its provider's report.

    :param peer: the machine without an endpoint.
    :param port: UDP port of its VPN interface; ``robot_port`` is the robot's.
    :raises VpnError: neither the robot nor the machine can dial the other.
    """
    outside = private = robot = None
    if machine.vpn_host:
        outside = host_port(machine.vpn_host, machine.vpn_port or port)
    elif machine.robot_host:
        robot = host_port(machine.robot_host, robot_port)
    else:
        raise VpnError(
            f"neither the robot nor '{machine.name}' can reach the other's UDP port of the VPN",
            'one of the two has to be reachable by UDP: see the options of its provider')
    if machine.private_network and machine.private_ip:
        private = host_port(machine.private_ip, port)
    return Route(
        dataclasses.replace(peer, endpoint=outside), machine.private_network, private, robot)


def machine_peers(robot: Peer, own: Route, others: Iterable[Route]) -> list[Peer]:
    """
    Return a machine's peers: the robot, then the other machines.

    The robot has an endpoint only if the machine has to dial it; otherwise the robot dials,
    possibly from behind a NAT. Machines of the same private network dial each other in it. Two
    machines that cannot be dialled from outside need such a network to reach each other.
    """
    return [dataclasses.replace(robot, endpoint=own.robot_endpoint), *(
        dataclasses.replace(other.peer, endpoint=other.private_endpoint)
        if own.private_network and own.private_network == other.private_network
        and other.private_endpoint is not None else other.peer
        for other in others)]


def price(per_hour: Decimal) -> str:
    """Format a price in US dollars per hour."""
    return f'${per_hour.quantize(Decimal("0.0001"))} an hour'


@dataclasses.dataclass(frozen=True)
class Underlay:
    """
    The ROS 2 environment of the robot's launch, as paths that a machine may have too.

    :param prefixes: ament prefixes and the Python environment, outside the workspace.
    :param environment: variables by which nodes find these prefixes and the workspace's install
        space; entries outside them, such as a user's own, are left out.
    :param rmw: the middleware of the launch's nodes.
    """

    prefixes: tuple[str, ...]
    environment: Mapping[str, str]
    rmw: str = DEFAULT_RMW


def underlay(
    environment: Mapping[str, str], workspaces: Sequence[str], ros2: str,
    prefix: str = sys.prefix,
) -> Underlay:
    """
    Determine the underlay from the variables in ``environment``.

    :param workspaces: the workspaces to send.
    :param ros2: path of the robot's ``ros2`` program.
    :param prefix: the interpreter's prefix; a virtual environment belongs to the underlay.
    """
    ament = [p for p in environment.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    outside = [p for p in ament if not below(p, workspaces)]
    prefixes = list(dict.fromkeys([*outside, *([prefix] if prefix != '/usr' else [])]))
    kept = [*prefixes, *workspaces]
    variables = {}
    for name in PATH_LISTS:
        entries = [
            entry for entry in environment.get(name, '').split(os.pathsep)
            if entry and below(entry, kept)]
        if name == 'PATH':
            entries = list(dict.fromkeys([*entries, os.path.dirname(ros2), SYSTEM_PATH]))
        if entries:
            variables[name] = os.pathsep.join(entries)
    variables.update({
        name: environment[name] for name in PLAIN_VARIABLES if environment.get(name)})
    return Underlay(
        tuple(prefixes), variables, environment.get('RMW_IMPLEMENTATION') or DEFAULT_RMW)


def below(path: str, roots: Iterable[str]) -> bool:
    """Return whether a path is one of some folders, or below one."""
    return any(path == root or path.startswith(root.rstrip('/') + '/') for root in roots)


def ament_prefixes(environment: Mapping[str, str]) -> list[str]:
    """Return the prefixes of the robot's packages, in their order."""
    paths = [p for p in environment.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    return list(dict.fromkeys([*paths, sys.prefix]))


def agent_config(spec: MachineSpec, launch_id: str, directory: str,
                 end_command: Sequence[str]) -> dict[str, Any]:
    """Return the agent's configuration for a machine of this launch."""
    return {
        'machine': spec.name, 'launch': launch_id, 'directory': directory,
        'on_exit': spec.on_exit, 'lifetime': spec.lifetime,
        'robot_timeout': spec.robot_timeout, 'end_command': list(end_command),
    }
