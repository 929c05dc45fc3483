# SPDX-License-Identifier: Apache-2.0
"""Open an authenticated SSH connection to a machine whose host key is already known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import getpass
import importlib.util
import logging
import os
from pathlib import Path
import socket
import sys
import threading
from typing import TYPE_CHECKING
import warnings

from fogros2.errors import AuthenticationError, ConnectError, HostKeyError, PrerequisiteError
from fogros2.model import Endpoint

if TYPE_CHECKING:
    import paramiko

#: In order of preference; entries that the installed paramiko lacks are skipped.
CIPHERS = ('aes128-gcm@openssh.com', 'aes256-gcm@openssh.com', 'aes128-ctr', 'aes256-ctr')
KEX = ('curve25519-sha256@libssh.org', 'ecdh-sha2-nistp256', 'diffie-hellman-group14-sha256',
       'diffie-hellman-group-exchange-sha256')
KNOWN_HOSTS = (Path('~/.ssh/known_hosts'), Path('/etc/ssh/ssh_known_hosts'))
OWN_KEYS = ('id_ed25519', 'id_ecdsa', 'id_rsa')
#: Seconds of silence after which a packet is sent, and after which an unanswered packet ends the
#: connection: it survives a cut of 30 s, and a robot with a new address connects again.
KEEPALIVE = 15
USER_TIMEOUT = 60
#: Maximum bytes of a packet; OpenSSH's is 256 kB.
_PACKET = 1 << 19
_IMPORT = threading.Lock()


class PromptSocket(socket.socket):
    """
    A TCP socket that acknowledges at once.

    During the set-up of a session, sshd sends small packets with Nagle's algorithm on. Each packet
    would wait for our delayed acknowledgement, 40 ms by Linux's default.
    """

    def recv(self, size: int, flags: int = 0) -> bytes:
        """
        Receive, and acknowledge at once.

        :raises EOFError: the server announces a packet that would fill the memory.
        """
        if size > _PACKET:
            raise EOFError(f'a packet of {size} bytes')
        data = super().recv(size, flags)
        if data:
            self.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        return data


def warm() -> threading.Thread:
    """
    Import paramiko in a thread, so that the first connection need not wait for it.

    :raises PrerequisiteError: paramiko is not installed.
    """
    if importlib.util.find_spec('paramiko') is None:
        raise PrerequisiteError("the Python package 'paramiko' is missing here",
                                'python3 -m pip install paramiko')
    thread = threading.Thread(target=_import, name='fog-warm', daemon=True)
    thread.start()
    return thread


def _import() -> None:
    with _IMPORT, warnings.catch_warnings():
        # the paramiko of Ubuntu 24.04 names a cipher of which a newer cryptography warns the user
        warnings.simplefilter('ignore')
        if 'paramiko' not in sys.modules and 'invoke' not in sys.modules:
            # paramiko imports 'invoke' only for a keyword of ssh_config files, which this
            # project never reads, and works without it. The import takes a third of its time.
            sys.modules['invoke'] = None  # type: ignore[assignment]
            try:
                import paramiko
            finally:
                del sys.modules['invoke']
        import paramiko
    # paramiko's threads log errors that we raise; without a handler, Python would print them.
    logger = logging.getLogger(paramiko.__name__)
    if logger.level == logging.NOTSET:
        logger.setLevel(logging.CRITICAL)


def user_of(endpoint: Endpoint) -> str:
    """Return the endpoint's login user, else the user of this process."""
    return endpoint.user or getpass.getuser()


def host_label(endpoint: Endpoint) -> str:
    """Return the machine's name in ``known_hosts``."""
    if endpoint.port == 22:
        return endpoint.host
    return f'[{endpoint.host}]:{endpoint.port}'


def connect(endpoint: Endpoint, *, name: str, timeout: float) -> paramiko.Transport:
    """
    Open an encrypted connection, verify the host key, and log in.

    :param name: the machine's name, for messages.
    :param timeout: seconds for each of TCP, key exchange and login.
    :raises ConnectError: connection refused, no route, no answer, or no SSH server.
    :raises HostKeyError: the host key is unknown, or differs from the pinned one.
    :raises AuthenticationError: the server accepts none of our keys.
    """
    _import()
    import paramiko

    known = known_keys(endpoint)
    transport = paramiko.Transport(_dial(endpoint, name, timeout))
    # paramiko's own limits follow the clock, which may be set back meanwhile
    late = threading.Event()

    def give_up() -> None:
        late.set()
        transport.close()

    limit = threading.Timer(3 * timeout, give_up)
    limit.daemon = True
    limit.start()
    try:
        transport.daemon = True
        transport.banner_timeout = transport.handshake_timeout = timeout
        transport.auth_timeout = timeout
        _choose(transport, [key.split()[0] for key in known])
        transport.start_client(timeout=timeout)
        _verify(endpoint, name, transport.get_remote_server_key(), known)
        _log_in(transport, endpoint, name)
        transport.set_keepalive(KEEPALIVE)
    except (paramiko.SSHException, EOFError, OSError, AuthenticationError) as error:
        transport.close()
        if late.is_set():
            raise ConnectError(f"'{name}' ({endpoint.host} port {endpoint.port}) did not complete "
                               f'the login within {3 * timeout:g} s', 'try again') from error
        if isinstance(error, AuthenticationError):
            raise
        raise _explained(error, endpoint, name, bool(known)) from error
    except BaseException:
        transport.close()
        raise
    finally:
        limit.cancel()
    return transport


def _dial(endpoint: Endpoint, name: str, timeout: float) -> PromptSocket:
    where = f"'{name}' ({endpoint.host} port {endpoint.port})"
    try:
        plain = socket.create_connection((endpoint.host, endpoint.port), timeout=timeout)
    except socket.gaierror as error:
        raise ConnectError(f"'{name}': there is no host called '{endpoint.host}'",
                           'check host=') from error
    except ConnectionRefusedError as error:
        raise ConnectError(f'{where} refuses connections', 'does its SSH server run?') from error
    except TimeoutError as error:
        raise ConnectError(f'{where} does not answer within {timeout:g} s',
                           'is it on, and is the port open for this robot?') from error
    except OSError as error:
        raise ConnectError(f'{where} can not be reached: {error.strerror or error}',
                           "check the robot's network") from error
    sock = PromptSocket(plain.family, plain.type, plain.proto, fileno=plain.detach())
    sock.settimeout(timeout)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, USER_TIMEOUT * 1000)
    return sock


def _choose(transport: paramiko.Transport, key_types: Sequence[str]) -> None:
    """Restrict the negotiation to fast and safe algorithms, and to the types of known keys."""
    options = transport.get_security_options()
    options.ciphers = [c for c in CIPHERS if c in options.ciphers] or options.ciphers
    options.kex = [k for k in KEX if k in options.kex] or options.kex
    if key_types:
        names = [n for t in key_types for n in (
            ('rsa-sha2-512', 'rsa-sha2-256') if t == 'ssh-rsa' else (t,))]
        options.key_types = [n for n in options.key_types if n in names] or options.key_types
    else:
        first = [n for n in options.key_types if n == 'ssh-ed25519']
        options.key_types = first + [n for n in options.key_types if n not in first]


def limited(channel: paramiko.Channel, window: int) -> paramiko.Channel:
    """Let a channel close its connection if the server sends more than its window."""
    import paramiko
    from paramiko.buffered_pipe import BufferedPipe

    class Limited(BufferedPipe):  # type: ignore[type-arg]
        def feed(self, data: bytes) -> None:
            if len(self) + len(data) > window:
                raise paramiko.SSHException('the server sends more than its window')
            super().feed(data)

    channel.in_buffer, channel.in_stderr_buffer = Limited(), Limited()
    return channel


def known_keys(endpoint: Endpoint) -> list[str]:
    """
    Return the accepted host keys (``type base64``): the pinned one, or those of known_hosts.

    :raises HostKeyError: the pinned key is no key, or known_hosts cannot be read.
    """
    import paramiko
    if endpoint.host_key is not None:
        words = endpoint.host_key.split()
        if len(words) < 2:
            raise HostKeyError(f"'{endpoint.host_key}' is no host key",
                               "host_key= takes 'ssh-ed25519 AAAA...'")
        return [' '.join(words[:2])]
    found: list[str] = []
    for path in KNOWN_HOSTS:
        file = path.expanduser()
        if file.is_file():
            hosts = paramiko.HostKeys()
            try:
                hosts.load(str(file))
            except (paramiko.SSHException, OSError) as error:
                raise HostKeyError(f'{file} can not be read: {error}') from error
            entry = hosts.lookup(host_label(endpoint))
            if entry is not None:
                found += [f'{kind} {entry[kind].get_base64()}' for kind in entry.keys()]
    return found


def _verify(
    endpoint: Endpoint, name: str, key: paramiko.PKey, known: Sequence[str],
) -> None:
    line = f'{key.get_name()} {key.get_base64()}'
    if line in known:
        return
    if endpoint.host_key is not None:
        raise HostKeyError(
            f"'{name}' ({endpoint.host}) shows another host key than the pinned one",
            f'another machine answers there; its key is {line}')
    if known:
        raise HostKeyError(
            f"'{name}' ({endpoint.host}) shows another host key than known_hosts has",
            f"if the machine was set up anew: ssh-keygen -R '{host_label(endpoint)}'")
    raise HostKeyError(
        f"the host key of '{name}' ({endpoint.host}) is unknown",
        'if it is right, add this line to ~/.ssh/known_hosts: '
        f'{host_label(endpoint)} {line}')


def _log_in(transport: paramiko.Transport, endpoint: Endpoint, name: str) -> None:
    import paramiko
    user = user_of(endpoint)
    tried = 0
    for key in _keys(endpoint, name):
        tried += 1
        try:
            transport.auth_publickey(user, key)
            return
        except paramiko.AuthenticationException:
            if not transport.is_active():
                break  # the server allows no further keys
    where = endpoint.key_file or "the user's own keys"
    raise AuthenticationError(
        f"'{name}' ({user}@{endpoint.host}) does not accept {where}" if tried else
        f"there is no key to log in to '{name}' with",
        f'add the public key to ~{user}/.ssh/authorized_keys there' if tried else
        'give key=, or make one with: ssh-keygen -t ed25519')


def _keys(endpoint: Endpoint, name: str) -> Iterator[paramiko.PKey]:
    import paramiko
    if endpoint.key_file is not None:
        yield load_key(Path(endpoint.key_file).expanduser(), name)
        return
    try:
        yield from paramiko.Agent().get_keys()
    except paramiko.SSHException:
        pass  # ignore an agent that does not answer
    for own in OWN_KEYS:
        path = Path('~/.ssh', own).expanduser()
        if path.is_file():
            try:
                yield load_key(path, name)
            except AuthenticationError:
                continue  # a key with a passphrase must come from the agent


def load_key(path: Path, name: str) -> paramiko.PKey:
    """
    Load a private key.

    :raises AuthenticationError: the key cannot be read, or has a passphrase.
    """
    import paramiko
    if not os.access(path, os.R_OK):
        raise AuthenticationError(f"the key {path} for '{name}' can not be read",
                                  'check the owner and the mode of the file')
    for kind in (paramiko.Ed25519Key, paramiko.ECDSAKey, paramiko.RSAKey):
        try:
            key: paramiko.PKey = kind.from_private_key_file(str(path))
            return key
        except paramiko.PasswordRequiredException as error:
            raise AuthenticationError(f'the key {path} has a passphrase',
                                      f'ssh-add {path}') from error
        except (paramiko.SSHException, ValueError, IndexError):
            continue  # another type of key
    raise AuthenticationError(f'{path} is no private key that SSH knows',
                              'check the content of the file; a full disk leaves it empty')


def _explained(
    error: Exception, endpoint: Endpoint, name: str, known: bool,
) -> ConnectError | HostKeyError | AuthenticationError:
    text = str(error) or type(error).__name__
    if known and 'host key' in text.lower() or 'ncompatible ssh peer (no acceptable host' in text:
        return HostKeyError(
            f"'{name}' ({endpoint.host}) has no host key of the type that is known",
            'another machine answers there, or the machine was reinstalled')
    where = f"'{name}' ({endpoint.host} port {endpoint.port})"
    if 'banner' in text or isinstance(error, EOFError):
        return ConnectError(f'{where} does not answer as an SSH server',
                            'it may still be starting, or limit connections')
    return ConnectError(f'the connection to {where} failed: {text}')
