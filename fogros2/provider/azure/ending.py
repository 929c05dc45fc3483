# SPDX-License-Identifier: Apache-2.0
"""
End the billing of a machine that its robot has left, and read the notice of an eviction.

A machine that powers itself off is billed on. With the right to assign roles, the machine gets an
identity that may deallocate it and delete its own group, and nothing else. Without the right, a
schedule of Azure deallocates it at the end of its lifetime.
"""

from __future__ import annotations

from collections.abc import Mapping
import fnmatch
import threading
import time
from typing import Any
import uuid

from fogros2.errors import DeadlineExceeded, FogError
from fogros2.provider.azure.account import Account, subscription
from fogros2.provider.azure.failures import AzureError
from fogros2.waiting import Periodic, wait_until

_ROLE_ACTIONS = ('Microsoft.Compute/virtualMachines/deallocate/action',
                 'Microsoft.Resources/subscriptions/resourceGroups/delete')
_ASSIGN = 'Microsoft.Authorization/roleAssignments/write'
#: Seconds until a new role is known to Azure.
ROLE = 20.0
#: Seconds before which a schedule of a time of day has to be set anew.
DAY = 86400.0 - 3600.0

#: With the API's address as argument, ends the machine, and its billing if it can. The agent runs
#: the command again when it fails. A role needs minutes until it works (403), and a machine
#: without an identity gets no token (400): such a machine can only power itself off.
END = ('python3', '-ISc', """\
import json, sys, subprocess, urllib.error, urllib.request
meta = 'http://169.254.169.254/metadata/'
def ask(url, method='GET', **head):
    call = urllib.request.Request(url, None if method == 'GET' else b'', head, method=method)
    with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(call, timeout=15) as a:
        return json.loads(a.read() or b'{}')
try:
    me = ask(meta + 'instance/compute?api-version=2021-02-01', Metadata='true')
    key = ask(meta + 'identity/oauth2/token?api-version=2018-02-01&resource=' + sys.argv[1],
              Metadata='true')['access_token']
    stop = {'name': 'fogros2-on-exit', 'value': 'stop'} in me['tagsList']
    group = me['resourceId'].split('/providers/')[0]
    ask(sys.argv[1] + (me['resourceId'] + '/deallocate?api-version=2024-07-01' if stop else
        group + '?api-version=2022-09-01'), 'POST' if stop else 'DELETE',
        Authorization='Bearer ' + key)
    sys.exit()
except urllib.error.HTTPError as error:
    with open('/proc/uptime') as up:
        young = float(up.read().split()[0]) < 900
    if error.code not in (400, 403) or error.code == 403 and young:
        sys.exit(1)
except OSError:
    sys.exit(1)
subprocess.run(['shutdown', '-h', 'now'])
""")

_NOTICE = """\
import json, sys, urllib.request
try:
    call = urllib.request.Request(
        'http://169.254.169.254/metadata/scheduledevents?api-version=2020-07-01',
        headers={'Metadata': 'true'})
    with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(call, timeout=3) as a:
        events = [e for e in json.load(a)['Events'] if e['EventType'] in ('Preempt', 'Terminate')]
except (OSError, ValueError, KeyError):
    sys.exit(1)
print(events and events[0]['EventType'] + ' ' + events[0].get('NotBefore', ''))
sys.exit(not events)
"""
#: Its success is the notice of a spot machine's eviction, and its output has the time.
NOTICE = ('python3', '-ISc', _NOTICE)


def may_assign(account: Account) -> bool:
    """Return whether the user may assign roles in the subscription; asked once in a process."""
    return account.once('assign', lambda: any(map(grants, account.pages(
        account.path(rest='providers/Microsoft.Authorization/permissions'),
        'asking for the rights of these credentials'))))


def grants(permission: Mapping[str, Any]) -> bool:
    """Return whether a permission of Azure allows the assignment of roles."""
    def has(key: str) -> bool:
        return any(fnmatch.fnmatchcase(_ASSIGN.lower(), pattern.lower())
                   for pattern in permission.get(key) or ())
    return has('actions') and not has('notActions')


def role_id() -> str:
    """Return the id of the machines' role, the same for every user of the subscription."""
    return str(uuid.uuid5(uuid.NAMESPACE_URL, f'fogros2 role:{subscription()}'))


def role() -> dict[str, Any]:
    """Return the role: a machine may deallocate itself and delete its own group."""
    return {'properties': {
        'roleName': f'FogROS2 machine ({subscription()})', 'type': 'CustomRole',
        'description': 'A machine of FogROS2 ends itself when its robot is gone.',
        'permissions': [{'actions': list(_ROLE_ACTIONS), 'notActions': []}],
        'assignableScopes': [f'/subscriptions/{subscription()}']}}


def assign(account: Account, name: str, principal: str) -> bool:
    """
    Let a machine end itself; return False if Azure refuses, whatever the reason.

    :param name: of the machine and its group.
    :param principal: id of the machine's identity.
    """
    words, what = 'providers/Microsoft.Authorization/role', f'giving {name} its role'
    definition = account.path(rest=f'{words}Definitions/{role_id()}')
    assignment = str(uuid.uuid5(uuid.NAMESPACE_URL, f'{name}:{principal}'))
    body = {'properties': {'roleDefinitionId': definition, 'principalId': principal,
                           # a new identity may not be known everywhere
                           'principalType': 'ServicePrincipal'}}

    def assigned() -> bool:
        try:
            account.call('PUT', account.path(name, f'{words}Assignments/{assignment}'), what, body)
        except AzureError as error:
            if error.code != 'RoleDefinitionDoesNotExist':
                raise
            account.call('PUT', definition, 'making the role of machines', role())
            return False
        return True

    try:
        # a new role may not be known everywhere
        return wait_until(assigned, timeout=ROLE, cancel=account.cancel, longest=5.0, what=what)
    except (AzureError, DeadlineExceeded):
        return False


def schedule(account: Account, name: str, region: str, lifetime: float) -> float:
    """
    Let Azure deallocate a machine at a time of day, and return when it first does.

    :param lifetime: in seconds; of more than a day, this process sets the time anew as long as it
        runs. Azure's clock counts, because the robot's may be wrong.
    """
    end = account.clock.now() + lifetime

    def put() -> float:
        # rounded up: a minute that has begun would be tomorrow's
        first = min(end, account.clock.now() + DAY) // 60 * 60 + 120
        account.having(None).call('PUT', path, f'scheduling the end of {name}', {
            'location': region, 'properties': {
                'status': 'Enabled', 'taskType': 'ComputeVmShutdownTask', 'timeZoneId': 'UTC',
                'dailyRecurrence': {'time': time.strftime('%H%M', time.gmtime(first))},
                'notificationSettings': {'status': 'Disabled'},
                'targetResourceId': account.vm(name)}})
        return first

    def again() -> None:
        try:
            put()
        except FogError as error:  # a later try may succeed
            if isinstance(error, AzureError) and error.gone:
                over.set()

    over = threading.Event()
    path = account.path(
        name, f'providers/Microsoft.DevTestLab/schedules/shutdown-computevm-{name}')
    first = put()
    if end > first:
        Periodic('fog-rearm', DAY / 8, again, stop=over)
    return first
