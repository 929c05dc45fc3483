# SPDX-License-Identifier: Apache-2.0
"""
Choose a region or an image when the launch is executed.

Each function returns launch substitutions and makes no request. A machine with such an option
makes the requests in a thread, when it comes up. The exception is ``nearest_aws_region_now``.

The names and keywords of FogROS2's module ``utils.region_ami_selection`` are among them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import functools
import threading
from typing import Any, Optional, TYPE_CHECKING

from launch import LaunchContext, Substitution

from fogros2 import plugin_system
from fogros2.describe import values
from fogros2.provider import Provider

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

#: The value that stands for the region with the fastest response.
NEAREST = 'nearest'


class Choice(Substitution):
    """
    A value that is requested when the launch is executed, once.

    :param what: description of the value, for messages.
    :param ask: returns the value for the resolved ``arguments``; may take seconds.
    """

    def __init__(self, what: str, ask: Callable[..., str], arguments: Mapping[str, Any]) -> None:
        super().__init__()
        self._what = what
        self._ask = ask
        self._arguments = dict(arguments)
        self._answer: Optional[str] = None
        self._lock = threading.Lock()

    def describe(self) -> str:
        """Return the description of the value."""
        return self._what

    def __repr__(self) -> str:
        return f'<{self._what}>'

    def defer(self, context: LaunchContext) -> values.Deferred:
        """Resolve the arguments; return the function that requests the value, for a thread."""
        resolved = {
            key: values.resolve_deferred(context, value) for key, value in self._arguments.items()}
        return functools.partial(self._once, resolved)

    def perform(self, context: LaunchContext) -> str:
        """Request the value and wait for it; options of machines use :meth:`defer` instead."""
        return self.defer(context)()

    def _once(self, arguments: Mapping[str, Any]) -> str:
        with self._lock:
            if self._answer is None:
                self._answer = self._ask(**values.await_all(arguments))
            return self._answer


def find_nearest_aws_region(regions: Optional[Sequence[SomeSubstitutionsType]] = None) -> Choice:
    """
    Choose the AWS region to which a connection opens fastest.

    :param regions: candidates; None for all regions that every account may use.
    """
    return Choice('the nearest AWS region', _nearest, {'regions': values.items(regions)})


def nearest_aws_region_now(regions: Optional[Sequence[str]] = None) -> str:
    """
    Measure now, and return the AWS region to which a connection opens fastest, as a string.

    This is the only function that makes requests when it is called. So ``ros2 launch -s`` also
    measures, for up to five seconds. Where another value of a machine depends on the region, a
    mapping needs no such call: see :class:`~fogros2.AWSCloudInstance`.

    :param regions: candidates; None for all regions that every account may use.
    :raises ProviderError: no region answers, and this computer's location is unknown.
    """
    return _nearest(regions)


def find_nearest_region_and_ami(
    regions: Mapping[str, Mapping[str, str]],
) -> tuple[Choice, Choice]:
    """
    Choose the nearest of some regions, and the image that is given for it.

    :param regions: by region, such as ``{'us-west-1': {'ami_image': 'ami-0123'}}``.
    """
    region = find_nearest_aws_region(list(regions))
    images = {name: about['ami_image'] for name, about in regions.items()}
    return region, Choice(
        'the image for that region', lambda region: images[region], {'region': region})


def _nearest(regions: Optional[Sequence[str]]) -> str:
    # loaded only when a request is made
    provider: Provider = plugin_system.load('fogros2.provider', 'aws')()
    return provider.nearest(regions or ())
