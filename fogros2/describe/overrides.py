# SPDX-License-Identifier: Apache-2.0
"""Run machines elsewhere than the launch file says: ``--machine planner=container``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
import dataclasses
import fnmatch
from typing import Any, Optional, TYPE_CHECKING

from fogros2.describe import features, keywords, values
from fogros2.describe.kinds import unknown
from fogros2.errors import ConfigurationError, did_you_mean
from fogros2.feature import contained

if TYPE_CHECKING:
    from launch import LaunchContext

    from fogros2.describe.machines import CloudInstance
    from fogros2.model import MachineSpec

#: Keywords of every machine whose MachineSpec field has another name; None: no such field.
_FIELDS = {'ros_workspace': 'workspace', 'working_dir_base': None, 'name': None}
#: Prefix of the short form ``ssh:user@host:port``.
_SSH = 'ssh:'


@dataclasses.dataclass(frozen=True)
class Override:
    """
    Run one machine, or several, elsewhere.

    :param pattern: the machine's name; ``*`` matches anything.
    :param given: keywords of the provider's class, converted to their kinds.
    """

    pattern: str
    provider: str
    given: Mapping[str, Any]

    @property
    def on_robot(self) -> bool:
        """Whether the nodes run on the robot, without a machine."""
        return self.provider == keywords.ROBOT

    def instead(self, spec: MachineSpec, context: LaunchContext) -> MachineSpec:
        """
        Return the spec to use instead.

        Keywords of every machine are kept; options of a provider only with the same provider.
        """
        machine = self.machine(spec.name)
        if contained(spec.features):
            machine.takes_containers()
        described = machine.spec(context)
        before = spec.options if spec.provider == described.provider else {}
        common = {_FIELDS.get(name, name) for name in self.given
                  if name not in described.options and name not in features.keywords()}
        if 'workspace' in common:
            common.add('underlays')
        return dataclasses.replace(
            spec, provider=described.provider, options={**before, **described.options},
            features=features.merged(spec.features, described.features),
            **{field: getattr(described, field) for field in common if field is not None})

    def machine(self, name: str) -> CloudInstance:
        """
        Return a machine as the override alone describes it.

        :raises ConfigurationError: the override is wrong.
        """
        return keywords.make(self.provider, {**self.given, 'name': name})


class Overrides:
    """
    All overrides of a command line.

    :param texts: such as 'planner=aws,region=eu-west-1'.
    :raises ConfigurationError: see :func:`parse`.
    """

    def __init__(self, texts: Iterable[str]) -> None:
        self._overrides = [parse(text) for text in texts]

    def of(self, name: str) -> Optional[Override]:
        """Return the override of a machine: a name beats a pattern, a later one an earlier one."""
        for override in reversed(self._overrides):
            if override.pattern == name:
                return override
        return next((override for override in reversed(self._overrides)
                     if fnmatch.fnmatchcase(name, override.pattern)), None)

    def check(self, names: Iterable[str]) -> None:
        """
        Check that each override matches a machine of the launch.

        :raises ConfigurationError: an override matches none.
        """
        names = sorted(set(names))
        for override in self._overrides:
            if not any(fnmatch.fnmatchcase(name, override.pattern) for name in names):
                raise ConfigurationError(
                    f'--machine {override.pattern}=...: this launch has no machine of this name',
                    did_you_mean(override.pattern, names, all_too=True)
                    or 'it has no machine at all')


def parse(text: str) -> Override:
    """
    Parse an override: ``NAME=PROVIDER[,KEYWORD=VALUE]...``.

    ``ssh:user@host:port`` is short for ``ssh,host=host,user=user,port=port``. A value with commas
    is enclosed in brackets or braces, as a YAML list or mapping.

    :raises ConfigurationError: wrong syntax, an unknown provider or keyword, or a wrong value.
    """
    pattern, _, rest = text.partition('=')
    if not pattern.strip() or not rest.strip():
        raise ConfigurationError(
            f"--machine '{text}' lacks the name or the provider of a machine",
            f"write planner=container; there are: {', '.join(keywords.providers())}")
    provider, *settings = (part.strip() for part in _parts(rest))
    options: dict[str, Any] = {}
    if provider.startswith(_SSH):
        options.update(_computer(provider[len(_SSH):]))
        provider = 'ssh'
    parameters = keywords.keywords(keywords.machine_class(provider))
    for setting in settings:
        name, equals, value = (part.strip() for part in setting.partition('='))
        if not equals:
            raise ConfigurationError(f"--machine '{text}': '{setting}' is no keyword=value",
                                     'such as region=eu-west-1')
        if name == 'name':
            raise ConfigurationError(f"--machine '{text}': a machine keeps its name",
                                     'leave name= out, or change it in the launch file')
        if name not in parameters:
            raise unknown(f"a machine of the provider '{provider}'", name, parameters)
        options[name] = keywords.read(parameters[name], value)
    override = Override(pattern.strip(), provider, options)
    # report wrong values before the launch begins; the name does not matter
    override.machine('machine')
    return override


def _parts(text: str) -> Iterator[str]:
    """Split at commas, except inside brackets and braces."""
    depth, begin = 0, 0
    for at, character in enumerate(text):
        depth += (character in '[{') - (character in ']}')
        if character == ',' and depth == 0:
            yield text[begin:at]
            begin = at + 1
    yield text[begin:]


def _computer(text: str) -> dict[str, Any]:
    """Parse ``user@host:port``; an IPv6 address is enclosed in brackets."""
    user, at, host = text.rpartition('@')
    name, colon, port = host.rpartition(':')
    if not colon or host.endswith(']'):
        name, port = host, ''
    options = {'host': name.strip('[]'), 'user': user if at else None,
               'port': values.number(port) if port else None}
    return {key: value for key, value in options.items() if value is not None}
