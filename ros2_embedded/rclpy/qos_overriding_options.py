# SPDX-License-Identifier: Apache-2.0
"""Parameters that change the quality of service of a publisher or subscription."""

from collections.abc import Callable, Iterable
from enum import IntEnum
from typing import Any, TYPE_CHECKING

from rclpy import qos as policies
from rclpy.duration import Duration
from rclpy.exceptions import ParameterAlreadyDeclaredException
from rclpy.qos import QoSPolicyKind, QoSProfile

if TYPE_CHECKING:
    from rclpy.node import Node


class InvalidQosOverridesError(Exception):
    """The callback refused the policies."""


class QoSOverridingOptions:
    """Which policies have a parameter."""

    def __init__(self, policy_kinds: Iterable[QoSPolicyKind], *,
                 callback: Callable[[QoSProfile], Any] | None = None,
                 entity_id: str | None = None) -> None:
        self._policy_kinds, self._callback, self._entity_id = policy_kinds, callback, entity_id

    @property
    def policy_kinds(self) -> Iterable[QoSPolicyKind]:
        """The policies."""
        return self._policy_kinds

    @property
    def callback(self) -> Callable[[QoSProfile], Any] | None:
        """What validates the result."""
        return self._callback

    @property
    def entity_id(self) -> str | None:
        """What tells several publishers of one topic apart."""
        return self._entity_id

    @classmethod
    def with_default_policies(cls, *, callback: Callable[[QoSProfile], Any] | None = None,
                              entity_id: str | None = None) -> 'QoSOverridingOptions':
        """Choose history, depth and reliability."""
        return cls((QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY),
                   callback=callback, entity_id=entity_id)


def override(node: 'Node', entity: str, topic: str, profile: QoSProfile,
             options: QoSOverridingOptions) -> None:
    """
    Declare the parameters of a publisher or subscription and apply them to its profile.

    :param entity: 'publisher' or 'subscription'.
    :raises InvalidQosOverridesError: if the callback refuses the result.
    """
    from rcl_interfaces.msg import ParameterDescriptor
    suffix = '' if options.entity_id is None else f'_{options.entity_id}'
    about = f'for {entity} `{topic}` with id `{options.entity_id}`'
    for kind in options.policy_kinds:
        if kind == QoSPolicyKind.LIFESPAN and entity == 'subscription':
            continue
        policy = kind.name.lower()
        value = getattr(profile, policy)
        plain = value.name.lower() if isinstance(value, IntEnum) else \
            value.nanoseconds if isinstance(value, Duration) else value
        name = f'qos_overrides.{topic}.{entity}{suffix}.{policy}'
        try:
            given = node.declare_parameter(name, plain, ParameterDescriptor(
                description=f'{policy} {about}', read_only=True)).value
        except ParameterAlreadyDeclaredException:
            given = node.get_parameter(name).value
        if isinstance(value, IntEnum):
            try:
                given = getattr(policies, f'{policy.capitalize()}Policy')[given.upper()]
            except KeyError:
                raise RuntimeError(
                    f'Unexpected QoS override for policy `{policy}`: `{given}`') from None
        elif isinstance(value, Duration):
            given = Duration(nanoseconds=given)
        setattr(profile, policy, given)
    if options.callback is not None:
        result = options.callback(profile)
        if not result.successful:
            raise InvalidQosOverridesError(
                f'Provided QoS overrides {about}, are not valid: {result.reason}')
