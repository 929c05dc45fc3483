# SPDX-License-Identifier: Apache-2.0
"""
Run the demo's launch file for some messages, and prove what it did.

The listener runs here and the talker on a container machine, started by the launch file. At the
end: how long each step took, the round trip through the VPN, where the talker ran, and that
nothing of it is left on this computer.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import dataclasses
import json
import os
from pathlib import Path
import re
import secrets
import signal
import subprocess
import sys
import threading
import time
from typing import Optional

LAUNCH_FILE = ('fogros2_examples', 'talker.container.launch.py')
HEARD = re.compile(r'I heard: \[.* from (\S+) \(([0-9a-fA-F.:]+)\): \d+\]')
STEP = re.compile(r'\[fogros2\]: (\S+): (.+?)(?: failed after)? ([0-9.]+) s(?:: .*| \((.*)\))?$')
COLOUR = re.compile(r'\x1b\[[0-9;]*m')


@dataclasses.dataclass
class Run:
    """What a run of the launch file showed."""

    begin: float
    hosts: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    first: Optional[float] = None
    steps: list[tuple[str, str, str]] = dataclasses.field(default_factory=list)
    status: dict[str, object] = dataclasses.field(default_factory=dict)
    returncode: int = 1


def say(text: str = '') -> None:
    """Print a line of the demo's own."""
    print(f'-- {text}' if text else '', flush=True)


def main() -> int:
    """Run the demo; 0 if all of it went as it should."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--count', type=int, default=20, help='messages to wait for')
    parser.add_argument('--timeout', type=float, default=300.0, help='seconds for all of it')
    args = parser.parse_args()
    name = f'talker-{secrets.token_hex(2)}'
    words = ['ros2', 'launch', *LAUNCH_FILE, f'count:={args.count}', f'name:={name}']
    say(' '.join(words))
    before = set(traces())
    run = launch(words, name, args.count, args.timeout)
    say()
    say('Steps')
    for where, step, seconds in run.steps:
        print(f'   {where:16}  {step:24}  {seconds:>6} s')
    problems = [*judge(run, args.count)]
    left = sorted(new for new in set(traces()) - before if is_ours(new, name, run))
    problems += [f'left behind: {trace}' for trace in left]
    if not left:
        print('   nothing is left: no container, interface, route, firewall table, process or '
              'file of this launch')
    for problem in problems:
        print(f'** {problem}', file=sys.stderr)
    say('The demo failed.' if problems else 'Done.')
    return 1 if problems else 0


def launch(words: list[str], name: str, count: int, timeout: float) -> Run:
    """Run the launch file and show its output; the status is asked half-way."""
    run = Run(time.monotonic())
    # an ignored SIGINT, as a background job has it, would be inherited and can't end a launch
    child = subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors='replace',
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler) and None,
        env={**os.environ, 'PYTHONUNBUFFERED': '1'}, stdin=subprocess.DEVNULL)
    asked: Optional[threading.Thread] = None
    clock = threading.Timer(timeout, child.send_signal, [signal.SIGINT])
    clock.daemon = True
    clock.start()
    assert child.stdout is not None
    try:
        for line in child.stdout:
            print(f'   {line}', end='', flush=True)
            plain = COLOUR.sub('', line.rstrip())
            if found := STEP.search(plain):
                run.steps.append((found[1], found[2], found[3]))
            if found := HEARD.search(plain):
                run.first = run.first or time.monotonic() - run.begin
                run.hosts.append((found[1], found[2]))
                if len(run.hosts) == max(1, count // 4):
                    asked = threading.Thread(target=ask, args=(name, run))
                    asked.start()
    except KeyboardInterrupt:
        # the launch has got it as well: let it clean up
        for line in child.stdout:
            print(f'   {line}', end='', flush=True)
    run.returncode = child.wait()
    clock.cancel()
    if asked is not None:
        asked.join(30)
    return run


def ask(name: str, run: Run) -> None:
    """Ask the machine's status while the talker talks."""
    said = subprocess.run(['ros2', 'fog', 'status', name, '--json'], capture_output=True,
                          text=True, timeout=30)
    try:
        run.status.update(json.loads(said.stdout))
    except ValueError:
        print(said.stderr, end='', file=sys.stderr)


def judge(run: Run, count: int) -> Iterator[str]:
    """Print what was shown, yield what was not."""
    say()
    say('What happened')
    if run.returncode != 0:
        yield f'the launch ended with status {run.returncode}'
    if len(run.hosts) < count:
        yield f'{len(run.hosts)} messages arrived, not {count}'
    if run.first is not None:
        print(f'   first message {run.first:.1f} s after the command, {len(run.hosts)} in all')
    vpn = run.status.get('vpn')
    if isinstance(vpn, dict) and vpn.get('latency') is not None:
        print(f"   VPN round trip {vpn['latency']:.2f} ms (median of 5 pings to "
              f"{vpn['address']} through {vpn['interface']})")
    else:
        yield 'the round trip through the VPN could not be measured'
    here = os.uname().nodename
    own = re.findall(r'inet6? ([0-9a-f.:]+)', output('ip', '-o', 'addr'))
    for host, address in sorted(set(run.hosts)):
        print(f'   the talker ran on {host} ({address}); this is {here}')
        if host == here or address in own:
            yield f'the talker ran on this computer ({host}, {address})'


def traces() -> Iterator[str]:
    """Yield everything that a launch could leave on this computer."""
    for engine in ('podman', 'docker'):
        for line in output(engine, 'ps', '-a', '--format', '{{.ID}} {{.Names}}',
                           root=True).splitlines():
            yield f'container {line}'
    for line in output('ip', '-o', 'link').splitlines():
        yield f'interface {line.split(": ")[1].split("@")[0]}'
    for line in output('ip', 'route', 'show', 'table', 'all').splitlines():
        yield f'route {line.strip()}'
    for line in output('nft', 'list', 'tables', root=True).splitlines():
        yield f'firewall {line}'
    for entry in Path('/proc').iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / 'cmdline').read_text(errors='replace').replace('\0', ' ').strip()
            except OSError:
                continue
            if words and int(entry.name) != os.getpid():
                yield f'process {entry.name} {words}'
    state = os.environ.get('FOGROS2_STATE_HOME') or os.path.join(
        os.environ.get('XDG_STATE_HOME') or os.path.expanduser('~/.local/state'), 'fogros2')
    for folder in (Path(state), Path('/var/lib/fogros2'), Path('/run/fogros2'),
                   Path('/run/wireguard')):
        if os.access(folder, os.R_OK | os.X_OK):
            for path in folder.rglob('*'):
                yield f'file {path}'


def is_ours(trace: str, name: str, run: Run) -> bool:
    """Tell this launch's traces from those of others at work on this computer."""
    launch_id = str(run.status.get('launch') or '')
    if name in trace or (launch_id and launch_id in trace):
        return True
    machine_id = str(run.status.get('id') or '')
    parts = [part for part in machine_id.split(':')[1:] if len(part) >= 12]
    return any(part in trace for part in parts)


def output(*words: str, root: bool = False) -> str:
    """Return a command's output, '' if it can't be run."""
    if root and os.geteuid() != 0:
        words = ('sudo', '-n', *words)
    environment = {**os.environ, 'PATH': f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"}
    try:
        return subprocess.run(words, capture_output=True, text=True, timeout=30,
                              env=environment, stdin=subprocess.DEVNULL).stdout
    except (OSError, subprocess.TimeoutExpired):
        return ''


if __name__ == '__main__':
    sys.exit(main())
