# SPDX-License-Identifier: Apache-2.0
"""Moto's instances, each with a computer; its classes are changed in this process alone."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from email.message import Message
import json
import secrets
import sys
import threading
import time
from typing import Any

from fogros2.errors import FogError
from rigs.computers import cloud, cloud_config, network
from rigs.computers.cloud import BY_ITSELF, BY_SPOT, BY_TROUBLE, BY_USER, Machine
from rigs.computers.computer import USER
from rigs.computers.metadata import MetadataService

_STATES = {'pending': 0, 'running': 16, 'shutting-down': 32, 'terminated': 48, 'stopping': 64,
           'stopped': 80}
#: Of what made an instance end: EC2's code and words.
_REASONS = {
    BY_USER: ('Client.UserInitiatedShutdown', 'User initiated shutdown'),
    BY_ITSELF: ('Client.InstanceInitiatedShutdown', 'Instance initiated shutdown'),
    BY_SPOT: ('Server.SpotInstanceTermination', 'Spot instance termination'),
    BY_TROUBLE: ('Server.InternalError', 'Internal error on launch'),
}
#: What Moto's own methods do, kept before they are replaced.
MOTO: dict[str, Callable[..., Any]] = {}


class Cloud(cloud.Cloud):
    """The computers of EC2 in a box."""

    def user_data(self, machine: Machine) -> bytes:
        """Return the attribute of that name."""
        data = machine.instance.user_data
        return base64.b64decode(data.as_bytes()) if data else b''

    def plan(self, machine: Machine) -> dict[str, Any]:
        """Return what the user data and the key pair say."""
        pair = machine.instance.ec2_backend.key_pairs.get(machine.instance.key_name)
        key = pair.material_public if pair else b''
        return {**cloud_config.parse(self.user_data(machine)), 'instance': machine.id,
                'user': USER, 'keys': [key.decode() if isinstance(key, bytes) else str(key)]}

    def network_of(self, machine: Machine) -> str:
        """Return the VPC."""
        return str(machine.instance.vpc_id)

    def groups_of(self, machine: Machine) -> Sequence[str]:
        """Return the security groups."""
        return [str(group.id) for group in machine.instance.nics[0].group_set]

    def allowed(
        self, machine: Machine, members: Mapping[str, Sequence[str]],
    ) -> tuple[network.Allowed, ...]:
        """Return what the security groups let in; a source may be another group."""
        allowed = []
        for group in machine.instance.nics[0].group_set:
            for rule in group.ingress_rules:
                sources = [rule.ip_range['CidrIp']] if rule.ip_range.get('CidrIp') else []
                if rule.source_group:
                    sources += members.get(rule.source_group.get('GroupId', ''), ())
                ports = None if rule.from_port in (None, -1) else (
                    int(rule.from_port), int(rule.to_port))
                if sources:
                    allowed.append(network.Allowed(rule.ip_protocol, ports, tuple(sources)))
        return tuple(allowed)

    def serve_metadata(self, machine: Machine) -> MetadataService:
        """Serve IMDS, of version 2 where the instance asks for it: with a token."""
        instance, token = machine.instance, secrets.token_urlsafe(40)

        def answers(method: str, path: str, headers: Message) -> tuple[int, str]:
            if method == 'PUT':
                life = headers.get('X-aws-ec2-metadata-token-ttl-seconds', '')
                good = path == '/latest/api/token' and life.isdecimal()
                return (200, token) if good and 1 <= int(life) <= 21600 else (400, '')
            if instance.metadata_options.http_tokens == 'required' \
                    and headers.get('X-aws-ec2-metadata-token') != token:
                return 401, ''
            text = {
                'meta-data/instance-id': instance.id,
                'meta-data/placement/region': instance.region_name,
                **({'meta-data/spot/instance-action': json.dumps({
                    'action': 'terminate', 'time': time.strftime(
                        '%Y-%m-%dT%H:%M:%SZ', time.gmtime(machine.notice))})}
                   if machine.notice else {})}.get(path.removeprefix('/latest/'))
            return (404, '') if text is None else (200, text)

        return MetadataService(machine.space, answers)

    def at_shutdown(self, machine: Machine) -> str:
        """Return what the instance's attribute says; a spot instance can't be stopped."""
        behaviour = machine.instance.instance_initiated_shutdown_behavior
        return 'stop' if behaviour == 'stop' and not machine.spot else 'terminate'

    def changed(self, machine: Machine) -> None:
        """Show the state, and the public address of an instance that runs."""
        instance, state = machine.instance, machine.state
        if state == 'pending':
            # EC2 tells the address when the instance runs
            nic = instance.nics[0]
            machine.private = str(instance.private_ip)
            machine.public, nic.public_ip = nic.public_ip or '', None
        elif state == 'running':
            instance.nics[0].public_ip = machine.public or None
        if state in ('terminated', 'stopped'):
            MOTO['terminate' if state == 'terminated' else 'stop'](instance)
            code, words = _REASONS[machine.reason]
            instance.state_reason.code, instance.state_reason.message = code, f'{code}: {words}'
            if machine.reason != BY_USER:
                instance._reason = f'{code}: {words}'
        else:
            instance._state.name, instance._state.code = state, _STATES[state]

    def image(self, image: Any, instance: Any) -> None:
        """Copy an instance's disk; the image is pending until that is done."""
        image.state = 'pending'

        def copy() -> None:
            try:
                self.copy(str(instance.id), str(image.id))
                image.state = 'available'
            except (FogError, OSError) as error:
                print(f'{image.id}: {error}', file=sys.stderr, flush=True)
                image.state = 'failed'

        threading.Thread(target=copy, daemon=True).start()
