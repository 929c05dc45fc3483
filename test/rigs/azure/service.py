# SPDX-License-Identifier: Apache-2.0
"""
Azure Resource Manager in memory: what it takes, refuses and answers, without any machine.

It refuses what the real one refuses: requests without a token or a version, names, tags and rules
that break its own rules, unknown sizes and images, things that are in use, other people's rights.
Operations take time, can fail late, and deleted machines stay in lists for a while. The shapes
are those of Azure's REST reference; ``schema`` compares bodies with the models of Azure's SDK.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable, Mapping, Sequence
import dataclasses
import datetime
import fnmatch
import http.client
import itertools
import json
import re
import threading
import time
from typing import Any, Optional
from urllib.parse import parse_qsl, urlsplit
import uuid

from rigs.azure import catalogue, schema
from rigs.computers import faults
from rigs.computers.box import Call

SUBSCRIPTION = '0b1f6471-1bf0-4dda-aec3-cb9272f09590'
#: The user's token, and the secret with which the token service hands it out.
TOKEN, HEADER = 'token-of-the-user', 'secret-of-the-token-service'
OPERATOR = {'actions': ['*'], 'notActions': []}
CONTRIBUTOR = {'actions': ['*'], 'notActions': [
    'Microsoft.Authorization/*/Delete', 'Microsoft.Authorization/*/Write',
    'Microsoft.Authorization/elevateAccess/Action']}
_NAMES = {
    'resourcegroups': r'[\w.()-]{0,89}[\w()-]', 'virtualmachines': r'[A-Za-z0-9][\w.-]{0,63}',
    'virtualnetworks': r'[A-Za-z0-9][\w.-]{1,63}', 'galleries': r'[A-Za-z0-9][\w.]{0,79}',
    **dict.fromkeys(('networksecuritygroups', 'securityrules', 'publicipaddresses', 'images',
                     'networkinterfaces', 'snapshots', 'disks'), r'[A-Za-z0-9][\w.-]{0,79}'),
    **dict.fromkeys(('roleassignments', 'roledefinitions'), '[0-9a-f-]{36}'),
    'versions': r'\d+\.\d+\.\d+', 'extensions': r'[\w.-]{1,64}', 'schedules': r'[\w-]{1,260}'}
#: Kinds whose creation takes an operation; the others answer at once.
_SLOW = {'networksecuritygroups', 'securityrules', 'publicipaddresses', 'virtualnetworks',
         'virtualmachines', 'extensions', 'snapshots', 'galleries', 'images', 'versions'}
#: Paths of operations and their results, with the number.
_OPERATION = re.compile(r'/(\w*operation(s|results))/([0-9a-f-]{36})$', re.IGNORECASE)
#: Kinds whose operations have another word in their path.
_OPERATIONS = {'disks': 'diskOperations', 'snapshots': 'diskOperations', **dict.fromkeys(
    ('galleries', 'images', 'versions'), 'capsOperations')}
_USERS = {'admin', 'administrator', 'root', 'user', 'test', 'guest', 'sys', 'console'}


class Refusal(Exception):
    """An answer with an error."""

    def __init__(self, status: int, code: str, message: str = '', **headers: str) -> None:
        super().__init__(code)
        self.status, self.code = status, code
        self.message = message or f'The simulated service refused: {code}.'
        self.headers = headers


@dataclasses.dataclass
class Fault:
    """
    An error to answer with, or to end an operation with.

    :param kind: such as 'virtualMachines'; '' for every request.
    :param late: let the operation fail, which begins as if nothing were wrong.
    :param after: carry the request out, and lose the answer.
    """

    code: str
    status: int = 409
    method: str = ''
    kind: str = ''
    size: str = ''
    times: int = 1
    late: bool = False
    after: bool = False


@dataclasses.dataclass
class Operation:
    """A long-running operation; ``finish`` returns False while it has to go on."""

    ready: float
    finish: Callable[[], Any]
    status: str = 'InProgress'
    error: Optional[tuple[str, str]] = None


class Computers:
    """What is behind the machines: nothing here; a box has containers."""

    def take_address(self, *, private: bool = False) -> str:
        """Return an address that no other machine has."""
        return f'198.51.100.{next(_NUMBERS) % 250 + 1}'

    def begin(self, vm: dict[str, Any]) -> None:
        """Give a new machine a computer."""

    def begin_again(self, vm: dict[str, Any]) -> None:
        """Switch a computer on that is off."""

    def off(self, vm: dict[str, Any], *, forever: bool = False) -> bool:
        """Take a computer's power away, and its disk; return whether it is off."""
        return True

    def copy_disk(self, vm: dict[str, Any], image: str) -> None:
        """Copy a computer's disk for an image."""

    def attach(self, number: str, disk: str, size_gb: int, path: str) -> None:
        """Let a machine have a disk that outlives it."""

    def detach(self, number: str, disk: str) -> None:
        """Take such a disk from a machine."""

    def protect(self) -> None:
        """Put the rules of the network security groups in force."""


_NUMBERS = itertools.count(1)


class Service:
    """
    One subscription.

    :param delay: seconds that an operation takes.
    :param ghost: seconds for which a deleted machine stays in lists.
    """

    def __init__(
        self, computers: Optional[Computers] = None, *, delay: float = 0.02, ghost: float = 0.3,
    ) -> None:
        self.computers = computers or Computers()
        self.delay, self.ghost = delay, ghost
        #: Address by which the request that is being answered came.
        self.url = ''
        #: Seconds until a role works.
        self.propagation = 0.0
        self.groups: dict[str, dict[str, Any]] = {}
        self.resources: dict[str, dict[str, Any]] = {}
        self.ghosts: list[tuple[float, dict[str, Any]]] = []
        self.operations: dict[str, Operation] = {}
        self.calls: list[Call] = []
        self.faults: list[Fault] = []
        self.rights: dict[str, Any] = OPERATOR
        #: The actions that requests have needed.
        self.actions: set[str] = set()
        self.restricted: set[str] = set()
        self.lock = threading.RLock()

    # -- requests -------------------------------------------------------------------------------

    def answer(
        self, method: str, target: str, headers: Mapping[str, str], body: Any,
    ) -> tuple[int, dict[str, str], Any]:
        """Return status, headers and JSON of the answer to a request."""
        parts = urlsplit(target)
        path, query = parts.path.rstrip('/'), dict(parse_qsl(parts.query))
        with self.lock:
            self.tick()
            kind = ''
            try:
                if path == '/token':
                    return self._token(headers)
                if path == '/prices':
                    return 200, {}, self._prices(query)
                who = self._check(headers, path, query)
                kind = kind_of(path)
                fault = self._fault(method, kind, path, body)
                if fault is not None and not fault.late and not fault.after:
                    raise Refusal(fault.status, fault.code, **(
                        {'Retry-After': '1'} if fault.status == 429 else {}))
                found = self._route(method, path, kind, query, body, who, fault)
                self._check_answer(kind, found[2])
                if fault is not None and fault.after:
                    raise Refusal(500, fault.code)
                code = ''
            except Refusal as error:
                code = error.code
                found = error.status, error.headers, {
                    'error': {'code': error.code, 'message': error.message}}
            self.calls.append(Call(kind, path, method, code))
            return found

    def __call__(self, environ: dict[str, Any], start_response: Any) -> list[bytes]:
        """Answer as a WSGI application."""
        text = environ['wsgi.input'].read(int(environ.get('CONTENT_LENGTH') or 0))
        target = f"{environ['PATH_INFO']}?{environ['QUERY_STRING']}"
        headers = {name: environ.get(f'HTTP_{name.upper().replace("-", "_")}', '')
                   for name in ('Authorization', 'X-IDENTITY-HEADER')}
        with self.lock:
            self.url = f"{environ['wsgi.url_scheme']}://{environ['HTTP_HOST']}"
            status, more, answer = self.answer(
                environ['REQUEST_METHOD'], target, headers, json.loads(text) if text else None)
            data = b'' if answer is None else json.dumps(answer).encode()
        start_response(f'{status} {http.client.responses[status]}', [
            *more.items(), ('Content-Type', 'application/json'),
            ('Content-Length', str(len(data)))])
        return [data]

    def _check_answer(self, kind: str, answer: Any) -> None:
        """Compare an answer with the models of the SDK: a defect of this service."""
        for entry in answer.get('value', [answer]) if isinstance(answer, Mapping) else ():
            if '/operations/' not in str(entry.get('id', '')) and 'status' not in entry:
                trouble = schema.unknown(kind, entry)
                assert not trouble, trouble

    def _token(self, headers: Mapping[str, str]) -> tuple[int, dict[str, str], Any]:
        if headers.get('X-IDENTITY-HEADER') != HEADER:
            raise Refusal(401, 'unauthorized_client')
        return 200, {}, {'access_token': TOKEN, 'token_type': 'Bearer',
                         'expires_on': str(int(time.time()) + 86400), 'resource': self.url}

    def _prices(self, query: Mapping[str, str]) -> Any:
        asked = dict(re.findall(r"(\w+) eq '([^']*)'", query.get('$filter', '')))
        found = [entry for entry in catalogue.retail(asked.get('armRegionName', 'westeurope'))
                 if asked.get('armSkuName', entry['armSkuName']) == entry['armSkuName']]
        start, size = int(query.get('$skip', 0)), 10
        more = f"{self.url}/prices?%24filter={query.get('$filter', '')}&%24skip={start + size}" \
            if len(found) > start + size else None
        return {'Items': found[start:start + size], 'NextPageLink': more, 'Count': size}

    def _check(self, headers: Mapping[str, str], path: str, query: Mapping[str, str]) -> str:
        """Return the principal of the token, '' for the user."""
        scheme, _, token = headers.get('Authorization', '').partition(' ')
        if scheme != 'Bearer' or token != TOKEN and not token.startswith('token-of-'):
            raise Refusal(401, 'InvalidAuthenticationToken', 'The access token is invalid.')
        if not re.fullmatch(r'\d{4}-\d\d-\d\d(-preview)?', query.get('api-version', '')):
            raise Refusal(400, 'MissingApiVersionParameter',
                          'The api-version query parameter (?api-version=) is required.')
        words = path.split('/')
        if len(words) < 3 or words[1] != 'subscriptions':
            raise Refusal(404, 'InvalidResourceType')
        if words[2] != SUBSCRIPTION:
            raise Refusal(404, 'SubscriptionNotFound')
        return '' if token == TOKEN else token.removeprefix('token-of-')

    def _fault(self, method: str, kind: str, path: str, body: Any) -> Optional[Fault]:
        body = body if isinstance(body, Mapping) else {}
        size = str(body.get('properties', {}).get('hardwareProfile', {}).get('vmSize', ''))
        return faults.due(self.faults, lambda one: (
            one.method in ('', method) and one.kind.lower() in ('', kind)
            and one.size in ('', size)
            and not _OPERATION.search(path)))

    def _route(
        self, method: str, path: str, kind: str, query: Mapping[str, str], body: Any, who: str,
        fault: Optional[Fault],
    ) -> tuple[int, dict[str, str], Any]:
        words = path.split('/')
        self._authorize(method, path, kind, who)
        if operation := _OPERATION.search(path):
            return self._poll(path, operation[3], result=operation[2].lower() == 'results')
        if len(words) == 3:
            return 200, {}, {'subscriptionId': SUBSCRIPTION, 'displayName': 'Robots',
                             'state': 'Enabled', 'id': path}
        if words[-1].lower() == 'permissions':
            return 200, {}, {'value': [self.rights]}
        if words[-1].lower() == 'skus':
            region = re.findall(r"location eq '(\w+)'", query.get('$filter', ''))
            return 200, {}, {'value': catalogue.skus(region[0], self.restricted)
                             if region and region[0] in catalogue.REGIONS else []}
        if kind == 'tags':
            return self._merge(path, body)
        if kind == 'resourcegroups' and len(words) in (4, 5):
            return self._group(method, path, query, body)
        group = self._group_of(path)
        if method == 'POST':
            return self._act(path.rpartition('/')[0], words[-1].lower(), fault)
        if len(words) % 2 == 0 and kind in _NAMES:
            return 200, {}, {'value': self._listed(path, kind, query)}
        if method == 'GET':
            return 200, {}, self._shown(self._there(path), query)
        if method == 'DELETE':
            return self._remove(path)
        if method in ('PUT', 'PATCH'):
            return self._put(method, path, kind, group, body, fault)
        raise Refusal(405, 'MethodNotAllowed')

    def _authorize(self, method: str, path: str, kind: str, who: str) -> None:
        """Refuse what the caller's roles do not allow."""
        action = action_of(method, path, kind)
        permissions = [self.rights] if not who else [
            role['properties']['permissions'][0] for scope, role in self._roles(who)
            if path.lower().startswith(scope.partition('/providers/')[0])]
        self.actions.add(action)
        if not any(
                _matches(action, one['actions']) and not _matches(action, one['notActions'])
                for one in permissions):
            raise Refusal(403, 'AuthorizationFailed',
                          f"The client '{who or 'robot'}' does not have authorization to perform "
                          f"action '{action}' over scope '{path}'.")

    def _roles(self, who: str) -> list[tuple[str, dict[str, Any]]]:
        return [(key, self.resources[entry['properties']['roleDefinitionId'].lower()])
                for key, entry in self.resources.items() if '/roleassignments/' in key
                and entry['properties']['principalId'] == who
                and time.monotonic() - entry['_made'] >= self.propagation]

    def _new_roleassignments(self, entry: dict[str, Any], _: Any) -> None:
        entry['_made'] = time.monotonic()
        if entry['properties']['roleDefinitionId'].lower() not in self.resources:
            raise Refusal(400, 'RoleDefinitionDoesNotExist')

    # -- operations -----------------------------------------------------------------------------

    def later(
        self, path: str, finish: Callable[[], Any], *, location: bool = False,
    ) -> dict[str, str]:
        """Begin an operation; return the headers that lead to it."""
        identity = str(uuid.uuid4())
        self.operations[identity] = Operation(time.monotonic() + self.delay, finish)
        base, version = f'{self.url}/subscriptions/{SUBSCRIPTION}', 'api-version=2024-03-01'
        if location:
            return {'Location': f'{base}/operationresults/{identity}?{version}'}
        provider, kind = path.split('/providers/')[-1].partition('/')[0], kind_of(path)
        group = self._group_of(path)
        assert group is not None, path
        base += f'/providers/{provider}/locations/{group["location"]}'
        words = _OPERATIONS.get(kind, 'operations')
        return {
            'Azure-AsyncOperation': f'{base}/{words}/{identity}?{version}',
            'Location': f'{base}/operationResults/{identity}?{version}', 'Retry-After': '10'}

    def tick(self) -> None:
        """Carry out what is due; a box does so without a request, too."""
        for operation in list(self.operations.values()):
            if operation.status == 'InProgress' and time.monotonic() >= operation.ready:
                try:
                    if operation.finish() is not False:
                        operation.status = 'Succeeded'
                except Refusal as error:
                    operation.status = 'Failed'
                    operation.error = (error.code, error.message)
        self.ghosts = [one for one in self.ghosts if one[0] > time.monotonic()]

    def _poll(
        self, path: str, identity: str, *, result: bool,
    ) -> tuple[int, dict[str, str], Any]:
        if identity not in self.operations:
            raise Refusal(404, 'NotFound')
        operation = self.operations[identity]
        error = {'error': dict(zip(('code', 'message'), operation.error))} \
            if operation.error else {}
        if result:
            if operation.status == 'InProgress':
                return 202, {'Location': f'{self.url}{path}?api-version=2024-03-01'}, None
            return (409, {}, error) if error else (200, {}, None)
        return 200, {}, {'name': identity, 'status': operation.status, **error}

    # -- groups ---------------------------------------------------------------------------------

    def _group(
        self, method: str, path: str, query: Mapping[str, str], body: Any,
    ) -> tuple[int, dict[str, str], Any]:
        name = path.split('/')[4] if path.count('/') == 4 else ''
        key = name.lower()
        if not name:
            asked = dict(re.findall(r"(tagName|tagValue) eq '([^']*)'", query.get('$filter', '')))
            return 200, {}, {'value': [
                group for group in self.groups.values() if not asked or
                asked['tagName'] in group['tags'] and
                asked.get('tagValue', group['tags'][asked['tagName']])
                == group['tags'][asked['tagName']]]}
        if method == 'PUT':
            _name('resourcegroups', name)
            _tags(body)
            if body.get('location') not in catalogue.REGIONS:
                raise Refusal(400, 'LocationNotAvailableForResourceGroup')
            old = self.groups.get(key)
            if old and old['properties']['provisioningState'] == 'Deleting':
                raise Refusal(409, 'ResourceGroupBeingDeleted')
            if old and old['location'] != body['location']:
                raise Refusal(409, 'InvalidResourceGroupLocation')
            self.groups[key] = {
                'id': path, 'name': name, 'type': 'Microsoft.Resources/resourceGroups',
                'location': body['location'], 'tags': dict(body.get('tags') or {}),
                'properties': {'provisioningState': 'Succeeded'}}
            return 200 if old else 201, {}, self.groups[key]
        if key not in self.groups:
            raise Refusal(404, 'ResourceGroupNotFound', f"Resource group '{name}' could not be "
                          'found.')
        if method == 'DELETE':
            if self.groups[key]['properties']['provisioningState'] != 'Deleting':
                self.groups[key]['properties']['provisioningState'] = 'Deleting'
                for entry in self._inside(key):
                    entry['properties']['provisioningState'] = 'Deleting'
            return 202, self.later(path, lambda: self.drop(key), location=True), None
        return 200, {}, self.groups[key]

    def _inside(self, group: str) -> list[dict[str, Any]]:
        return [entry for key, entry in self.resources.items()
                if key.split('/')[4:5] == [group] and key.split('/')[3] == 'resourcegroups']

    def drop(self, group: str) -> bool:
        """Delete a group and what is in it; return whether all of it is gone."""
        inside = self._inside(group)
        there = [entry for entry in inside if kind_of(entry['id']) == 'virtualmachines'
                 and not self.computers.off(entry, forever=True)]
        if there:
            return False
        for entry in inside:
            self._vanish(entry)
        self.groups.pop(group, None)
        return True

    def _vanish(self, entry: dict[str, Any]) -> None:
        self.resources.pop(entry['id'].lower(), None)
        if kind_of(entry['id']) == 'virtualmachines':
            self._free(entry['id'])
            entry['properties']['provisioningState'] = 'Deleting'
            self.ghosts.append((time.monotonic() + self.ghost, entry))

    def _group_of(self, path: str) -> Optional[dict[str, Any]]:
        found = re.search('/resourcegroups/([^/]+)/', path, re.IGNORECASE)
        if found is None:
            return None
        if found[1].lower() not in self.groups:
            raise Refusal(404, 'ResourceGroupNotFound',
                          f"Resource group '{found[1]}' could not be found.")
        return self.groups[found[1].lower()]

    # -- resources ------------------------------------------------------------------------------

    def _there(self, path: str) -> dict[str, Any]:
        if path.lower() not in self.resources:
            raise Refusal(404, 'ResourceNotFound', f"The Resource '{path}' was not found.")
        return self.resources[path.lower()]

    def _listed(self, path: str, kind: str, query: Mapping[str, str]) -> list[dict[str, Any]]:
        scope = path.lower().rpartition('/')[0]
        if '/resourcegroups/' in scope:
            found = [entry for key, entry in self.resources.items()
                     if key.rpartition('/')[0] == path.lower()]
        else:
            found = [entry for key, entry in self.resources.items() if kind_of(key) == kind]
            found += [entry for _, entry in self.ghosts if kind == 'virtualmachines']
        if query.get('statusOnly') == 'true':
            return [{**{key: entry[key] for key in ('id', 'name', 'type', 'location')},
                     'properties': {'instanceView': self.view(entry)}} for entry in found]
        return [plain(entry) for entry in found]

    def _shown(self, entry: dict[str, Any], query: Mapping[str, str]) -> dict[str, Any]:
        found = plain(entry)
        if query.get('$expand') == 'instanceView':
            found['properties'] = {**found['properties'], 'instanceView': self.view(entry)}
        return found

    def view(self, entry: dict[str, Any]) -> dict[str, Any]:
        """Return the instance view of a machine."""
        making, failure = entry['properties']['provisioningState'], entry.get('_failure')
        status = {'code': f'ProvisioningState/{making.lower()}', 'level': 'Info',
                  'displayStatus': f'Provisioning {making.lower()}',
                  'time': datetime.datetime.now(datetime.timezone.utc).isoformat()}
        if failure:
            status = {'code': f'ProvisioningState/failed/{failure[0]}', 'level': 'Error',
                      'displayStatus': 'Provisioning failed', 'message': failure[1]}
        power = entry.get('_power')
        return {'statuses': [status, *([{
            'code': f'PowerState/{power}', 'level': 'Info', 'displayStatus': f'VM {power}'}]
            if power else [])]}

    def _attach(self, path: str, body: Any) -> tuple[int, dict[str, str], Any]:
        """Replace the data disks of a machine, as a PATCH does."""
        vm = self._there(path)
        if trouble := schema.unknown('virtualmachines', body):
            raise Refusal(400, 'InvalidRequestContent', f'Could not find member {trouble}.')
        storage, wanted = vm['properties']['storageProfile'], body['properties'][
            'storageProfile']['dataDisks']
        if len({one['lun'] for one in wanted}) < len(wanted):
            raise Refusal(400, 'InvalidParameter', 'lun')
        disks = [self._there(one['managedDisk']['id']) for one in wanted]
        for disk in disks:
            if disk.get('managedBy', path).lower() != path.lower():
                raise Refusal(409, 'AttachDiskWhileBeingDetached', 'another machine has the disk')
            if disk['location'] != vm['location']:
                raise Refusal(400, 'BadRequest', 'the disk is in another region')
        before = {one['managedDisk']['id'].lower() for one in storage.get('dataDisks') or ()}
        self._free(path)
        storage['dataDisks'] = wanted
        for one, disk in zip(wanted, disks):
            disk['managedBy'] = path
            if disk['id'].lower() not in before:
                self.computers.attach(vm['name'], disk['name'], disk['properties']['diskSizeGB'],
                                      f'/dev/disk/azure/scsi1/lun{one["lun"]}')
        for gone in before - {disk['id'].lower() for disk in disks}:
            self.computers.detach(vm['name'], gone.rpartition('/')[2])
        return 200, self.later(path, lambda: None), plain(vm)

    def _free(self, path: str) -> None:
        """Detach the data disks of a machine."""
        for entry in self.resources.values():
            if entry.get('managedBy', '').lower() == path.lower() \
                    and entry['properties'].get('creationData'):
                del entry['managedBy']

    def _put(
        self, method: str, path: str, kind: str, group: Optional[dict[str, Any]], body: Any,
        fault: Optional[Fault],
    ) -> tuple[int, dict[str, str], Any]:
        if kind not in _NAMES or not isinstance(body, Mapping):
            raise Refusal(400, 'InvalidRequestContent')
        if method == 'PATCH':
            return self._attach(path, body)
        if group and group['properties']['provisioningState'] == 'Deleting':
            raise Refusal(409, 'ResourceGroupBeingDeleted')
        _name(kind, path.rpartition('/')[2])
        _tags(body)
        if trouble := schema.unknown(kind, body):
            raise Refusal(400, 'InvalidRequestContent', f'Could not find member {trouble}.')
        needs_place = kind not in ('securityrules', 'roleassignments', 'roledefinitions')
        if needs_place and body.get('location') not in catalogue.REGIONS:
            raise Refusal(400, 'LocationRequired' if 'location' not in body
                          else 'LocationNotAvailableForResourceType')
        old = self.resources.get(path.lower())
        provider = path.split('/providers/')[-1].split('/')
        entry = {'id': path, 'name': provider[-1], 'type': '/'.join(
                     [provider[0], *provider[1::2]]),
                 **{key: value for key, value in body.items() if key != 'properties'},
                 'properties': dict(body.get('properties', {}))}
        # roles are there at once, and have no state
        if not kind.startswith('role'):
            entry['properties']['provisioningState'] = 'Updating'
        getattr(self, f'_new_{kind}', lambda *_: None)(entry, old)
        if old is not None and kind in ('virtualmachines', 'disks'):
            return 200, {}, plain(old)
        self.resources[path.lower()] = entry
        if kind == 'virtualmachines':
            return 201, self._create(path, entry, fault), plain(entry)

        def finish() -> None:
            if fault is not None:
                entry['properties']['provisioningState'] = 'Failed'
                raise Refusal(fault.status, fault.code)
            if 'provisioningState' in entry['properties']:
                entry['properties']['provisioningState'] = 'Succeeded'
            self._made(kind, entry)

        if kind not in _SLOW:
            finish()
            return 200 if old else 201, {}, plain(entry)
        made = 202 if kind == 'snapshots' else 201
        return 200 if old else made, self.later(path, finish), plain(entry)

    def _made(self, kind: str, entry: dict[str, Any]) -> None:
        if kind == 'publicipaddresses':
            entry['properties'].setdefault('ipAddress', self.computers.take_address())
        elif kind in ('networksecuritygroups', 'securityrules'):
            self.computers.protect()
        elif kind == 'versions':
            source = entry['properties']['storageProfile']['osDiskImage']['source']['id']
            disk = self._there(source)['properties']['creationData']['sourceResourceId']
            vm = self._there(self._there(disk)['managedBy'])
            entry['_disk_gb'] = vm['properties']['storageProfile']['osDisk']['diskSizeGB']
            self.computers.copy_disk(vm, entry['id'])

    def _new_networksecuritygroups(self, entry: dict[str, Any], _: Any) -> None:
        rules = entry['properties'].pop('securityRules', [])
        for rule in rules:
            key = f'{entry["id"]}/securityRules/{rule["name"]}'
            self._new_securityrules({**rule, 'id': key}, None)
            self.resources[key.lower()] = {
                'id': key, 'name': rule['name'],
                'type': 'Microsoft.Network/networkSecurityGroups/securityRules',
                'properties': {**rule['properties'], 'provisioningState': 'Succeeded'}}

    def _new_securityrules(self, entry: dict[str, Any], _: Any) -> None:
        rule, group = entry['properties'], entry['id'].lower().rpartition('/securityrules/')[0]
        _name('securityrules', entry['name'])
        if not 100 <= rule['priority'] <= 4096:
            raise Refusal(400, 'SecurityRuleInvalidPriority')
        for key, other in self.resources.items():
            if key.startswith(f'{group}/securityrules/') and key != entry['id'].lower() \
                    and other['properties']['priority'] == rule['priority']:
                raise Refusal(400, 'SecurityRuleConflict')
        sources = rule.get('sourceAddressPrefixes') or [rule.get('sourceAddressPrefix')]
        if len({':' in str(source) for source in sources}) > 1 or None in sources:
            raise Refusal(400, 'SecurityRuleInvalidAddressPrefix')

    def _new_publicipaddresses(self, entry: dict[str, Any], old: Any) -> None:
        if entry.get('sku', {}).get('name') != 'Standard' \
                or entry['properties']['publicIPAllocationMethod'] != 'Static':
            raise Refusal(400, 'StandardSkuPublicIPAddressMustBeStatic')
        if old and 'ipAddress' in old['properties']:
            entry['properties']['ipAddress'] = old['properties']['ipAddress']

    def _new_virtualnetworks(self, entry: dict[str, Any], _: Any) -> None:
        for subnet in entry['properties'].get('subnets', []):
            subnet['id'] = f'{entry["id"]}/subnets/{subnet["name"]}'

    def _new_networkinterfaces(self, entry: dict[str, Any], old: Any) -> None:
        for one in entry['properties']['ipConfigurations']:
            network = one['properties']['subnet']['id'].lower().partition('/subnets/')[0]
            for needed in (network, one['properties']['publicIPAddress']['id'],
                           entry['properties']['networkSecurityGroup']['id']):
                found = self.resources.get(needed.lower())
                if found is None:
                    raise Refusal(400, 'InvalidResourceReference',
                                  f'Resource {needed} referenced by {entry["id"]} was not found.')
                if found['location'] != entry['location']:
                    raise Refusal(400, 'InvalidResourceReference', 'another region')
                if found['properties']['provisioningState'] != 'Succeeded':
                    raise Refusal(429, 'RetryableErrorDueToAnotherOperation')
            one['properties']['privateIPAddress'] = self.computers.take_address(private=True)
        if old and 'virtualMachine' in old['properties']:
            entry['properties']['virtualMachine'] = old['properties']['virtualMachine']

    def _new_virtualmachines(self, entry: dict[str, Any], old: Any) -> None:
        what, region = entry['properties'], entry['location']
        size = what['hardwareProfile']['vmSize']
        if old is not None:
            if old['properties']['hardwareProfile']['vmSize'] != size:
                raise Refusal(409, 'PropertyChangeNotAllowed')
            return
        if size not in catalogue.SIZES:
            raise Refusal(400, 'InvalidParameter', f'The value {size} provided for the VM size '
                          'is not valid.')
        if size in self.restricted:
            raise Refusal(409, 'SkuNotAvailable', f"The requested size '{size}' is currently not "
                          f"available in location '{region}'.")
        self._check_image(what, size)
        system = what['osProfile']
        if system['adminUsername'].lower() in _USERS or len(system['computerName']) > 64:
            raise Refusal(400, 'InvalidParameter', 'osProfile')
        for key in system['linuxConfiguration']['ssh']['publicKeys']:
            if key['path'] != f"/home/{system['adminUsername']}/.ssh/authorized_keys" \
                    or not re.match('ssh-(rsa|ed25519) [A-Za-z0-9+/]+', key['keyData']):
                raise Refusal(400, 'InvalidParameter', 'linuxConfiguration.ssh')
        try:
            if len(base64.b64decode(system['customData'], validate=True)) > 65535:
                raise Refusal(400, 'InvalidParameter', 'customData')
        except binascii.Error:
            raise Refusal(400, 'InvalidParameter', 'customData is no base64') from None
        (nic,) = what['networkProfile']['networkInterfaces']
        interface = self.resources.get(nic['id'].lower())
        if interface is None or interface['location'] != region:
            raise Refusal(400, 'InvalidResourceReference', 'the network interface')
        if 'virtualMachine' in interface['properties']:
            raise Refusal(400, 'NicInUse')

    def _check_image(self, what: dict[str, Any], size: str) -> None:
        has = catalogue.CAPABILITIES.get(size, {})
        if 'ConfidentialComputingType' in has:
            raise Refusal(400, 'BadRequest', f'The VM size {size} is not supported for creation '
                          'of VMs and Virtual Machine Scale Set with no security type.')
        image, (_, _, arch, *_) = what['storageProfile']['imageReference'], catalogue.SIZES[size]
        if 'id' in image:
            definition = self.resources.get(image['id'].lower().partition('/versions/')[0])
            version = self.resources.get(image['id'].lower())
            if definition is None or version is None \
                    or version['properties']['provisioningState'] != 'Succeeded':
                raise Refusal(404, 'GalleryImageNotFound')
            found = definition['properties']['architecture']
            least = version['_disk_gb']
            features = {one['name']: one['value'] for one in
                        definition['properties'].get('features', ())}
            if has.get('DiskControllerTypes') == 'NVMe' \
                    and 'NVMe' not in features.get('DiskControllerTypes', 'SCSI'):
                raise Refusal(400, 'InvalidParameter', f'The VM size {size} cannot boot with OS '
                              'image or disk. Please check that disk controller types match.')
        else:
            name = ':'.join(image[part] for part in ('publisher', 'offer', 'sku'))
            if name not in catalogue.IMAGES or image['version'] != 'latest':
                raise Refusal(404, 'PlatformImageNotFound')
            found, _, least = catalogue.IMAGES[name]
        if found != arch:
            raise Refusal(400, 'BadRequest', f'The size {size} cannot boot this image: {found}.')
        disk = what['storageProfile']['osDisk'].setdefault('diskSizeGB', least)
        if disk < least:
            raise Refusal(409, 'OperationNotAllowed', f'The specified disk size {disk} GB is '
                          'smaller than the size of the corresponding disk in the VM image: '
                          f'{least} GB.')

    def _create(
        self, path: str, entry: dict[str, Any], fault: Optional[Fault],
    ) -> dict[str, str]:
        """Begin to create a machine, whose allocation may fail late."""
        what = entry['properties']
        what['provisioningState'], what['vmId'] = 'Creating', str(uuid.uuid4())
        what['timeCreated'] = datetime.datetime.now(datetime.timezone.utc).isoformat()
        if 'identity' in entry:
            entry['identity'] = {**entry['identity'], 'principalId': str(uuid.uuid4()),
                                 'tenantId': SUBSCRIPTION}
        for nic in what['networkProfile']['networkInterfaces']:
            self._there(nic['id'])['properties']['virtualMachine'] = {'id': path}
        disk = f'{path.partition("/providers/")[0]}/providers/Microsoft.Compute/disks/' \
               f'{entry["name"]}_OsDisk'
        what['storageProfile']['osDisk']['managedDisk'] = {
            **what['storageProfile']['osDisk'].get('managedDisk', {}), 'id': disk}
        self.resources[disk.lower()] = {
            'id': disk, 'name': disk.rpartition('/')[2], 'type': 'Microsoft.Compute/disks',
            'location': entry['location'], 'managedBy': path, 'tags': dict(entry.get('tags', {})),
            'properties': {'provisioningState': 'Succeeded'}}

        def allocate() -> None:
            if path.lower() not in self.resources or what['provisioningState'] == 'Deleting':
                return
            if fault is not None and fault.late:
                what['provisioningState'] = 'Failed'
                entry['_failure'] = (fault.code, 'Allocation failed.')
                raise Refusal(409, fault.code, 'Allocation failed.')
            what['provisioningState'], entry['_power'] = 'Succeeded', 'running'
            self.computers.begin(entry)

        return self.later(path, allocate)

    def _act(
        self, path: str, action: str, fault: Optional[Fault],
    ) -> tuple[int, dict[str, str], Any]:
        entry = self._there(path)
        before, after = {'deallocate': ('deallocating', 'deallocated'),
                         'start': ('starting', 'running')}[action]
        if entry['properties']['provisioningState'] not in ('Succeeded', 'Failed'):
            raise Refusal(409, 'OperationNotAllowed', 'another operation is in progress')
        entry['_power'], entry['properties']['provisioningState'] = before, 'Updating'

        def finish() -> bool:
            if action != 'start' and not self.computers.off(entry):
                return False
            entry['properties']['provisioningState'] = 'Succeeded'
            if fault is not None and fault.late:
                entry['_power'] = 'deallocated'
                raise Refusal(409, fault.code, 'Allocation failed.')
            entry['_power'] = after
            if action == 'start':
                self.computers.begin_again(entry)
            return True

        return 202, self.later(path, finish), None

    def _remove(self, path: str) -> tuple[int, dict[str, str], Any]:
        entry = self.resources.get(path.lower())
        if entry is None:
            return 204, {}, None
        users = [other['id'] for other in self.resources.values()
                 if _refers(other, path) and other['id'] != entry['id']]
        if users and kind_of(path) not in ('virtualmachines', 'snapshots'):
            raise Refusal(400, 'InUse', f'{path} is used by {users[0]}')
        entry['properties']['provisioningState'] = 'Deleting'

        def finish() -> bool:
            machine = kind_of(path) == 'virtualmachines'
            if machine and not self.computers.off(entry, forever=True):
                return False
            self._vanish(entry)
            if machine:
                what = entry['properties']
                for nic in what['networkProfile']['networkInterfaces']:
                    self.resources.pop(nic['id'].lower(), None)
                self.resources.pop(what['storageProfile']['osDisk']['managedDisk']['id'].lower(),
                                   None)
            elif kind_of(path) == 'securityrules':
                self.computers.protect()
            return True

        return 202, self.later(path, finish), None

    def _merge(self, path: str, body: Any) -> tuple[int, dict[str, str], Any]:
        scope = re.sub('/providers/Microsoft[.]Resources/tags/default$', '', path, flags=re.I)
        entry = self._there(scope)
        if body['operation'] != 'Merge':
            raise Refusal(400, 'InvalidRequestContent')
        merged = {**entry.get('tags', {}), **body['properties']['tags']}
        _tags({'tags': merged})
        entry['tags'] = merged
        return 200, {}, {'properties': {'tags': merged}}

    # -- what happens by itself -----------------------------------------------------------------

    def turned_off(self, path: str) -> None:
        """Note that a machine has powered itself off: it is billed on."""
        with self.lock:
            if (entry := self.resources.get(path.lower())) is not None:
                if entry.get('_power') == 'running':
                    entry['_power'] = 'stopped'

    def evict(self, path: str) -> None:
        """Take a spot machine away; its group and its address stay."""
        with self.lock:
            if path.lower() in self.resources:
                self._remove(path)

    def vms(self) -> list[dict[str, Any]]:
        """Return the machines that exist."""
        with self.lock:
            self.tick()
            return [entry for key, entry in self.resources.items()
                    if kind_of(key) == 'virtualmachines']


def environment(url: str) -> dict[str, str]:
    """Return the variables by which azure-identity and the provider take a service for Azure."""
    return {'AZURE_SUBSCRIPTION_ID': SUBSCRIPTION, 'FOGROS2_AZURE_ENDPOINT': url,
            'FOGROS2_AZURE_PRICES': f'{url}/prices', 'AZURE_DEFAULTS_LOCATION': 'westeurope',
            'IDENTITY_ENDPOINT': f'{url}/token', 'IDENTITY_HEADER': HEADER,
            'AZURE_TOKEN_CREDENTIALS': 'ManagedIdentityCredential',
            'AZURE_CONFIG_DIR': '/nonexistent'}


def kind_of(path: str) -> str:
    """Return the kind of resource that a path is about, in lower case."""
    words = path.lower().split('/')[1:]
    if 'providers' not in words:
        return words[2] if len(words) > 2 else 'subscriptions'
    last = words[len(words) - words[::-1].index('providers'):][1:]
    if not last:
        return ''
    kinds = last[::2]
    return kinds[-1] if kinds[-1] not in ('deallocate', 'start') else kinds[-2]


def _matches(action: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch.fnmatchcase(action.lower(), one.lower()) for one in patterns)


def plain(entry: dict[str, Any]) -> dict[str, Any]:
    """Return an entry without what only the service knows, and without secrets."""
    found = {key: value for key, value in entry.items() if not key.startswith('_')}
    if 'osProfile' in found['properties']:
        system = found['properties']['osProfile']
        found['properties'] = {**found['properties'], 'osProfile': {
            key: value for key, value in system.items() if key != 'customData'}}
    return found


def action_of(method: str, path: str, kind: str) -> str:
    """Return the action that a request needs."""
    verb = {'GET': 'read', 'DELETE': 'delete', 'POST': 'action'}.get(method, 'write')
    parts = re.split('/providers/', path, flags=re.IGNORECASE)
    if len(parts) == 1:
        below = path.split('/')[3:4]
        if below and below[0].lower() == 'resourcegroups':
            below = ['resourceGroups']
        return '/'.join(('Microsoft.Resources/subscriptions', *below, verb))
    words = parts[-1].split('/')
    if kind == 'tags':
        return f'Microsoft.Resources/tags/{verb}'
    if method == 'POST':
        return '/'.join((words[0], *words[1:-1:2], words[-1], verb))
    return '/'.join((words[0], *words[1::2], verb))


def _refers(entry: Any, path: str) -> bool:
    if isinstance(entry, Mapping):
        return any(_refers(value, path) for key, value in entry.items() if key != 'virtualMachine')
    if isinstance(entry, list):
        return any(_refers(value, path) for value in entry)
    return isinstance(entry, str) and entry.lower().startswith(path.lower())


def _name(kind: str, name: str) -> None:
    if not re.fullmatch(_NAMES[kind], name):
        raise Refusal(400, 'InvalidResourceName', f"'{name}' is no name of {kind}.")


def _tags(body: Mapping[str, Any]) -> None:
    tags = body.get('tags') or {}
    if len(tags) > 50 or len({key.lower() for key in tags}) < len(tags):
        raise Refusal(400, 'InvalidTags')
    for key, value in tags.items():
        if not 0 < len(key) <= 512 or not isinstance(value, str) or len(value) > 256 \
                or re.search(r'[<>%&\\?/]', key) or re.match('(?i)microsoft|azure|windows', key):
            raise Refusal(400, 'InvalidTagNameCharacters', f'{key}: {value}')
