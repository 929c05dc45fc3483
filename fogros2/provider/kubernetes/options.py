# SPDX-License-Identifier: Apache-2.0
"""Parse the options of a Kubernetes machine; pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import dataclasses
import re
from typing import Any

from fogros2 import untrusted
from fogros2.errors import ConfigurationError
from fogros2.provider.options import convert, parsed

IMAGE = 'docker.io/library/ros:jazzy-ros-base'
#: How the robot's VPN reaches a pod, in the order of 'auto'.
EXPOSURES = ('load_balancer', 'node_port', 'pod_dials_robot', 'pod_ip')

_LABEL = re.compile(r'[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?')
_TOLERATION = ('key', 'operator', 'value', 'effect', 'tolerationSeconds')


@dataclasses.dataclass(frozen=True)
class Options:
    """
    The options of a Kubernetes machine in a launch file.

    :param container_image: image with Python 3.10 and ``sh``; ``{dependencies}`` in its name is
        replaced by the hash of the launch's needs, the tag of ``image.recipe``.
    :param namespace: '' for the context's namespace.
    :param context: context of the kubeconfig; '' for the current one.
    :param zone: preferred zone of the pod.
    :param mcpu: thousandths of a CPU, as request and limit; 0 for none.
    :param mb: MiB of memory, as request and limit; 0 for none.
    :param gpus: number of devices of the kind ``gpu_resource``.
    :param node_selector: required labels of the node.
    :param tolerations: as in a pod's specification.
    :param runtime_class: such as 'nvidia'.
    :param image_pull_secrets: names of secrets in the namespace.
    :param service_account: service account for the pod's admission; the pod gets no token.
    :param expose: one of ``EXPOSURES``, or 'auto'.
    :param robot_host: the robot's address for pods that connect to it; '' for the robot's address
        on the way to the API server.
    :param user: login user, created if the image does not have it.
    :param env: environment variables of every login.
    :param annotations: of the Service, such as a cloud's settings for load balancers.
    """

    container_image: str = IMAGE
    namespace: str = ''
    context: str = ''
    zone: str = ''
    mcpu: int = 0
    mb: int = 0
    gpus: int = 0
    gpu_resource: str = 'nvidia.com/gpu'
    node_selector: Mapping[str, str] = dataclasses.field(default_factory=dict)
    tolerations: tuple[Mapping[str, Any], ...] = ()
    runtime_class: str = ''
    image_pull_secrets: tuple[str, ...] = ()
    service_account: str = ''
    expose: str = 'auto'
    robot_host: str = ''
    user: str = 'fog'
    env: Mapping[str, str] = dataclasses.field(default_factory=dict)
    annotations: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @property
    def node_labels(self) -> dict[str, str]:
        """All required labels of the node; clusters may have Windows nodes without a taint."""
        return {'kubernetes.io/os': 'linux', **self.node_selector}

    @classmethod
    def parse(cls, given: Mapping[str, Any]) -> Options:
        """
        Return the options of a spec.

        :raises ConfigurationError: an option is unknown (with the nearest name) or invalid.
        """
        options = parsed(cls, given, 'a Kubernetes machine', _converted)
        _check_values(options)
        return options


def _converted(name: str, value: Any, default: Any) -> Any:
    if name == 'tolerations':
        return _tolerations(value)
    return convert(name, value, default)


def _tolerations(value: Any) -> tuple[Mapping[str, Any], ...]:
    if isinstance(value, Sequence) and not isinstance(value, str) and all(
            isinstance(each, Mapping) and set(each) <= set(_TOLERATION) for each in value):
        return tuple(dict(each) for each in value)
    raise ConfigurationError(
        f"option 'tolerations' can't be {value!r}",
        "it takes dictionaries such as {'key': 'gpu', 'operator': 'Exists'}")


def _check_values(options: Options) -> None:
    image, robot_host = options.container_image, options.robot_host
    for name, fits, hint in (
            ('expose', options.expose in ('auto', *EXPOSURES),
             f"it takes auto, {', '.join(EXPOSURES)}"),
            ('container_image', image and not re.search(r'\s|^-', image),
             f"it takes an image's name, such as {IMAGE}"),
            ('namespace', not options.namespace or _LABEL.fullmatch(options.namespace),
             'lower-case letters, digits and - make one, 63 at most'),
            ('user', untrusted.NAME.fullmatch(options.user),
             'lower-case letters, digits, _ and - make one, 32 at most'),
            ('robot_host', not re.search(r'[\s/@]', robot_host), 'it takes an address or a name')):
        if not fits:
            raise ConfigurationError(f"{name}= can't be '{getattr(options, name)}'", hint)
    for variable in options.env:
        if not re.fullmatch(r'[A-Za-z_][A-Za-z0-9_]*', variable):
            raise ConfigurationError(f"env= can't carry the variable {variable!r}",
                                     'a name has letters, digits and _')
