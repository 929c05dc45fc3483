# SPDX-License-Identifier: Apache-2.0
"""Existing computers with an SSH server; a launch cleans them up and never ends them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
import dataclasses
import getpass
import os
from pathlib import Path
import re
import socket
from typing import Any, ClassVar
from urllib.parse import parse_qsl, urlencode

from fogros2.errors import (
    CommandError,
    ConfigurationError,
    MachineNotFound,
    NameTaken,
    ProviderError,
    Unsupported,
)
from fogros2.model import (
    Command,
    CreateRequest,
    Endpoint,
    Machine,
    MachineSpec,
    MachineState,
    Volume,
)
from fogros2.provider import Attached, Capabilities, Provider
from fogros2.provider.options import parsed
from fogros2.shell import connect, ssh_config, ssh_connection

_SCHEME = 'ssh:'
#: Seconds after which a computer without an answer counts as off.
_TIMEOUT = 5.0
#: Seconds for a look at volumes, and for the deletion of one.
_VOLUMES_TIMEOUT = 600.0
_VOLUMES = '~/.local/share/fogros2-volumes'
_VOLUME = re.compile('[a-z0-9-]+')
# A launch that uses a volume holds its lock.
_LIST = f"""\
cd {_VOLUMES} 2>/dev/null || exit 0
for each in *; do
    [ ! -d "$each" ] || {{ flock -n "$each" true && echo "$each free" || echo "$each used"; }}
done
"""
_DELETE = f"""\
cd {_VOLUMES} 2>/dev/null && [ -d "$1" ] || exit 0
flock -n -E 75 "$1" rm -rf -- "$1"
"""


@dataclasses.dataclass(frozen=True)
class Options:
    """
    Options of an existing computer.

    :param host: name or address, or a name of OpenSSH's configuration.
    :param user: login user; '' for the one that ``ssh`` would choose.
    :param port: TCP port of its SSH server; 0 for that of OpenSSH's configuration.
    :param key: private key file; '' for the user's own keys and agent.
    :param host_key: ``ssh-ed25519 AAAA...``; '' to use ``known_hosts``.
    """

    host: str = ''
    user: str = ''
    port: str = '0'
    key: str = ''
    host_key: str = ''

    @classmethod
    def parse(cls, given: Mapping[str, Any]) -> Options:
        """
        Return the options of a spec.

        :raises ConfigurationError: an option is unknown (with the nearest name) or wrong.
        """
        options = parsed(cls, given, 'an SSH machine')
        if any(c.isspace() or c in '/@' for c in options.host) \
                or options.host.startswith('-') or not _is_name(options.host):
            raise ConfigurationError(f"'{options.host}' can't be the host of an SSH machine",
                                     'host= takes a name or an address')
        if not options.port.isdecimal() or int(options.port) > 65535:
            raise ConfigurationError(f"'{options.port}' can't be the port of an SSH machine",
                                     'port= takes a number from 1 to 65535')
        if options.host_key and len(options.host_key.split()) < 2:
            raise ConfigurationError(f"'{options.host_key}' is no host key",
                                     "host_key= takes 'ssh-ed25519 AAAA...'")
        if options.key and not os.access(Path(options.key).expanduser(), os.R_OK):
            raise ConfigurationError(f"the key '{options.key}' can't be read", 'check key=')
        return options


def _is_name(host: str) -> bool:
    try:
        # a look-up encodes the name first, and refuses an empty or too long label
        return bool(host.encode('idna'))
    except UnicodeError:
        return False


class SSHProvider(Provider):
    """Computers that exist before and after the launch."""

    name: ClassVar[str] = 'ssh'
    capabilities: ClassVar[Capabilities] = Capabilities(owned=False, keeps_volumes=True)
    poll_interval: ClassVar[float] = 0.1

    def check(self, spec: MachineSpec) -> None:
        """Check the options without a connection."""
        Options.parse(spec.options)

    def check_here(self, spec: MachineSpec) -> None:
        """Check that the computer answers."""
        self.create(spec, CreateRequest('', '', {}, 0))

    def create(self, spec: MachineSpec, request: CreateRequest) -> str:
        """Return the id of the computer if it answers."""
        options = Options.parse(spec.options)
        settings = ssh_config.read(options.host, options.user, int(options.port))
        try:
            reach(settings)
        except socket.gaierror as error:
            if error.errno == socket.EAI_AGAIN:
                raise ProviderError(f"no DNS server answers for '{settings.host}'",
                                    "check the robot's network") from error
            raise ProviderError(f"there is no host called '{settings.host}'",
                                'it is reached through another computer, and the VPN needs its '
                                'address: write that as HostName' if settings.proxy else
                                f"check host= of '{spec.name}'") from error
        except ConnectionRefusedError as error:
            raise ProviderError(
                f'{settings.host} refuses connections to port {settings.port}',
                'does its SSH server run, and at that port?') from error
        except OSError as error:
            raise ProviderError(
                f'{settings.host} port {settings.port} does not answer: {error}',
                'is it on, and reachable from this robot?') from error
        return _SCHEME + urlencode({
            'name': spec.name, **dataclasses.asdict(options),
            'user': settings.user or getpass.getuser(), 'port': settings.port,
            'key': str(Path(options.key).expanduser().absolute()) if options.key else ''})

    def describe(self, machine_id: str) -> Machine:
        """Return the computer; its state is stopped if its SSH port does not answer."""
        if not machine_id.startswith(_SCHEME):
            raise MachineNotFound(f"'{machine_id}' is no SSH machine")
        words = dict(parse_qsl(machine_id[len(_SCHEME):], keep_blank_values=True))
        try:
            alias, name, user = words['host'], words['name'], words['user']
            number = int(words['port'])
            host_key, key_file = words['host_key'] or None, words['key'] or None
        except (KeyError, ValueError) as error:
            raise MachineNotFound(f"'{machine_id}' is no SSH machine") from error
        settings = ssh_config.read(alias, user, number)
        endpoint = Endpoint(
            'ssh', settings.host, settings.port, user, host_key, key_file, alias)
        try:
            address = reach(settings)
        except OSError:
            return Machine(machine_id, name, self.name, MachineState.STOPPED, owned=False)
        return Machine(
            machine_id, name, self.name, MachineState.RUNNING, endpoint=endpoint,
            vpn_host=address, owned=False)

    def find(self, tags: Mapping[str, str]) -> Iterable[Machine]:
        """Raise Unsupported: an existing computer stores no tags."""
        raise Unsupported('an SSH machine keeps no tags')

    def destroy(self, machine_id: str) -> None:
        """Do nothing: the launch did not create the computer."""

    def volumes(self, hosts: Sequence[str] = ()) -> Iterator[Volume]:
        """Yield the folders of these computers, whose volumes nobody else lists."""
        for host in hosts:
            for line in self._run(host, _LIST).splitlines():
                name, _, state = line.rpartition(' ')
                if _VOLUME.fullmatch(name):  # not another folder, nor what a host makes up
                    yield Volume(f'{_SCHEME}{host}/{name}', name, self.name, host,
                                 user='a launch' if state == 'used' else '')

    def attach(self, machine_id: str, name: str, size_gb: int) -> Attached:
        """Return a folder, whose size has no limit."""
        return Attached(folder=f'{_VOLUMES}/{name}')

    def detach(self, machine_id: str, name: str) -> None:
        """Do nothing: the folder stays where it is."""

    def delete_volume(self, volume_id: str) -> None:
        """Delete a folder unless a launch holds its lock."""
        host, _, name = volume_id.removeprefix(_SCHEME).rpartition('/')
        try:
            self._run(host, _DELETE, name)
        except CommandError as error:
            if error.result.returncode != 75:
                raise
            raise NameTaken(f"a launch uses the volume '{name}' on {host}",
                            'end that launch first') from error

    def _run(self, host: str, script: str, *words: str) -> str:
        machine = self.describe(self.create(
            MachineSpec(host, self.name, {'host': host}), CreateRequest('', '', {}, 0)))
        assert machine.endpoint is not None  # it has just answered
        shell = connect(machine.endpoint, name=host)
        try:
            return shell.run(Command(('sh', '-c', script, 'sh', *words),
                                     what=f'look at volumes on {host}'),
                             timeout=_VOLUMES_TIMEOUT).stdout
        finally:
            shell.close()


def reach(settings: ssh_config.Settings) -> str:
    """
    Return the address at which a computer answers; behind a proxy, the login will tell.

    :raises OSError: no answer, or no address.
    """
    if settings.proxy:
        return _address(socket.getaddrinfo(
            settings.host, settings.port, settings.family)[0][4])
    with ssh_connection.open_socket(settings, _TIMEOUT) as connection:
        return _address(connection.getpeername())


def _address(socket_address: tuple[Any, ...]) -> str:
    """Return the address of a socket address, a link-local one with its interface."""
    host, _, *rest = socket_address
    return f'{host}%{socket.if_indextoname(rest[1])}' if rest and rest[1] else str(host)
