# SPDX-License-Identifier: Apache-2.0
"""
Write the user data of a machine: a #cloud-config, gzipped unless the cloud takes only text.

It contains, in this order: the one-time SSH host key and the login key (before sshd starts), a
script that runs the agent (before anything slow), and, in the background, programs that an Ubuntu
image lacks. It is JSON, which is also YAML. The launch sends the agent over the first connection;
until then, the script ends the machine at ``boot_timeout``. cloud-init runs ``bootcmd`` at every
boot. So a stopped machine starts its agent again, and a machine of a baked image uses neither the
agent of the former one nor its settings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import gzip
import json
import shlex
from typing import Any

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
#: Settings of apt where a launch deletes the machine: Ubuntu's unattended upgrades take time and
#: apt's lock from the launch.
NO_UPGRADES = 'APT::Periodic::Enable "0";'
#: Settings of apt on other machines. An upgrade of NVIDIA's libraries does not fit the driver in
#: the running kernel, and one of an engine ends its containers.
CAREFUL_UPGRADES = ('Unattended-Upgrade::Package-Blacklist '
                    '{ "linux-"; "nvidia-"; "libnvidia-"; "docker"; "containerd"; };')
#: Seconds for which the agent may fail to start before the machine ends.
UNGUARDED = 120

# Starts at the beginning of the boot, before the login user exists; later comes the agent.
_WATCHDOG = """\
#!/bin/sh
# Keeps the agent running, however it ends; a machine whose agent does not start ends.
exec >>{log} 2>&1 </dev/null
# the clock may be set while the machine boots
uptime() {{ read -r now _ </proc/uptime; now=${{now%.*}}; }}
uptime
end=$((now + {boot_timeout}))
while [ $now -lt $end ]; do
    if [ -e {program} ] && id -u {user} >/dev/null 2>&1; then
        begin=$now
        python3 -IS {program} serve --config {folder}/agent.json
        uptime
        # an agent that ran for a while starts again
        [ $((now - begin)) -lt 10 ] || end=$((now + {unguarded}))
    fi
    sleep 0.2
    uptime
done
echo 'no agent came or starts: ending the machine'
until {end}; do sleep 30; done
"""

_BOOT = """\
umask 022
mkdir -p {folder}
# an image of another machine contains the keys that could log in there, and its recordings
owned=yes
if [ "$(cat {folder}/instance 2>/dev/null)" != "$INSTANCE_ID" ]; then
    home=$(getent passwd {user} | cut -d: -f6)
    [ -z "$home" ] || rm -rf "$home/.ssh/authorized_keys" "$home"/fogros2-*/recordings
    rm -f /root/.ssh/authorized_keys
    rm -f {folder}/kept_until {program}
    echo "$INSTANCE_ID" >{folder}/instance
else
    owned=  # at a later boot, the first launch that connects uses the machine
fi
cat >{folder}/watchdog.sh <<'{mark}'
{watchdog}
{mark}
(umask 077; cat >{folder}/agent.json) <<'{mark}'
{config}
{mark}
[ -n "$owned" ] || sed -i 's/"launch": "[^"]*"/"launch": ""/' {folder}/agent.json
# Ubuntu restarts units after an update of a library, and all nodes run in the agent's
mkdir -p /etc/needrestart/conf.d
echo '$nrconf{{override_rc}}{{qr(^fogros2-agent)}} = 0;' >/etc/needrestart/conf.d/fogros2.conf
mkdir -p /etc/apt/apt.conf.d
echo {upgrades} >/etc/apt/apt.conf.d/90fogros2
# logind would remove the user's shared memory and runtime folder after the last logout
mkdir -p /var/lib/systemd/linger
touch /var/lib/systemd/linger/{user}
# a unit of its own: it must not end with this step of the boot, nor with a node without memory
systemd-run --no-block --unit=fogros2-agent --property=DefaultDependencies=no \\
    --property=Restart=always --property=OOMPolicy=continue \\
    /bin/sh {folder}/watchdog.sh >/dev/null 2>&1 \\
    || setsid /bin/sh {folder}/watchdog.sh &
"""

# the launch installs these too: one waits for apt's locks of the other
_TOOLS = """\
command -v wg && command -v rsync && command -v nft && exit 0
export DEBIAN_FRONTEND=noninteractive
{ tries=0
until output=$(LC_ALL=C apt-get -q update 2>&1); do
    case $output in *'Could not get lock'*) ;; *) tries=300 ;; esac
    [ $((tries += 1)) -lt 300 ] || break
    sleep 1
done
echo "$output"
apt-get -qy -o DPkg::Lock::Timeout=300 -o Dpkg::Options::=--force-confdef \\
    -o Dpkg::Options::=--force-confold install --no-install-recommends \\
    wireguard-tools rsync nftables
} >/var/log/fogros2-tools.log 2>&1 </dev/null &
"""


def user_data(config: Mapping[str, Any]) -> bytes:
    """
    Return a #cloud-config as user data; the same bytes for the same one.

    :raises ProviderError: longer than the limit of the clouds.
    """
    data = gzip.compress(f'#cloud-config\n{json.dumps(config)}'.encode(), 9, mtime=0)
    if len(data) > LIMIT:
        raise ProviderError(f"the user data of '{config['hostname']}' has {len(data)} bytes, and "
                            f'the cloud takes {LIMIT}', 'name fewer keys in fleet=')
    return data


def cloud_config(
    *, name: str, user: str, authorized_keys: Sequence[str], host_key: HostKey,
    agent_config: Mapping[str, Any], boot: str = '',
) -> dict[str, Any]:
    """
    Return a machine's #cloud-config as a dictionary.

    :param agent_config: the agent's configuration; empty for a machine without an agent.
    :param boot: a shell script of the cloud, for each boot.
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
    scripts = [boot] if boot else []
    if agent_config:
        armed = {'user': user, 'kept_until': f'{FOLDER}/kept_until', **agent_config}
        armed['end_command'] = armed.get('end_command') or list(END_COMMAND)
        names = {'user': user, 'folder': FOLDER, 'program': AGENT_PROGRAM, 'log': LOG,
                 'upgrades': shlex.quote(NO_UPGRADES if armed.get('on_exit') == 'delete'
                                         else CAREFUL_UPGRADES),
                 'unguarded': UNGUARDED, 'end': shlex.join(armed['end_command']),
                 'boot_timeout': round(armed.get('boot_timeout', 1800.0))}
        scripts.append(_BOOT.format(
            watchdog=_WATCHDOG.format(**names), mark='FOGROS2-END',
            config=json.dumps(armed), **names))
    if scripts:
        config['bootcmd'] = [['sh', '-c', script] for script in scripts]
    return config
