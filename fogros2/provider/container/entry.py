# SPDX-License-Identifier: Apache-2.0
"""The first process of a container machine, which starts sshd and the agent, as files."""

from __future__ import annotations

from collections.abc import Mapping
import json
from typing import Any

from fogros2.agent_client import agent_program
from fogros2.provider.container import engine as container_engine
from fogros2.provider.container.root import Archive

#: Folder of FogROS2's files on the machine, without the leading slash.
FOLDER = 'opt/fogros2'
#: The agent's folder, which belongs to the login user.
AGENT_DIRECTORY = 'run/fogros2'
HOST_KEY = 'etc/ssh/fogros2_host_ed25519_key'
#: Ends the first process, and with it the container.
END_COMMAND = ('kill', '-TERM', '1')
#: Prefixes of the first process's output for its public host key, and for an error.
HOST_KEY_MARK = 'fogros2-host-key: '
ERROR_MARK = 'fogros2-error: '

_ENTRY = """\
#!/bin/sh
# The first process of the machine: its end ends the machine.
trap 'exit 0' TERM INT
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
user='{user}'
key=/{host_key}
fail() {{ echo "{error_mark}$*"; exit 1; }}
missing=
for program in sshd sudo rsync python3; do
    command -v $program >/dev/null || missing="$missing $program"
done
if [ -n "$missing" ]; then
    # the package manager installs what the image lacks, once
    command -v apt-get >/dev/null || fail "the image lacks$missing, and has no apt-get"
    export DEBIAN_FRONTEND=noninteractive
    apt-get update -q >&2; apt-get install -q -y --no-install-recommends \\
        openssh-server sudo rsync python3 iproute2 >&2 \\
        || fail "the image lacks$missing, and apt-get could not install them"
fi
case $(id -u "$user" 2>/dev/null) in
    0 | {number}) ;;
    # the list of last logins would become as long as the number is high
    '') rm -f /var/log/lastlog; useradd -l -m -u {number} -s /bin/bash "$user" ;;
    *) rm -f /var/log/lastlog; usermod -u {number} "$user" ;;
esac || fail "no user $user with the id {number} can be made in the image"
# without PAM, sshd refuses users with a locked password; no typed password equals '*'
if grep -q "^$user:!" /etc/shadow; then usermod -p '*' "$user"; fi
if [ "$user" != root ] && ! grep -q "^$user .*NOPASSWD: ALL" /etc/sudoers; then
    rights=/etc/sudoers
    if grep -q '^[#@]includedir /etc/sudoers.d' /etc/sudoers; then
        rights=/etc/sudoers.d/fogros2
    fi
    grep -qs "^$user " $rights || echo "$user ALL=(ALL:ALL) NOPASSWD: ALL" >> $rights
    chmod 440 $rights
fi
{nested}mkdir -p /run/sshd /etc/ssh /{agent_directory}
chown "$user" /{agent_directory} && chmod 700 /{agent_directory}
# other accounts here must not speak for the machine to other machines
[ ! -d /{folder}/share ] || {{ chown "$user" /{folder}/share && chmod 711 /{folder}/share; }}
grep -qw "$(hostname)" /etc/hosts 2>/dev/null \\
    || printf '127.0.0.1 localhost\\n127.0.1.1 %s\\n' "$(hostname)" >> /etc/hosts
[ -s $key.pub ] || {{
    rm -f $key $key.new $key.new.pub
    ssh-keygen -q -t ed25519 -N '' -C fogros2 -f $key.new || fail 'no SSH host key can be made'
    mv $key.new $key
}}
"$(command -v sshd)" -f /{folder}/sshd_config || fail 'the SSH server does not start'
[ -s $key.pub ] || mv $key.new.pub $key.pub
echo "{host_key_mark}$(cat $key.pub)"
{agent}
"""

# However the agent ends, it starts again: nobody else would end the machine.
_AGENT = """\
# deadlines of an agent before this boot
rm -f /{agent_directory}/watchdog.json
while :; do
    python3 -IS /{folder}/agent.py serve --config /{folder}/agent.json &
    wait $!
    sleep 1 & wait $!
done
"""

# An engine in the machine changes network settings, which belong to this machine's network; the
# rest of the kernel's settings stays read-only. The engine's state of an earlier boot is deleted.
_NESTED = """\
rm -rf /run/containers /run/libpod /run/netns/netns-*
mount --bind /proc/sys/net /proc/sys/net && mount -o remount,bind,rw /proc/sys/net
[ -e /etc/containers/policy.json ] || {
    mkdir -p /etc/containers
    echo '{"default": [{"type": "insecureAcceptAnything"}]}' > /etc/containers/policy.json
}
"""
_NESTED_CONFIG = 'etc/containers/containers.conf.d/fogros2.conf'
# The outer engine manages control groups and limits. The usual network may be the machine's own.
_NESTED_SETTINGS = """\
[containers]
cgroups = "disabled"
default_ulimits = [{limits}]

[engine]
cgroup_manager = "cgroupfs"
events_logger = "file"
runtime = "crun"

[network]
default_subnet = "10.187.88.0/24"
"""

#: ``wait`` reaps the orphans that the first process inherits.
_IDLE = """\
sleep infinity &
wait $!
"""

_SSHD = """\
Port 22
HostKey /{host_key}
AuthorizedKeysFile /{folder}/authorized_keys .ssh/authorized_keys
AllowUsers {user}
PermitRootLogin {root}
PubkeyAuthentication yes
PasswordAuthentication no
KbdInteractiveAuthentication no
UsePAM no
UseDNS no
PrintMotd no
PrintLastLog no
X11Forwarding no
LoginGraceTime 20
MaxSessions 100
MaxStartups 100:30:200
ClientAliveInterval 15
ClientAliveCountMax 8
PidFile none
LogLevel ERROR
AcceptEnv LANG LC_*
Subsystem sftp internal-sftp
SetEnv LANG=C.UTF-8 PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
"""


def archive(
    *, user: str, number: int, authorized_key: str, agent_config: Mapping[str, Any],
    nested: bool = False,
) -> Archive:
    """
    Return the script of the first process, and the files that it needs in a machine's root.

    :param number: id of the login user, if the user is not root.
    :param nested: whether the machine runs containers.
    """
    names = {
        'user': user, 'number': number, 'folder': FOLDER, 'host_key': HOST_KEY,
        'error_mark': ERROR_MARK, 'host_key_mark': HOST_KEY_MARK,
        'agent_directory': AGENT_DIRECTORY,
        'root': 'prohibit-password' if user == 'root' else 'no',
    }
    start_agent = _AGENT.format(**names) if agent_config else _IDLE
    files = Archive()
    if nested:
        files.file(_NESTED_CONFIG, _NESTED_SETTINGS.format(
            limits=', '.join(f'"{word}"' for word in container_engine.limits()[1::2])).encode())
    files.folder(FOLDER)
    files.file(f'{FOLDER}/entry.sh', _ENTRY.format(
        agent=start_agent, nested=_NESTED if nested else '', **names).encode(), 0o755)
    files.file(f'{FOLDER}/sshd_config', _SSHD.format(**names).encode())
    files.file(f'{FOLDER}/authorized_keys', f'{authorized_key.strip()}\n'.encode())
    if agent_config:
        config = {'user': user, **agent_config}
        config['end_command'] = config.get('end_command') or list(END_COMMAND)
        files.file(f'{FOLDER}/agent.py', agent_program().encode())
        files.file(f'{FOLDER}/agent.json', json.dumps(config).encode(), 0o600)
    return files
