# SPDX-License-Identifier: Apache-2.0
"""The computers of Compute Engine in a box: what instances boot with, and who reaches them."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from email.message import Message
import json
import threading
from typing import Any

from rigs.computers import cloud, cloud_config, network
from rigs.computers.cloud import Machine
from rigs.computers.computer import USER
from rigs.computers.metadata import MetadataService

#: Token of the service account of an instance.
GUEST_TOKEN = 'ya29.guest'
_STATES = {'pending': 'STAGING', 'running': 'RUNNING', 'stopping': 'STOPPING',
           'shutting-down': 'STOPPING', 'stopped': 'TERMINATED', 'terminated': 'TERMINATED'}


class Cloud(cloud.Cloud):
    """
    The computers, whose instances are dictionaries as the API reports them.

    ``firewalls`` returns the firewall rules of the project.
    """

    firewalls: Callable[[], Sequence[Mapping[str, Any]]] = staticmethod(lambda: ())

    def user_data(self, machine: Machine) -> bytes:
        """Return the metadata of that name."""
        items = {item['key']: item['value']
                 for item in machine.instance.get('metadata', {}).get('items', ())}
        data: bytes = items.get('user-data', '').encode()
        return base64.b64decode(data) if items.get('user-data-encoding') == 'base64' else data

    def plan(self, machine: Machine) -> dict[str, Any]:
        """Return what the user data says."""
        return {**cloud_config.parse(self.user_data(machine)), 'instance': machine.id,
                'user': USER, 'keys': [], 'google': True}

    def network_of(self, machine: Machine) -> str:
        """Return the VPC network."""
        return str(machine.instance['networkInterfaces'][0]['network'])

    def allowed(
        self, machine: Machine, members: Mapping[str, Sequence[str]],
    ) -> tuple[network.Allowed, ...]:
        """Return what the firewall rules say, in the order of their priority."""
        tags = set(machine.instance.get('tags', {}).get('items', ()))
        found: list[tuple[int, bool, network.Allowed]] = []
        for rule in self.firewalls():
            targets = set(rule.get('targetTags', ()))
            if rule.get('disabled') or rule['direction'] != 'INGRESS' \
                    or targets and not targets & tags \
                    or rule['network'] != self.network_of(machine):
                continue
            for verdict in ('denied', 'allowed'):
                for entry in rule.get(verdict, ()):
                    protocol = '-1' if entry['IPProtocol'] == 'all' else entry['IPProtocol']
                    for ports in entry.get('ports') or [None]:
                        first, _, last = (ports or '').partition('-')
                        found.append((rule['priority'], verdict == 'allowed', network.Allowed(
                            protocol, (int(first), int(last or first)) if ports else None,
                            tuple(rule['sourceRanges']), verdict == 'allowed')))
        # at the same priority, a denial wins
        return tuple(entry for _, _, entry in sorted(found, key=lambda one: one[:2]))

    def serve_metadata(self, machine: Machine) -> MetadataService:
        """Serve the metadata."""
        instance = machine.instance

        def answers(method: str, path: str, headers: Message) -> tuple[int, str]:
            found = {
                'instance/name': instance['name'], 'instance/id': instance['id'],
                'instance/zone': f'projects/1/zones/{instance["zone"].rpartition("/")[2]}',
                'project/project-id': instance['selfLink'].split('/projects/')[1].split('/')[0],
                'instance/preempted': 'TRUE' if machine.notice else 'FALSE'}
            if instance.get('serviceAccounts'):
                found['instance/service-accounts/default/token'] = json.dumps(
                    {'access_token': GUEST_TOKEN, 'expires_in': 3599, 'token_type': 'Bearer'})
            if headers.get('Metadata-Flavor') != 'Google':
                return 403, 'Missing Metadata-Flavor:Google header.'
            text = found.get(path.removeprefix('/computeMetadata/v1/'))
            return (404, 'not found') if text is None else (200, text)

        return MetadataService(machine.space, answers)

    def at_shutdown(self, machine: Machine) -> str:
        """Return that an instance that shuts itself down is stopped."""
        return 'stop'

    def changed(self, machine: Machine) -> None:
        """Show the state, and the addresses."""
        instance, access = machine.instance, machine.instance['networkInterfaces'][0]
        if machine.state == 'pending':
            if access.get('accessConfigs'):
                machine.public = self.addresses.take()
                access['accessConfigs'][0]['natIP'] = machine.public
            machine.private = access['networkIP']
        elif machine.state in ('stopped', 'terminated'):
            for config in access.get('accessConfigs', ()):
                config.pop('natIP', None)
        instance['status'] = _STATES[machine.state]


class Hollow(Cloud):
    """Instances without computers, for tests of the API alone."""

    def __init__(self) -> None:
        super().__init__('hollow', None, mounts=())  # type: ignore[arg-type]

    def _live(self, machine: Machine) -> None:
        if not machine.news.wait(self.boot_delay):
            with self.lock:
                if machine.wanted == 'run':
                    self._set(machine, 'running')
            machine.news.wait()
        self._finish(machine)

    def _finish(self, machine: Machine) -> None:
        self.addresses.give_back(filter(None, [
            machine.public, machine.private if machine.wanted == 'terminate' else '']))
        self._set(machine, 'terminated' if machine.wanted == 'terminate' else 'stopped')

    def shut_down(self, number: str) -> None:
        """Let an instance shut itself down."""
        threading.Thread(target=self.end, args=(number, 'stop', cloud.BY_ITSELF)).start()

    def copy(self, number: str, image: str) -> None:
        """Copy nothing."""

    def forget_image(self, image: str) -> None:
        """Remove nothing."""

    def protect(self) -> None:
        """Protect nothing."""
