# SPDX-License-Identifier: Apache-2.0
"""What the steps of one machine use and do not change."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
import dataclasses
import shutil
import threading
from typing import Optional

from fogros2 import plan
from fogros2.dds import DdsVendor
from fogros2.deploy.choosing import Choices
from fogros2.deploy.robot_vpn import RobotVpn
from fogros2.errors import FogError, PrerequisiteError
from fogros2.feature import contained
from fogros2.host import workspace
from fogros2.model import NodeSpec, OtherVpn
from fogros2.provider import Capabilities, Provider
from fogros2.report import Reporter
from fogros2.store import Store
from fogros2.waiting import Timeouts


@dataclasses.dataclass(frozen=True)
class Context:
    """
    What the steps of one machine use; only the machine's number and nodes are its own.

    :param launch_id: of the launch.
    :param environment: the user's environment variables.
    :param failures: errors of undo steps.
    :param cancel: when set, every wait of the deployment raises Cancelled.
    :param ending: set when the launch is on its way down.
    :param vpn: the robot's VPN interface; it need not be up.
    :param index: the machine's number in the VPN.
    :param others: returns the VPN addresses of the other machines that are known now.
    :param nodes: that are known to run on the machine.
    :param other_vpn: the VPN of another robot in which the machine is; None: the launch's.
    :param shorten_others: shortens the lifetimes of the launch's other machines where features
        allow less since this machine costs, too.
    """

    launch_id: str
    environment: Mapping[str, str]
    store: Store
    report: Reporter
    failures: list[FogError]
    timeouts: Timeouts
    cancel: threading.Event
    ending: threading.Event
    provider: Provider
    choices: Choices
    vpn: RobotVpn
    dds: DdsVendor
    index: int = 0
    others: Callable[[], Sequence[str]] = tuple
    nodes: Sequence[NodeSpec] = ()
    other_vpn: Optional[OtherVpn] = None
    shorten_others: Callable[[], None] = lambda: None

    @property
    def capabilities(self) -> Capabilities:
        """What the machine's provider can do."""
        return self.provider.capabilities

    @property
    def packages(self) -> list[str]:
        """The packages of the known programs."""
        return sorted({package for package, _ in programs_of(self.nodes)})

    def underlay(self, workspaces: Sequence[str]) -> plan.Underlay:
        """
        Return the paths of the robot's ROS 2 and of workspaces; the first need not be sourced.

        :raises PrerequisiteError: the robot has no ROS 2.
        """
        ros2 = shutil.which('ros2', path=self.environment.get('PATH'))
        if ros2 is None:
            raise PrerequisiteError('ros2 is not on PATH', "source ROS 2's setup.bash")
        return plan.underlay(
            workspace.sourced(next(iter(workspaces), None), self.environment), workspaces, ros2)


def programs_of(nodes: Iterable[NodeSpec]) -> list[tuple[str, str]]:
    """Return the (package, executable) pairs of nodes, without those in containers."""
    return sorted({(node.package, node.executable) for node in nodes
                   if node.package and not contained(node.features)})
