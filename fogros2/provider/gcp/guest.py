# SPDX-License-Identifier: Apache-2.0
"""The commands that run on an instance: at its boot, for the notice, at its end."""

from fogros2.provider.vm.metadata import ASK

#: Google's guest agent would replace the host key of the user data at the first boot. Source:
#: its instance_setup.go.
BOOT = """\
file=/etc/default/instance_configs.cfg
grep -qs '^set_host_keys = false' $file ||
    printf '\\n[InstanceSetup]\\nset_host_keys = false\\n' >>$file
"""
_ASK = ASK + """\
def get(path):
    return ask('/computeMetadata/v1/' + path, 'Metadata-Flavor: Google')
"""
#: Its success is the notice that a spot instance is preempted, in 30 seconds.
NOTICE = ('python3', '-ISc', _ASK + """\
try:
    sys.exit(get('instance/preempted') != 'TRUE')
except OSError:
    sys.exit(1)
""")
#: With the API's address as argument, deletes the instance if its service account may, or else
#: shuts it down: such an instance is only stopped, and its disk is billed.
DELETE = ('python3', '-ISc', _ASK + """\
try:
    import json, urllib.request
    token = json.loads(get('instance/service-accounts/default/token'))['access_token']
    zone = get('instance/zone').split('/')[-1]
    path = get('project/project-id') + f'/zones/{zone}/instances/' + get('instance/name')
    urllib.request.urlopen(urllib.request.Request(
        sys.argv[1] + 'projects/' + path, method='DELETE',
        headers={'Authorization': 'Bearer ' + token}), timeout=20)
except (OSError, ValueError, KeyError):
    pass
os.execvp('shutdown', ['shutdown', '-h', 'now'])
""")
