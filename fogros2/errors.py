# SPDX-License-Identifier: Apache-2.0
"""
What can go wrong, one tree::

    FogError                     (a RuntimeError: ros2cli prints it as one line, exit status 1)
      ConfigurationError         the launch file, an argument or the environment is wrong
        WorkspaceError           the workspace that should travel isn't one, or lacks a package
      PrerequisiteError          this computer lacks a program, a right or a kernel feature
      ProviderError              a provider refused or failed
        MachineNotFound          no such machine (any more)
        Unsupported              the provider can't do this
        NameTaken                another launch or another robot has a machine of that name
      ShellError                 a machine can't be reached or a command there failed
        ConnectError             no route, refused, timed out
        HostKeyError             the machine isn't the one that was pinned
        AuthenticationError      the machine doesn't take our key
        CommandError             a command exited with a status other than zero
      VpnError
      DdsError
      AgentError                 the agent refused or vanished
        AgentAbsent              no agent listens on the machine, not yet or not any more
      StoreError                 local state can't be read or written
      DeadlineExceeded           a wait ran out of time
      Cancelled                  the launch was asked to end while this ran
"""

from __future__ import annotations

from collections.abc import Collection
import difflib
from typing import Optional, TYPE_CHECKING

if TYPE_CHECKING:
    from fogros2.model import Command, Result


class FogError(RuntimeError):
    """
    A failure with a known cause.

    :param message: what failed, where and why, in one line.
    :param hint: what to do about it, in one line; may be empty.
    """

    #: Set by who was asked to make something: nothing was made, and there is nothing to look for.
    refused: bool = False
    #: Resources that the failed step could not clean up; reported with the error.
    undo_failures: tuple[FogError, ...] = ()

    def __init__(self, message: str, hint: str = '') -> None:
        super().__init__(message)
        self.hint = hint

    def __str__(self) -> str:
        message = str(self.args[0])
        return f'{message} ({self.hint})' if self.hint else message


class ConfigurationError(FogError):
    """The launch file, an argument or the environment is wrong."""


class WorkspaceError(ConfigurationError):
    """The workspace that should travel isn't one, or lacks a package."""


class PrerequisiteError(FogError):
    """This computer lacks a program, a right or a kernel feature."""


class ProviderError(FogError):
    """A provider refused or failed."""


class MachineNotFound(ProviderError):
    """No such machine, or no longer."""


class Unsupported(ProviderError):
    """The provider can't do this."""


class NameTaken(ProviderError):
    """Another launch or another robot has a machine of that name."""


class ShellError(FogError):
    """A machine can't be reached, or a command there failed."""


class ConnectError(ShellError):
    """No route, refused, timed out, or lost."""


class HostKeyError(ShellError):
    """The machine that answered isn't the one that was pinned."""


class AuthenticationError(ShellError):
    """The machine doesn't take our key."""


class CommandError(ShellError):
    """
    A command exited with a status other than zero.

    :param where: the machine's name, or 'this computer'.
    """

    def __init__(self, command: Command, result: Result, where: str, hint: str = '') -> None:
        tail = (result.stderr.strip() or result.stdout.strip()).splitlines()[-3:]
        what = command.what or ' '.join(command.argv)[:120]
        message = f'{what} failed on {where} with exit status {result.returncode}'
        super().__init__(f"{message}: {' / '.join(tail)}" if tail else message, hint)
        self.command = command
        self.result = result


class VpnError(FogError):
    """The VPN can't be set up, or doesn't carry."""


class DdsError(FogError):
    """DDS can't be configured as asked."""


class AgentError(FogError):
    """The agent on the machine refused a command, or vanished."""


class AgentAbsent(AgentError):
    """No agent listens on the machine, not yet or not any more."""


class StoreError(FogError):
    """Local state can't be read or written."""


class DeadlineExceeded(FogError):
    """A wait ran out of time."""


class Cancelled(FogError):
    """The launch was asked to end while this ran."""

    def __init__(self, what: str = 'the deployment', hint: Optional[str] = None) -> None:
        super().__init__(f'{what} was cancelled', hint or '')


def did_you_mean(
    name: str, known: Collection[str], otherwise: Optional[str] = None, *,
    all_too: bool = False, cutoff: float = 0.6,
) -> str:
    """
    Return a hint for an unknown name: the nearest known one.

    :param otherwise: the hint where none is near; None for all known names.
    :param all_too: whether all known names follow the nearest.
    :param cutoff: how near a name has to be, from 0 to 1; see ``difflib``.
    """
    every = f"there are: {', '.join(known)}" if known else ''
    near = difflib.get_close_matches(name, known, n=1, cutoff=cutoff)
    if not near:
        return every if otherwise is None else otherwise
    return f"did you mean '{near[0]}'?{f' {every}' if all_too else ''}"
