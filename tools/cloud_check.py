# SPDX-License-Identifier: Apache-2.0
"""
Check a cloud account: create the smallest machine, run the talker there, delete everything.

    tools/run.sh best -- python tools/cloud_check.py PROVIDER [--options KEYWORD=VALUE,...]

The program prints what it will create and the price, and begins after a 'yes' at the terminal or
with YES=1. At the end it prints the cost and asks the provider whether anything is left.
"""

from __future__ import annotations

import argparse
from decimal import Decimal
import os
import re
import secrets
import signal
import subprocess
import sys
import threading
import time
from typing import Optional

from launch import LaunchContext

from fogros2 import deploy, plan
from fogros2.describe import overrides
from fogros2.errors import FogError
from fogros2.model import Machine, MachineSpec, MachineState
from fogros2.provider import Provider, TAG_NAME
from fogros2.runtime import cost

#: Keywords of the smallest machine that has room for ROS 2, and what else the provider creates.
SMALLEST = {
    'aws': ('ec2_instance_type=cheapest,min_cpu=2,min_memory_gb=2',
            'an EC2 instance with a 30 GB disk, a security group and a key pair'),
    'azure': ('vm_size=cheapest,min_cpu=2,min_memory_gb=2',
              'a resource group with a virtual machine, a 30 GB disk, a network and an address'),
    'gcp': ('machine_type=e2-medium',
            'a Compute Engine instance with a 30 GB disk, and three firewall rules'),
    'kubernetes': ('mcpu=500,mb=1024', 'a Job with a pod, and a Service for UDP'),
}
#: The machine ends itself after this time, even if this computer fails.
LIFETIME = '1h'
MESSAGES = 5
#: Seconds for all of it; a new EC2 instance installs ROS 2 first.
TIMEOUT = 2400.0


def main() -> int:
    """Run the check; 0 if the talker was heard and nothing is left."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('provider', choices=sorted(SMALLEST))
    parser.add_argument('--options', default='', metavar='KEYWORD=VALUE,...',
                        help='of the machine, such as region=eu-central-1')
    args = parser.parse_args()
    name = f'check-{secrets.token_hex(2)}'
    small, things = SMALLEST[args.provider]
    words = ','.join(filter(None, [
        f'{name}={args.provider}', small, f'lifetime={LIFETIME}', args.options]))
    try:
        provider = deploy.provider(args.provider)
        price = announce(provider, overrides.parse(words).machine(name).spec(LaunchContext()),
                         things)
        if not agreed():
            print('Nothing was created.')
            return 1
        begin = time.monotonic()
        heard, status = run(words, name)
        left = remaining(provider, name)
    except FogError as error:
        print(f'{parser.prog}: {error}', file=sys.stderr)
        return 1
    if price is not None:
        seconds = time.monotonic() - begin
        print(f'-- cost: at most ${cost.short(price * Decimal(seconds) / 3600)} '
              f'({seconds:.0f} s at {plan.price(price)}), disk and traffic aside')
    problems = [f'left at {args.provider}: {machine.id}' for machine in left]
    if status != 0:
        problems.append(f'the launch ended with status {status}')
    if heard < MESSAGES:
        problems.append(f'{heard} of {MESSAGES} messages arrived')
    for problem in problems:
        print(f'** {problem}', file=sys.stderr)
    if not problems:
        print(f'-- {args.provider} works: {heard} messages arrived, and nothing is left.')
    return 1 if problems else 0


def announce(provider: Provider, asked: MachineSpec, things: str) -> Optional[Decimal]:
    """
    Print what would be created and where, and return the price per hour in US dollars.

    :raises FogError: an option is wrong, or the provider refuses the credentials.
    """
    provider.check(asked)
    print(f'-- {provider.name}: {provider.answers()}')
    chosen = provider.resolve(asked)
    price = provider.cost_per_hour(chosen)
    print(f"-- creates '{asked.name}': {things}")
    print(f"   {', '.join(provider.choices(asked, chosen)) or asked.options}")
    print(f'   {plan.price(price)}, disk and traffic aside' if price is not None else
          '   the provider names no price; a pod costs what the node below it costs')
    print(f'-- runs the talker for {MESSAGES} messages, then deletes all of it')
    return price


def agreed() -> bool:
    """Return whether the user wants this: a 'yes' at the terminal, or YES=1."""
    if os.environ.get('YES') == '1':
        return True
    if not sys.stdin.isatty():
        print('There is no terminal to ask at: YES=1 begins without a question.')
        return False
    try:
        return input("Type 'yes' to begin: ").strip() == 'yes'
    except (EOFError, KeyboardInterrupt):
        print()
        return False


def run(words: str, name: str) -> tuple[int, int]:
    """
    Launch the talker on the machine; return the number of messages heard, and the exit status.

    :param words: the value of ``--machine``.
    """
    # an ignored SIGINT, as a background job has it, would be inherited and can't end a launch
    child = subprocess.Popen(
        ['ros2', 'launch', 'fogros2_examples', 'talker.container.launch.py', f'name:={name}',
         f'count:={MESSAGES}', '--machine', words],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors='replace',
        stdin=subprocess.DEVNULL, env={**os.environ, 'PYTHONUNBUFFERED': '1'},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler) and None)
    assert child.stdout is not None
    clock = threading.Timer(TIMEOUT, child.send_signal, [signal.SIGINT])
    clock.daemon = True
    clock.start()
    heard, ended = 0, False
    while not ended:
        try:
            for line in child.stdout:
                print(f'   {line}', end='', flush=True)
                heard += bool(re.search(rf'I heard: \[.* from {name} ', line))
            ended = True
        except KeyboardInterrupt:
            continue  # the launch got the Ctrl-C, too, and deletes the machine
    clock.cancel()
    return heard, child.wait()


def remaining(provider: Provider, name: str) -> list[Machine]:
    """Delete what the launch left of a machine, and return what is there even then."""
    if exists(provider, name):
        print(f"-- '{name}' is still there: deleting it")
        subprocess.run(['ros2', 'fog', 'delete', name, '--yes'], stdin=subprocess.DEVNULL)
    return exists(provider, name)


def exists(provider: Provider, name: str) -> list[Machine]:
    """Return the machines of that name at the provider."""
    return [machine for machine in provider.find({TAG_NAME: name})
            if machine.state is not MachineState.DELETED]


if __name__ == '__main__':
    sys.exit(main())
