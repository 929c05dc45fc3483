# SPDX-License-Identifier: Apache-2.0
"""
Read command lines for ``docker run`` as the shell and docker of a machine would; pure.

A launch file has the lines that people find in pages: continued over several lines, with ``sudo``,
with ``$HOME``. What only the machine's shell knows stays an expansion; what is more than one
command with words is refused.
"""

from __future__ import annotations

from collections.abc import Iterator
import re
import shlex

#: Stands before and after an expansion in a word: no word of a command line has it.
MARK = '\0'
#: Options of ``docker run`` and ``podman run`` without a value, and with one.
FLAGS = frozenset("""
    detach disable-content-trust env-host help http-proxy init interactive no-healthcheck
    no-hostname no-hosts oom-kill-disable passwd privileged publish-all quiet read-only
    read-only-tmpfs replace rm rmi sig-proxy tls-verify tty unsetenv-all use-api-socket
    """.split())
SHORT_FLAGS = 'diPqt'
VALUES = frozenset("""
    add-host annotation arch attach authfile blkio-weight blkio-weight-device cap-add cap-drop
    cert-dir cgroup-conf cgroup-parent cgroupns cgroups chrootdirs cidfile conmon-pidfile cpu-count
    cpu-percent cpu-period cpu-quota cpu-rt-period cpu-rt-runtime cpu-shares cpus cpuset-cpus
    cpuset-mems creds decryption-key detach-keys device device-cgroup-rule device-read-bps
    device-read-iops device-write-bps device-write-iops dns dns-opt dns-option dns-search
    domainname entrypoint env env-file env-merge expose gidmap gpus group-add group-entry
    health-cmd health-interval health-log-destination health-max-log-count health-max-log-size
    health-on-failure health-retries health-start-interval health-start-period health-startup-cmd
    health-startup-interval health-startup-retries health-startup-success health-startup-timeout
    health-timeout hostname hosts-file hostuser image-volume init-path io-maxbandwidth io-maxiops
    ip ip6 ipc isolation kernel-memory label label-file link link-local-ip log-driver log-opt
    mac-address memory memory-reservation memory-swap memory-swappiness mount name net net-alias
    network network-alias oom-score-adj os passwd-entry personality pid pidfile pids-limit platform
    pod pod-id-file preserve-fd preserve-fds publish pull rdt-class requires restart retry
    retry-delay runtime sdnotify seccomp-policy secret security-opt shm-size shm-size-systemd
    stop-signal stop-timeout storage-opt subgidname subuidname sysctl systemd timeout tmpfs tz
    uidmap ulimit umask unsetenv user userns uts variant volume volume-driver volumes-from workdir
    """.split())
SHORT_VALUES = 'acehlmpuvw'

_NAME = r'[A-Za-z_]\w*'
_COMMANDS = 'pwd|whoami|hostname|id -[ug]n?|uname -[mrs]'
#: Expansions that the machine's shell makes; more of them would be a program.
_EXPANSION = (rf'\$(?P<name>{_NAME})|\$\{{(?P<braces>{_NAME}(?::?-[\w./:@%+,=-]*)?)\}}'
              rf'|\$\((?P<command>{_COMMANDS})\)|`(?P<ticks>{_COMMANDS})`')
_PIECE = re.compile(rf"""
    (?P<space>[ \t]+)
    |(?P<joined>\\(?:\n|\Z))
    |\\(?P<escaped>.)
    |'(?P<single>[^']*)'
    |"(?P<double>(?:\\.|[^"\\])*)"
    |(?P<expansion>{_EXPANSION.replace(' ', '[ ]')})
    |(?P<comment>(?<![^\s])\#[^\n]*)
    |(?P<home>(?<![^\s])~(?=[\s/]|$))
    |(?P<plain>(?!(?<![^\s])~)[^\s\\'"`$|&;<>()]|\$(?![A-Za-z_({{'"0-9@*\#?$!-]))
    """, re.VERBOSE | re.DOTALL)
_QUOTED = re.compile(rf"""
    (?P<joined>\\\n)
    |\\(?P<escaped>[$`"\\])
    |(?P<expansion>{_EXPANSION.replace(' ', '[ ]')})
    |(?P<plain>[^$`]|\$(?![A-Za-z_({{0-9@*\#?$!-]))
    """, re.VERBOSE | re.DOTALL)


def words(line: str) -> list[str]:
    """
    Split a command line as a shell does; an expansion stands between two ``MARK``.

    :raises ValueError: the line is more than one command, or has another expansion.
    """
    if MARK in line:
        raise ValueError('has a NUL character')
    result: list[str] = []
    word: list[str] = []
    for kind, text in _pieces(_PIECE, line.replace('\r\n', '\n').strip()):
        if kind in ('space', 'comment'):
            result += [''.join(word)] if word else []
            word = []
        elif kind == 'double':
            # '' keeps a word without content
            word += ['', *(part for _, part in _pieces(_QUOTED, text))]
        else:
            word += [text]
    return result + ([''.join(word)] if word else [])


def _pieces(pattern: re.Pattern[str], text: str) -> Iterator[tuple[str, str]]:
    """Yield the kind and the meaning of each piece of a text."""
    at = 0
    while at < len(text):
        match = pattern.match(text, at)
        if match is None:
            rest = text[at:].split('\n')[0][:20].strip() or 'a second line'
            if rest[0] in '\'"':
                raise ValueError('is no command line: a quote has no end')
            raise ValueError(f'has {rest} where a shell would do more than run a command')
        at = match.end()
        kind = match.lastgroup or ''
        if any(match.group('name', 'braces', 'command', 'ticks')):
            command = match['command'] or match['ticks']
            yield 'plain', (f'{MARK}$({command}){MARK}' if command else
                            f"{MARK}${{{match['name'] or match['braces']}}}{MARK}")
        elif kind == 'home':
            yield 'plain', f'{MARK}${{HOME}}{MARK}'
        elif kind != 'joined':
            yield kind, match[kind]


def unfold(line: str) -> str:
    """
    Unfold the continued lines of a launch file in XML or YAML before launch reads it.

    For launch, a backslash makes the next character plain; and XML has a space for a newline in an
    attribute, so that a backslash stands alone.
    """
    return re.sub(r'(^|\s)\\\s+', r'\1', re.sub(r'\\\r?\n', '', line))


def expression(word: str) -> str:
    """Return the expression of a shell script for a word; it has no other expansions."""
    parts = word.split(MARK)
    return ''.join(f'"{part}"' if number % 2 else shlex.quote(part) if part or len(parts) == 1
                   else '' for number, part in enumerate(parts))
