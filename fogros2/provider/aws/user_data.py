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
from collections.abc import Mapping, Sequence
import functools
import gzip
import json
from pathlib import Path
import re
import shlex
import threading
from typing import Any, Optional

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
cat >{program} <<'{mark}'
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
        armed = {'user': user, **agent_config}
        armed['end_command'] = armed.get('end_command') or list(END_COMMAND)
        names = {'user': user, 'folder': FOLDER, 'program': AGENT_PROGRAM, 'log': LOG,
                 'unguarded': UNGUARDED, 'end': shlex.join(armed['end_command'])}
        config['bootcmd'] = [['sh', '-c', _BOOT.format(
            agent=agent_program(), guard=_GUARD.format(**names), mark='FOGROS2-END',
            config=json.dumps(armed), **names)]]
    return config


_shrinking = threading.Lock()


def agent_program() -> str:
    """
    Return the agent's program without what only people read, which is most of it.

    :raises ProviderError: this installation has no agent.
    """
    path = agent_file()
    if path is None:
        raise ProviderError('this installation of FogROS2 has no agent.py', 'install it again')
    with _shrinking:  # a tenth of a second, which the machines of a launch shouldn't take each
        return _agent_program(path)


@functools.lru_cache(maxsize=1)
def _agent_program(path: Path) -> str:
    return shrunk(path.read_text(encoding='utf-8'))


def shrunk(source: str) -> str:
    """Return a program without comments, docstrings and annotations, narrowly indented."""
    tree = _Shrinker().visit(ast.parse(source))
    ast.fix_missing_locations(tree)
    text = ast.unparse(tree)
    narrow = re.sub(r'^(?: {4})+', lambda found: ' ' * (len(found[0]) // 4), text,
                    flags=re.MULTILINE)
    # a string over several lines may begin one of them with spaces of its own
    return narrow if ast.dump(ast.parse(narrow)) == ast.dump(ast.parse(text)) else text


def _fields(parts: Sequence[ast.expr], values: list[ast.expr]) -> str:
    """Return an f-string's parts as ``format`` has them; the values go to the end of a list."""
    text = ''
    for part in parts:
        if isinstance(part, ast.FormattedValue):
            values.append(part.value)
            text += '{' + ('' if part.conversion < 0 else f'!{chr(part.conversion)}')
            if isinstance(part.format_spec, ast.JoinedStr):
                text += ':' + _fields(part.format_spec.values, values)
            text += '}'
        elif isinstance(part, ast.Constant):
            text += str(part.value).replace('{', '{{').replace('}', '}}')
    return text


class _Shrinker(ast.NodeTransformer):
    """Takes away what isn't needed to run."""

    def _body(self, node: Any) -> Any:
        self.generic_visit(node)
        first = node.body[0] if node.body else None
        if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) \
                and isinstance(first.value.value, str):
            node.body = node.body[1:]
        node.body = node.body or [ast.Pass()]
        return node

    visit_Module = visit_ClassDef = _body

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        """Drop the annotations."""
        node.returns = None
        words = node.args
        for word in (*words.posonlyargs, *words.args, *words.kwonlyargs, words.vararg,
                     words.kwarg):
            if word is not None:
                word.annotation = None
        shorter: ast.AST = self._body(node)
        return shorter

    def visit_If(self, node: ast.If) -> Optional[ast.AST]:
        """Drop what is for type checkers."""
        self.generic_visit(node)
        if isinstance(node.test, ast.Name) and node.test.id == 'TYPE_CHECKING' \
                and not node.orelse:
            return None
        return node

    def visit_JoinedStr(self, node: ast.JoinedStr) -> ast.AST:
        """
        Make an f-string a call of ``format``.

        Python 3.12 writes f-strings that older ones, which a machine may have, can't read (PEP
        701): with the outer quotes inside once more.
        """
        self.generic_visit(node)
        values: list[ast.expr] = []
        text = _fields(node.values, values)
        return ast.Call(ast.Attribute(ast.Constant(text), 'format', ast.Load()), values, [])

    def visit_FormattedValue(self, node: ast.FormattedValue) -> ast.AST:
        """Leave a format's own fields to the f-string that it is in."""
        node.value = self.visit(node.value)
        if isinstance(node.format_spec, ast.JoinedStr):
            node.format_spec.values = [self.visit(part) for part in node.format_spec.values]
        return node

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        """Make an annotated assignment a plain one; a bare annotation stays."""
        self.generic_visit(node)
        if node.value is None:
            return node
        return ast.Assign(targets=[node.target], value=node.value)
