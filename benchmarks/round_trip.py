# SPDX-License-Identifier: Apache-2.0
"""DDS round trip between robot and machine, through the VPN and beside it, and here alone."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
import statistics
import subprocess
import sys
import time
from typing import Any

from figures import Row, write

#: Round trips of one measurement, after as many thrown away to warm up.
ROUNDS = 400
RUNS = 5
PERIOD = 0.004


def echo() -> None:
    """Send back on ``pong`` what comes on ``ping``."""
    import rclpy
    from std_msgs.msg import String

    rclpy.init()
    node = rclpy.create_node('echo')
    publisher = node.create_publisher(String, 'pong', 10)
    node.create_subscription(String, 'ping', publisher.publish, 10)
    rclpy.spin(node)


def measure() -> None:
    """Print the median round trip in milliseconds."""
    import rclpy
    from std_msgs.msg import String

    rclpy.init()
    node = rclpy.create_node('measure')
    publisher = node.create_publisher(String, 'ping', 10)
    sent: dict[str, float] = {}
    times: list[float] = []

    def back(message: Any) -> None:
        times.append(time.perf_counter() - sent.pop(message.data))

    node.create_subscription(String, 'pong', back, 10)
    deadline = time.monotonic() + 30
    while not (publisher.get_subscription_count() and node.count_publishers('pong')):
        rclpy.spin_once(node, timeout_sec=0.05)
        if time.monotonic() > deadline:
            raise SystemExit('nobody echoes')
    for number in range(2 * ROUNDS):
        text = str(number)
        sent[text] = time.perf_counter()
        publisher.publish(String(data=text))
        until = time.perf_counter() + 1.0
        while text in sent and time.perf_counter() < until:
            rclpy.spin_once(node, timeout_sec=0.2)
        time.sleep(PERIOD)
    lost = len(sent)
    print(statistics.median(times[-ROUNDS:]) * 1e3, lost)


def run_measure(environment: dict[str, str]) -> float:
    """Return the median round trip in ms, from a process with this environment."""
    said = subprocess.run(
        [sys.executable, __file__, '--measure'], check=True, capture_output=True, text=True,
        env={**os.environ, **environment}).stdout.splitlines()
    return float(said[-1].split()[0])  # Fast DDS warns on standard output


def main() -> None:
    """Measure through the VPN, over the bridge between robot and container, and here."""
    from fogros2.deploy import Launch
    from fogros2.model import Command, DdsInterface, MachineSpec, NodeSpec
    from fogros2.process import run as run_here
    from fogros2.provider.container import packet_filter

    launch = Launch()
    through, beside, here = [], [], []
    try:
        script = Path(__file__).read_text()
        machine, bare = (launch.up(MachineSpec(f'bench-rtt-{number}', 'container'))
                         for number in range(2))
        for one in (machine, bare):
            one.shell.put(script.encode(), '/tmp/bench/round_trip.py', mode=0o755)
            one.shell.put(b'class Row: ...\ndef write(): ...\n', '/tmp/bench/figures.py',
                          mode=0o644)
        # both ends admit DDS only through the VPN
        token = launch.store.load(bare.spec.name).token
        run_here(Command.script(
            packet_filter.unset(f'fogros2-{token}'), sudo=True), timeout=10.0)
        bare.shell.run(Command(('nft', 'delete', 'table', 'inet', bare.interface.name), sudo=True),
                       timeout=10.0)
        robot = launch.robot_environment()

        def node(name: str, environment: dict[str, str]) -> NodeSpec:
            return NodeSpec(name, name, environment=environment, arguments=(
                sys.executable, '/tmp/bench/round_trip.py', '--echo'))

        vendor = launch.dds()
        address = bare.machine.vpn_host
        # the same nodes, with the bridge's addresses instead of the VPN's
        bridge = subprocess.run(
            ['ip', '-o', 'route', 'get', address], check=True, capture_output=True,
            text=True).stdout.split()
        own, device = bridge[bridge.index('src') + 1], bridge[bridge.index('dev') + 1]
        folder = launch.store.launch_folder(launch.id)
        (folder / 'bridge.xml').write_text(vendor.render(
            [DdsInterface(device, 10), DdsInterface('lo')], [address]))
        bare.shell.put(vendor.render(
            [DdsInterface('eth0', 10), DdsInterface('lo')], [own]).encode(),
            '/tmp/bench/bridge.xml', mode=0o644)
        (folder / 'here.xml').write_text(vendor.render([DdsInterface('lo')], []))
        plain = dict(vendor.environment(str(folder / 'bridge.xml'), {}))
        local = dict(vendor.environment(str(folder / 'here.xml'), {}))
        for run in range(RUNS):
            machine.start([node(f'vpn-{run}', {})])
            through.append(run_measure(robot))
            machine.stop([f'vpn-{run}'])
            bare.start([node(f'bridge-{run}', dict(
                vendor.environment('/tmp/bench/bridge.xml', {})))])
            beside.append(run_measure(plain))
            bare.stop([f'bridge-{run}'])
            echoing = subprocess.Popen(
                [sys.executable, __file__, '--echo'], env={**os.environ, **local})
            try:
                here.append(run_measure(local))
            finally:
                echoing.terminate()
                echoing.wait()
    finally:
        launch.down()
    write('round_trip', 'DDS round trip, robot to machine and back', [
        Row.of('between two processes here', here, 'ms'),
        Row.of('to a container, without the VPN', beside, 'ms'),
        Row.of('to a container, through the VPN', through, 'ms'),
        Row.of('what the VPN adds', [one - other for one, other in zip(through, beside)], 'ms',
               0.4),
    ])


if __name__ == '__main__':
    parser = argparse.ArgumentParser()
    parser.add_argument('--echo', action='store_true')
    parser.add_argument('--measure', action='store_true')
    arguments = parser.parse_args()
    if arguments.echo:
        echo()
    elif arguments.measure:
        measure()
    else:
        main()
