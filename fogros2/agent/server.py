# SPDX-License-Identifier: Apache-2.0
"""
The agent's clients, their requests, and its command line.

    agent.py serve --config FILE [--detach]    run the agent; detached, start it again if it dies
    agent.py connect --directory DIR           relay stdin and stdout to a running agent
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import fcntl
import json
import os
import resource
import selectors
import signal
import socket
import stat
import sys
import threading
import time

from fogros2.agent.journal import BLOCK, Journal
from fogros2.agent.loop import Loop
from fogros2.agent.nodes import Node, Nodes
from fogros2.agent.processes import (
    Identity,
    NOTICE,
    Processes,
    remove_tree,
    Watch,
    Watches,
)
from fogros2.agent.protocol import checked, CONFIG, dump, MAX_LINE, Refused, say
from fogros2.agent.watchdog import Heartbeats, Watchdog

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any, Optional

    from fogros2.agent.protocol import Json
    from fogros2.events import AgentEvent, Configured, Empty, Status

#: The number of connections; with more, the connection that was idle for longest is closed.
CLIENTS = 64
#: Seconds between attempts to end the machine.
RETRY_END = 30.0
#: Shortest and longest pause in seconds before an agent that died starts again.
FIRST_RESTART, LAST_RESTART = 0.1, 30.0
#: Seconds without new connections after all descriptors were used up.
ACCEPT_PAUSE = 1.0
#: Bytes of the file of the deadlines.
DEADLINES = 256
#: Settings that a restarted agent takes over from its predecessor.
RESUMED = (
    'launch', 'on_exit', 'lifetime', 'robot_timeout', 'heartbeat', 'environment', 'setup')


class Client:
    """A connection: receives requests, sends replies and events, and blocks on neither."""

    def __init__(self, agent: Agent, connection: socket.socket) -> None:
        connection.setblocking(False)
        self.agent = agent
        self.loop = agent.loop
        self.socket = connection
        self.received = bytearray()
        self.out = bytearray()
        #: Whether the other end sends nothing more.
        self.ended = False
        #: The journal's position of the next event to send; None until the client wants events.
        self.position: Optional[int] = None
        #: The number of replies that are not available yet.
        self.awaiting = 0
        self.active = self.loop.clock()
        self.loop.select(connection, selectors.EVENT_READ, self._serve)

    def _serve(self, mask: int) -> None:
        """Exchange data with the other end when the socket is ready."""
        if mask & selectors.EVENT_READ:
            self._receive()
        self.send()

    def _receive(self) -> None:
        try:
            data = self.socket.recv(BLOCK)
        except BlockingIOError:
            return
        except OSError:
            data = b''
        self.ended = not data
        self.received += data
        lines = []
        if b'\n' in data:
            *lines, self.received = self.received.split(b'\n')
        self.active = self.loop.clock()
        for line in lines:
            if line.strip() and self in self.agent.clients:
                self.agent.request(self, bytes(line))
        if len(self.received) > MAX_LINE:
            self.received.clear()
            self.ended = True
            self.reply(None, {'error': f'a request is longer than {MAX_LINE} bytes'})
        if self.ended:
            self.position = None

    def reply(self, number: Any, answer: Any) -> None:
        """Send a reply; one with ``error`` in it is a failure."""
        self.send(dump({'id': number, 'ok': 'error' not in answer, **answer}))

    def reply_later(self, number: Any) -> Callable[[Any], None]:
        """Return a function that sends the reply when it is available."""
        self.awaiting += 1

        def reply(answer: Any) -> None:
            self.awaiting -= 1
            self.reply(number, answer)
        return reply

    def turn_away(self, reason: str) -> None:
        """Tell a launch that its agent isn't here any more, and close the connection."""
        self.ended, self.position = True, None
        self.send(dump({'error': reason, 'kind': 'absent'}))

    def send(self, data: bytes = b'') -> None:
        """Send data, then events, as far as the other end takes them now, the rest later."""
        if self not in self.agent.clients:
            return
        self.out += data
        more = self.position is not None
        while more and len(self.out) < BLOCK:
            assert self.position is not None
            # the journal is the queue of the events
            events, self.position = self.agent.journal.read(self.position)
            self.out += events
            more = bool(events)
        try:
            while self.out:
                del self.out[:self.socket.send(self.out[:BLOCK])]
        except BlockingIOError:
            pass
        except OSError:  # its other end is gone
            self.close()
            return
        if self.ended and not self.out and not self.awaiting:
            self.close()
            return
        # a socket at its end would wake the selector forever
        wanted = 0 if self.ended else selectors.EVENT_READ
        if self.out or more:
            wanted |= selectors.EVENT_WRITE
        self.loop.select(self.socket, wanted, self._serve)

    def close(self) -> None:
        """Close the connection; idempotent."""
        if self in self.agent.clients:
            self.agent.clients.remove(self)
            self.loop.select(self.socket, 0, self._serve)
            self.socket.close()


class Agent:
    """
    The agent of a machine: its configuration, which launch has it, and its end.

    :param config: see ``CONFIG``.
    """

    def __init__(self, config: Json) -> None:
        self.config = {key: default for key, (_, default) in CONFIG.items()}
        self.config.update(checked(config))
        self.identity = Identity(self.config['user'])
        account = self.identity.account
        directory = self.config['directory']
        if directory.startswith('~/'):
            directory = os.path.join(account.pw_dir, directory[2:])
        self.directory = os.path.normpath(directory)
        if not os.path.isabs(self.directory) or self.directory in ('/', account.pw_dir):
            # the agent deletes its content in the end, so it must belong to the agent alone
            raise Refused(f"the agent can't have the directory '{self.directory}'")
        self.config.update(user=account.pw_name, directory=self.directory)
        self.loop = Loop()
        self.processes = Processes(self.loop, self.identity)
        self.watches = Watches(self.processes, self.emit)
        self.nodes = Nodes(self.processes, self.directory, self.config, self.emit)
        self.watchdog = Watchdog(self.config, self.loop.clock())
        self.heartbeats = Heartbeats(
            self.loop, self.config, self.watchdog, self.save_deadlines)
        self.clients: list[Client] = []
        self.ending = self.done = False
        #: Whether a launch has taken the machine over from the launch that created it.
        self.adopted = False
        #: The launch that will have the machine when the former launch's nodes have ended.
        self.claimed = ''
        #: Whether no launch has the machine; late requests of the former launch start nothing.
        self.released = False
        #: Whether an agent of a launch died here.
        self.succeeds = False
        self.since = time.time()

    # -- the directory ------------------------------------------------------------------------

    def open(self) -> None:
        """
        Create the directory, lock it, open the socket in it, and write the files in it.

        :raises Refused: the directory is not writable, or another agent uses it.
        """
        try:
            self.identity.assume()
            try:
                self._make_directory()
            except PermissionError:
                with self.identity.root():
                    self._make_directory()
            folder = os.stat(self.directory, follow_symlinks=False)
            if not stat.S_ISDIR(folder.st_mode) or \
                    folder.st_uid != self.identity.account.pw_uid:
                raise Refused(f'{self.directory} belongs to somebody else')
            os.chmod(self.directory, 0o700)
            self.lock = os.open(
                self.path('agent.pid'),
                os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
            try:
                fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                other = os.pread(self.lock, 20, 0).decode().strip()
                raise Refused(
                    f'another agent (process {other}) serves {self.directory}',
                    'connect to it', 'running') from None
            self._resume()
            self._recall_kept()
            self.journal = Journal(self.directory, self.config['log_bytes'])
            self.listener = self._listen()
            # before the start is reported: another robot's launch reads whose agent this is
            self.save()
        except OSError as error:
            raise Refused(f"{self.directory} can't be used: {error.strerror or error}") from error

    def _make_directory(self) -> None:
        os.makedirs(os.path.dirname(self.directory), mode=0o755, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            os.mkdir(self.directory, 0o700)
            # change the owner only of a new directory, and never through a symbolic link
            folder = os.open(self.directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            account = self.identity.account
            os.fchown(folder, account.pw_uid, account.pw_gid)
            os.close(folder)

    def _listen(self) -> socket.socket:
        path = self.path('agent.sock')
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path)  # left by a former agent: this one holds the lock
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        mask = os.umask(0o177)
        # a Unix socket address has at most 107 bytes; the directory's path may be longer
        folder = os.open(self.directory, os.O_RDONLY | os.O_DIRECTORY)
        try:
            listener.bind(f'/proc/self/fd/{folder}/agent.sock')
        finally:
            os.umask(mask)
            os.close(folder)
        listener.listen(2 * CLIENTS)
        return listener

    def path(self, name: str) -> str:
        """Return the path of a file in the agent's directory."""
        return os.path.join(self.directory, name)

    def _resume(self) -> None:
        """Take over the configuration of an agent that died in this directory."""
        try:
            with open(self.path('config.json')) as stream:
                saved = checked(json.load(stream))
        except (AttributeError, OSError, RecursionError, Refused, ValueError):
            return
        if saved.get('machine') == self.config['machine']:
            # the user could have written the file: take nothing that root would execute
            self.config.update({key: saved[key] for key in RESUMED if key in saved})
            self._restart_watchdog()
            self.succeeds = bool(self.config['launch'])
            kept = not self.config['launch'] and self.config['on_exit'] == 'keep'
            with contextlib.suppress(
                    OSError, OverflowError, RecursionError, TypeError, ValueError), \
                    open(self.path('watchdog.json')) as stream:
                self.nodes.mark, *state = json.load(stream)
                if self.config['launch'] or kept:
                    self.watchdog.resume(state, self.loop.clock())
            if kept:
                self._expect_no_launch()

    def _expect_no_launch(self) -> None:
        """Only the lifetime ends this machine, which a launch has kept."""
        self.watchdog.disarm()
        self.released = True

    def _recall_kept(self) -> None:
        """Go on with a kept machine that was rebooted, which empties the directory."""
        if self.config['launch']:
            return
        with self.identity.root(), contextlib.suppress(OSError, ValueError), \
                open(self.config['kept_until']) as stream:
            self.config.update(on_exit='keep', lifetime=float(stream.read()) - time.time())
            self.watchdog.lifetime_from = self.loop.clock()
            self._expect_no_launch()

    def _note_kept(self) -> None:
        """Write until when a launch keeps the machine, for ``_recall_kept``."""
        path = self.config['kept_until']
        if not path:
            return
        with self.identity.root(), contextlib.suppress(OSError):
            if self.config['on_exit'] == 'keep':
                seconds = self.watchdog.lifetime_from + self.config['lifetime'] - self.loop.clock()
                with open(path, 'w') as stream:
                    stream.write(f'{time.time() + seconds}')
            else:
                os.unlink(path)

    def save(self) -> None:
        """Write the pid for people, and the configuration for a restarted agent."""
        try:
            os.ftruncate(self.lock, 0)
            os.pwrite(self.lock, f'{os.getpid()}\n'.encode(), 0)
            self._write('config.json', self.config)
        except OSError as error:
            say(f"the configuration can't be kept: {error}")
        self.save_deadlines()

    def save_deadlines(self) -> None:
        """Write the watchdog's state, and the mark of the nodes, for a restarted agent."""
        data = json.dumps([self.nodes.mark, *self.watchdog.state]).ljust(DEADLINES).encode()
        # in place, for which a full disk has room
        with contextlib.suppress(OSError):
            fd = os.open(self.path('watchdog.json'),
                         os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
            try:
                os.pwrite(fd, data, 0)
            finally:
                os.close(fd)

    def _write(self, name: str, data: Any) -> None:
        aside = self.path(f'{name}.new')
        fd = os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
        with os.fdopen(fd, 'w') as stream:
            json.dump(data, stream)
        os.replace(aside, self.path(name))

    # -- running ------------------------------------------------------------------------------

    def heed_signals(self) -> None:
        """End in order at a signal; called before the start is reported."""
        alarm, self.wake = socket.socketpair()
        alarm.setblocking(False)
        self.wake.setblocking(False)
        signal.set_wakeup_fd(self.wake.fileno(), warn_on_full_buffer=False)
        # a handler, because children would inherit an ignored SIGHUP
        for number in (signal.SIGCHLD, signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, lambda number, frame: None)
        self.loop.select(
            alarm, selectors.EVENT_READ, lambda mask: self._on_signals(alarm.recv(4096)))

    def run(self) -> None:
        """Serve until the agent ends."""
        # each node takes two descriptors
        most = self.processes.descriptors[1]
        with contextlib.suppress(OSError, ValueError):  # more than fs.nr_open
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
        self._await_clients()
        try:
            self.heartbeats.open()
        except Refused as error:
            say(str(error))
        self._watch_notice()
        if self.succeeds or self.journal.next > 1:
            # the nodes end with the agent that died here, and nothing has reported it
            self.nodes.sweep_former()
        while not self.done:
            until = self.loop.clock() + 60.0
            if not self.ending:
                self._watch()
                until = self.watchdog.deadlines()[0][0]
            if not self.done:  # without nodes and watches, there is nothing to wait for
                self.loop.turn(until)
        for client in list(self.clients):
            client.close()

    def _on_signals(self, numbers: bytes) -> None:
        if signal.SIGCHLD in numbers:
            self.processes.reap()
        if signal.SIGTERM in numbers or signal.SIGINT in numbers:
            if self.ending and self.nodes.stopping:
                self.done = True  # the second signal ends the agent at once
            say('asked to end')
            if not self.ending:
                self.emit({'event': 'ending', 'reason': 'asked to end by a signal'})
            self.ending = True
            self.loop.at(1.8, self._leave)
            self.nodes.stop_all(lambda: self.watches.take_down(self._leave), quickly=True)

    def emit(self, event: AgentEvent) -> None:
        """Append an event to the journal, and send it to the clients that follow."""
        self.journal.append(event)
        for client in list(self.clients):
            if client.position is not None and not client.out:
                client.send()

    def _await_clients(self) -> None:
        self.loop.select(self.listener, selectors.EVENT_READ, self._accept)

    def _accept(self, mask: int) -> None:
        try:
            connection, _ = self.listener.accept()
        except (BlockingIOError, ConnectionError):
            return
        except OSError as error:
            # the client waits, and would wake the selector forever
            say(f'no connection accepted: {error}')
            self.loop.select(self.listener, 0, self._accept)
            self.loop.at(ACCEPT_PAUSE, self._await_clients)
            return
        if len(self.clients) >= CLIENTS:
            # connections whose network is gone accumulate here
            min(self.clients, key=lambda client: client.active).close()
        self.clients.append(Client(self, connection))

    def request(self, client: Client, line: bytes) -> None:
        """Serve a request."""
        number = None
        try:
            request = json.loads(line)
            if not isinstance(request, dict):
                raise Refused('a request is a JSON object')
            number, command = request.get('id'), request.get('command')
            handler = getattr(self, f'do_{command}', None)
            if handler is None:
                raise Refused(f'no such command: {json.dumps(command)[:80]}', kind='unknown')
            if command not in ('configure', 'release'):  # they compare it for themselves
                launch, owner = request.get('of'), self.config['launch']
                if launch and owner and launch != owner:
                    client.turn_away(f"launch '{owner}' has this machine now")
                    return
            answer = handler(client, request)
        except Refused as error:
            answer = error.answer
        except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
            what = f'{error} is missing' if isinstance(error, KeyError) else str(error)
            answer = {'error': f'malformed request: {what[:200]}', 'kind': 'malformed'}
        except OSError as error:
            answer = {'error': f'{error.filename or "the machine"}: {error.strerror or error}'}
        if answer is not None:
            client.reply(number, answer)

    # -- requests -----------------------------------------------------------------------------

    def do_configure(self, client: Client, request: Json) -> Optional[Configured]:
        """Change settings; a new launch takes the machine over."""
        new = checked(request)
        for fixed in ('directory', 'user', 'log_bytes', 'kept_until'):
            new.pop(fixed, None)
        notice = self.config['notice']
        if self.ending:
            raise Refused('this machine is ending', 'launch again', 'ending')
        owner = self.config['launch']  # '' after a reboot: no owner until a launch comes
        taken_over = new.get('launch', owner) != owner
        if notice is not None and not taken_over and new.get('notice', notice) != notice:
            # a node could report with another command that the provider reclaims the machine
            raise Refused('the command for the preemption notice is fixed', kind='fixed')
        if taken_over and request.get('again'):
            raise Refused(f"launch '{new['launch']}' doesn't have this machine any more",
                          kind='released')
        heard_at = self.watchdog.heard_at
        if taken_over and owner and heard_at is not None and request.get('force') != owner:
            raise Refused(
                f"this machine belongs to launch '{owner}', whose last sign of life is "
                f'{self.loop.clock() - heard_at:.0f} s old',
                'end that launch, or choose another name', 'busy')
        occupied = taken_over and (
            self.nodes.known or self.watches.known or self.watches.ending)
        if not (self.nodes.stopping or occupied):
            return self._configure(new, taken_over)
        if taken_over:
            self.claimed = new['launch']
        reply = client.reply_later(request.get('id'))

        def stopped() -> None:
            try:
                # a request that was sent twice takes over once
                claims = taken_over and self.config['launch'] != new['launch']
                if claims and self.claimed != new['launch']:
                    raise Refused('the machine was released meanwhile', kind='released')
                reply(self._configure(new, claims))
            except Refused as error:
                reply(error.answer)

        # the former launch's VPN uses the port that the new launch needs
        self.nodes.stop_all(
            (lambda: self.watches.take_down(stopped)) if taken_over else stopped)
        return None

    def _configure(self, new: Json, taken_over: bool) -> Configured:
        if taken_over:
            self.claimed = ''
            self.adopted = True
            self.nodes.clear()
            new.setdefault('heartbeat', None)
            self.config['notice'] = None
        self.released = self.released and not new.get('launch')
        if new.get('heartbeat', self.config['heartbeat']) != self.config['heartbeat']:
            self.watchdog.number = 0  # of another key
        self.config.update(new)
        if 'notice' in new and NOTICE not in self.watches.known:
            self._watch_notice()
        if taken_over:
            self.watchdog.disarm()
            self.watchdog.boot_from = self.loop.clock()
        self._restart_watchdog()
        self.save()
        self._note_kept()
        self.heartbeats.open()
        return {'machine': self.config['machine'], 'next': self.journal.next}

    def _watch_notice(self) -> None:
        if self.config['notice']:
            self.watches.start(Watch({'what': NOTICE, 'argv': self.config['notice']}))

    def _restart_watchdog(self) -> None:
        self.watchdog.configured(self.loop.clock(), heartbeat=bool(self.config['heartbeat']))

    def _check_held(self) -> None:
        """
        Refuse to start anything for a launch that has released the machine: a late request.

        :raises Refused: no launch has the machine, or the agent is ending.
        """
        if self.released:
            raise Refused('no launch has this machine any more', kind='released')
        if self.ending:
            raise Refused('the agent is stopping its nodes', kind='ending')

    def do_watch(self, client: Client, request: Json) -> Empty:
        """Start a watch, or replace the one with the same ``what``."""
        self._check_held()
        watch = Watch(request)
        if watch.what == NOTICE:
            raise Refused(f"'{NOTICE}' is part of the configuration")
        self.watches.start(watch)
        return {}

    def do_start(self, client: Client, request: Json) -> None:
        """Start nodes, as soon as their environment is known."""
        specs = request['nodes']
        if not isinstance(specs, list) or not all(isinstance(spec, dict) for spec in specs):
            raise Refused("'nodes' is a list of objects")
        nodes = [Node(spec) for spec in specs]
        self._check_held()
        owner = self.config['launch']
        reply = client.reply_later(request.get('id'))

        def sourced(failure: Optional[Refused]) -> None:
            try:
                if failure is not None:
                    raise failure
                self._check_held()
                if owner != self.config['launch']:
                    raise Refused('another launch has taken this machine over', kind='released')
                if self.config['heartbeat'] and self.watchdog.beat_at is None:
                    # the robot was gone, and the machine stayed
                    self.watchdog.beat_at = self.loop.clock()
                    self.save_deadlines()
                reply({'known': self.nodes.start(nodes)})
            except Refused as error:
                reply(error.answer)

        self.nodes.source(sourced)

    def do_stop(self, client: Client, request: Json) -> Empty:
        """Stop nodes."""
        self.nodes.stop(request.get('nodes'))
        return {}

    def do_signal(self, client: Client, request: Json) -> Empty:
        """Send a node a signal."""
        self.nodes.signal(str(request['node']), str(request['signal']))
        return {}

    def do_status(self, client: Client, request: Json) -> Status:
        """Return the agent's state."""
        with open('/proc/self/statm') as stream:
            rss = int(stream.read().split()[1]) * os.sysconf('SC_PAGE_SIZE') // 1024
        config, now, dog = self.config, self.loop.clock(), self.watchdog
        return {
            'machine': config['machine'], 'launch': config['launch'], 'pid': os.getpid(),
            'user': config['user'], 'directory': self.directory, 'since': self.since,
            'on_exit': config['on_exit'], 'robot_timeout': config['robot_timeout'],
            'lifetime_left': dog.lifetime_from + config['lifetime'] - now,
            'heartbeat_age': None if dog.beat_at is None else now - dog.beat_at,
            'ending': self.ending,
            'nodes': [node.status for node in self.nodes.known.values()],
            'kept': self.watches.status(), 'rss_kb': rss,
            'first': self.journal.first, 'next': self.journal.next,
        }

    def do_ping(self, client: Client, request: Json) -> Empty:
        """Reply, as a sign of life."""
        return {}

    def do_log(self, client: Client, request: Json) -> None:
        """Send the events from a seq on."""
        begin, journal = max(1, int(request.get('from') or 1)), self.journal
        client.reply(request.get('id'), {
            'first': journal.first, 'next': journal.next, 'lost': max(0, journal.first - begin)})
        client.position = journal.find(begin)
        client.send()

    def do_release(self, client: Client, request: Json) -> Optional[Empty]:
        """Stop the nodes of a launch and release the machine."""
        launch, has = request.get('launch'), self.claimed or self.config['launch']
        if launch and has and launch != has:
            return {}
        ends = request.get('exit', False)
        if not isinstance(ends, bool):
            raise Refused("'exit' is true or false")
        self.config.update(checked({'on_exit': request.get('on_exit', self.config['on_exit'])}))
        self.claimed = ''
        self.released = True
        self.watchdog.disarm()
        self.config.update(heartbeat=None, launch='')
        self.heartbeats.open()
        self.save()
        self._note_kept()
        reply = client.reply_later(request.get('id'))

        def stopped() -> None:
            if ends:
                reply({})
                self.watches.take_down(self._leave_for_good)
            else:
                # end the health check first: it would recreate the VPN interface
                self.watches.take_down(lambda: reply({}))

        if ends:
            self._hurry()
        self.nodes.stop_all(stopped)
        return None

    # -- the end ------------------------------------------------------------------------------

    def _watch(self) -> None:
        """Stop the nodes or end the machine when a deadline of the watchdog has passed."""
        now = self.loop.clock()
        self.watchdog.check_suspend(now - time.monotonic(), now)
        reason = self.watchdog.due(now)
        if reason is None:
            return
        # 'no launch came' ends a machine whose first launch died, but not an adopted machine
        unattended = reason == 'robot gone' or (reason == 'no launch came' and self.adopted)
        stay = unattended and self.config['on_exit'] == 'keep'
        ends = 'end the machine' if self.config['end_command'] else 'leave'
        action = 'stop the nodes' if stay else ends
        say(f'{reason}: {action}')
        self.emit({'event': 'watchdog', 'reason': reason, 'action': action})
        self.watchdog.disarm()
        if stay:
            self.nodes.stop_all(lambda: None)
        else:
            self._hurry()
            self.nodes.stop_all(self._end_machine)

    def _hurry(self) -> None:
        """Start nothing more, and give processes that the nodes left behind little time."""
        self.ending = self.nodes.quickly = True

    def _end_machine(self) -> None:
        """End the machine, retrying until it works; exit where there is no end command."""
        command = self.config['end_command']
        if not command:
            self.watches.take_down(self._leave_for_good)
            return

        def ended(status: int) -> None:
            if status != 0:
                self.emit({'event': 'end_failed', 'returncode': status})
            if os.getpid() == 1:
                self.done = True  # the container ends with this process
            self.loop.at(RETRY_END, self._end_machine)
        self.processes.spawn(command, ended, timeout=60.0)

    def _leave(self) -> None:
        """Exit, and leave the journal and the configuration to a restarted agent."""
        self.done = True
        for name in ('agent.sock', 'agent.pid'):
            with contextlib.suppress(OSError):
                os.unlink(self.path(name))

    def _leave_for_good(self) -> None:
        """Exit, and remove the directory; the last agent removes the folder of all agents."""
        self.done = True
        remove_tree(self.directory)
        parent = os.path.dirname(self.directory)
        for folder in (self.directory, parent):
            if folder is not parent or os.path.basename(parent) == 'fogros2':
                with self.identity.root(), contextlib.suppress(OSError):
                    os.rmdir(folder)


def detach() -> int:
    """
    Become a daemon; the parent prints a line about the start, and exits.

    Returns the daemon's descriptor for that line.
    """
    reader, writer = os.pipe()
    if os.fork():
        os.close(writer)
        with os.fdopen(reader, 'rb') as stream:
            line = stream.read()
        sys.stdout.buffer.write(line or dump({'error': 'the agent died while starting'}))
        sys.stdout.flush()
        os._exit(0 if b'"ready":true' in line else 1)
    os.close(reader)
    os.setsid()
    silence(0, 1, 2)
    return writer


def silence(*descriptors: int) -> None:
    """Connect descriptors to /dev/null."""
    null = os.open(os.devnull, os.O_RDWR)
    for fd in descriptors:
        os.dup2(null, fd)
    os.close(null)


def supervise(directory: str, answer: int) -> None:
    """
    Return in a child process that is to be the agent; start another child when one dies.

    This process exits when an agent ends in order or by SIGTERM, which finds no handler while
    Python ends; and when its directory was removed, even if another launch made it again.

    :param answer: descriptor of the line about the start; only the first child writes it.
    """
    pause = FIRST_RESTART
    while child := os.fork():
        silence(answer)
        begin = time.monotonic()
        status = os.waitpid(child, 0)[1]
        ran = time.monotonic() - begin
        if status in (0, signal.SIGTERM) or not os.path.isdir(directory):
            os._exit(0)
        folder = os.open(directory, os.O_RDONLY | os.O_CLOEXEC)
        pause = FIRST_RESTART if ran > LAST_RESTART else min(2 * pause, LAST_RESTART)
        time.sleep(pause)
        if os.fstat(folder).st_nlink == 0:
            os._exit(0)
        os.close(folder)


def read(path: str) -> Json:
    """
    Return the configuration in a file.

    :raises Refused: the file cannot be read, or names no directory.
    """
    try:
        with open(path) as stream:
            config = json.load(stream)
    except (OSError, ValueError) as error:
        raise Refused(f"the configuration {path} can't be read: {error}") from error
    if not isinstance(config, dict) or not config.get('directory'):
        raise Refused(f"the configuration {path} names no 'directory'")
    return config


def serve(config_path: str, *, daemon: bool) -> int:
    """Run the agent with a configuration file; return the exit status."""
    answer = detach() if daemon else -1
    try:
        config = read(config_path)
        if daemon:
            supervise(config['directory'], answer)
        agent = Agent(config)
        agent.open()
        agent.heed_signals()
    except Refused as error:
        if daemon:
            os.write(answer, dump(error.answer))
            return 0  # nothing to start again
        say(str(error))
        return 1
    if daemon:
        log = os.open(agent.path('agent.log'),
                      os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW, 0o600)
        os.dup2(log, 2)
        os.close(log)
        os.write(answer, dump({'ready': True, 'socket': agent.path('agent.sock'),
                               'pid': os.getpid()}))
        os.close(answer)
    agent.run()
    return 0


def connect(directory: str) -> int:
    """Relay stdin and stdout to the agent of a directory; return the exit status."""
    directory = os.path.expanduser(directory)
    link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        folder = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
        link.connect(f'/proc/self/fd/{folder}/agent.sock')
        os.close(folder)
    except OSError as error:
        sys.stdout.buffer.write(dump({
            'error': f'no agent serves {directory}: {error.strerror}', 'kind': 'absent'}))
        return 3

    def send() -> None:
        with contextlib.suppress(OSError):
            while data := os.read(0, BLOCK):
                link.sendall(data)
            link.shutdown(socket.SHUT_WR)  # the agent still answers pending requests

    threading.Thread(target=send, daemon=True).start()
    with contextlib.suppress(OSError, KeyboardInterrupt):
        while data := link.recv(BLOCK):
            while data:
                data = data[os.write(1, data):]
    return 0


def main(arguments: list[str]) -> int:
    """Run a command line; return the exit status."""
    daemon = '--detach' in arguments
    rest = [word for word in arguments if word != '--detach']
    if len(rest) == 3 and rest[:2] == ['serve', '--config']:
        return serve(rest[2], daemon=daemon)
    if len(rest) == 3 and rest[:2] == ['connect', '--directory']:
        return connect(rest[2])
    sys.stderr.write('usage: agent.py serve --config FILE [--detach]\n'
                     '       agent.py connect --directory DIR\n')
    return 2


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
