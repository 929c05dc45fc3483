# SPDX-License-Identifier: Apache-2.0
"""
Go on when a provider reclaims a machine, or a machine is lost: on the robot, or on a new machine.

``options`` has the values of the keywords. ``machine_state`` decides what follows for a machine,
``steps`` by which steps a new one replaces it. ``snapshots`` copies a folder of nodes to the robot
and back, ``checkpoints`` does so at intervals. ``replacer`` carries the steps out, and ``session``
moves the nodes.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import functools
import re
from typing import Optional, TYPE_CHECKING

from fogros2 import plan, plugin_system
from fogros2.errors import ConfigurationError
from fogros2.feature import contained, Feature, RunningMachine, used
from fogros2.model import CreateRequest, MachineSpec, NodeSpec
from fogros2_features.replacement.options import folder_of, Options, read, read_folder

if TYPE_CHECKING:
    from launch import SomeSubstitutionsType

    from fogros2.describe.machines import Scalar
    from fogros2_features.replacement.session import Interruptible


class Replacement(Feature):
    """``on_interrupt='replace'``: what happens to the nodes of a machine that ends."""

    # the default ends the launch at a notice, too
    always = True

    @staticmethod
    def options(
        on_interrupt: Optional[SomeSubstitutionsType] = None,
        on_loss_after: Optional[Scalar] = None,
        max_replacements: Optional[Scalar] = None,
        checkpoint: Optional[SomeSubstitutionsType] = None,
        checkpoint_interval: Optional[Scalar] = None,
    ) -> Options:
        """
        Return the options of a machine.

        :param on_interrupt: what to do when the provider reclaims the machine while its nodes run,
            or when neither the machine nor its provider has answered for 37 s.
            'shutdown', the default, waits for ``robot_timeout`` if that is longer, and ends the
            launch with a nonzero exit status. 'robot' restarts the nodes on the robot, where their
            programs must be installed. They keep names and parameters, and lose their memory:
            lifecycle states and loaded components. 'replace' creates a new machine; until it is
            up, nodes whose programs are installed on the robot run there.
        :param on_loss_after: silence after which 'replace' replaces the machine, in seconds or
            text such as '5m'; at least ``robot_timeout``, which is the default.
        :param max_replacements: how often 'replace' replaces the machine in a launch; 3.
        :param checkpoint: folder of its nodes, such as '$HOME/map', that a replacement takes over.
        :param checkpoint_interval: time between two copies of the folder to the robot.
        """
        return read({name: value for name, value in locals().items() if value is not None})

    @staticmethod
    def node_options(checkpoint: Optional[SomeSubstitutionsType] = None) -> str:
        """
        Return the folder of a node that a replacement of its machine takes over, '' for none.

        :param checkpoint: such as '$HOME/map'.
        """
        return read_folder(checkpoint)

    def check(self, spec: MachineSpec, own: Options) -> None:
        """Check that the machine can be replaced, and has stopped its nodes by then."""
        if 0 < own.on_loss_after < spec.robot_timeout:
            raise ConfigurationError(
                f'on_loss_after={own.on_loss_after:g} s is shorter than robot_timeout='
                f'{spec.robot_timeout:g} s: nodes may still run on a machine that is cut off',
                'raise on_loss_after, or lower robot_timeout')
        if own.checkpoint and not own.replaces:
            raise ConfigurationError(
                f"'{spec.name}' has a checkpoint, and nothing would restore it",
                "add on_interrupt='replace', or leave checkpoint= out")
        if own.replaces and not plugin_system.load(
                'fogros2.provider', spec.provider).capabilities.owned:
            raise ConfigurationError(
                f"'{spec.name}' is a computer that exists already: no launch can replace it",
                "use on_interrupt='robot' or 'shutdown'")
        _check_folder(spec, own.checkpoint)

    def check_node(self, spec: MachineSpec, node: NodeSpec, own: Options) -> None:
        """Check that something copies and restores the node's folder."""
        folder = folder_of(node)
        if folder and not own.replaces:
            raise ConfigurationError(
                f"a node of '{spec.name}' has a checkpoint, and nothing would restore it",
                "add on_interrupt='replace' to the machine, or leave checkpoint= out")
        if folder and contained(node.features):
            raise ConfigurationError(
                f"the checkpoint {folder} of a node on '{spec.name}' would be the machine's "
                "folder, and the node's image has its own",
                'give the machine the checkpoint, and mount the folder with image_options=')
        _check_folder(spec, folder)

    @contextlib.contextmanager
    def machine(self, running: RunningMachine, own: Options) -> Iterator[None]:
        """Set the silence after which the machine counts as lost."""
        if own.replaces:
            running.lose_after(own.on_loss_after or running.spec.robot_timeout)
        elif own.on_interrupt == 'shutdown':
            # as long as its nodes go on there, the launch may wait for the network
            running.bear_silence(running.spec.robot_timeout)
        yield

    def session(self, own: Options) -> functools.partial[Interruptible]:
        """Return what makes the session of a machine that may be interrupted."""
        from fogros2_features.replacement.session import Interruptible
        return functools.partial(Interruptible, own)


def _check_folder(spec: MachineSpec, folder: str) -> None:
    """
    Check that a volume has no files of a checkpoint, because the volume's are newer.

    :raises ConfigurationError: one has.
    """
    request = CreateRequest('', '', {}, 0)
    for each, own in used(spec) if folder else ():
        request = each.request(request, own)
    here = _of_home(folder)
    for name, (path, _) in request.with_volumes.items():
        there = _of_home(path)
        if plan.below(here, [there]) or plan.below(there, [here]):
            raise ConfigurationError(
                f"a replacement of '{spec.name}' gets the volume '{name}' at {path}, and the "
                f'checkpoint {folder} would write an older copy over it',
                'leave checkpoint= out, or use a folder beside the volume')


def _of_home(path: str) -> str:
    """Return a path as ``check_folder`` writes a path in a home."""
    return re.sub('^(/home/[^/]+|/root)(?=/|$)', '~', path)
