# SPDX-License-Identifier: Apache-2.0
"""What an instance of Moto's means for its computer: its boot, its metadata, who may reach it."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
import json
import time
from typing import Any

from rigs.computers import cloud_config, network
from rigs.computers.computer import USER


def plan(instance: Any) -> dict[str, Any]:
    """Return what the first process of an instance has to do; see ``guest``."""
    return {**cloud_config.parse(user_data(instance)), 'instance': instance.id, 'user': USER,
            'keys': _public_keys(instance)}


def values(instance: Any, notice: float) -> dict[str, str]:
    """
    Return what the metadata service knows, by path below ``/latest/``.

    :param notice: when a spot instance will be taken away (seconds since the epoch), else 0.
    """
    return {
        'meta-data/instance-id': instance.id,
        'meta-data/placement/region': instance.region_name,
        **({'meta-data/spot/instance-action': json.dumps(
            {'action': 'terminate', 'time': time.strftime(
                '%Y-%m-%dT%H:%M:%SZ', time.gmtime(notice))})} if notice else {})}


def allowed(
    instance: Any, members: Mapping[str, Sequence[str]],
) -> tuple[network.Allowed, ...]:
    """
    Return what an instance's security groups let in.

    :param members: addresses of the instances in each group, by its id.
    """
    found = []
    for group in instance.nics[0].group_set:
        for rule in group.ingress_rules:
            sources = [rule.ip_range['CidrIp']] if rule.ip_range.get('CidrIp') else []
            if rule.source_group:
                sources += members.get(rule.source_group.get('GroupId', ''), ())
            ports = None if rule.from_port in (None, -1) else (
                int(rule.from_port), int(rule.to_port))
            if sources:
                found.append(network.Allowed(rule.ip_protocol, ports, tuple(sources)))
    return tuple(found)


def user_data(instance: Any) -> bytes:
    return base64.b64decode(instance.user_data.as_bytes()) if instance.user_data else b''


def _public_keys(instance: Any) -> list[str]:
    pair = instance.ec2_backend.key_pairs.get(instance.key_name)
    if pair is None:
        return []
    material = pair.material_public
    return [material.decode() if isinstance(material, bytes) else str(material)]
