# SPDX-License-Identifier: Apache-2.0
"""
The tree of all errors with a known cause::

    FogError                     (a RuntimeError: ros2cli prints it as one line, exit status 1)
      ConfigurationError         the launch file, an argument or the environment is wrong
        WorkspaceError           the workspace to send is not one, or lacks a package
      PrerequisiteError          this computer lacks a program, a right or a kernel feature
      ProviderError              a provider refused or failed
        MachineNotFound          the machine does not exist (any more)
        Unsupported              the provider cannot do this
        NameTaken                another launch or another robot has a machine of that name
      ShellError                 a machine cannot be reached, or a command there failed
        ConnectError             no route, refused, timed out, or lost
        HostKeyError             the machine's host key is not the pinned one
        AuthenticationError      the machine does not accept our key
        CommandError             a command exited with a status other than zero
      VpnError
      DdsError
      AgentError                 the agent refused or vanished
        AgentAbsent              no agent listens on the machine (yet, or any more)
      StoreError                 local state cannot be read or written
      DeadlineExceeded           a wait has timed out
      Cancelled                  the launch was asked to end during this
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
import contextlib
import difflib
from typing import Optional, TYPE_CHECKING

from fogros2.untrusted import clean

if TYPE_CHECKING:
    from fogros2.model import Command, Result


class FogError(RuntimeError):
    """
    A failure with a known cause.

    :param message: what failed, where and why, in one line; may contain text of a machine.
    :param hint: the remedy, in one line; may be empty.
    """

    #: Set by a provider's ``create``. True: nothing was created. False: no answer came, so a
    #: machine may exist or may still appear. None: unknown, so the launch searches once.
    refused: Optional[bool] = None
    #: Set by a provider's ``create``: another region or cloud may have capacity.
    no_capacity: bool = False
    #: Resources that the failed step could not clean up; reported with the error.
    undo_failures: tuple[FogError, ...] = ()

    def __init__(self, message: str, hint: str = '') -> None:
        super().__init__(clean(message))
        self.hint = clean(hint)

    def __str__(self) -> str:
        message = str(self.args[0])
        return f'{message} ({self.hint})' if self.hint else message


class ConfigurationError(FogError):
    """The launch file, an argument or the environment is wrong."""


class WorkspaceError(ConfigurationError):
    """The workspace to send is not one, or lacks a package."""


class PrerequisiteError(FogError):
    """This computer lacks a program, a right or a kernel feature."""


class ProviderError(FogError):
    """A provider refused or failed."""


class MachineNotFound(ProviderError):
    """The machine does not exist, or no longer exists."""


class Unsupported(ProviderError):
    """The provider cannot do this."""


class NameTaken(ProviderError):
    """Another launch or another robot has a machine of that name."""


class ShellError(FogError):
    """A machine cannot be reached, or a command there failed."""


class ConnectError(ShellError):
    """No route, refused, timed out, or lost."""


class HostKeyError(ShellError):
    """The machine's host key is not the pinned one."""


class AuthenticationError(ShellError):
    """The machine does not accept our key."""


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
        self.where = where


class VpnError(FogError):
    """The VPN cannot be set up, or carries no packets."""


class DdsError(FogError):
    """DDS cannot be configured as requested."""


class AgentError(FogError):
    """The agent on the machine refused a request, or vanished."""


class AgentAbsent(AgentError):
    """No agent listens on the machine, not yet or no longer."""


class StoreError(FogError):
    """Local state cannot be read or written."""


class DeadlineExceeded(FogError):
    """A wait has timed out."""

    refused = False


class Cancelled(FogError):
    """The launch was asked to end during this."""

    refused = False

    def __init__(self, what: str = 'the deployment') -> None:
        super().__init__(f'{what} was cancelled')


@contextlib.contextmanager
def naming(machine: str) -> Iterator[None]:
    """Put a machine's name, if it has one, before the message of an error without the name."""
    try:
        yield
    except FogError as error:
        message = str(error.args[0])
        if machine and f"'{machine}'" not in message and not message.startswith(f'{machine}: '):
            error.args = (f'{machine}: {message}',)
        raise


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
