# SPDX-License-Identifier: Apache-2.0
"""The context of a machine's deployment, of fakes: no machine, no network interface."""

from __future__ import annotations

from pathlib import Path
import threading
from typing import Any

from fogros2.dds.fastdds import FastDds
from fogros2.deploy.choosing import Choices
from fogros2.deploy.context import Context
from fogros2.deploy.robot_vpn import RobotVpn
from fogros2.deploy.running import RunningMachine
from fogros2.model import MachineSpec, VpnInterface
from fogros2.provider import Provider
from fogros2.report import Reporter, silent
from fogros2.store import Store
from fogros2.vpn import addresses
from fogros2.waiting import Timeouts
from fogros2_testing.fakes import FakeProvider, FakeVpn

ROBOT = VpnInterface('fog0a0b0c', '198.18.7.1', '198.18.7.0/24', 0, '/nowhere/key', firewall=True)


def job(
    folder: Path, spec: MachineSpec, *, provider: Provider | None = None,
    report: Reporter = silent, **changes: Any,
) -> tuple[Context, RunningMachine]:
    """
    Return the context and the job of a machine that is about to be deployed.

    :param folder: of the store.
    :param changes: of the context's other fields.
    """
    machines = provider or FakeProvider()
    failures: list[Any] = []
    cancel, ending = threading.Event(), threading.Event()
    fields: dict[str, Any] = {
        'launch_id': '0a0b0c', 'environment': {}, 'store': Store(folder), 'report': report,
        'failures': failures, 'timeouts': Timeouts(), 'cancel': cancel, 'ending': ending,
        'provider': machines, 'choices': Choices(lambda name: machines, report),
        'vpn': RobotVpn(ROBOT, FakeVpn(), report=report, timeout=30.0,
                        cancel=cancel, ending=ending,
                        choose_port=addresses.choose_port),
        'dds': FastDds(), **changes}
    context = Context(**fields)
    return context, RunningMachine(context, spec)
