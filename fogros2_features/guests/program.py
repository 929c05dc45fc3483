# SPDX-License-Identifier: Apache-2.0
"""
Keep the guests of a machine's VPN interface: computers that an invitation admits as peers.

A guest whose invitation has expired stays while it is connected. It is removed after ``patience``
seconds without a handshake; a connected peer makes one at least each 2 minutes. Times are seconds
since boot, because a machine's clock may be set while it runs.

This is the program for further peers of an interface, see ``fogros2.vpn``: ``/run/NAME.more``,
where NAME is the interface. Runs as python3 /run/NAME.more NAME VERB, with a request as JSON on
the standard input; prints the list, except for ``peers``. Imports nothing of fogros2.

``admit``   ``key``, ``label``, ``seconds``, ``patience``, ``addresses`` to choose from,
            ``secret``, ``left``: seconds of the machine's lifetime, ``rules`` for ``nft``, and
            ``door`` for ``serve``
``remove``  ``keys``, or null for all
``look``    removes those whose time is over
``peers``   prints them for ``wg``, after the rules are there
``serve``   is the door of the guests' nodes; ``admit`` starts it, in the background. It listens at
            ``address`` and ``port`` until there are no guests. A guest proves with its secret that
            it was invited, and gets a ``shell`` (a program's source) of an account of its own. The
            account has no rights, and ends with the guest: processes, files and agent included.
``stay``    a launch that keeps its machine leaves the interface to guests: the door runs the
            script ``down`` after the last one. Fails without guests.
``clear``   ends the accounts of all guests, because the interface ends

All of this is for root; only the processes of a guest's account, its agent among them, read what
the guest sends after its proof.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
import contextlib
import fcntl
import hmac
import json
import os
from pathlib import Path
import pwd
import re
import secrets
import socket
import socketserver
import subprocess
import sys
import time
from typing import Any, IO, Optional

#: Seconds between two looks at a guest that is connected beyond its invitation.
INTERVAL = 10.0
#: Seconds that a guest may take to prove who it is, and its connections at the same time.
PROOF_TIMEOUT, CONNECTIONS = 10.0, 8
#: Bytes of a challenge, and of its answer by HMAC-SHA256.
CHALLENGE = 32
#: Folder of the guests' homes.
HOMES = Path('/var/lib/fogros2-guests')
#: Ids of guests, which no account has; and ids for a namespace of users that lacks them.
IDS, FEW_IDS = range(0x7c000000, 0x7ffe0000), range(20000, 60000)
#: Types of file systems with no files of users, and of those on other computers.
OTHERS = ('proc', 'sysfs', 'cgroup', 'cgroup2', 'devpts', 'debugfs', 'tracefs', 'securityfs',
          'bpf', 'pstore', 'autofs', 'nfs', 'nfs4', 'cifs', 'smb3', '9p', 'fuse.sshfs')
#: Deletes the files of the user with the id $1 in all folders where all users may write, and
#: where programs write for users. The search may take long, and no account gets the id again, so
#: nobody waits for it.
CLEAN = f"""\
exec >/dev/null 2>&1 </dev/null
{{
    find / ! -type d -o '(' ! -perm -0001 -o -fstype {' -o -fstype '.join(OTHERS)} ')' -prune \\
        -o -perm -0002 -print0 -prune | xargs -0 -I @ find @ -xdev -uid "$1" -delete
    find /var/spool -xdev -uid "$1" -delete
}} &
"""
#: Ends all processes of the user $1 with the group $2. The third argument is its own real and
#: saved id, so that none of them can stop or kill it first.
KILL = """\
import os, sys
uid, gid, spare = map(int, sys.argv[1:])
os.setgroups([])
os.setresgid(gid, gid, gid)
os.setresuid(spare, uid, spare)
os.kill(-1, 9)
"""

#: What the guest's account runs: its agent, unless that runs, then its shell on the connection.
ENTRY = """\
python3 -IS agent.py serve --detach --config agent.json </dev/null >/dev/null
echo
exec python3 -IS -c "$0"
"""

#: Keeps an account from a cloud's services for its machine, which hold the machine's rights. The
#: same addresses serve DNS.
CONFINE = """\
add table inet {user}
delete table inet {user}
table inet {user} {{
    chain output {{
        type filter hook output priority filter; policy accept;
        meta skuid {uid} ip daddr {{ 169.254.169.0/24, 169.254.170.0/24, 168.63.129.16 }} \\
            meta l4proto {{ tcp, udp }} th dport != 53 reject
        meta skuid {uid} ip6 daddr {{ fd00:ec2::/32, fd20:ce::254 }} \\
            meta l4proto {{ tcp, udp }} th dport != 53 reject
    }}
}}
"""

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
    matches = [guest for guest in guests if guest['key'] == request['key']]
    addresses = {guest['address'] for guest in others}
    free = [address for address in request['addresses'] if address not in addresses]
    if not free:
        sys.exit(f'{len(addresses)} guests are as many as a machine can have')
    return [*others, {
        **(matches[0] if matches else {'address': free[0], 'handshake': 0, 'heard': None}),
        'key': request['key'], 'label': request['label'], 'until': now + request['seconds'],
        'patience': request['patience'], 'secret': request['secret'],
        'end': now + request['left']}]


def due(guest: Guest) -> float:
    """Return when a guest's time is over, in seconds since boot, unless it is heard again."""
    if guest.get('leaving'):
        return 0.0
    until: float = guest['until']
    if guest['heard'] is not None:
        until = max(until, guest['heard'] + guest['patience'])
    return min(until, float(guest['end']))


def rendered(guests: list[Guest]) -> str:
    """Return the guests as peers for ``wg``."""
    return '\n'.join(
        f"[Peer]\nPublicKey = {guest['key']}\nAllowedIPs = {guest['address']}/32"
        for guest in guests)


def again(guests: list[Guest], now: float) -> int:
    """Return when to look at guests again, in seconds since boot."""
    return int(min(guest['until'] if now < guest['until'] and now < due(guest) else now + INTERVAL
                   for guest in guests)) + 1


def write(path: Path, text: str) -> None:
    """Replace a file of root's, which nobody else can read."""
    aside = path.with_name(f'{path.name}.new')
    aside.unlink(missing_ok=True)
    with open(os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), 'w') as file:
        file.write(text)
    aside.replace(path)


def lock_file(path: Path) -> IO[str]:
    """Open a file for locks of root's: a guest that could read it could lock it."""
    return open(path, 'a', opener=lambda name, flags: os.open(name, flags, 0o600))


def account(name: str, address: str) -> str:
    """Return the account of the guest at an address of an interface."""
    return f"{name}g{address.rpartition('.')[2]}"


class Guests:
    """
    The guests of an interface.

    :param name: of the interface.
    """

    def __init__(self, name: str, folder: Path = Path('/run')) -> None:
        self.name = name
        self.due, self.state, self.rules, self.left, self.lock, self.door = (
            folder / f'{name}.more.{what}'
            for what in ('due', 'json', 'rules', 'left', 'lock', 'door'))

    @contextlib.contextmanager
    def locked(self) -> Iterator[list[Guest]]:
        """Keep other processes from changing the list during the block; yield the list."""
        with lock_file(self.lock) as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield json.loads(self.state.read_text()) if self.state.exists() else []

    def change(self, before: list[Guest], verb: str, request: dict[str, Any]) -> list[Guest]:
        """
        Run one request, with the lock held; return the guests that there are afterwards.

        :raises OSError: one could not be evicted, and will be by the next look.
        """
        before = self.finish(before)
        now = uptime()
        output = subprocess.run(('wg', 'show', self.name, 'latest-handshakes'), check=True,
                                stdout=subprocess.PIPE, text=True).stdout
        heard(before, {key: int(at) for key, at in map(str.split, output.splitlines())}, now)
        after = admitted(before, request, now) if verb == 'admit' else [
            guest for guest in before if verb != 'remove'
            or request['keys'] is not None and guest['key'] not in request['keys']]
        after = [guest for guest in after if now < due(guest)]
        keys = [guest['key'] for guest in after]
        listed = self.leave(
            [*after, *(guest for guest in before if guest['key'] not in keys)], keys)
        if listed:
            write(self.due, f'{again(listed, now)}\n')
        else:
            self.due.unlink(missing_ok=True)
        if verb == 'admit':
            write(self.rules, request['rules'])
        if after:
            self.confine()
        for guest in after if verb == 'admit' else ():
            subprocess.run(('wg', 'set', self.name, 'peer', guest['key'],
                            'allowed-ips', guest['address']), check=True)
            # a machine whose networks overlap the VPN's has no route to the VPN as a whole
            subprocess.run(('ip', 'route', 'replace', f"{guest['address']}/32", 'dev', self.name),
                           check=True)
        if len(listed) > len(after):
            raise OSError('the account of a guest is not deleted yet')
        return after

    def leave(self, guests: list[Guest], staying: list[str], *, peers: bool = True) -> list[Guest]:
        """
        Evict guests; each stays in the list until it is, so that a look may continue.

        :param staying: keys of the others.
        :param peers: whether the interface stays, too.
        :return: the list.
        """
        marked = [{**guest, 'leaving': guest['key'] not in staying} for guest in guests]
        if len(marked) > len(staying):
            write(self.due, '0\n')
        write(self.state, json.dumps(marked))
        return self.finish(marked, peers=peers)

    def finish(self, guests: list[Guest], *, peers: bool = True) -> list[Guest]:
        """Evict the guests that leave; return the list without those that have left."""
        for guest in [guest for guest in guests if guest.get('leaving')]:
            # the others don't wait for one that can't be evicted now
            with contextlib.suppress(OSError, subprocess.SubprocessError):
                if peers:
                    subprocess.run(('wg', 'set', self.name, 'peer', guest['key'], 'remove'),
                                   check=True)
                evict(account(self.name, guest['address']))
                guests = [other for other in guests if other is not guest]
                write(self.state, json.dumps(guests))
        return guests

    def clear(self, guests: list[Guest]) -> None:
        """End the accounts of all guests, and their rules."""
        self.left.unlink(missing_ok=True)
        self.leave(guests, [], peers=False)  # a door that runs admits nobody any more
        self.state.unlink(missing_ok=True)
        self.due.unlink(missing_ok=True)
        subprocess.run(('nft', 'delete', 'table', 'inet', f'{self.name}g'),
                       stderr=subprocess.DEVNULL)

    def confine(self) -> None:
        """
        Let guests reach only what the rules say; idempotent.

        :raises OSError, SubprocessError: there are no rules, or the packet filter takes none.
        """
        subprocess.run(('nft', '-f', self.rules), check=True, stderr=subprocess.PIPE)


def uptime() -> float:
    """Return the seconds since boot, by the health check's clock."""
    return float(Path('/proc/uptime').read_text().split()[0])


def runs(uid: int) -> bool:
    """Return whether a process with a user id runs."""
    for path in Path('/proc').glob('[0-9]*/status'):
        with contextlib.suppress(OSError):  # it has ended
            fields = dict(line.split(':\t', 1) for line in path.read_bytes().decode(
                errors='replace').splitlines() if ':\t' in line)
            # with several threads, the first may have ended before the others
            if str(uid) in fields['Uid'].split() and (
                    fields['State'][0] not in 'ZX' or int(fields['Threads']) > 1):
                return True
    return False


def evict(user: str) -> None:
    """
    End a guest's processes, and delete its account and its files; idempotent.

    :raises OSError: a process does not end.
    """
    try:
        entry = pwd.getpwnam(user)
    except KeyError:
        return
    until = time.monotonic() + 5.0
    while runs(entry.pw_uid):
        if time.monotonic() > until:
            raise OSError(f"a process of '{user}' does not end")
        subprocess.run((sys.executable, '-ISc', KILL, *map(str, (
            entry.pw_uid, entry.pw_gid, new_id()))), stderr=subprocess.DEVNULL)
        time.sleep(0.02)
    with contextlib.suppress(FileNotFoundError):
        # memory of System V outlives its processes; of other accounts' it removes nothing
        subprocess.run(('ipcrm', '--all'), user=entry.pw_uid, group=entry.pw_gid, extra_groups=(),
                       stderr=subprocess.DEVNULL)
    for words in (('userdel', user), ('groupdel', user)):  # mostly, the group goes with the user
        subprocess.run(words, stderr=subprocess.DEVNULL)
    with contextlib.suppress(FileNotFoundError):
        subprocess.run(('nft', 'delete', 'table', 'inet', user), stderr=subprocess.DEVNULL)
    subprocess.run(('rm', '-rf', '--', HOMES / user), stderr=subprocess.DEVNULL)  # at any depth
    subprocess.run(('sh', '-c', CLEAN, 'sh', str(entry.pw_uid)), start_new_session=True)
    with contextlib.suppress(OSError):
        HOMES.rmdir()  # of the last guest


def new_id() -> int:
    """Return an id for an account: by chance, so that no file of a former guest has it."""
    mapped = [[int(word) for word in line.split()]
              for line in Path('/proc/self/uid_map').read_text().splitlines()]
    some = IDS if any(first + count > IDS[-1] for first, _, count in mapped) else FEW_IDS
    while True:
        number = secrets.choice(some)
        try:
            pwd.getpwuid(number)
        except KeyError:
            return number


def confine(user: str, uid: int) -> None:
    """
    Keep a guest's account from the metadata service of a cloud; idempotent.

    :raises OSError, SubprocessError: the machine has no packet filter.
    """
    subprocess.run(('nft', '-f', '-'), input=CONFINE.format(user=user, uid=uid), text=True,
                   check=True, stderr=subprocess.PIPE)


class Door(socketserver.ThreadingTCPServer):
    """
    Where guests' robots reach their accounts.

    :param request: ``address``, ``port``, ``shell``, ``down``, ``machine``, ``agent`` (the path of
        the agent's program), ``process`` (the file with a process id, of ``VpnInterface``).
    """

    allow_reuse_address = daemon_threads = True

    def __init__(self, guests: Guests, request: dict[str, Any]) -> None:
        self.guests = guests
        self.request = request
        self.agent = Path(request['agent']).read_text()
        self.open: Counter[str] = Counter()
        super().__init__((request['address'], request['port']), socketserver.BaseRequestHandler)

    def serve(self, own: IO[str]) -> None:
        """
        Serve until there are no guests.

        :param own: the lock of doors; released while nobody can be admitted.
        """
        look = 0.0
        while True:
            self.timeout = max(0.0, look - time.monotonic())
            self.handle_request()
            if time.monotonic() < look:
                continue
            look = time.monotonic() + INTERVAL
            with self.guests.locked() as guests:
                with contextlib.suppress(OSError, subprocess.CalledProcessError):
                    guests = guests and self.guests.change(guests, 'look', {})
                if not guests:
                    self.server_close()
                    own.close()  # a guest that is admitted from now on gets another door
                    return

    def follow(self) -> None:
        """Enter the control group that takes no DDS of strangers, on a host that has one."""
        with contextlib.suppress(OSError, IndexError):
            pid = Path(self.request['process']).read_text().strip()
            group = re.findall('^0::(.*)', Path(f'/proc/{pid}/cgroup').read_text(), re.MULTILINE)
            for top in ('/sys/fs/cgroup', '/sys/fs/cgroup/unified'):
                with contextlib.suppress(OSError):
                    Path(f'{top}{group[0]}/cgroup.procs').write_text(str(os.getpid()))

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Return whether a guest may have one more connection."""
        return self.open[client_address[0]] < CONNECTIONS

    def finish_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection, in a thread of its own."""
        self.open[client_address[0]] += 1
        try:
            with contextlib.suppress(OSError):
                self.answer(request, client_address[0])
        finally:
            self.open[client_address[0]] -= 1

    def answer(self, link: socket.socket, address: str) -> None:
        """Let a guest prove who it is; then run its shell until the connection ends."""
        challenge, proof = os.urandom(CHALLENGE), b''
        if not self.admits(address, challenge, None):
            return  # it gets not even a challenge
        link.settimeout(PROOF_TIMEOUT)
        link.sendall(challenge)
        until = time.monotonic() + PROOF_TIMEOUT
        while len(proof) < CHALLENGE and time.monotonic() < until:
            proof += (more := link.recv(CHALLENGE - len(proof)))
            if not more:
                return
        with self.guests.locked():  # a guest that is revoked now is evicted after this
            if not self.admits(address, challenge, proof):
                return
            try:
                child = self.begin(link, account(self.guests.name, address))
            except (OSError, KeyError, subprocess.SubprocessError) as error:
                why = str(getattr(error, 'stderr', None) or error).strip().splitlines()
                link.sendall(f"{''.join(why[-1:])[:200]}\n".encode())
                return
        child.wait()

    def admits(self, address: str, challenge: bytes, proof: Optional[bytes]) -> bool:
        """Return whether an address is a guest's, and the proof, if there is one, that guest's."""
        return any(proof is None or hmac.compare_digest(
            hmac.digest(bytes.fromhex(guest['secret']), challenge, 'sha256'), proof)
            for guest in json.loads(self.guests.state.read_text())
            if guest['address'] == address and guest['secret'] and not guest.get('leaving'))

    def begin(self, link: socket.socket, user: str) -> subprocess.Popen[bytes]:
        """
        Start a guest's shell on a connection, beside its agent.

        :raises OSError, KeyError, SubprocessError: the machine has no room for an account.
        """
        home = HOMES / user
        try:
            entry = pwd.getpwnam(user)
        except KeyError:
            HOMES.mkdir(mode=0o755, exist_ok=True)
            number = str(new_id())
            for words in (
                    ('groupadd', '--gid', number, user),
                    # the list of last logins would become as long as the number is high
                    ('useradd', '--system', '--no-log-init', '--uid', number, '--gid', number,
                     '--no-create-home', '--home-dir', home, '--shell', '/bin/sh', user)):
                subprocess.run(words, check=True, stderr=subprocess.PIPE, text=True)
            entry = pwd.getpwnam(user)
            home.mkdir(mode=0o700)
            (home / 'agent.py').write_text(self.agent)
            (home / 'agent.json').write_text(json.dumps({
                'machine': self.request['machine'], 'directory': f'{home}/agent', 'user': user,
                'boot_timeout': 120.0}))
            os.chown(home, entry.pw_uid, entry.pw_gid)
        confine(user, entry.pw_uid)
        link.settimeout(None)
        # Popen with user= would wait for a process that the guest's other processes can stop
        return subprocess.Popen(
            ('setpriv', f'--reuid={entry.pw_uid}', f'--regid={entry.pw_gid}', '--clear-groups',
             'sh', '-c', ENTRY, self.request['shell']), stdin=link.fileno(), stdout=link.fileno(),
            stderr=subprocess.DEVNULL, cwd=home, umask=0o022, start_new_session=True, env={
                'HOME': str(home), 'USER': user, 'LOGNAME': user, 'SHELL': '/bin/sh',
                'LANG': 'C.UTF-8', 'PATH': '/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin'})


def serve(guests: Guests, request: dict[str, Any]) -> None:
    """Be the door, unless there is one; at the end take down an interface that was left to it."""
    os.umask(0o022)
    with lock_file(guests.door) as own:
        with guests.locked():
            try:
                fcntl.flock(own, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return  # there is a door
        door = Door(guests, request)
        door.follow()
        door.serve(own)
    if guests.left.exists():
        os.execvp('sh', ('sh', '-c', request['down']))


def main(name: str, verb: str, folder: Path = Path('/run')) -> None:
    """Run one request."""
    guests = Guests(name, folder)
    # a login user's may lack the folders of nft
    os.environ['PATH'] = f"{os.environ.get('PATH', os.defpath)}:/usr/sbin:/sbin"
    if verb == 'serve':
        serve(guests, json.load(sys.stdin))
        return
    request = json.load(sys.stdin) if verb in ('admit', 'remove') else {}
    with guests.locked() as before:
        if verb == 'clear':
            guests.clear(before)
            return
        if verb == 'peers':
            if staying := [guest for guest in before if not guest.get('leaving')]:
                guests.confine()
                print(rendered(staying))
            return
        after = guests.change(before, verb, request) if before or verb == 'admit' else []
        if verb == 'stay':
            if not after:
                sys.exit(1)
            guests.left.touch()
            return
    if 'door' in request:
        started = subprocess.Popen(
            (sys.executable, '-IS', __file__, name, 'serve'), stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd='/', start_new_session=True)
        assert started.stdin is not None
        with started.stdin as stdin:
            stdin.write(json.dumps(request['door']).encode())
    now = uptime()
    print(json.dumps([{
        'key': guest['key'], 'label': guest['label'], 'address': guest['address'],
        'left': guest['until'] - now, 'heard': guest['heard'] and now - guest['heard'],
    } for guest in after]))


if __name__ == '__main__':
    main(sys.argv[1], sys.argv[2])
