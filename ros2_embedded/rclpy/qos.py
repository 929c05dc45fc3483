# SPDX-License-Identifier: Apache-2.0
"""Quality of service."""

from enum import Enum, IntEnum
from typing import Any
import warnings

from rclpy._dds import Policies
from rclpy.duration import Duration
from rosidl_embedded.lacking import NotEmbeddedError


class QoSPolicyKind(IntEnum):
    """Policies, as events name them."""

    INVALID = 1 << 0
    DURABILITY = 1 << 1
    DEADLINE = 1 << 2
    LIVELINESS = 1 << 3
    RELIABILITY = 1 << 4
    HISTORY = 1 << 5
    LIFESPAN = 1 << 6
    DEPTH = 1 << 7
    LIVELINESS_LEASE_DURATION = 1 << 8
    AVOID_ROS_NAMESPACE_CONVENTIONS = 1 << 9


def qos_policy_name_from_kind(policy_kind: QoSPolicyKind | int) -> str:
    """Name a policy."""
    return QoSPolicyKind(policy_kind).name


class InvalidQoSProfileException(Exception):
    """A profile's arguments don't make one."""

    def __init__(self, *args: object) -> None:
        super().__init__('Invalid QoSProfile', *args)


class _ShortKeys(Enum):
    """Values with names as one types them."""

    @classmethod
    def short_keys(cls) -> list[str]:
        """List the values' names as one types them."""
        return [key.lower() for key in cls.__members__]

    @classmethod
    def get_from_short_key(cls, name: str) -> Any:
        """Find the value of a name, in upper or lower case."""
        return cls[name.upper()].value


class QoSPolicyEnum(IntEnum, _ShortKeys):
    """The base of the policies' values."""

    @property
    def short_key(self) -> str:
        """The value's name as one types it."""
        return self.name.lower()


class HistoryPolicy(QoSPolicyEnum):
    """How many samples are kept."""

    SYSTEM_DEFAULT = 0
    KEEP_LAST = 1
    KEEP_ALL = 2
    UNKNOWN = 3


class ReliabilityPolicy(QoSPolicyEnum):
    """Whether lost samples are sent again."""

    SYSTEM_DEFAULT = 0
    RELIABLE = 1
    BEST_EFFORT = 2
    UNKNOWN = 3
    BEST_AVAILABLE = 4


class DurabilityPolicy(QoSPolicyEnum):
    """Whether late subscriptions get earlier samples."""

    SYSTEM_DEFAULT = 0
    TRANSIENT_LOCAL = 1
    VOLATILE = 2
    UNKNOWN = 3
    BEST_AVAILABLE = 4


class LivelinessPolicy(QoSPolicyEnum):
    """Who says that a publisher is alive."""

    SYSTEM_DEFAULT = 0
    AUTOMATIC = 1
    MANUAL_BY_TOPIC = 3
    UNKNOWN = 4
    BEST_AVAILABLE = 5


QoSHistoryPolicy = HistoryPolicy
QoSReliabilityPolicy = ReliabilityPolicy
QoSDurabilityPolicy = DurabilityPolicy
QoSLivelinessPolicy = LivelinessPolicy

_UNSPECIFIED = Duration()
DeadlineBestAvailable = Duration(nanoseconds=2 ** 63 - 2)
LivelinessLeaseDurationeBestAvailable = Duration(nanoseconds=2 ** 63 - 2)


def _policy(name: str, kind: type) -> Any:
    """Make the property of a policy, which checks what it is set to."""
    slot = '_' + name

    def getter(self: 'QoSProfile') -> Any:
        return getattr(self, slot)

    def setter(self: 'QoSProfile', value: Any) -> None:
        assert isinstance(value, (kind, int) if issubclass(kind, IntEnum) else kind)
        if name == 'depth' and value == 0 and self.history == HistoryPolicy.KEEP_LAST:
            warnings.warn(
                "A zero depth with KEEP_LAST doesn't make sense; no data could be stored. "
                'This will be interpreted as SYSTEM_DEFAULT', stacklevel=2)
        setattr(self, slot, kind(value) if issubclass(kind, IntEnum) else value)

    return property(getter, setter, doc=f"The policy '{name}'.")


_DEFAULTS: dict[str, Any] = {
    'history': HistoryPolicy.KEEP_LAST, 'depth': 10, 'reliability': ReliabilityPolicy.RELIABLE,
    'durability': DurabilityPolicy.VOLATILE, 'lifespan': _UNSPECIFIED, 'deadline': _UNSPECIFIED,
    'liveliness': LivelinessPolicy.SYSTEM_DEFAULT, 'liveliness_lease_duration': _UNSPECIFIED,
    'avoid_ros_namespace_conventions': False}


class QoSProfile:
    """
    A set of policies.

    :raises InvalidQoSProfileException: without history and depth, or KEEP_LAST without depth.
    """

    __slots__ = ['_' + name for name in _DEFAULTS]

    history: Any = _policy('history', HistoryPolicy)
    depth: Any = _policy('depth', int)
    reliability: Any = _policy('reliability', ReliabilityPolicy)
    durability: Any = _policy('durability', DurabilityPolicy)
    lifespan: Any = _policy('lifespan', Duration)
    deadline: Any = _policy('deadline', Duration)
    liveliness: Any = _policy('liveliness', LivelinessPolicy)
    liveliness_lease_duration: Any = _policy('liveliness_lease_duration', Duration)
    avoid_ros_namespace_conventions: Any = _policy('avoid_ros_namespace_conventions', bool)

    def __init__(self, **kwargs: Any) -> None:
        assert all('_' + key in self.__slots__ for key in kwargs), \
            f'Invalid arguments passed to constructor: {kwargs.keys()!r}'
        if 'depth' not in kwargs:
            if 'history' not in kwargs:
                raise InvalidQoSProfileException('History and/or depth settings are required.')
            if kwargs['history'] == HistoryPolicy.KEEP_LAST:
                raise InvalidQoSProfileException(
                    'History set to KEEP_LAST without a depth setting.')
        for name, default in _DEFAULTS.items():
            setattr(self, name, kwargs.get(name, default))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, QoSProfile) and all(
            getattr(self, slot) == getattr(other, slot) for slot in self.__slots__)

    __hash__ = None  # type: ignore[assignment]

    def __str__(self) -> str:
        policies = ', '.join(f'{slot[1:]}={getattr(self, slot)}' for slot in self.__slots__)
        return f'{type(self).__name__}({policies})'

    def _policies(self, user_data: bytes, ignore_local: bool = False) -> Policies:
        """Translate to DDS as rmw_cyclonedds does."""
        for name in ('reliability', 'durability', 'liveliness'):
            if getattr(self, name).name == 'BEST_AVAILABLE':
                raise NotEmbeddedError(f'the policy BEST_AVAILABLE for {name}')
        keep_all = self.history == HistoryPolicy.KEEP_ALL
        return Policies(
            depth=0 if keep_all else max(self.depth, 1),
            reliable=self.reliability != ReliabilityPolicy.BEST_EFFORT,
            transient_local=self.durability == DurabilityPolicy.TRANSIENT_LOCAL,
            lifespan=self.lifespan.nanoseconds,
            deadline=self.deadline.nanoseconds,
            manual_liveliness=self.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC,
            lease=self.liveliness_lease_duration.nanoseconds,
            user_data=user_data,
            ignore_local=ignore_local)

    @classmethod
    def _from_policies(cls, policies: Policies) -> 'QoSProfile':
        """Translate from DDS."""
        return cls(
            history=HistoryPolicy.UNKNOWN if policies.depth < 0
            else HistoryPolicy.KEEP_LAST if policies.depth else HistoryPolicy.KEEP_ALL,
            depth=max(policies.depth, 0),
            reliability=ReliabilityPolicy.RELIABLE if policies.reliable
            else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if policies.transient_local
            else DurabilityPolicy.VOLATILE,
            lifespan=Duration(nanoseconds=policies.lifespan),
            deadline=Duration(nanoseconds=policies.deadline),
            liveliness=LivelinessPolicy.MANUAL_BY_TOPIC if policies.manual_liveliness
            else LivelinessPolicy.AUTOMATIC,
            liveliness_lease_duration=Duration(nanoseconds=policies.lease))


qos_profile_unknown = QoSProfile(
    history=HistoryPolicy.UNKNOWN, depth=0, reliability=ReliabilityPolicy.UNKNOWN,
    durability=DurabilityPolicy.UNKNOWN, liveliness=LivelinessPolicy.UNKNOWN)
qos_profile_default = QoSProfile(depth=10)
qos_profile_system_default = QoSProfile(
    history=HistoryPolicy.SYSTEM_DEFAULT, depth=0,
    reliability=ReliabilityPolicy.SYSTEM_DEFAULT, durability=DurabilityPolicy.SYSTEM_DEFAULT)
qos_profile_sensor_data = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
qos_profile_services_default = QoSProfile(depth=10)
qos_profile_parameters = QoSProfile(depth=1000)
qos_profile_parameter_events = QoSProfile(depth=1000)
qos_profile_best_available = QoSProfile(
    depth=10, reliability=ReliabilityPolicy.BEST_AVAILABLE,
    durability=DurabilityPolicy.BEST_AVAILABLE, deadline=DeadlineBestAvailable,
    liveliness=LivelinessPolicy.BEST_AVAILABLE,
    liveliness_lease_duration=LivelinessLeaseDurationeBestAvailable)
qos_profile_action_status_default = QoSProfile(
    depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
qos_profile_rosout_default = QoSProfile(
    depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL, lifespan=Duration(seconds=10))


class QoSPresetProfiles(_ShortKeys):
    """The profiles by name."""

    UNKNOWN = qos_profile_unknown
    DEFAULT = qos_profile_default
    SYSTEM_DEFAULT = qos_profile_system_default
    SENSOR_DATA = qos_profile_sensor_data
    SERVICES_DEFAULT = qos_profile_services_default
    PARAMETERS = qos_profile_parameters
    PARAMETER_EVENTS = qos_profile_parameter_events
    ACTION_STATUS_DEFAULT = qos_profile_action_status_default
    BEST_AVAILABLE = qos_profile_best_available


class QoSCompatibility(IntEnum):
    """Whether a publisher's and a subscription's profile go together."""

    OK = 0
    WARNING = 1
    ERROR = 2


def qos_check_compatible(
        publisher_qos: QoSProfile,
        subscription_qos: QoSProfile) -> tuple[QoSCompatibility, str]:
    """
    Say whether a publisher and a subscription with these profiles would be matched.

    :returns: the verdict and the reasons; WARNING where it depends on the middleware.
    """
    offered, requested = publisher_qos, subscription_qos
    errors = []
    if offered.reliability == ReliabilityPolicy.BEST_EFFORT \
            and requested.reliability == ReliabilityPolicy.RELIABLE:
        errors.append('Best effort publisher and reliable subscription')
    if offered.durability == DurabilityPolicy.VOLATILE \
            and requested.durability == DurabilityPolicy.TRANSIENT_LOCAL:
        errors.append('Volatile publisher and transient local subscription')
    if offered.liveliness == LivelinessPolicy.AUTOMATIC \
            and requested.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC:
        errors.append("Publisher's liveliness is automatic and subscription's is manual by topic")
    for name, end in (('deadline', ' deadline'), ('liveliness_lease_duration', '')):
        ours, theirs, words = getattr(offered, name), getattr(requested, name), \
            name.replace('_', ' ')
        if ours == _UNSPECIFIED != theirs:
            errors.append(f'Subscription has a {words}, but publisher does not')
        elif ours != _UNSPECIFIED != theirs and theirs < ours:
            errors.append(f'Subscription {words} is less than publisher{end}')
    if errors:
        return QoSCompatibility.ERROR, ''.join(f'ERROR: {error};' for error in errors)
    warned = []
    for name, weak, weak_words, strong, strong_words in (
            ('reliability', ReliabilityPolicy.BEST_EFFORT, 'Best effort publisher',
             ReliabilityPolicy.RELIABLE, 'Reliable subscription'),
            ('durability', DurabilityPolicy.VOLATILE, 'Volatile publisher',
             DurabilityPolicy.TRANSIENT_LOCAL, 'Transient local subscription'),
            ('liveliness', LivelinessPolicy.AUTOMATIC, "Publisher's liveliness is automatic",
             LivelinessPolicy.MANUAL_BY_TOPIC, "Subscription's liveliness is manual by topic")):
        ours, theirs = getattr(offered, name), getattr(requested, name)
        unsure, unsure_too = (one.name in ('SYSTEM_DEFAULT', 'UNKNOWN') for one in (ours, theirs))
        whose = "'s" if name == 'liveliness' else ''
        if unsure and unsure_too:
            warned.append(f'Publisher {name} is {ours.short_key} and subscription {name} is '
                          f'{theirs.short_key}')
        elif unsure and theirs == strong:
            warned.append(f'{strong_words}, but publisher{whose} is {ours.short_key}')
        elif ours == weak and unsure_too:
            warned.append(f'{weak_words}, but subscription{whose} is {theirs.short_key}')
    if warned:
        return QoSCompatibility.WARNING, ''.join(f'WARNING: {one};' for one in warned)
    return QoSCompatibility.OK, ''
