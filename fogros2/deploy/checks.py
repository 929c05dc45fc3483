# SPDX-License-Identifier: Apache-2.0
"""Checks of machine specs that cost nothing, made before anything is created."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import contextlib
from typing import Optional

from fogros2 import feature, plan
from fogros2 import shell as shells
from fogros2.errors import ConfigurationError, FogError
from fogros2.host import bootstrap, undeclared, workspace
from fogros2.host.programs import check_program
from fogros2.model import MachineSpec
from fogros2.provider import Provider
from fogros2.report import Reporter
from fogros2.store import check_name


def check_names(specs: Sequence[MachineSpec]) -> None:
    """
    Check that machines have valid and different names.

    :raises ConfigurationError: they have not.
    """
    names = [spec.name for spec in specs]
    for name in names:
        check_name(name)
        if names.count(name) > 1:
            raise ConfigurationError(f"two machines of this launch have the name '{name}'",
                                     'give each a name= of its own')


def check_here(
    spec: MachineSpec, provider: Provider, programs: Sequence[tuple[str, str]],
    environment: Mapping[str, str],
) -> None:
    """
    Check what this computer has for a machine, without a right that it has to ask for.

    :param programs: the (package, executable) pairs that will run there, as far as known.
    :raises FogError: the first problem that was found, with its remedy.
    """
    shells.warm(provider.capabilities.shell_kind)
    if not provider.has_own_packages(spec):
        for package, executable in programs:
            check_program(
                package, executable, plan.ament_prefixes(environment), spec.workspace)
    check_stop(spec, provider)
    provider.check_here(spec)


def check_stop(spec: MachineSpec, provider: Provider) -> None:
    """
    Check that a machine can be stopped, if ``on_exit`` says so; of 'cheapest', when it is chosen.

    :raises ConfigurationError: it cannot.
    """
    can = provider.capabilities
    if spec.on_exit == 'stop' and not (can.stop or can.places):
        raise ConfigurationError(
            f"the provider '{spec.provider}' can't stop '{spec.name}' and start it again",
            f"use on_exit='keep', or 'delete'{'' if can.owned else ' to leave nothing there'}")


def check(
    spec: MachineSpec, provider: Provider, *, environment: Mapping[str, str],
    programs: Sequence[tuple[str, str]], report: Reporter,
) -> None:
    """
    Check a machine's options, rights and features; report undeclared packages.

    :param environment: the user's environment variables.
    :param programs: the (package, executable) pairs that will run there.
    :raises FogError: the first problem that was found, with its remedy.
    """
    shells.warm(provider.capabilities.shell_kind)
    check_stop(spec, provider)
    provider.check(spec)
    for each, own in feature.used(spec):
        each.check(spec, own)
    chain = [workspace.inspected(path) for path in spec.workspaces]
    # a step that cannot do without reports what is wrong
    with contextlib.suppress(FogError, OSError):
        warned = undeclared.warning(
            spec, chain, {package for package, _ in programs},
            plan.ament_prefixes(environment), provider.shared_folders(spec))
        if warned:
            report(warned)


def check_together(specs: Sequence[MachineSpec]) -> None:
    """
    Check the machines of a launch, with all choices made, against each other.

    :raises FogError: a feature can't work on all of them.
    """
    for spec in specs:
        for each, own in feature.used(spec):
            each.check_beside(spec, [other for other in specs if other is not spec], own)


def check_architecture(spec: MachineSpec, provider: Provider) -> None:
    """
    Check that wheels and workspace fit the processor of a machine with all choices made.

    :raises WorkspaceError: the workspace is compiled for another processor.
    """
    if spec.workspace is None and spec.bootstrap not in ('pip', 'apt'):
        return  # only the machine's system decides
    architecture: Optional[str] = provider.architecture(spec)
    if architecture:
        bootstrap.check_architecture(
            spec, architecture,
            workspace.inspected(spec.workspace) if spec.workspace else None)
