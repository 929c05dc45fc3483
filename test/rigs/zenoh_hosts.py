# SPDX-License-Identifier: Apache-2.0
"""Routers and sessions of zenoh on the hosts of ``vpn_lab``, with a launch's configurations."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
import sys
from typing import Optional

from fogros2.dds.zenoh import Zenoh
from rigs.vpn_lab import Child, Lab

NODE = Path(__file__).parents[1] / 'integration/vpn/zenoh_node.py'


class Hosts:
    """Starts routers and sessions on the lab's hosts, as a launch does or without one."""

    def __init__(self, lab: Lab, folder: Path) -> None:
        self.lab = lab
        self.folder = folder
        self.dds = Zenoh()

    def address(self, host: str) -> str:
        return self.lab.interfaces[host].address

    def router(self, host: str, *others: str, user: Optional[Mapping[str, str]] = None) -> Child:
        made = self.dds.router(self.address(host), [self.address(one) for one in others], user)
        assert made is not None
        path = self.folder / f'{host}.router.json5'
        path.write_text(made.config)
        return self._start(host, 'router', **{made.variable: str(path)})

    def node(self, host: str, *words: str) -> Child:
        path = self.folder / f'{host}.json5'
        path.write_text(self.dds.render(self.dds.machine_interfaces(self.address(host)), ()))
        return self._start(host, *words, **self.dds.environment(str(path), {}))

    def stock(self, host: str, *words: str) -> Child:
        """Start what knows nothing of FogROS2."""
        return self._start(host, *words)

    def users_router(self, host: str, endpoint: str = '') -> Child:
        """Start rmw_zenoh's own router, which connects to another one."""
        path = self.folder / f'{host} own.json5'
        # the files of shared memory would stay
        path.write_text('{mode: "router", listen: {endpoints: ["tcp/[::]:7447"]},'
                        f' connect: {{endpoints: [{endpoint}]}},'
                        ' transport: {shared_memory: {enabled: false}}}')
        return self._start(host, 'router', ZENOH_ROUTER_CONFIG_URI=str(path))

    def _start(self, host: str, *words: str, **environment: str) -> Child:
        child = self.lab.start(host, [sys.executable, str(NODE), *words], **environment)
        child.wait('ready', timeout=60.0)
        return child
