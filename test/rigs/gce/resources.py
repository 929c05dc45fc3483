# SPDX-License-Identifier: Apache-2.0
"""
The resources of a project: instances, firewall rules, images, operations that take time.

It refuses what Google refuses. Sources: the discovery document's descriptions of fields, and the
pages on VPC firewall rules, labels, Spot VMs and "Limit the run time of a VM".
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
import copy
import dataclasses
import datetime
import hashlib
import ipaddress
import itertools
import json
import re
import threading
import time
from typing import Any, Optional
import uuid

from fogros2.errors import FogError
from rigs.gce import catalogue, filters
from rigs.gce.cloud import Cloud
from rigs.gce.errors import Refusal

BASE = 'https://www.googleapis.com/compute/v1/projects/'
SERVICE_ACCOUNT = 'robot@robots.iam.gserviceaccount.com'
Words = Mapping[str, str]


@dataclasses.dataclass
class Operation:
    """
    A change under way.

    :param over: returns whether it has ended; ``last`` is called once when it has.
    """

    name: str
    scope: str
    kind: str
    target: str
    begun: float
    over: Callable[[], bool]
    error: Optional[dict[str, Any]] = None
    last: Callable[[], None] = lambda: None
    done: bool = False


class Project:
    """
    One project, with the network 'default' and its rules.

    :param delay: seconds that an operation takes at least.
    :param linger: seconds for which lists show what was deleted.
    """

    def __init__(
        self, cloud: Cloud, *, name: str = 'robots', delay: float = 0.1, linger: float = 0.3,
    ) -> None:
        self.cloud = cloud
        self.name = name
        self.delay = delay
        self.linger = linger
        self.page = 500
        self.lock = threading.RLock()
        self._numbers = itertools.count(1000)
        self.instances: dict[str, dict[str, Any]] = {}
        self.firewalls: dict[str, dict[str, Any]] = {}
        self.images: dict[tuple[str, str], dict[str, Any]] = {}
        #: Disks that outlive instances, by their links.
        self.kept: dict[str, dict[str, Any]] = {}
        self.operations: dict[str, Operation] = {}
        self._asked: dict[str, tuple[str, str]] = {}
        self._deleted: dict[str, tuple[float, dict[str, Any]]] = {}
        cloud.firewalls = lambda: list(self.firewalls.values())
        for name, source, protocol, ports in catalogue.DEFAULT_RULES:
            self._add_firewall({
                'name': f'default-allow-{name}', 'priority': 65534, 'sourceRanges': [source],
                'allowed': [{'IPProtocol': protocol, **({'ports': ports} if ports else {})}]})
        self.publish()

    def publish(self) -> None:
        """Add the public images."""
        for owner, name, family, arch, size in catalogue.IMAGES:
            self.images[owner, name] = {
                **self._new('image', name, f'{owner}/global/images/{name}'), 'family': family,
                'architecture': arch, 'diskSizeGb': str(size), 'status': 'READY'}

    def _new(self, kind: str, name: str, path: str) -> dict[str, Any]:
        return {'kind': f'compute#{kind}', 'id': str(next(self._numbers)), 'name': name,
                'selfLink': BASE + path,
                'creationTimestamp': datetime.datetime.now(
                    datetime.timezone.utc).isoformat(timespec='milliseconds')}

    def _url(self, path: str) -> str:
        """Return the whole address of a path, which may begin with the project."""
        if path.startswith('https://'):
            return path
        return BASE + (path.removeprefix('projects/') if path.startswith('projects/')
                       else f'{self.name}/{path}')

    def clear(self) -> None:
        """Delete everything but what Google ships."""
        self._prune()
        self.kept.clear()
        for instance in self.instances.values():
            self.cloud.end(instance['id'], 'terminate')
        for name in [name for name in self.firewalls if not name.startswith('default-')]:
            del self.firewalls[name]
        for owner, name in [key for key in self.images if key[0] == self.name]:
            del self.images[owner, name]

    # -- operations -----------------------------------------------------------------------

    def start(
        self, kind: str, resource: Mapping[str, Any], *, over: Callable[[], bool] = lambda: True,
        error: Optional[dict[str, Any]] = None, last: Callable[[], None] = lambda: None,
    ) -> dict[str, Any]:
        """Begin an operation on a resource, and return it as the API reports it."""
        path = str(resource['selfLink']).removeprefix(BASE)
        scope = '/'.join(path.split('/')[1:3]) if '/zones/' in path else 'global'
        operation = Operation(f'operation-{uuid.uuid4()}', scope, kind, path, time.monotonic(),
                              over, error, last)
        self.operations[operation.name] = operation
        return self.shown(operation)

    def shown(self, operation: Operation) -> dict[str, Any]:
        """Return an operation as the API reports it."""
        if not operation.done and operation.over() \
                and time.monotonic() - operation.begun >= self.delay:
            operation.done = True
            operation.last()
        where = f'{self.name}/{operation.scope}'
        return {
            'kind': 'compute#operation', 'id': str(int(operation.name[-12:], 16)),
            'name': operation.name, 'operationType': operation.kind,
            'targetLink': BASE + operation.target, 'user': 'robot@example.com',
            'status': 'DONE' if operation.done else 'RUNNING',
            'progress': 100 if operation.done else 0,
            'selfLink': f'{BASE}{where}/operations/{operation.name}',
            'insertTime': datetime.datetime.now(datetime.timezone.utc).isoformat(),
            **({'zone': f'{BASE}{where}'} if operation.scope != 'global' else {}),
            **({'error': operation.error, 'httpErrorStatusCode': 400,
                'httpErrorMessage': 'BAD REQUEST'}
               if operation.done and operation.error else {})}

    def _operation(self, words: Words, wait: float) -> dict[str, Any]:
        operation = self.operations.get(words['operation'])
        if operation is None:
            raise Refusal('notFound', f"The resource '{words['operation']}' was not found")
        end = time.monotonic() + wait
        while True:
            with self.lock:
                found = self.shown(operation)
            if found['status'] == 'DONE' or time.monotonic() > end:
                return found
            time.sleep(0.01)

    def once(self, query: Mapping[str, str], method: str, words: Words, body: Any,
             ) -> Optional[dict[str, Any]]:
        """
        Return the operation of an earlier request with the same id, None for a new id.

        :raises Refusal: the id is no UUID, or was another request's.
        """
        number = query.get('requestId')
        if number is None:
            return None
        try:
            if uuid.UUID(number).int == 0:
                raise ValueError(number)
        except ValueError as error:
            raise Refusal('invalid', f"Invalid value for field 'requestId': '{number}'") from error
        digest = hashlib.sha256(json.dumps([method, dict(words), body], sort_keys=True).encode())
        if number in self._asked:
            before, name = self._asked[number]
            if before != digest.hexdigest():
                raise Refusal('invalid', 'The request id was used for another request')
            return self.shown(self.operations[name])
        self._asked[number] = digest.hexdigest(), ''
        return None

    def remember(self, query: Mapping[str, str], name: str) -> None:
        """Keep the operation of a request with an id; '' for a refused request."""
        number = query.get('requestId', '')
        if not name:
            self._asked.pop(number, None)
        elif number in self._asked:
            self._asked[number] = self._asked[number][0], name

    def zone_operations_wait(self, words: Words, query: Words, body: Any) -> Any:
        """Wait for an operation."""
        return self._operation(words, 20.0)

    global_operations_wait = zone_operations_wait

    # -- lists ----------------------------------------------------------------------------

    def listed(self, kind: str, entries: list[dict[str, Any]], query: Words,
               path: str) -> dict[str, Any]:
        """Return a page of a list."""
        test, begin = filters.parse(query.get('filter', '')), int(query.get('pageToken') or 0)
        size = min(int(query.get('maxResults') or 500), self.page)
        fitting = [entry for entry in entries if test(entry)]
        return {'kind': f'compute#{kind}List', 'id': path, 'selfLink': BASE + path,
                **({'items': fitting[begin:begin + size]} if fitting else {}),
                **({'nextPageToken': str(begin + size)} if begin + size < len(fitting) else {})}

    def aggregated(self, kind: str, entries: list[dict[str, Any]], query: Words) -> Any:
        """Return a page of a list over all zones, each with a warning if it has nothing."""
        path = f'{self.name}/aggregated/{kind}s'
        page = self.listed(f'{kind}Aggregated', entries, query, path)
        scopes: dict[str, Any] = {f'zones/{zone}': {} for zone in catalogue.zones()}
        for entry in page.pop('items', ()):
            scopes[f'zones/{entry["zone"].rpartition("/")[2]}'].setdefault(
                f'{kind}s', []).append(entry)
        for name, scope in scopes.items():
            if not scope:
                scope['warning'] = {'code': 'NO_RESULTS_ON_PAGE',
                                    'message': f"There are no results for scope '{name}'."}
        return {**page, 'items': scopes}

    # -- what Google offers ---------------------------------------------------------------

    def projects_get(self, words: Words, query: Words, body: Any) -> Any:
        """Return the project."""
        return {**self._new('project', self.name, self.name), 'quotas': []}

    def machine_types_aggregated_list(self, words: Words, query: Words, body: Any) -> Any:
        """Return the machine types of all zones."""
        return self.aggregated('machineType', [
            self._type(zone, entry) for zone in catalogue.zones()
            for entry in catalogue.machine_types(zone).values()], query)

    def _type(self, zone: str, entry: Mapping[str, Any]) -> dict[str, Any]:
        path = f'{self.name}/zones/{zone}/machineTypes/{entry["name"]}'
        return {**entry, 'selfLink': BASE + path}

    def networks_get(self, words: Words, query: Words, body: Any) -> Any:
        """Return the network."""
        if words['network'] not in ('default', 'robots'):
            raise Refusal('notFound', f"The resource 'projects/{self.name}/global/networks/"
                          f"{words['network']}' was not found")
        name = words['network']
        return {**self._new('network', name, f'{self.name}/global/networks/{name}'),
                'autoCreateSubnetworks': name == 'default',
                'subnetworks': [f'{BASE}{self.name}/regions/{region}/subnetworks/{name}'
                                for region in catalogue.ZONES]}

    # -- firewall rules -------------------------------------------------------------------

    def _add_firewall(self, body: Mapping[str, Any]) -> dict[str, Any]:
        name = body['name']
        rule = {'direction': 'INGRESS', 'priority': 1000, 'disabled': False, **body,
                **self._new('firewall', name, f'{self.name}/global/firewalls/{name}'),
                'network': self._url(body.get('network', 'global/networks/default'))}
        self.firewalls[name] = rule
        return rule

    def firewalls_insert(self, words: Words, query: Words, body: Any) -> Any:
        """Create a rule."""
        _check_firewall(body)
        if body['name'] in self.firewalls:
            raise Refusal('alreadyExists', f"The resource '{body['name']}' already exists")
        self.networks_get({'network': _last(body.get('network', 'default'))}, {}, None)
        return self.start('insert', self._add_firewall(body), last=self.cloud.protect)

    def _firewall(self, name: str) -> dict[str, Any]:
        if name not in self.firewalls:
            raise Refusal('notFound', f"The resource 'projects/{self.name}/global/firewalls/"
                          f"{name}' was not found")
        return self.firewalls[name]

    def firewalls_get(self, words: Words, query: Words, body: Any) -> Any:
        """Return a rule."""
        return self._firewall(words['firewall'])

    def firewalls_list(self, words: Words, query: Words, body: Any) -> Any:
        """Return the rules, and those that were deleted a moment ago."""
        return self.listed('firewall', [*self.firewalls.values(), *self._lingering('firewall')],
                           query, f'{self.name}/global/firewalls')

    def firewalls_patch(self, words: Words, query: Words, body: Any) -> Any:
        """Change a rule."""
        rule = self._firewall(words['firewall'])
        changed = {**rule, **body}
        _check_firewall(changed)
        rule.update(body)
        return self.start('patch', rule, last=self.cloud.protect)

    def firewalls_delete(self, words: Words, query: Words, body: Any) -> Any:
        """Delete a rule."""
        rule = self._firewall(words['firewall'])
        del self.firewalls[rule['name']]
        self._deleted[rule['selfLink']] = time.monotonic(), rule
        return self.start('delete', rule, last=self.cloud.protect)

    def _lingering(self, kind: str) -> list[dict[str, Any]]:
        return [entry for when, entry in self._deleted.values()
                if entry['kind'] == f'compute#{kind}' and time.monotonic() - when < self.linger]

    # -- instances ------------------------------------------------------------------------

    def _prune(self) -> None:
        for link, instance in list(self.instances.items()):
            machine = self.cloud.machines.get(instance['id'])
            if machine is not None and machine.state == 'terminated':
                del self.instances[link]
                self._deleted[link] = time.monotonic(), {**instance, 'status': 'STOPPING'}

    def _instance(self, words: Words) -> dict[str, Any]:
        self._prune()
        path = f'{self.name}/zones/{words["zone"]}/instances/{words["instance"]}'
        if BASE + path not in self.instances:
            raise Refusal('notFound', f"The resource 'projects/{path}' was not found")
        return self.instances[BASE + path]

    def instances_insert(
        self, words: Words, query: Words, body: Any, error: Optional[dict[str, Any]] = None,
    ) -> Any:
        """Start a new instance, or let its operation fail late."""
        self._prune()
        zone = words['zone']
        self._known_zone(zone)
        link = f'{BASE}{self.name}/zones/{zone}/instances/{body["name"]}'
        if link in self.instances:
            raise Refusal('alreadyExists', f"The resource '{body['name']}' already exists")
        self._check_instance(zone, body)
        image = self._check_disk(zone, body)
        instance = self.instances[link] = self._made(zone, body, image)
        if error:
            def drop() -> None:
                del self.instances[link]

            return self.start('insert', instance, error=error, last=drop)
        scheduling = instance['scheduling']
        self.cloud.launch(instance['id'], instance, disk_of=image['id'],
                          spot=scheduling.get('provisioningModel') == 'SPOT')
        self._limit(instance)
        return self.start('insert', instance, over=lambda: self._state(instance) != 'pending')

    def _limit(self, instance: Mapping[str, Any]) -> None:
        """Let Google end an instance when its run time is over."""
        limit = instance['scheduling'].get('maxRunDuration')
        if limit:
            timer = threading.Timer(float(limit['seconds']), self._over, (instance,))
            timer.daemon = True
            timer.start()

    def _over(self, instance: Mapping[str, Any]) -> None:
        self.cloud.end(instance['id'], 'terminate' if instance['scheduling'].get(
            'instanceTerminationAction') == 'DELETE' else 'stop')

    def _state(self, instance: Mapping[str, Any]) -> str:
        return self.cloud.machines[instance['id']].state

    def _known_zone(self, zone: str) -> None:
        if zone not in catalogue.zones():
            raise Refusal('notFound', f"The resource 'projects/{self.name}/zones/{zone}' was not "
                          'found')

    def _made(self, zone: str, body: Mapping[str, Any], image: Mapping[str, Any]) -> Any:
        name, nic = body['name'], body['networkInterfaces'][0]
        disk = body['disks'][0].get('initializeParams', {})
        return {
            **copy.deepcopy({key: value for key, value in body.items() if key != 'disks'}),
            **self._new('instance', name, f'{self.name}/zones/{zone}/instances/{name}'),
            'status': 'PROVISIONING', 'zone': f'{BASE}{self.name}/zones/{zone}',
            'machineType': self._url(body['machineType']), 'labels': dict(body.get('labels', {})),
            'labelFingerprint': _print(body.get('labels', {})),
            **{name: {'fingerprint': _print({}), **body.get(name, {})}
               for name in ('tags', 'metadata')},
            'scheduling': {'automaticRestart': True, 'onHostMaintenance': 'MIGRATE',
                           **body.get('scheduling', {})},
            'networkInterfaces': [{
                **copy.deepcopy(nic), 'name': 'nic0', 'networkIP':
                    self.cloud.addresses.take(private=True),
                'network': self._url(nic.get('network', 'global/networks/default'))}],
            'disks': [{
                'kind': 'compute#attachedDisk', 'boot': True, 'type': 'PERSISTENT',
                'autoDelete': body['disks'][0].get('autoDelete', False), 'deviceName': name,
                'diskSizeGb': str(disk.get('diskSizeGb') or image['diskSizeGb']),
                'source': f'{BASE}{self.name}/zones/{zone}/disks/{disk.get("diskName") or name}'}]}

    def _check_instance(self, zone: str, body: Mapping[str, Any]) -> None:
        """Look at everything of a request but the disk."""
        kind = catalogue.machine_types(zone).get(_last(body['machineType']))
        if kind is None or f'zones/{zone}/' not in body['machineType']:
            raise Refusal('invalid', f"Machine type with name '{body['machineType']}' does not "
                          f"exist in zone '{zone}'.")
        _check_labels(body.get('labels', {}))
        if len(json.dumps(body.get('metadata', {}))) > 512 * 1024:
            raise Refusal('invalid', 'The metadata is too large.')
        name = _last(body['networkInterfaces'][0].get('network', 'default'))
        subnet = self.networks_get({'network': name}, {}, None)
        if not subnet['autoCreateSubnetworks'] and not body['networkInterfaces'][0].get(
                'subnetwork', '').endswith(f'/regions/{zone[:-2]}/subnetworks/{name}'):
            raise Refusal('invalid', 'a subnetwork is required for a network in custom mode')
        _check_scheduling(body.get('scheduling', {}), bool(
            body.get('guestAccelerators') or kind.get('accelerators')))
        for gpu in body.get('guestAccelerators', ()):
            if zone in catalogue.ACCELERATORS.get(_last(gpu['acceleratorType']), (zone,)):
                raise Refusal('notFound', f"The resource 'projects/{self.name}/"
                              f"{gpu['acceleratorType']}' was not found")
            if not body['machineType'].rpartition('/')[2].startswith('n1-'):
                raise Refusal('invalid', 'Only N1 machine types take accelerators.')
        for account in body.get('serviceAccounts', ()):
            if account['email'] not in (SERVICE_ACCOUNT, 'default'):
                raise Refusal('invalid', f"The service account '{account['email']}' was not found")

    def _check_disk(self, zone: str, body: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the image of a request's boot disk."""
        disk = body['disks'][0].get('initializeParams', {})
        image = self._image(disk.get('sourceImage', ''))
        if int(disk.get('diskSizeGb') or image['diskSizeGb']) < int(image['diskSizeGb']):
            raise Refusal('invalid', 'Requested disk size cannot be smaller than the image size')
        kind = catalogue.machine_types(zone)[_last(body['machineType'])]
        if image['architecture'] != kind['architecture']:
            raise Refusal('invalid', 'The image is of another architecture.')
        drive = _last(disk.get('diskType', 'pd-standard'))
        if drive not in catalogue.DISK_TYPES:
            raise Refusal('notFound', f"The resource '{drive}' was not found")
        if _last(body['machineType']).startswith('c4-') and not drive.startswith('hyperdisk'):
            raise Refusal('invalid', f'[{drive}] features are not compatible for creating '
                          'instance.')
        _check_labels(disk.get('labels', {}))
        return image

    def instances_get(self, words: Words, query: Words, body: Any) -> Any:
        """Return an instance."""
        return self._instance(words)

    def _all_instances(self) -> list[dict[str, Any]]:
        self._prune()
        return [*self.instances.values(), *self._lingering('instance')]

    def instances_aggregated_list(self, words: Words, query: Words, body: Any) -> Any:
        """Return the instances of all zones, and those that were deleted a moment ago."""
        return self.aggregated('instance', self._all_instances(), query)

    def instances_delete(self, words: Words, query: Words, body: Any) -> Any:
        """Delete an instance."""
        instance = self._instance(words)
        if instance['id'] in self.cloud.machines:
            self.cloud.end(instance['id'], 'terminate')
        return self.start('delete', instance, over=lambda: self._state(instance) == 'terminated',
                          last=self._prune)

    def instances_stop(self, words: Words, query: Words, body: Any) -> Any:
        """Stop an instance."""
        instance = self._instance(words)
        self.cloud.end(instance['id'], 'stop')

        def last() -> None:
            instance['lastStopTimestamp'] = datetime.datetime.now(
                datetime.timezone.utc).isoformat(timespec='milliseconds')

        return self.start('stop', instance, last=last,
                          over=lambda: self._state(instance) in ('stopped', 'terminated'))

    def instances_start(self, words: Words, query: Words, body: Any) -> Any:
        """Start a stopped instance."""
        instance = self._instance(words)
        if self._state(instance) == 'stopped':
            self.cloud.start(instance['id'])
            self._limit(instance)
        return self.start('start', instance, over=lambda: self._state(instance) != 'pending')

    def instances_set_scheduling(self, words: Words, query: Words, body: Any) -> Any:
        """Replace the scheduling of a stopped instance."""
        instance = self._instance(words)
        if self._state(instance) != 'stopped':
            raise Refusal('resourceInUseByAnotherResource', 'The instance must be terminated.')
        _check_scheduling(body, False)
        instance['scheduling'] = body
        return self.start('setScheduling', instance)

    def instances_set_labels(self, words: Words, query: Words, body: Any) -> Any:
        """Replace all labels."""
        instance = self._instance(words)
        if body.get('labelFingerprint') != instance['labelFingerprint']:
            raise Refusal('conditionNotMet', 'Labels fingerprint either invalid or resource '
                          'labels have changed')
        _check_labels(body['labels'])

        def last() -> None:
            instance['labels'] = dict(body['labels'])
            instance['labelFingerprint'] = _print(body['labels'])

        return self.start('setLabels', instance, last=last)

    def disks_aggregated_list(self, words: Words, query: Words, body: Any) -> Any:
        """Return the disks of all zones."""
        return self.aggregated('disk', self.disks(), query)

    def disks(self) -> list[dict[str, Any]]:
        """Return the disks of all instances, and those that outlive them."""
        self._prune()
        users: dict[str, list[str]] = {}
        for instance in self.instances.values():
            for disk in instance['disks']:
                users.setdefault(disk['source'], []).append(instance['selfLink'])
        return [*({'kind': 'compute#disk', 'id': f'{i["id"]}1', 'name': _last(d['source']),
                   'sizeGb': d['diskSizeGb'], 'zone': i['zone'], 'selfLink': d['source'],
                   'status': 'READY', 'users': [i['selfLink']],
                   'type': f'{i["zone"]}/diskTypes/pd-standard',
                   'creationTimestamp': i['creationTimestamp']}
                  for i in self.instances.values() for d in i['disks'] if d['boot']),
                *({**disk, 'users': users.get(link, [])} for link, disk in self.kept.items())]

    def disks_insert(self, words: Words, query: Words, body: Any) -> Any:
        """Create a disk without an instance."""
        zone = words['zone']
        self._known_zone(zone)
        path = f'{self.name}/zones/{zone}/disks/{body["name"]}'
        if BASE + path in self.kept:
            raise Refusal('alreadyExists', f"The resource '{body['name']}' already exists")
        if _last(body['type']) not in catalogue.DISK_TYPES:
            raise Refusal('notFound', f"The resource '{body['type']}' was not found")
        _check_labels(body.get('labels', {}))
        disk = self.kept[BASE + path] = {
            **body, **self._new('disk', body['name'], path), 'status': 'READY',
            'zone': f'{BASE}{self.name}/zones/{zone}'}
        return self.start('insert', disk)

    def disks_delete(self, words: Words, query: Words, body: Any) -> Any:
        """Delete a disk that no instance has."""
        link = f'{BASE}{self.name}/zones/{words["zone"]}/disks/{words["disk"]}'
        if link not in self.kept:
            raise Refusal('notFound', f"The resource '{words['disk']}' was not found")
        if any(disk['selfLink'] == link and disk['users'] for disk in self.disks()):
            raise Refusal('resourceInUseByAnotherResource', 'The disk is in use')
        return self.start('delete', self.kept.pop(link))

    def instances_attach_disk(self, words: Words, query: Words, body: Any) -> Any:
        """Attach a disk of the instance's zone that no other instance has."""
        instance, link = self._instance(words), self._url(body['source'])
        if link not in self.kept or self.kept[link]['zone'] != instance['zone']:
            raise Refusal('notFound', f"The resource '{body['source']}' was not found")
        if any(disk['selfLink'] == link and disk['users'] for disk in self.disks()):
            raise Refusal('resourceInUseByAnotherResource', 'The disk is in use')
        instance['disks'].append({
            'kind': 'compute#attachedDisk', 'boot': False, 'type': 'PERSISTENT', **body,
            'source': link, 'diskSizeGb': self.kept[link]['sizeGb']})
        self.cloud.attach(instance['id'], self.kept[link]['id'], int(self.kept[link]['sizeGb']),
                          f'/dev/disk/by-id/google-{body["deviceName"]}')
        return self.start('attachDisk', instance)

    def instances_detach_disk(self, words: Words, query: Words, body: Any) -> Any:
        """Detach a disk by its device's name."""
        instance = self._instance(words)
        for disk in instance['disks']:
            if disk.get('deviceName') == query['deviceName']:
                self.cloud.detach(instance['id'], self.kept[disk['source']]['id'])
        instance['disks'] = [disk for disk in instance['disks']
                             if disk.get('deviceName') != query['deviceName']]
        return self.start('detachDisk', instance)

    # -- images ---------------------------------------------------------------------------

    def _image(self, path: str) -> dict[str, Any]:
        found = re.search(r'(?:projects/([^/]+)/)?'
                          r'global/images/(family/)?([^/]+)$', path)
        if found:
            owner, family, name = found[1] or self.name, found[2], found[3]
            for (project, known), image in reversed(self.images.items()):
                if project == owner and (image.get('family') if family else known) == name:
                    return image
        raise Refusal('notFound', f"The resource '{path}' was not found")

    def images_get(self, words: Words, query: Words, body: Any) -> Any:
        """Return an image."""
        return self._image(f'projects/{words["project"]}/global/images/{words["image"]}')

    def images_get_from_family(self, words: Words, query: Words, body: Any) -> Any:
        """Return the newest image of a family."""
        return self._image(f'projects/{words["project"]}/global/images/family/{words["family"]}')

    def images_list(self, words: Words, query: Words, body: Any) -> Any:
        """Return the images of a project."""
        return self.listed('image', [image for (project, _), image in self.images.items()
                                     if project == words['project']], query,
                           f'{words["project"]}/global/images')

    def images_insert(self, words: Words, query: Words, body: Any) -> Any:
        """Make an image of an instance's disk."""
        _check_labels(body.get('labels', {}))
        if (self.name, body['name']) in self.images:
            raise Refusal('alreadyExists', f"The resource '{body['name']}' already exists")
        disk = next((disk for disk in self.disks()
                     if disk['selfLink'].endswith(body['sourceDisk'].partition('projects/')[2])),
                    None)
        if disk is None:
            raise Refusal('notFound', f"The resource '{body['sourceDisk']}' was not found")
        instance = self.instances[disk['users'][0]]
        if self._state(instance) == 'running' and query.get('forceCreate') != 'true':
            raise Refusal('resourceInUseByAnotherResource', 'The disk is in use')
        name, source = body['name'], self._image(
            instance['labels'].get('source', '') or 'projects/ubuntu-os-cloud/global/images/'
            'family/ubuntu-2404-lts-amd64')
        image = {**body, **self._new('image', name, f'{self.name}/global/images/{name}'),
                 'status': 'PENDING', 'architecture': source['architecture'],
                 'diskSizeGb': disk['sizeGb']}
        self.images[self.name, name] = image

        def work() -> None:
            try:
                self.cloud.copy(instance['id'], image['id'])
                image['status'] = 'READY'
            except (FogError, OSError):
                image['status'] = 'FAILED'

        threading.Thread(target=work, daemon=True).start()
        return self.start('insert', image, over=lambda: image['status'] != 'PENDING')

    def images_delete(self, words: Words, query: Words, body: Any) -> Any:
        """Delete an image."""
        image = self.images_get(words, query, body)
        del self.images[words['project'], image['name']]
        self.cloud.forget_image(image['id'])
        return self.start('delete', image)


def _check_firewall(body: Mapping[str, Any]) -> None:
    ranges = [ipaddress.ip_network(source) for source in body.get('sourceRanges', ())]
    if len({network.version for network in ranges}) > 1:
        raise Refusal('invalid', 'Source ranges must be of one IP version.')
    if bool(body.get('allowed')) == bool(body.get('denied')):
        raise Refusal('invalid', 'Exactly one of allowed and denied must be specified.')
    if not 0 <= body.get('priority', 1000) <= 65535:
        raise Refusal('invalid', "Invalid value for field 'priority'")
    if len(body.get('description', '')) > 2048:
        raise Refusal('invalid', "Invalid value for field 'description'")
    if not ranges and not body.get('sourceTags'):
        raise Refusal('invalid', 'a rule without sources is for everybody: name them here')


def _check_scheduling(words: Mapping[str, Any], gpus: bool) -> None:
    spot = words.get('provisioningModel') == 'SPOT' or words.get('preemptible')
    if (spot or gpus) and words.get('onHostMaintenance') != 'TERMINATE':
        raise Refusal('invalid', 'Instances with guest accelerators, and Spot VMs, do not '
                      'support live migration.')
    if spot and words.get('automaticRestart', True):
        raise Refusal('invalid', 'Scheduling must have automaticRestart false for Spot VMs.')
    if 'instanceTerminationAction' in words and not spot and 'maxRunDuration' not in words:
        raise Refusal('invalid', 'Instance termination action needs a Spot VM or a limit.')
    if 'maxRunDuration' in words and not (
            30 <= int(words['maxRunDuration']['seconds']) <= 120 * 86400
            and 'instanceTerminationAction' in words):
        raise Refusal('invalid', "Invalid value for field 'scheduling.maxRunDuration'")


def _check_labels(labels: Mapping[str, str]) -> None:
    if len(labels) > 64:
        raise Refusal('invalid', 'Too many labels.')
    for key, value in labels.items():
        if not re.fullmatch('[a-z][a-z0-9_-]{0,62}', key) \
                or not re.fullmatch('[a-z0-9_-]{0,63}', value):
            raise Refusal('invalid', f"Invalid value for field 'labels': '{key}: {value}'")


def _print(labels: Mapping[str, str]) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(
        json.dumps(dict(labels), sort_keys=True).encode()).digest()[:8]).decode()


def _last(path: str) -> str:
    return path.rpartition('/')[2]
