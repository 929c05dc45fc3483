# SPDX-License-Identifier: Apache-2.0
"""Defaults of machines in TOML files, of the user and of each sourced workspace."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
import contextlib
import dataclasses
import importlib
import os
from pathlib import Path
import re
from typing import Any, Optional, TYPE_CHECKING

from fogros2.describe import features, keywords, kinds, values
from fogros2.describe.machines import check_setting, CloudInstance, SETTINGS
from fogros2.errors import ConfigurationError, PrerequisiteError
from fogros2.host.workspace import find_workspaces
from fogros2.model import MachineSpec
from fogros2.store import check_owner

if TYPE_CHECKING:
    from launch import LaunchContext

    from fogros2.describe.overrides import Overrides

#: The file's name, in the user's folder of configurations and in a workspace.
FILE = 'fogros2.toml'


def files(environment: Mapping[str, str]) -> list[Path]:
    """Return the paths, whether or not they exist; a later one wins."""
    home = Path(environment.get('XDG_CONFIG_HOME') or '~/.config').expanduser()
    return [home / 'fogros2' / FILE,
            *(Path(folder) / FILE for folder in reversed(find_workspaces(environment)))]


def read(path: Path) -> dict[str, dict[str, Any]]:
    """
    Return the keywords in a file by provider, with '' for all providers.

    :raises ConfigurationError: the file cannot be read, or has a keyword that no machine has.
    :raises StoreError: the file belongs to another account.
    :raises PrerequisiteError: this Python cannot read TOML.
    """
    # not by Path: another account's folder may be closed to this one
    if not os.path.isfile(path):
        return {}
    tables: dict[str, dict[str, Any]] = {'': {}}
    for name, value in _parsed(check_owner(path)).items():
        if name in keywords.providers() and isinstance(value, dict):
            tables[name] = value
        else:
            tables[''][name] = value
    for provider, table in tables.items():
        allowed = {name: keyword for cls in _classes(provider)
                   for name, keyword in _allowed(cls).items()}
        for name, value in table.items():
            with values.named(str(path)):
                _check_name(provider, name, value, allowed)
                kinds.check({name: allowed[name]}, {name: value})
                if name in SETTINGS:
                    check_setting(name, value)
                features.own({name: value})
    return tables


def _classes(provider: str) -> Iterable[type[CloudInstance]]:
    """Return the classes of a provider's machines, '' for those of all providers."""
    return [keywords.machine_class(provider)] if provider else keywords.machine_classes()


def _check_name(provider: str, name: str, value: Any, allowed: Collection[str]) -> None:
    """
    Check that a file may set a keyword.

    :param provider: whose table has it, '' for the lines before the first table.
    :raises ConfigurationError: it may not.
    """
    if name in allowed:
        return
    if not provider and isinstance(value, dict):
        keywords.machine_class(name)
    for cls in _classes(provider):
        if name in keywords.keywords(cls):
            raise ConfigurationError(f"only a launch file can set '{name}'", 'take it out here')
    raise kinds.unknown(f'[{provider}]' if provider else 'a machine', name, allowed)


def check(environment: Mapping[str, str]) -> None:
    """
    Check all files.

    :raises FogError: one is wrong, or cannot be read.
    """
    for path in files(environment):
        read(path)


@contextlib.contextmanager
def named(environment: Mapping[str, str]) -> Iterator[None]:
    """Name the files that set an option in the error that a provider raises for the option."""
    try:
        yield
    except ConfigurationError as error:
        words = re.findall(r'\w+', str(error))
        setters = [f'{path} sets {name}' for path in files(environment)
                   for table in read(path).values() for name in table if name in words]
        error.hint = '; '.join(filter(None, [error.hint, *setters]))
        raise


def _parsed(path: Path) -> dict[str, Any]:
    for name in ('tomllib', 'tomli'):
        try:
            toml = importlib.import_module(name)
        except ModuleNotFoundError:
            continue
        try:
            parsed: dict[str, Any] = toml.loads(path.read_text('utf-8'))
        except (OSError, ValueError, RecursionError) as error:
            raise ConfigurationError(f"{path} can't be read: {error}",
                                     'it is TOML, such as: lifetime = "4h"') from error
        return parsed
    raise PrerequisiteError(f"Python 3.10 can't read {path}", 'pip install tomli')


def _allowed(cls: type[CloudInstance]) -> dict[str, kinds.Keyword]:
    """Return the keywords that a file may set: no machine has them by itself."""
    fixed = keywords.keywords(CloudInstance).keys() - features.keywords().keys() - {*SETTINGS}
    return {name: keyword for name, keyword in keywords.keywords(cls).items()
            if name in features.keywords() or keyword.default is None and name not in fixed}


def apply(
    spec: MachineSpec, given: Collection[str], environment: Mapping[str, str],
) -> MachineSpec:
    """
    Return a spec with defaults for what neither launch file nor command line says.

    :param given: the keywords of every machine that they say.
    :raises FogError: a file is wrong, or cannot be read.
    """
    wanted: dict[str, Any] = {}
    for path in files(environment):
        tables = read(path)
        allowed = _allowed(keywords.machine_class(spec.provider)) if tables else {}
        wanted.update({name: value for part in ('', spec.provider)
                       for name, value in tables.get(part, {}).items() if name in allowed})
    settings = {name: check_setting(name, value) for name, value in wanted.items()
                if name in SETTINGS and name not in given}
    # an empty text is what an argument of a launch file has without a value
    more = {name: wanted.pop(name) for name in [*wanted] if name in features.keywords()}
    options = {name: value for name, value in wanted.items()
               if name not in SETTINGS and spec.options.get(name, '') == ''}
    return dataclasses.replace(
        spec, options={**spec.options, **options},
        features=features.merged(features.by_feature(values.known(features.own(more))),
                                 spec.features), **settings)


def resolved(
    machine: CloudInstance, overrides: Optional[Overrides], context: LaunchContext,
) -> MachineSpec:
    """
    Return the spec of a machine by the launch file, the command line and the files of defaults.

    :raises FogError: a value is wrong, or a file cannot be read.
    """
    spec, settings = machine.spec(context), set(machine.settings)
    override = overrides.of(spec.name) if overrides is not None else None
    if override is not None:
        spec = override.instead(spec, context)
        settings.update(override.given)
    return apply(spec, settings, context.environment)
