# SPDX-License-Identifier: Apache-2.0
"""
Record topics of a machine in an MCAP file, without decoding the messages.

The format: https://mcap.dev, written by ``foxglove-sdk``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
import os
from pathlib import Path
import shutil
import sys
import time

import foxglove
from foxglove.mcap import MCAPWriteOptions
from rclpy.logging import get_logger
from rclpy.utilities import remove_ros_args

from fogros2_monitor.topics import GraphNode, LOOK, Topic
from image_transport_h264 import ending
from image_transport_h264.lazy import every

#: Bytes of the disk that stay free.
FREE = 1_000_000_000
#: Seconds until the node reports topics that are not there.
PATIENCE = 60.0


class DiskFull(Exception):
    """The recording would fill the machine's disk."""


class RecorderNode(GraphNode):
    """
    The node that records topics.

    :param path: of the file, which must not exist.
    :param names: of topics; they may appear later.
    """

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        super().__init__('fogros2_recorder')
        self._path = path
        self._names = names
        self._writer = foxglove.open_mcap(
            path, context=self.viewers, writer_options=MCAPWriteOptions(profile='ros2'))
        self._look()
        every(self, LOOK, self._tick)
        self._missing = every(self, PATIENCE, self._report_missing)
        self.get_logger().info(f'recording {", ".join(names)} to {path}')

    def destroy_node(self) -> None:
        """Complete the file, then destroy the node."""
        self._writer.close()
        super().destroy_node()

    def _chosen(self, everything: Iterable[str]) -> dict[str, str]:
        # of a denied topic, or a stream between machines, the graph has only the new name
        names = {name: self.resolve_topic_name(name) for name in self._names}
        # the file says of each topic what its publishers offer, so it takes one to begin
        return {name: full for name, full in names.items() if full in everything
                and (name in self._topics or self.count_publishers(full))}

    def _report_missing(self) -> None:
        self._missing.cancel()
        if missing := [name for name in self._names if name not in self._topics]:
            self.get_logger().warning(f'no topic of the names {", ".join(missing)} yet')

    def _added(self, topic: Topic) -> Topic:
        topic.look(0)
        return topic

    def _tick(self) -> None:
        if shutil.disk_usage(self._path.parent).free < FREE:
            raise DiskFull(f'less than {FREE / 1e9:g} GB are free: {self._path} ends here')
        self._look()


def main() -> int:
    """Record until a signal; return the exit status."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument('folder', help='of the file; ~ is the home of the user')
    parser.add_argument('topics', nargs='+')
    arguments = parser.parse_args(remove_ros_args(sys.argv)[1:])
    folder = Path(arguments.folder).expanduser()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f'{time.strftime("%Y%m%d-%H%M%S")}-{os.getpid()}.mcap'
    try:
        ending.run(lambda: RecorderNode(path, arguments.topics))
    except DiskFull as error:
        get_logger('fogros2_recorder').error(str(error))
        return 1
    return 0
