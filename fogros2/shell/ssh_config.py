# SPDX-License-Identifier: Apache-2.0
"""What the user's configuration of OpenSSH says of a host: ``ssh -G`` evaluates it."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
import pwd
import re
import socket

from fogros2 import process
from fogros2.errors import ConfigurationError, ShellError
from fogros2.model import Command, Endpoint

_KEYS = ('~/.ssh/id_ed25519', '~/.ssh/id_ecdsa', '~/.ssh/id_rsa')
_KNOWN_HOSTS = ('~/.ssh/known_hosts', '/etc/ssh/ssh_known_hosts')
_FAMILIES = {'inet': socket.AF_INET, 'inet6': socket.AF_INET6}
#: Seconds for the evaluation, which may run the commands of ``Match exec``.
_TIMEOUT = 10.0
#: Characters that end a value. An unpaired quote in a file ends ssh, for all hosts.
MISREAD = re.compile('[ "\'#=]')


@dataclasses.dataclass(frozen=True)
class Settings:
    """
    How to connect to a host.

    :param user: '' for the user of this process.
    :param keys: files of private keys, of which some may not exist.
    :param only_keys: whether other keys of the agent are left out.
    :param agent: socket of the agent; '' for that of the environment, 'none' for no agent.
    :param proxy: command whose streams replace the TCP connection.
    :param known_hosts: files, of which some may not exist.
    :param label: name in these files, instead of the host and port.
    :param family: the only family of addresses, if it is one.
    """

    host: str
    port: int = 22
    user: str = ''
    keys: tuple[str, ...] = _KEYS
    only_keys: bool = False
    agent: str = ''
    proxy: tuple[str, ...] = ()
    known_hosts: tuple[str, ...] = _KNOWN_HOSTS
    label: str = ''
    family: socket.AddressFamily = socket.AF_UNSPEC


def of(endpoint: Endpoint) -> Settings:
    """
    Return how to connect to an endpoint, with the user's settings if it has an alias.

    :raises ConfigurationError: OpenSSH refuses its configuration.
    """
    settings = read(endpoint.alias, endpoint.user, endpoint.port) if endpoint.alias \
        else Settings(endpoint.host, endpoint.port, endpoint.user)
    if endpoint.key_file is not None:
        settings = dataclasses.replace(settings, keys=(endpoint.key_file,), only_keys=True)
    return settings


def read(name: str, user: str = '', port: int = 0) -> Settings:
    """
    Return what OpenSSH would do for ``ssh [-l user] [-p port] name``.

    :raises ConfigurationError: it refuses the name or its configuration.
    """
    home = os.path.expanduser('~')
    try:
        account = pwd.getpwuid(os.geteuid())
    except KeyError:
        account = None  # ssh refuses to run
    if account is None or process.which('ssh') is None:
        return Settings(name.lower(), port or 22, user)
    files: list[str] = []
    if account.pw_dir != home:
        # ssh takes the account's home, Python $HOME
        own = Path(home, '.ssh/config')
        files = ['-F', str(own) if own.is_file() else 'none']
    options = [*(('-l', user) if user else ()), *(('-p', str(port)) if port else ())]
    done = process.run(Command(('ssh', *files, '-G', '-T', *options, '--', name)),
                       timeout=_TIMEOUT, check=False)
    values: dict[str, list[str]] = {}
    for line in done.stdout.splitlines():
        keyword, _, value = line.partition(' ')
        values.setdefault(keyword, []).append(value)
    if done.returncode != 0 or 'hostname' not in values:
        raise ConfigurationError(f"OpenSSH has no use for its settings of '{name}': "
                                 f'{" ".join(done.stderr.split())}', f"try: ssh -G '{name}'")

    def first(keyword: str, default: str = '') -> str:
        return values.get(keyword, [default])[0]

    host, user, number = first('hostname'), first('user'), first('port')
    tokens = {'h': host, 'n': name, 'p': number, 'r': user, 'd': home, 'u': account.pw_name}

    def expanded(text: str) -> str:
        return re.sub('%(.)', lambda match: tokens.get(match[1], match[1] if match[1] == '%'
                                                       else match[0]), text)

    # ssh prints no quotes around a path with a space
    known = [file for kind in ('user', 'global') for file in re.split(
        ' (?=[/~])', expanded(first(f'{kind}knownhostsfile')))]
    return Settings(
        host, int(number), user,
        keys=tuple(os.path.expandvars(expanded(key)) for key in values.get('identityfile', ())),
        only_keys=first('identitiesonly') == 'yes', agent=expanded(first('identityagent')),
        proxy=_proxy(first('proxyjump'), expanded(first('proxycommand')), host, number, files),
        known_hosts=tuple(re.sub(f'^{re.escape(account.pw_dir)}/[.]ssh/', f'{home}/.ssh/',
                                 file) for file in known),
        label=first('hostkeyalias'),
        family=_FAMILIES.get(first('addressfamily'), socket.AF_UNSPEC))


def _proxy(
    jump: str, command: str, host: str, port: str, files: list[str],
) -> tuple[str, ...]:
    """Return the command that ``ProxyJump`` or ``ProxyCommand`` means."""
    if jump and jump != 'none':
        *before, last = jump.split(',')
        return ('ssh', *files, '-T', '-o', 'BatchMode=yes', '-W', f'[{host}]:{port}',
                *(('-J', ','.join(before)) if before else ()),
                '--', last if '://' in last else f'ssh://{last}')
    return ('sh', '-c', f'exec {command}') if command and command != 'none' else ()


def quoted(path: str) -> str:
    """
    Quote a path for a file or an option of OpenSSH.

    :raises ShellError: it cannot be quoted.
    """
    if '"' in path or '${' in path:
        raise ShellError(f'ssh would misread the path {path!r}', 'rename the file or folder')
    text = path.replace('%', '%%')
    return f'"{text}"' if MISREAD.search(text) else text
