# SPDX-License-Identifier: Apache-2.0
"""Replace a host key that was sent to a machine by a key that never leaves the machine."""

from __future__ import annotations

import re

from fogros2.errors import HostKeyError
from fogros2.model import Command

_KEY = re.compile('ssh-ed25519 [A-Za-z0-9+/]+={0,2}')

# The listening server is the outermost sshd among our parent processes. Its process title has its
# command line, which names the configuration and so the keys. If systemd holds the socket, the
# script restarts the service, whose sessions continue; otherwise SIGHUP reloads the keys.
_RENEW = r"""
listener= server=sshd config= pid=$$
PATH=$PATH:/usr/local/sbin:/usr/sbin:/sbin
while [ "${pid:-0}" -gt 1 ]; do
    title=$(tr '\0' ' ' </proc/$pid/cmdline)
    case $title in
        'sshd: /'*|/*/sshd|/*/sshd\ *) listener=$pid line=${title#sshd: } ;;
    esac
    pid=$(sed -n 's/^PPid:[[:space:]]*//p' /proc/$pid/status)
done
if [ -n "$listener" ]; then
    server=${line%% *}
    case $line in *' -f '*) config=${line#* -f }; config=${config%% *} ;; esac
fi
key=
while IFS= read -r each; do
    [ -s "$each" ] || continue
    case $(ssh-keygen -y -P '' -f "$each" 2>/dev/null) in ssh-ed25519*) key=$each; break ;; esac
done <<END
$("$server" -T ${config:+-f "$config"} 2>/dev/null | sed -n 's/^hostkey //p')
/etc/ssh/ssh_host_ed25519_key
END
[ -n "$key" ] || { echo 'its SSH server has no Ed25519 host key' >&2; exit 1; }
umask 077
rm -f "$key.new" "$key.new.pub"
ssh-keygen -q -t ed25519 -N '' -C "$(uname -n)" -f "$key.new"
chmod 644 "$key.new.pub"
mv -f "$key.new.pub" "$key.pub"
mv -f "$key.new" "$key"
cat "$key.pub"
if systemctl is-active -q ssh.socket 2>/dev/null; then
    systemctl restart ssh.service
elif [ -n "$listener" ]; then
    kill -HUP "$listener"
fi
"""


def renew() -> Command:
    """
    Return the command that gives a machine's SSH server a new Ed25519 host key.

    The command prints the public key. The connection that it runs over stays open.
    """
    return Command.script(_RENEW, sudo=True, what='make a host key')


def parse(output: str) -> str:
    """
    Return the public key (``ssh-ed25519 AAAA...``) in the output of :func:`renew`.

    :raises HostKeyError: the output has no key.
    """
    for line in output.splitlines():
        key = ' '.join(line.split()[:2])
        if _KEY.fullmatch(key):
            return key
    raise HostKeyError(f'the machine returned no host key, but {output[:80]!r}')
