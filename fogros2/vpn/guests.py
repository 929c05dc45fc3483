# SPDX-License-Identifier: Apache-2.0
"""
Keep the guests of a machine's VPN interface: computers that an invitation admits as peers.

A guest whose invitation has expired stays while it is connected. It is removed after ``patience``
seconds without a handshake; a connected peer makes one at least each 2 minutes. Times are seconds
since boot, because a machine's clock may be set while it runs.

Two files in ``/run`` belong to root: ``NAME.guests.json`` is the list, ``NAME.guests`` the same as
peers for ``wg``. The first line of the latter says when the list has to be looked at again. So the
health check starts no Python before.

Runs as python3 -c SOURCE NAME VERB, where NAME is the interface, with a request as JSON on the
standard input; prints the list. Imports nothing of fogros2.

``admit``   ``key``, ``label``, ``seconds``, ``patience``, ``addresses`` to choose from
``remove``  ``keys``, or null for all
``look``    removes those whose time is over
"""

from __future__ import annotations

import fcntl
import json
import os
from pathlib import Path
import subprocess
import sys
from typing import Any

#: Seconds between two looks at a guest that is connected beyond its invitation.
INTERVAL = 10.0

Guest = dict[str, Any]


def heard(guests: list[Guest], handshakes: dict[str, int], now: float) -> None:
    """Note when each guest was heard: when its last handshake is another than before."""
    for guest in guests:
        last = handshakes.get(guest['key'], 0)
        if last and last != guest['handshake']:
            guest.update(handshake=last, heard=now)


def admitted(guests: list[Guest], request: dict[str, Any], now: float) -> list[Guest]:
    """
    Return the list with one more guest, at the first free address; a known key keeps its address.

    :raises SystemExit: there is no free address.
    """
    others = [guest for guest in guests if guest['key'] != request['key']]
    known = [guest for guest in guests if guest['key'] == request['key']]
    taken = {guest['address'] for guest in others}
    free = [address for address in request['addresses'] if address not in taken]
    if not free:
        sys.exit(f'{len(taken)} guests are as many as a machine can have')
    return [*others, {
        **(known[0] if known else {'address': free[0], 'handshake': 0, 'heard': None}),
        'key': request['key'], 'label': request['label'], 'until': now + request['seconds'],
        'patience': request['patience']}]


def due(guest: Guest) -> float:
    """Return when a guest's time is over, in seconds since boot, unless it is heard again."""
    until: float = guest['until']
    return until if guest['heard'] is None else max(until, guest['heard'] + guest['patience'])


def rendered(guests: list[Guest], now: float) -> str:
    """Return the guests as peers for ``wg``; the first line says when to look at them again."""
    again = min((guest['until'] if guest['until'] > now else now + INTERVAL for guest in guests),
                default=0)
    return '\n'.join([f'# {int(again) + 1}', *(
        f"[Peer]\nPublicKey = {guest['key']}\nAllowedIPs = {guest['address']}/32"
        for guest in guests), ''])


def write(path: Path, text: str) -> None:
    """Replace a file of root's, which nobody else can read."""
    aside = path.with_name(f'{path.name}.new')
    aside.unlink(missing_ok=True)
    with open(os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), 'w') as file:
        file.write(text)
    aside.replace(path)


def main(name: str, verb: str, folder: Path = Path('/run')) -> None:
    """Run one request, and print the guests that there are afterwards."""
    config, state = folder / f'{name}.guests', folder / f'{name}.guests.json'
    if verb == 'look' and not state.exists():
        print('[]')  # there never was one
        return
    with open(folder / f'{name}.guests.lock', 'a') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        now = float(Path('/proc/uptime').read_text().split()[0])  # the health check's clock
        before = json.loads(state.read_text()) if state.exists() else []
        output = subprocess.run(('wg', 'show', name, 'latest-handshakes'), check=True,
                                stdout=subprocess.PIPE, text=True).stdout
        heard(before, {key: int(at) for key, at in map(str.split, output.splitlines())}, now)
        request = {} if verb == 'look' else json.load(sys.stdin)
        after = admitted(before, request, now) if verb == 'admit' else [
            guest for guest in before if verb != 'remove'
            or request['keys'] is not None and guest['key'] not in request['keys']]
        after = [guest for guest in after if now < due(guest)]
        write(state, json.dumps(after))
        write(config, rendered(after, now))
        for guest in [guest for guest in before if guest not in after and not any(
                guest['key'] == other['key'] for other in after)]:
            subprocess.run(('wg', 'set', name, 'peer', guest['key'], 'remove'), check=True)
        for guest in after if verb == 'admit' else ():
            subprocess.run(('wg', 'set', name, 'peer', guest['key'],
                            'allowed-ips', guest['address']), check=True)
            # a machine whose networks overlap the VPN's has no route to the VPN as a whole
            subprocess.run(('ip', 'route', 'replace', f"{guest['address']}/32", 'dev', name),
                           check=True)
    print(json.dumps([{
        'key': guest['key'], 'label': guest['label'], 'address': guest['address'],
        'left': guest['until'] - now, 'heard': guest['heard'] and now - guest['heard'],
    } for guest in after]))


if __name__ == '__main__':
    main(sys.argv[1], sys.argv[2])
