# SPDX-License-Identifier: Apache-2.0
"""The commands that run on an instance: at its boot, for the notice, at its end."""

from __future__ import annotations

#: Google's guest agent would replace the host key of the user data at the first boot. Source:
#: its instance_setup.go.
BOOT = """\
file=/etc/default/instance_configs.cfg
grep -qs '^set_host_keys = false' $file ||
    printf '\\n[InstanceSetup]\\nset_host_keys = false\\n' >>$file
"""
# A socket is used, because an HTTP library takes five times as long to load as this takes to run.
_ASK = """\
import os, socket, sys
def ask(path):
    with socket.create_connection(('169.254.169.254', 80), 2) as link:
        link.settimeout(2)
        lines = f'GET /computeMetadata/v1/{path} HTTP/1.0', 'Metadata-Flavor: Google', '', ''
        link.sendall('\\r\\n'.join(lines).encode())
        answer = b''.join(iter(lambda: link.recv(4096), b''))
    top, _, body = answer.partition(b'\\r\\n\\r\\n')
    if top.split(b' ')[1:2] != [b'200']:
        raise OSError(top)
    return body.decode()
"""
#: Its success is the notice that a spot instance is preempted, in 30 seconds.
NOTICE = ('python3', '-ISc', _ASK + """\
try:
    sys.exit(ask('instance/preempted') != 'TRUE')
except OSError:
    sys.exit(1)
""")
#: With the API's address as argument, deletes the instance if its service account may, or else
#: shuts it down: such an instance is only stopped, and its disk is billed.
DELETE = ('python3', '-ISc', _ASK + """\
try:
    import json, urllib.request
    token = json.loads(ask('instance/service-accounts/default/token'))['access_token']
    zone = ask('instance/zone').split('/')[-1]
    path = ask('project/project-id') + f'/zones/{zone}/instances/' + ask('instance/name')
    urllib.request.urlopen(urllib.request.Request(
        sys.argv[1] + 'projects/' + path, method='DELETE',
        headers={'Authorization': 'Bearer ' + token}), timeout=20)
except (OSError, ValueError, KeyError):
    pass
os.execvp('shutdown', ['shutdown', '-h', 'now'])
""")
