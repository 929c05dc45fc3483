# SPDX-License-Identifier: Apache-2.0
"""
Describe this computer and its last launch for a report of a bug, without secrets.

The report has chosen parts only: no output of nodes, no options and variables of machines. What
looks like a secret in the rest is replaced.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
import contextlib
from importlib import metadata
from pathlib import Path
import platform
import re
import sys

from fogros2 import journal
from fogros2.store import entries, Record, Store
from ros2fog_cli.api.doctor import Check

#: Replaces a secret.
HIDDEN = '[hidden]'
#: Lines of the last launch's log.
LAST = 200
_PACKAGES = ('ros-rclpy', 'cryptography', 'paramiko', 'PyYAML', 'boto3', 'google-auth',
             'azure-identity', 'kubernetes', 'av', 'foxglove-sdk')
#: Variables whose values are shown, by how they begin, and names of secrets.
_SHOWN = ('ROS_', 'RMW_', 'FOGROS2_', 'CYCLONEDDS_', 'FASTDDS_', 'FASTRTPS_', 'ZENOH_')
_WORD = 'secret|token|passw|passphr|credential|authorization|signature|cookie'
_SHORT = '(?:pass|pwd|psk|sig)(?![a-z])'
#: PWD itself is the current folder.
_SECRET_NAME = re.compile(f'key|{_WORD}|_{_SHORT}|sshpass', re.IGNORECASE)
_SECRETS = (
    re.compile(r'-----BEGIN [A-Z ]+-----(?:\s*\n\s*[A-Za-z0-9+/=]+$)*'
               r'(?:\s*-----END [A-Z ]+-----)?', re.MULTILINE),
    # a password may have '@' and '/', although it should not
    re.compile(r'(?<=://)(?:[^/\s:]*:\S+|[^/\s]+)(?=@)'),
    re.compile(r'(?i)(?P<kept>authorization["\']?\s*[:=]\s*).+'),
    re.compile(r'(?i)(?P<kept>\bbearer\s+|\bsshpass\s+-p\s*|\s-u\s+(?=\S+:))\S+'),
    re.compile(rf'(?i)(?P<kept>(?:\w[_-]?key|[?&]key|{_WORD}|(?<![a-z]){_SHORT})[\w-]*'
               r'["\']?\s*[:=>]\s*b?["\']?)[^\s&"\',;)]+'),
    re.compile(rf'(?i)(?P<kept>--[\w-]*(?:key|{_WORD}|{_SHORT})[\w-]*\s+["\']?)[^\s"\']+'),
    re.compile(r'\b(?:gh[pousr]_|github_pat_|glpat-|hf_|xox[a-z]-|sk-|AIza|pypi-|npm_|'
               r'dop_v1_|whsec_|SG\.)[\w.-]{16,}'),
    re.compile(r'\b(?:AKIA|ASIA)[A-Z0-9]{16}\b'),
    re.compile(r'\beyJ[\w-]+\.[\w-]+\.?[\w-]*'),
    re.compile(r'\b[0-9a-fA-F]{32,}\b'),
    re.compile(r'(?<![\w+/])(?=\S*[0-9])(?=\S*[A-Z])(?:[A-Za-z0-9+/]{40}|[A-Za-z0-9+/]{42,}={0,2})'
               r'(?![\w+/=])'))
#: Begin of an entry in launch's log; what nodes print has no level and logger there.
_LINE = re.compile(r'[0-9]+\.[0-9]+ (?:\[[A-Z]+\] \[(.*?)\]: )?')


def report(
    checks: Iterable[Check], store: Store, environment: Mapping[str, str], log: Path,
) -> str:
    """
    Return the report.

    :param checks: results of :func:`ros2fog_cli.api.doctor.examine`.
    :param log: folder of ROS 2's logs.
    """
    parts = {
        'Versions': versions(), 'Environment': variables(environment),
        'Checks': (f'[{check.verdict}] {check.name}: {check.detail}' for check in checks),
        'Machines': machines(store.machines()), 'Steps': steps(store),
        'Last launch': last_lines(log / 'latest' / 'launch.log')}
    text = '\n'.join(f'## {title}\n\n' + ''.join(f'    {line}\n' for line in lines)
                     for title, lines in parts.items())
    return without_secrets(text, known_secrets(environment, store), environment.get('HOME', ''))


def versions() -> Iterator[str]:
    """Yield the versions of programs and packages."""
    with contextlib.suppress(OSError):
        yield f"{platform.freedesktop_os_release().get('PRETTY_NAME', 'Linux')}, " \
            f'{platform.release()} {platform.machine()}'
    yield f'Python {platform.python_version()} in {sys.prefix}'
    for name in ('fogros2', *_PACKAGES):
        with contextlib.suppress(metadata.PackageNotFoundError):
            yield f'{name} {metadata.version(name)}'


def variables(environment: Mapping[str, str]) -> Iterator[str]:
    """Yield variables of ROS 2 and FogROS2; of one that names a secret, only that it is set."""
    for name, value in sorted(environment.items()):
        if name.startswith(_SHOWN):
            yield f'{name}={HIDDEN if _SECRET_NAME.search(name) else value}'


def machines(records: Iterable[Record]) -> Iterator[str]:
    """Yield a line for each record."""
    for record in records:
        launch = 'its launch runs' if record.launch_alive else \
            'its launch is gone' if record.launch else 'no launch'
        yield (f'{record.name}: {record.provider}, on_exit={record.spec.on_exit}, '
               f'bootstrap={record.spec.bootstrap}, {launch}'
               + f', damaged: {record.damage}' * bool(record.damage))


def steps(store: Store) -> Iterator[str]:
    """Yield the steps of launches that run."""
    for launch in sorted({record.launch for record in store.machines() if record.launch}):
        for step in journal.read(store.root / 'launches' / launch).steps:
            seconds = '' if step.seconds is None else f' {step.seconds:.2f} s'
            yield (f"{step.machine or 'robot'}: {step.step} {step.state}{seconds}"
                   + f': {step.detail}' * bool(step.detail))


def last_lines(path: Path) -> Sequence[str]:
    """Return the last lines that FogROS2 and launch wrote to a log, without those of nodes."""
    lines, own = [], False
    with contextlib.suppress(OSError), open(path, errors='replace') as file:
        for line in file:
            begin = _LINE.match(line)
            if begin:
                own = begin[1] in ('fogros2', 'launch')
            if own:
                lines.append(line.rstrip('\n'))
    return lines[-LAST:]


def known_secrets(environment: Mapping[str, str], store: Store) -> set[str]:
    """Return the values of variables that name secrets, and the lines of files with keys."""
    texts = {value for name, value in environment.items() if _SECRET_NAME.search(name)}
    for path in (Path(entry.path) for entry in entries(store.root)):
        with contextlib.suppress(OSError):
            if path.is_file() and path.suffix != '.json' and path.stat().st_size < 1 << 16 and (
                    path.suffix == '.key' or path.name.startswith('id_')):
                texts.update(path.read_text(errors='replace').splitlines())
    return {text.strip() for text in texts if len(text.strip()) >= 8}


def without_secrets(text: str, secrets: Iterable[str], home: str = '') -> str:
    """
    Return a text without secrets.

    :param secrets: texts that must not be in it.
    :param home: the user's home, which becomes ``~``.
    """
    if len(home) > 1:
        text = text.replace(home, '~')
    for pattern in _SECRETS:
        text = pattern.sub(lambda match: match.groupdict().get('kept', '') + HIDDEN, text)
    for secret in sorted(secrets, key=len, reverse=True):
        text = text.replace(secret, HIDDEN)
    return text
