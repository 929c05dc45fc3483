# SPDX-License-Identifier: Apache-2.0
"""Options that the machines of every cloud have; a cloud's own dataclass adds to them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
import contextlib
import dataclasses
from decimal import Decimal
import ipaddress
import re
from typing import Any, ClassVar, Optional, TypeVar

from fogros2.errors import ConfigurationError
from fogros2.model import MachineSpec
from fogros2.provider.options import convert, parsed

NEAREST, CHEAPEST = 'nearest', 'cheapest'
#: Port of the SSH server of every machine.
SSH = 22
#: Ports from which Linux, and so a container engine, chooses free ones.
FREE_PORTS = (32768, 60999)
_ARCHES = {'': '', 'x86_64': 'x86_64', 'amd64': 'x86_64', 'arm64': 'arm64', 'aarch64': 'arm64'}
_PUBLIC_KEY = r'(ssh-|ecdsa-|sk-)[a-z0-9@.-]+ [A-Za-z0-9+/]+={0,2}( [^\r\n]*)?'
Own = TypeVar('Own', bound='VmOptions')


@dataclasses.dataclass(frozen=True)
class VmOptions:
    """
    Options of a virtual machine. A cloud's subclass adds its own, and sets the class variables.

    :class:`~fogros2.describe.machines_cloud.VmInstance` describes the options; '' and 0 stand for
    one that a launch file leaves out.

    :param region: name, or 'nearest'; '' for the region of the user's configuration.
    :param by_region: options with a value for each region, by name; ``in_region`` puts them into
        the other fields.
    """

    region: str = ''
    regions: tuple[str, ...] = ()
    disk_size: int = 30
    spot: bool = False
    arch: str = ''
    min_cpu: float = 0.0
    min_memory_gb: float = 0.0
    cpu_type: str = ''
    gpu: str = ''
    gpu_memory_gb: float = 0.0
    max_price: Optional[Decimal] = None
    tags: Mapping[str, str] = dataclasses.field(default_factory=dict)
    user: str = 'ubuntu'
    ssh_from: tuple[str, ...] = ()
    fleet: tuple[str, ...] = ()
    by_region: Mapping[str, Mapping[str, str]] = dataclasses.field(default_factory=dict)

    #: For messages, such as 'a machine at AWS'.
    WHAT: ClassVar[str]
    #: Names of the options for the type and for further types; the type that is the default.
    TYPE: ClassVar[str] = 'machine_type'
    TYPES: ClassVar[str] = 'machine_types'
    DEFAULT_TYPE: ClassVar[str]
    #: Options whose value may be a mapping with a value for each region.
    BY_REGION: ClassVar[tuple[str, ...]] = ()
    #: Name of the option for the image, '' if an image exists in every region.
    IMAGE: ClassVar[str] = ''
    #: Options that belong to one region, so that ``regions`` excludes them.
    IN_ONE_REGION: ClassVar[tuple[str, ...]] = ()
    #: By option, a regular expression that its value has to match, and an example.
    FORMS: ClassVar[Mapping[str, tuple[str, str]]] = {}
    DISK_SIZES: ClassVar[tuple[int, int]] = (8, 65536)
    #: Beginnings of tags that a launch file must not use.
    RESERVED: ClassVar[tuple[str, ...]] = ('fogros2-',)

    @classmethod
    def parse(cls: type[Own], given: Mapping[str, Any]) -> Own:
        """
        Return the options of a spec.

        :raises ConfigurationError: an option is unknown (with the nearest name) or wrong.
        """
        by_region = {name: convert(name, given[name], {}) for name in cls.BY_REGION
                     if isinstance(given.get(name), Mapping)}
        options = parsed(cls, {name: value for name, value in given.items()
                               if name not in by_region}, cls.WHAT, _value)
        options.check()
        options = dataclasses.replace(options, arch=_ARCHES[options.arch], by_region=by_region)
        for name, value in by_region.items():
            cls._check_mapping(name, value)
        if options.common_regions() == []:
            raise ConfigurationError(f'{" and ".join(by_region)} have no region in common',
                                     'give each a value for the same region')
        return options

    @classmethod
    def of(cls: type[Own], spec: MachineSpec) -> Own:
        """
        Return a spec's options, checked together with what all machines have.

        :raises ConfigurationError: they contradict each other.
        """
        options = cls.parse(spec.options)
        if options.spot and spec.on_exit == 'stop':
            raise ConfigurationError("a spot instance can't be stopped and started again",
                                     "on_exit='delete' or 'keep', or spot=False")
        if options.fleet and spec.on_exit != 'keep':
            raise ConfigurationError('robots of fleet= use the machine after the launch',
                                     "on_exit='keep'")
        return options

    def in_region(self: Own, region: str) -> Own:
        """
        Return the options with the values for a region.

        :raises ConfigurationError: an option by region has no value for this one.
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
        """Return the regions for which every option has a value; None if all regions do."""
        if not self.by_region:
            return None
        first, *others = self.by_region.values()
        return [region for region in first if all(region in values for values in others)]

    @property
    def named_type(self) -> str:
        """The type that the launch file names, 'cheapest', or ''."""
        return str(getattr(self, self.TYPE))

    @property
    def named_image(self) -> str:
        """The image that the launch file names, or ''."""
        return str(getattr(self, self.IMAGE)) if self.IMAGE else ''

    @property
    def further_types(self) -> Sequence[str]:
        """The types to try if the first has no capacity."""
        return tuple(getattr(self, self.TYPES))

    @property
    def types(self) -> list[str]:
        """All types to try, in this order."""
        return list(dict.fromkeys([self.named_type or self.DEFAULT_TYPE, *self.further_types]))

    @property
    def chooses_type(self) -> bool:
        """Whether the cheapest type that meets the requirements is used."""
        return self.named_type == CHEAPEST or not self.named_type and bool(
            self.min_cpu or self.min_memory_gb or self.cpu_type or self.gpu
            or self.gpu_memory_gb or self.arch)

    def check(self) -> None:
        """
        Check the values; a cloud's options override this, and call it.

        :raises ConfigurationError: a value is wrong.
        """
        for name, word in self._words():
            form, example = self.FORMS[name]
            if word and not re.fullmatch(form, word):
                raise ConfigurationError(f"'{word}' can't be the {name} of {self.WHAT}",
                                         f'it takes {example}')
        if self.arch not in _ARCHES:
            raise ConfigurationError(f"there are no machines of the architecture '{self.arch}'",
                                     'arch= takes x86_64 or arm64')
        least, most = self.DISK_SIZES
        if not least <= self.disk_size <= most:
            raise ConfigurationError(f'a disk can not have {self.disk_size} GB',
                                     f'disk_size= takes {least} to {most}')
        for network in self.ssh_from:
            cidr(network, 'ssh_from: ')
        if len(' '.join(self.ssh_from)) > 256:
            raise ConfigurationError('ssh_from= names too many networks for a tag',
                                     'name fewer, or larger ones')
        for key in self.fleet:
            if not re.fullmatch(_PUBLIC_KEY, key.strip()):
                raise ConfigurationError(f"'{key:.40}' is no public SSH key",
                                         "fleet= takes 'ssh-ed25519 AAAA...'")
        for key, value in self.tags.items():
            if not 0 < len(key) <= 128 or len(value) > 256 or key.startswith(self.RESERVED):
                first = ', '.join(f"'{word}'" for word in self.RESERVED)
                raise ConfigurationError(
                    f"'{key}' can't be a tag", f'tags are short and do not begin with {first}')
        if self.named_image and self.regions:
            raise ConfigurationError('an image belongs to one region, and regions= names more',
                                     f'leave {self.IMAGE}= or regions= out')
        for name in self.IN_ONE_REGION:
            if getattr(self, name) and (self.regions or self.region == NEAREST):
                raise ConfigurationError(
                    f'{name}= belongs to one region, and the launch may use others',
                    f'name one with region=, or leave {name}= or regions= out')

    def _words(self) -> Iterator[tuple[str, str]]:
        for name in self.FORMS:
            yield name, getattr(self, name)
        yield from (('region', word) for word in self.regions)
        yield from ((self.TYPE, word) for word in self.further_types)

    @classmethod
    def _check_mapping(cls, name: str, values: Mapping[str, str]) -> None:
        if not values:
            raise ConfigurationError(f'{name} is an empty mapping',
                                     "write {'us-west-1': ...}, or leave it out")
        for region, value in values.items():
            if region == NEAREST or value == CHEAPEST:
                raise ConfigurationError(
                    f"{name}: a mapping can't have '{NEAREST}' or '{CHEAPEST}'",
                    'it takes names of regions, and a value for each')
            one: dict[str, Any] = {'region': region, name: value}
            cls(**one).check()


def _value(name: str, value: Any, default: Any) -> Any:
    if name == 'ssh_from' and isinstance(value, str):
        value = (value,)
    if name == 'gpu' and isinstance(value, bool):
        return '1' if value else ''
    number = isinstance(default, float) or name in ('disk_size', 'max_price')
    if number and isinstance(value, str):
        with contextlib.suppress(ValueError):
            value = float(value)  # launch arguments are strings
    if name == 'max_price':
        return Decimal(repr(convert(name, value, 0.0)))
    if isinstance(default, float) and value == 0:
        return 0.0
    if name == 'disk_size' and isinstance(value, float) and value.is_integer():
        value = int(value)
    return convert(name, value, default)


def cidr(text: str, what: str = '') -> str:
    """
    Return an address or network in CIDR form.

    :param what: the beginning of the error.
    :raises ConfigurationError: it is neither.
    """
    try:
        return str(ipaddress.ip_network(text.strip(), strict=False))
    except ValueError as error:
        raise ConfigurationError(f"{what}'{text}' is no address or network",
                                 "such as '198.51.100.7' or '198.51.100.0/24'") from error


def ipv4(sources: Iterable[str]) -> list[str]:
    """Return the networks (CIDR) for machines that have no IPv6 address."""
    return sorted({cidr(source) for source in sources if ':' not in source})
