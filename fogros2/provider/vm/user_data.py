# SPDX-License-Identifier: Apache-2.0
"""
Write the user data of a machine: a #cloud-config, gzipped unless the cloud takes only text.

It contains, in this order: the one-time SSH host key and the login key (before sshd starts), the
agent (before anything slow), and, in the background, programs that an Ubuntu image lacks. It is
JSON, which is also YAML. cloud-init runs ``bootcmd`` at every boot. So a stopped machine has its
agent again, and a machine of a baked image does not use the agent's settings of the former one.
"""

from __future__ import annotations

import base64
import bz2
from collections.abc import Mapping, Sequence
import gzip
import json
import shlex
from typing import Any

from fogros2.agent_client import joined
from fogros2.errors import ProviderError
from fogros2.provider.vm.host_key import HostKey

#: Bytes that EC2 accepts, the smallest limit of the clouds.
LIMIT = 16384
#: Folder of FogROS2's programs on the machine, and the agent's own folder.
FOLDER = '/opt/fogros2'
AGENT_DIRECTORY = '/run/fogros2'
AGENT_PROGRAM = f'{FOLDER}/agent.py'
END_COMMAND = ('shutdown', '-h', 'now')
LOG = '/var/log/fogros2-agent.log'
#: Seconds for which the agent may fail to start before the machine ends.
UNGUARDED = 120

# Starts at the beginning of the boot; the login user is created a little later.
_WATCHDOG = """\
#!/bin/sh
# Keeps the agent running, however it ends; a machine whose agent does not start ends.
exec >>{log} 2>&1 </dev/null
left={unguarded}
while [ $left -gt 0 ]; do
    if id -u {user} >/dev/null 2>&1; then
        begin=$(date +%s)
        python3 -IS {program} serve --config {folder}/agent.json
        # an agent that ran for a while starts again
        [ $(($(date +%s) - begin)) -lt 10 ] || left={unguarded}
    fi
    left=$((left - 1))
    sleep 1
done
echo 'the agent does not start: ending the machine'
{end}
"""

_BOOT = """\
umask 022
mkdir -p {folder}
# an image of another machine contains the keys that could log in there
owned=yes
if [ "$(cat {folder}/instance 2>/dev/null)" != "$INSTANCE_ID" ]; then
    home=$(getent passwd {user} | cut -d: -f6)
    [ -z "$home" ] || rm -f "$home/.ssh/authorized_keys"
    rm -f /root/.ssh/authorized_keys
    rm -f {folder}/kept_until
    echo "$INSTANCE_ID" >{folder}/instance
else
    owned=  # at a later boot, the first launch that connects uses the machine
fi
python3 -ISc 'import base64, bz2, sys
sys.stdout.buffer.write(bz2.decompress(base64.b64decode(sys.stdin.read())))' \\
    >{program} <<'{mark}'
{agent}
{mark}
cat >{folder}/watchdog.sh <<'{mark}'
{watchdog}
{mark}
(umask 077; cat >{folder}/agent.json) <<'{mark}'
{config}
{mark}
[ -n "$owned" ] || sed -i 's/"launch": "[^"]*"/"launch": ""/' {folder}/agent.json
# a unit of its own: it must not end with this step of the boot
systemd-run --no-block --unit=fogros2-agent --property=DefaultDependencies=no \\
    --property=Restart=always /bin/sh {folder}/watchdog.sh >/dev/null 2>&1 \\
    || setsid /bin/sh {folder}/watchdog.sh &
"""

# the launch installs these too: apt's lock makes one wait for the other
_TOOLS = """\
command -v wg && command -v rsync && command -v nft && exit 0
export DEBIAN_FRONTEND=noninteractive
{ apt-get -q -o DPkg::Lock::Timeout=300 update
apt-get -qy -o DPkg::Lock::Timeout=300 install --no-install-recommends \\
    wireguard-tools rsync nftables
} >/var/log/fogros2-tools.log 2>&1 </dev/null &
"""


def user_data(config: Mapping[str, Any], text_limit: int = 0) -> bytes:
    """
    Return a #cloud-config as user data; the same bytes for the same one.

    :param text_limit: the most bytes of a text (ASCII); 0 for compressed user data.
    :raises ProviderError: longer than the limit of the clouds.
    """
    text = f'#cloud-config\n{json.dumps(config)}'.encode()
    data, limit = (text, text_limit) if text_limit else (gzip.compress(text, 9, mtime=0), LIMIT)
    if len(data) > limit:
        raise ProviderError(f"the user data of '{config['hostname']}' has {len(data)} bytes, and "
                            f'the cloud takes {limit}', 'name fewer keys in fleet=')
    return data


def cloud_config(
    *, name: str, user: str, authorized_keys: Sequence[str], host_key: HostKey,
    agent_config: Mapping[str, Any],
) -> dict[str, Any]:
    """
    Return a machine's #cloud-config as a dictionary.

    :param agent_config: the agent's configuration; empty for a machine without an agent.
    """
    config: dict[str, Any] = {
        'hostname': name,
        'manage_etc_hosts': 'localhost',
        'ssh_deletekeys': True,
        'ssh_keys': {'ed25519_private': host_key.private,
                     'ed25519_public': f'{host_key.public}\n'},
        'ssh_authorized_keys': [key.strip() for key in authorized_keys],
        'ssh_pwauth': False,
        'package_update': False,
        'package_upgrade': False,
        'runcmd': [['sh', '-c', _TOOLS]],
    }
    if agent_config:
        armed = {'user': user, 'kept_until': f'{FOLDER}/kept_until', **agent_config}
        armed['end_command'] = armed.get('end_command') or list(END_COMMAND)
        names = {'user': user, 'folder': FOLDER, 'program': AGENT_PROGRAM, 'log': LOG,
                 'unguarded': UNGUARDED, 'end': shlex.join(armed['end_command'])}
        # bzip2 is smaller here than gzip or xz
        agent = base64.b64encode(bz2.compress(joined().encode())).decode()
        config['bootcmd'] = [['sh', '-c', _BOOT.format(
            agent=agent, watchdog=_WATCHDOG.format(**names), mark='FOGROS2-END',
            config=json.dumps(armed), **names)]]
    return config
