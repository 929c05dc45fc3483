# SPDX-License-Identifier: Apache-2.0
"""
User data, as cloud-init would read it: what the first boot of an instance has to do; pure.

It knows the modules that are named in ``KNOWN`` and refuses the rest aloud, since cloud-init
would pass over a misspelled key with a warning that nobody sees.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping, Sequence
import dataclasses
import email
import email.policy
import gzip
from typing import Any, Optional, Union
import zlib

import yaml

#: The smallest limit of the clouds, before base64.
LIMIT = 16384
#: What a cloud-config may ask for here. The last line's are understood and change nothing.
KNOWN = (
    'bootcmd', 'hostname', 'packages', 'runcmd', 'ssh_authorized_keys', 'ssh_deletekeys',
    'ssh_keys', 'users', 'write_files',
    'apt', 'disable_root', 'final_message', 'growpart', 'locale', 'manage_etc_hosts', 'output',
    'package_reboot_if_required', 'package_update', 'package_upgrade', 'preserve_hostname',
    'resize_rootfs', 'ssh_genkeytypes', 'ssh_pwauth', 'ssh_quiet_keygen', 'timezone',
)
_GZIP = ('gz', 'gzip', 'gz+b64', 'gzip+b64', 'gz+base64', 'gzip+base64')
_BASE64 = ('b64', 'base64', 'gz+b64', 'gzip+b64', 'gz+base64', 'gzip+base64')


class UserDataError(ValueError):
    """The user data can't be carried out here."""


@dataclasses.dataclass(frozen=True)
class File:
    """A file to write; ``content`` is base64, ``mode`` an octal number as text."""

    path: str
    content: str
    owner: str = 'root:root'
    mode: str = '0644'
    append: bool = False
    defer: bool = False


@dataclasses.dataclass(frozen=True)
class User:
    """An account to make, and who may log in to it."""

    name: str
    shell: str = '/bin/bash'
    sudo: tuple[str, ...] = ()
    keys: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Plan:
    """
    What a boot has to do; commands are words, or a line for the shell.

    :param host_keys: private and public parts by type; empty for keys of the machine's own.
    :param users: accounts beside the image's own.
    :param scripts: whole scripts, run last.
    """

    bootcmd: tuple[Union[str, tuple[str, ...]], ...] = ()
    runcmd: tuple[Union[str, tuple[str, ...]], ...] = ()
    files: tuple[File, ...] = ()
    host_keys: Mapping[str, tuple[str, str]] = dataclasses.field(default_factory=dict)
    delete_host_keys: bool = True
    authorized_keys: tuple[str, ...] = ()
    users: tuple[User, ...] = ()
    packages: tuple[str, ...] = ()
    hostname: str = ''
    scripts: tuple[str, ...] = ()


def parse(data: bytes) -> Plan:
    """
    Return what user data asks for: plain or gzipped, one document or several in MIME.

    :raises UserDataError: it is too long, malformed, or asks for what isn't known here.
    """
    if len(data) > LIMIT:
        raise UserDataError(f'User data is limited to {LIMIT} bytes')
    plan = Plan()
    for text in _documents(_unzip(data)):
        if text.startswith('#cloud-config'):
            plan = _configured(plan, text)
        elif text.startswith('#!'):
            plan = dataclasses.replace(plan, scripts=(*plan.scripts, text))
        elif text.strip():
            raise UserDataError(f'user data begins with {text.splitlines()[0][:40]!r}: '
                                'neither a cloud-config nor a script')
    return plan


def _unzip(data: bytes) -> str:
    try:
        if data[:2] == b'\x1f\x8b':
            data = gzip.decompress(data)
        return data.decode()
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise UserDataError(f'user data is damaged: {error}') from error


def _documents(text: str) -> list[str]:
    head = text[:512].lower()
    if not head.startswith(('content-type: multipart', 'mime-version:', 'from ')):
        return [text]
    message = email.message_from_string(text, policy=email.policy.default)
    found = []
    for part in message.walk():
        if not part.is_multipart():
            payload = part.get_payload(decode=True)
            found.append(_unzip(payload if isinstance(payload, bytes) else b''))
    return found


def _configured(plan: Plan, text: str) -> Plan:
    try:
        config = yaml.safe_load(text) or {}
    except yaml.YAMLError as error:
        raise UserDataError(f'the cloud-config is no YAML: {error}') from error
    if not isinstance(config, Mapping):
        raise UserDataError('the cloud-config holds no settings')
    unknown = sorted(set(config) - set(KNOWN))
    if unknown:
        raise UserDataError(
            f"a cloud in a box knows no {', '.join(map(str, unknown))} in user data")
    return dataclasses.replace(
        plan,
        bootcmd=(*plan.bootcmd, *_commands(config.get('bootcmd'))),
        runcmd=(*plan.runcmd, *_commands(config.get('runcmd'))),
        files=(*plan.files, *(_file(entry) for entry in config.get('write_files') or ())),
        host_keys=_host_keys(config.get('ssh_keys') or {}) or plan.host_keys,
        delete_host_keys=bool(config.get('ssh_deletekeys', plan.delete_host_keys)),
        authorized_keys=(*plan.authorized_keys, *_words(config.get('ssh_authorized_keys'))),
        users=(*plan.users, *(user for entry in config.get('users') or ()
                              if (user := _user(entry)) is not None)),
        packages=(*plan.packages, *(entry if isinstance(entry, str) else str(entry[0])
                                    for entry in config.get('packages') or ())),
        hostname=str(config.get('hostname') or plan.hostname))


def _commands(given: Any) -> list[Union[str, tuple[str, ...]]]:
    if given is None:
        return []
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise UserDataError(f'commands have to be a list, not {given!r}')
    return [entry if isinstance(entry, str) else tuple(str(word) for word in entry)
            for entry in given]


def _words(given: Any) -> tuple[str, ...]:
    if given is None:
        return ()
    return (given,) if isinstance(given, str) else tuple(str(word) for word in given)


def _file(entry: Mapping[str, Any]) -> File:
    content = entry.get('content', '')
    data = content if isinstance(content, bytes) else str(content).encode()
    encoding = str(entry.get('encoding', 'text/plain')).lower()
    try:
        if encoding in _BASE64:
            data = base64.b64decode(data)
        if encoding in _GZIP:
            data = gzip.decompress(data)
    except (binascii.Error, OSError, EOFError, zlib.error) as error:
        raise UserDataError(f"{entry.get('path')} is no {encoding}: {error}") from error
    mode = entry.get('permissions', '0644')
    return File(
        str(entry['path']), base64.b64encode(data).decode(), str(entry.get('owner', 'root:root')),
        f'{mode:o}' if isinstance(mode, int) else str(mode), bool(entry.get('append')),
        bool(entry.get('defer')))


def _host_keys(given: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    found = {}
    for name, value in given.items():
        kind, _, half = str(name).partition('_')
        if half not in ('private', 'public', 'certificate') or kind not in (
                'rsa', 'ecdsa', 'ed25519'):
            raise UserDataError(f"ssh_keys knows no '{name}'")
        if half == 'private':
            found[kind] = (str(value), str(given.get(f'{kind}_public', '')))
    return found


def _user(entry: Any) -> Optional[User]:
    if entry == 'default':
        return None  # the image's own, which is there in any case
    if isinstance(entry, str):
        return User(entry)
    groups = entry.get('groups') or ()
    sudo = entry.get('sudo') or ()
    return User(
        str(entry['name']), str(entry.get('shell', '/bin/bash')),
        (sudo,) if isinstance(sudo, str) else tuple(str(line) for line in sudo),
        _words(entry.get('ssh_authorized_keys')),
        tuple(word.strip() for word in groups.split(',')) if isinstance(groups, str)
        else tuple(str(word) for word in groups))
