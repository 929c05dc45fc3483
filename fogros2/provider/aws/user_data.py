# SPDX-License-Identifier: Apache-2.0
"""
The user data of an instance: a #cloud-config, gzipped, within EC2's 16 KB.

In this order: the one-time SSH host key and the login key (before sshd starts), then the guard
(before anything slow), last, in the background, the programs that an Ubuntu image lacks. Written
as JSON, which is YAML too. cloud-init runs ``bootcmd`` at every boot, so a machine that was
stopped is guarded again, and one made of a baked image isn't guarded by the former's settings.
"""

from __future__ import annotations

import ast
import base64
import bz2
from collections.abc import Mapping
import functools
import gzip
import io
import json
from pathlib import Path
import shlex
import tokenize
from typing import Any

from fogros2.errors import ProviderError
from fogros2.provider.agent_file import agent_file
from fogros2.provider.aws.host_key import HostKey

#: Bytes that EC2 takes, before it is encoded.
LIMIT = 16384
#: What FogROS2 brings, and the agent's own folder.
FOLDER = '/opt/fogros2'
AGENT_DIRECTORY = '/run/fogros2'
AGENT_PROGRAM = f'{FOLDER}/agent.py'
END_COMMAND = ('shutdown', '-h', 'now')
LOG = '/var/log/fogros2-agent.log'
#: Seconds for which the guard may fail to start before the machine ends: nobody guards it.
UNGUARDED = 120

# Runs in the background from the first moment: the login user is made a little later.
_GUARD = """\
#!/bin/sh
# Keeps the guard running; a machine that can not be guarded ends.
exec >>{log} 2>&1 </dev/null
left={unguarded}
while [ $left -gt 0 ]; do
    if id -u {user} >/dev/null 2>&1; then
        begin=$(date +%s)
        python3 -IS {program} serve --config {folder}/agent.json && exit 0
        # one that ran for a while, and died, begins anew
        [ $(($(date +%s) - begin)) -lt 10 ] || left={unguarded}
    fi
    left=$((left - 1))
    sleep 1
done
echo 'the guard does not start: ending the machine'
{end}
"""

_BOOT = """\
umask 022
mkdir -p {folder}
# an image that was baked of another machine brings the keys that could log in there
owned=yes
if [ "$(cat {folder}/instance 2>/dev/null)" != "$INSTANCE_ID" ]; then
    home=$(getent passwd {user} | cut -d: -f6)
    [ -z "$home" ] || rm -f "$home/.ssh/authorized_keys"
    rm -f /root/.ssh/authorized_keys
    echo "$INSTANCE_ID" >{folder}/instance
else
    owned=  # at a later boot it is whose launch comes first
fi
python3 -ISc 'import base64, bz2, sys
sys.stdout.buffer.write(bz2.decompress(base64.b64decode(sys.stdin.read())))' \\
    >{program} <<'{mark}'
{agent}
{mark}
cat >{folder}/guard.sh <<'{mark}'
{guard}
{mark}
(umask 077; cat >{folder}/agent.json) <<'{mark}'
{config}
{mark}
[ -n "$owned" ] || sed -i 's/"launch": "[^"]*"/"launch": ""/' {folder}/agent.json
# of its own, or it would end with the step of the boot that it was started in
systemd-run --no-block --unit=fogros2-guard --property=DefaultDependencies=no \\
    --property=Restart=on-failure /bin/sh {folder}/guard.sh >/dev/null 2>&1 \\
    || setsid /bin/sh {folder}/guard.sh &
"""

# the launch installs what is missing as well: apt's lock puts one behind the other
_TOOLS = """\
command -v wg && command -v rsync && exit 0
export DEBIAN_FRONTEND=noninteractive
{ apt-get -q -o DPkg::Lock::Timeout=300 update
apt-get -qy -o DPkg::Lock::Timeout=300 install --no-install-recommends wireguard-tools rsync
} >/var/log/fogros2-tools.log 2>&1 </dev/null &
"""


def user_data(
    *, name: str, user: str, authorized_key: str, host_key: HostKey,
    agent_config: Mapping[str, Any],
) -> bytes:
    """
    Return an instance's user data; the same bytes for the same arguments.

    :param agent_config: what arms the guard; none for a machine without one.
    :raises ProviderError: it is longer than EC2 takes.
    """
    config = cloud_config(name=name, user=user, authorized_key=authorized_key,
                          host_key=host_key, agent_config=agent_config)
    text = '#cloud-config\n' + json.dumps(config, ensure_ascii=False)
    data = gzip.compress(text.encode(), 9, mtime=0)
    if len(data) > LIMIT:
        raise ProviderError(
            f"the user data of '{name}' has {len(data)} bytes, and EC2 takes {LIMIT}")
    return data


def cloud_config(
    *, name: str, user: str, authorized_key: str, host_key: HostKey,
    agent_config: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the #cloud-config as a dictionary; see :func:`user_data`."""
    config: dict[str, Any] = {
        'hostname': name,
        'manage_etc_hosts': 'localhost',
        'ssh_deletekeys': True,
        'ssh_keys': {'ed25519_private': host_key.private,
                     'ed25519_public': f'{host_key.public}\n'},
        'ssh_authorized_keys': [authorized_key.strip()],
        'ssh_pwauth': False,
        'package_update': False,
        'package_upgrade': False,
        'runcmd': [['sh', '-c', _TOOLS]],
    }
    if agent_config:
        path = agent_file()
        if path is None:
            raise ProviderError('this installation of FogROS2 has no agent.py', 'install it again')
        armed = {'user': user, **agent_config}
        armed['end_command'] = armed.get('end_command') or list(END_COMMAND)
        names = {'user': user, 'folder': FOLDER, 'program': AGENT_PROGRAM, 'log': LOG,
                 'unguarded': UNGUARDED, 'end': shlex.join(armed['end_command'])}
        config['bootcmd'] = [['sh', '-c', _BOOT.format(
            agent=packed_agent(path), guard=_GUARD.format(**names), mark='FOGROS2-END',
            config=json.dumps(armed), **names)]]
    return config


@functools.lru_cache(maxsize=1)
def packed_agent(path: Path) -> str:
    """Return the agent's program for the boot script; bzip2 is smaller here than gzip or xz."""
    return base64.b64encode(bz2.compress(bare(path.read_text(encoding='utf-8')).encode())).decode()


def bare(source: str) -> str:
    """Blank a program's comments and docstrings; every line keeps its number."""
    lines = source.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column].rstrip()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)) \
                and ast.get_docstring(node, clean=False) is not None:
            text = node.body[0]
            begin, end = text.lineno - 1, text.end_lineno or text.lineno
            lines[begin:end] = [' ' * text.col_offset + '""'] + [''] * (end - begin - 1)
    return '\n'.join(lines)
