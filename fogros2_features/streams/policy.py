# SPDX-License-Identifier: Apache-2.0
"""
What a machine's link carries: bits per second, topics that stay off it, and limits of rates; pure.

A topic that is denied or limited gets the machine's name there, as the topics of streams do. So no
middleware passes it: DDS and zenoh connect equal names only. For limits, the program ``limits`` of
``fogros2_share`` runs at each end of the link and passes the topic at its rate.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import dataclasses
import json
import re
from typing import Any, Optional

from fogros2.errors import ConfigurationError
from fogros2.model import NodeSpec
from fogros2.ros_names import check_name, identifier, local_topic

_PREFIXES = {'': 1.0, 'k': 1e3, 'M': 1e6, 'G': 1e9}
#: Parts of names of topics that belong to actions and services.
_CALLS = re.compile('/_action/|/_service_event$')
_LATCHED = '/tf_static'


@dataclasses.dataclass(frozen=True)
class Policy:
    """
    The policy of a machine's link.

    :param bandwidth: bits per second that streams may use in each direction, 0 for no limit.
    :param denied: topics that do not cross.
    :param limits: messages per second, or per second and child frame, by topic.
    """

    bandwidth: float = 0.0
    denied: Sequence[str] = ()
    limits: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def names(self, machine: str) -> dict[str, str]:
        """Return the new names of topics for nodes on the machine."""
        return {topic: local_topic(topic, machine) for topic in (*self.denied, *self.limits)}

    def ends(self, machine: str) -> list[tuple[Optional[str], NodeSpec]]:
        """Return the program at each end of the link, on the robot (None) and on the machine."""
        label = f'limits_{identifier(machine)}'
        return [(host, NodeSpec(
            id=f"{host or 'robot'}/{label}", name=label, package='fogros2', executable='limits',
            respawn=True, respawn_delay=1.0, arguments=(json.dumps([
                (local_topic(topic, host), _on_link(topic, machine, host is None),
                 _on_link(topic, machine, host is not None), 1 / rate)
                for topic, rate in self.limits.items()]),)))
            for host in (None, machine) if self.limits]


def _on_link(topic: str, machine: str, from_robot: bool) -> str:
    """Return the name of a topic on the link, on its way from the robot or from the machine."""
    return f"{local_topic(topic, machine)}/from_{'robot' if from_robot else 'machine'}"


def policy(bandwidth: Any, denied: Iterable[Any], limits: Mapping[str, Any]) -> Policy:
    """
    Return the policy of what a launch file says.

    :param bandwidth: such as '10Mbit/s', None for no limit.
    :param denied: full names of topics.
    :param limits: such as '20 Hz', by topic.
    :raises ConfigurationError: a value is wrong, or a topic can't stay off the link.
    """
    made = Policy(_bits(bandwidth), tuple(map(str, denied)),
                  {topic: _rate(topic, text) for topic, text in limits.items()})
    for keyword, topics in (('deny_topics', made.denied), ('limit_topics', made.limits)):
        for topic in topics:
            check_name(topic)
            if topic == _LATCHED:
                raise ConfigurationError(
                    f'{topic} in {keyword} would leave nodes without frames: each publisher sends '
                    'its transforms once', f'leave {topic} out; it costs nothing afterwards')
            if _CALLS.search(topic):
                raise ConfigurationError(
                    f'{topic} in {keyword} belongs to an action or a service, whose calls would '
                    'wait for ever', 'name topics only')
            if topic in made.denied and topic in made.limits:
                raise ConfigurationError(f'{topic} is in deny_topics and in limit_topics',
                                         'leave one of the two out')
    return made


def _bits(bandwidth: Any) -> float:
    if bandwidth is None:
        return 0.0
    match = re.fullmatch(r'(\d+(?:\.\d+)?) ?([kMG]?)bit/s|(\d+(?:\.\d+)?)',
                         str(bandwidth).strip())
    bits = 0.0 if match is None else (
        float(match[1] or match[3]) * _PREFIXES[match[2] or ''])
    if not 1e5 <= bits <= 1e12:
        raise ConfigurationError(
            f'bandwidth={bandwidth!r} is no bandwidth from 100 kbit/s to 1 Tbit/s',
            "write '500kbit/s', '10Mbit/s' or '1Gbit/s'")
    return bits


def _rate(topic: str, text: Any) -> float:
    match = re.fullmatch(r'(\d+(?:\.\d+)?)(?: ?Hz)?', str(text).strip())
    rate = float(match[1]) if match else 0.0
    if not 0.01 <= rate <= 1000:
        raise ConfigurationError(
            f'{text!r} of {topic} in limit_topics is no rate from 0.01 to 1000 Hz',
            f"write limit_topics={{{topic!r}: '20 Hz'}}")
    return rate
