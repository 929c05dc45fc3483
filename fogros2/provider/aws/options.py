# SPDX-License-Identifier: Apache-2.0
"""What a launch file may ask of a machine at AWS."""

from __future__ import annotations

from collections.abc import Mapping
import dataclasses
from decimal import Decimal
import ipaddress
import re
from typing import Any, Optional

from fogros2.errors import ConfigurationError
from fogros2.model import MachineSpec
from fogros2.provider.options import convert, parsed

#: What a machine is unless something else is asked for.
DEFAULT_TYPE = 't3.medium'
NEAREST, CHEAPEST = 'nearest', 'cheapest'
_ARCHES = {'': '', 'x86_64': 'x86_64', 'amd64': 'x86_64', 'arm64': 'arm64', 'aarch64': 'arm64'}
_FORMS = {
    'region': (r'nearest|[a-z]{2,4}(-[a-z]+)+-\d+', "'eu-central-1' or 'nearest'"),
    'ec2_instance_type': (r'cheapest|[a-z0-9-]+\.[a-z0-9-]+', "'t3.medium' or 'cheapest'"),
    'ami_image': (r'ami-[0-9a-f]+', 'ami-...'),
    'subnet': (r'subnet-[0-9a-f]+', 'subnet-...'),
    'user': (r'[a-z_][a-z0-9_-]{0,31}', "a login name, such as 'ubuntu'"),
}
#: Options that may depend on the region: a mapping has one value for each region.
_BY_REGION = ('ami_image', 'ec2_instance_type', 'subnet')


@dataclasses.dataclass(frozen=True)
class Options:
    """
    What a launch file may ask of an EC2 instance.

    :param ami_image: id of an image; '' for one baked before with the same dependencies, else
        Ubuntu 24.04 (with NVIDIA's driver for a type that has its GPUs).
    :param region: 'eu-central-1', or 'nearest'; '' for that of the user's AWS configuration.
    :param regions: more regions to try, in this order, when one has no room.
    :param ec2_instance_type: 't3.medium', or 'cheapest' of what has what is asked for below.
    :param instance_types: more types to try, in this order, when there is no room for one.
    :param disk_size: GB.
    :param spot: take a spot instance: cheaper, and AWS may take it back at two minutes' notice.
    :param arch: x86_64 or arm64.
    :param min_cpu: vCPUs at least; ``min_memory_gb`` GiB.
    :param gpu: how many, True, or part of the name of one; ``gpu_memory_gb`` GB of each.
    :param cpu_type: the processor's maker: intel, amd, aws.
    :param max_price: US dollars an hour; more is refused, and it is the cap of a spot instance.
    :param iam_instance_profile: name or ARN of what the machine itself may do at AWS.
    :param subnet: id; '' for the default VPC's.
    :param security_groups: ids of groups besides the machine's own.
    :param tags: on everything that is made.
    :param user: the image's login user.
    :param ssh_from: networks (CIDR) that may reach the SSH port; none for this robot's public
        address alone.
    :param by_region: options that depend on the region, by name: their values by region.
        ``in_region`` puts them into the fields above.
    """

    ami_image: str = ''
    region: str = ''
    regions: tuple[str, ...] = ()
    ec2_instance_type: str = ''
    instance_types: tuple[str, ...] = ()
    disk_size: int = 30
    spot: bool = False
    arch: str = ''
    min_cpu: float = 0.0
    min_memory_gb: float = 0.0
    cpu_type: str = ''
    gpu: str = ''
    gpu_memory_gb: float = 0.0
    max_price: Optional[Decimal] = None
    iam_instance_profile: str = ''
    subnet: str = ''
    security_groups: tuple[str, ...] = ()
    tags: Mapping[str, str] = dataclasses.field(default_factory=dict)
    user: str = 'ubuntu'
    ssh_from: tuple[str, ...] = ()
    by_region: Mapping[str, Mapping[str, str]] = dataclasses.field(default_factory=dict)

    @classmethod
    def parse(cls, given: Mapping[str, Any]) -> Options:
        """
        Return the options of a spec.

        :raises ConfigurationError: one is unknown (with the nearest name) or makes no sense.
        """
        by_region = {name: convert(name, given[name], {}) for name in _BY_REGION
                     if isinstance(given.get(name), Mapping)}
        options = parsed(cls, {name: value for name, value in given.items()
                               if name not in by_region}, 'a machine at AWS', _value)
        _check(options)
        _check_by_region(by_region)
        options = dataclasses.replace(options, arch=_ARCHES[options.arch], by_region=by_region)
        if options.common_regions() == []:
            raise ConfigurationError(f'{" and ".join(by_region)} have no region in common',
                                     'give each a value for the same region')
        return options

    def in_region(self, region: str) -> Options:
        """
        Return the options with the values that a region has.

        :raises ConfigurationError: an option depends on the region and has no value for this one.
        """
        for name, values in self.by_region.items():
            if region not in values:
                raise ConfigurationError(
                    f'{name} has no value for the region {region}',
                    f'add one, or choose the region among {", ".join(values)}')
        chosen: dict[str, Any] = {
            name: values[region] for name, values in self.by_region.items()}
        return dataclasses.replace(self, by_region={}, **chosen)

    def common_regions(self) -> Optional[list[str]]:
        """Return the regions for which every option has a value; None where all regions do."""
        if not self.by_region:
            return None
        first, *others = self.by_region.values()
        return [region for region in first if all(region in values for values in others)]

    @property
    def chooses_type(self) -> bool:
        """Whether the type is to be the cheapest that has what is asked for."""
        return self.ec2_instance_type == CHEAPEST or not self.ec2_instance_type and bool(
            self.min_cpu or self.min_memory_gb or self.cpu_type or self.gpu
            or self.gpu_memory_gb or self.arch)


def check_spec(spec: MachineSpec) -> Options:
    """
    Return a spec's options, looked at together with what all machines have.

    :raises ConfigurationError: they don't go together.
    """
    options = Options.parse(spec.options)
    if options.spot and spec.on_exit == 'stop':
        raise ConfigurationError("a spot instance can't be stopped and started again",
                                 "on_exit='delete' or 'keep', or spot=False")
    return options


def _value(name: str, value: Any, default: Any) -> Any:
    if name == 'max_price':
        return Decimal(repr(convert(name, _number(value), 0.0)))
    if name == 'ssh_from' and isinstance(value, str):
        value = (value,)
    if name == 'gpu' and isinstance(value, bool):
        return '1' if value else ''
    if name == 'disk_size':
        value = _number(value)
        if isinstance(value, float) and value.is_integer():
            value = int(value)
    if isinstance(default, float):
        value = _number(value)
        if value == 0:
            return 0.0
    return convert(name, value, default)


def _number(value: Any) -> Any:
    """Return the number in a string, as launch arguments have it."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def _check(options: Options) -> None:
    words = [(name, getattr(options, name)) for name in _FORMS]
    words += [('region', word) for word in options.regions]
    words += [('ec2_instance_type', word) for word in options.instance_types]
    for name, word in words:
        form, example = _FORMS[name]
        if word and not re.fullmatch(form, word):
            raise ConfigurationError(f"'{word}' can't be the {name} of a machine at AWS",
                                     f'it takes {example}')
    if options.arch not in _ARCHES:
        raise ConfigurationError(f"there are no machines of the architecture '{options.arch}'",
                                 'arch= takes x86_64 or arm64')
    if not 8 <= options.disk_size <= 65536:
        raise ConfigurationError(f'a disk can not have {options.disk_size} GB',
                                 'disk_size= takes 8 to 65536')
    for group in options.security_groups:
        if not re.fullmatch(r'sg-[0-9a-f]+', group):
            raise ConfigurationError(f"'{group}' is no id of a security group",
                                     'security_groups= takes sg-...')
    for network in options.ssh_from:
        cidr(network)
    for key, value in options.tags.items():
        if not 0 < len(key) <= 128 or len(value) > 256 or key.startswith(('aws:', 'fogros2-')):
            raise ConfigurationError(f"'{key}' can't be a tag",
                                     "tags are short, and 'aws:', 'fogros2-' begin others' names")
    if options.ami_image and options.regions:
        raise ConfigurationError('an image belongs to one region, and regions= names more',
                                 'leave ami_image= or regions= out')
    if options.subnet and (options.regions or options.region == NEAREST):
        raise ConfigurationError('a subnet belongs to one region', 'name that one with region=')


def _check_by_region(by_region: Mapping[str, Mapping[str, str]]) -> None:
    for name, values in by_region.items():
        if not values:
            raise ConfigurationError(f'{name} is an empty mapping',
                                     "write {'us-west-1': ...}, or leave it out")
        for region, value in values.items():
            if region == NEAREST or value == CHEAPEST:
                raise ConfigurationError(
                    f"{name}: a mapping can't have '{NEAREST}' or '{CHEAPEST}'",
                    'it takes names of regions, and a value for each')
            one: dict[str, Any] = {'region': region, name: value}
            _check(Options(**one))


def cidr(text: str) -> str:
    """
    Return an address or network in CIDR form.

    :raises ConfigurationError: it is neither.
    """
    try:
        return str(ipaddress.ip_network(text.strip(), strict=False))
    except ValueError as error:
        raise ConfigurationError(f"'{text}' is no address or network",
                                 "such as '198.51.100.7' or '198.51.100.0/24'") from error
