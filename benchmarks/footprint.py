# SPDX-License-Identifier: Apache-2.0
"""What the agent takes of a machine's memory."""

from __future__ import annotations

from figures import Row, write

from fogros2.deploy import Launch
from fogros2.model import Command, MachineSpec, NodeSpec
from fogros2.waiting import wait_until

RUNS = 3


def resident() -> float:
    """Return the resident memory of an agent that runs a node, in MB."""
    launch = Launch()
    try:
        machine = launch.up(MachineSpec('bench-memory', 'container'))
        machine.start([NodeSpec('a', 'talker-1', 'fogros2_examples', 'talker')])
        wait_until(
            lambda: any(n['state'] == 'running' for n in machine.agent.request('status')['nodes']),
            timeout=30, what='the node')
        status = machine.shell.run(Command(('sh', '-c', (
            'for p in /proc/[0-9]*; do tr "\\0" " " <$p/cmdline | grep -q "agent.py serve" && '
            'grep VmRSS $p/status; done; true')), sudo=True), timeout=30).stdout
        # Linux says kB for 1024 bytes
        return max(float(line.split()[1]) for line in status.splitlines()) * 1024 / 1e6
    finally:
        launch.down()


def main() -> None:
    """Take the median."""
    write('footprint', "The agent's memory", [
        Row.of('agent, resident, one node running', [resident() for _ in range(RUNS)], 'MB',
               30.0)])


if __name__ == '__main__':
    main()
