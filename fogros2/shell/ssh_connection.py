# SPDX-License-Identifier: Apache-2.0
"""Open an authenticated SSH connection to a machine whose host key is already known."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import errno
import getpass
import importlib.util
import io
import logging
import os
from pathlib import Path
import socket
import sys
import threading
import time
from typing import Any, Optional, TYPE_CHECKING
import warnings

from fogros2.errors import AuthenticationError, ConnectError, HostKeyError, PrerequisiteError
from fogros2.model import Command, Endpoint
from fogros2.shell import flow, known_hosts, proxy, ssh_config
from fogros2.shell.known_hosts import Known
from fogros2.shell.ssh_config import Settings

if TYPE_CHECKING:
    import paramiko

#: In order of preference; entries that the installed paramiko lacks are skipped.
CIPHERS = ('aes128-gcm@openssh.com', 'aes256-gcm@openssh.com', 'aes128-ctr', 'aes256-ctr')
KEX = ('curve25519-sha256@libssh.org', 'ecdh-sha2-nistp256', 'diffie-hellman-group14-sha256',
       'diffie-hellman-group-exchange-sha256')
#: Seconds of silence after which a packet is sent, and after which an unanswered packet ends the
#: connection: it survives a cut of 30 s, and a robot with a new address connects again.
KEEPALIVE = 15
USER_TIMEOUT = 60
_IMPORT = threading.Lock()


class PromptSocket(proxy.PacketSocket):
    """
    A TCP socket that acknowledges at once.

    During the set-up of a session, sshd sends small packets with Nagle's algorithm on. Each packet
    would wait for our delayed acknowledgement, 40 ms by Linux's default.
    """

    def recv(self, size: int, flags: int = 0) -> bytes:
        """Receive, and acknowledge at once."""
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
        # it takes 40 % of paramiko's import, for the settings that ssh itself reads for us
        modules: dict[str, Any] = sys.modules
        unused = modules.setdefault('invoke', None) is None
        import paramiko
        if unused:
            del modules['invoke']
    # paramiko's threads log errors that we raise; without a handler, Python would print them.
    logger = logging.getLogger(paramiko.__name__)
    if logger.level == logging.NOTSET:
        logger.setLevel(logging.CRITICAL)


def user_of(endpoint: Endpoint | Settings) -> str:
    """Return the login user, else the user of this process."""
    return endpoint.user or getpass.getuser()


def connect(endpoint: Endpoint, *, name: str, timeout: float) -> paramiko.Transport:
    """
    Open an encrypted connection, verify the host key, and log in.

    :param name: the machine's name, for messages.
    :param timeout: seconds for each of TCP, key exchange and login.
    :raises ConnectError: connection refused, no route, no answer, or no SSH server.
    :raises HostKeyError: the host key is unknown, or differs from the pinned one.
    :raises AuthenticationError: the server accepts none of our keys.
    :raises ConfigurationError: OpenSSH refuses its configuration.
    """
    _import()
    import paramiko

    settings = ssh_config.of(endpoint)
    known = known_keys(endpoint, settings)
    sock = proxy.dial(Command(settings.proxy), timeout) if settings.proxy \
        else _dial(settings, name, timeout)
    transport = transport_over(sock)
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
        _choose(transport, known)
        transport.start_client(timeout=timeout)
        _verify(endpoint, settings, name, transport.get_remote_server_key(), known)
        _log_in(transport, settings, name)
        transport.set_keepalive(KEEPALIVE)
    except (paramiko.SSHException, EOFError, OSError, AuthenticationError) as error:
        transport.close()
        if late.is_set():
            raise ConnectError(f"'{name}' ({settings.host} port {settings.port}) did not complete "
                               f'the login within {3 * timeout:g} s', 'try again') from error
        if isinstance(error, AuthenticationError):
            raise
        raise _explained(error, settings, name, bool(known.keys), sock) from error
    except BaseException:
        transport.close()
        raise
    finally:
        limit.cancel()
    return transport


def _dial(settings: Settings, name: str, timeout: float) -> PromptSocket:
    where = f"'{name}' ({settings.host} port {settings.port})"
    try:
        sock = open_socket(settings, timeout)
    except socket.gaierror as error:
        if error.errno == socket.EAI_AGAIN:
            raise ConnectError(f"'{name}': no DNS server answers for '{settings.host}'",
                               "check the robot's network") from error
        raise ConnectError(f"'{name}': there is no host called '{settings.host}'",
                           'check host=') from error
    except ConnectionRefusedError as error:
        raise ConnectError(f'{where} refuses connections', 'does its SSH server run?') from error
    except TimeoutError as error:
        raise ConnectError(f'{where} does not answer within {timeout:g} s',
                           'is it on, and is the port open for this robot?') from error
    except OSError as error:
        raise ConnectError(f'{where} can not be reached: {error.strerror or error}',
                           "check the robot's network") from error
    sock.settimeout(timeout)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, USER_TIMEOUT * 1000)
    flow.keep_prompt(sock)
    return sock


def open_socket(settings: Settings, timeout: float) -> PromptSocket:
    """
    Connect to a host; each address gets its share of the time, as one may lead nowhere.

    :param timeout: seconds for all addresses together.
    :raises OSError: that of the last address.
    """
    end = time.monotonic() + timeout
    found = socket.getaddrinfo(
        settings.host, settings.port, settings.family, socket.SOCK_STREAM)
    for rest, (family, kind, protocol, _, address) in zip(range(len(found), 0, -1), found):
        sock = PromptSocket(family, kind, protocol)
        try:
            sock.settimeout(max(0.1, (end - time.monotonic()) / rest))
            sock.connect(address)
            return sock
        except OSError:
            sock.close()
            if rest == 1:
                raise
    raise OSError('the host has no address')


def _choose(transport: paramiko.Transport, known: Known) -> None:
    """Restrict the negotiation to fast and safe algorithms, and to the types of known keys."""
    options = transport.get_security_options()
    options.ciphers = [c for c in CIPHERS if c in options.ciphers] or options.ciphers
    options.kex = [k for k in KEX if k in options.kex] or options.kex
    names = [n for key in known.keys for n in (
        ('rsa-sha2-512', 'rsa-sha2-256') if key.startswith('ssh-rsa ') else (key.split()[0],))]
    types = [n for n in options.key_types if n in names] or sorted(
        options.key_types, key=lambda n: n != 'ssh-ed25519')
    if known.authorities:
        types = [n + known_hosts.CERTIFICATE for n in options.key_types
                 if n not in ('ssh-rsa', 'ssh-dss')] + types
    options.key_types = types


def transport_over(sock: socket.socket) -> paramiko.Transport:
    """
    Return a transport whose channels raise only OSErrors.

    paramiko raises an EOFError for a connection that is gone, even in a read, which makes room for
    more; and an SSHException if the key exchange takes too long. A login raises a
    ConnectionAbortedError only if the server ends it with a message.
    """
    import paramiko

    turns = flow.Turns()

    class Transport(paramiko.Transport):
        def _send_user_message(self, data: paramiko.Message) -> None:
            try:
                with turns:
                    super()._send_user_message(data)  # type: ignore[misc]
            except EOFError as error:
                # paramiko's own thread shows number and text of an error of a socket
                raise ConnectionResetError(
                    errno.ECONNRESET, 'the connection is gone') from error
            except paramiko.SSHException as error:
                raise TimeoutError(str(error)) from error

        def _parse_disconnect(self, message: paramiko.Message) -> None:
            super()._parse_disconnect(message)  # type: ignore[misc]
            raise ConnectionAbortedError(
                errno.ECONNABORTED, 'the server ended the connection')

    return Transport(sock)


def limited(channel: paramiko.Channel) -> paramiko.Channel:
    """
    Let the link's rate set a channel's window, and a server that exceeds it lose its connection.

    :param channel: opened with a window of ``flow.LEAST``.
    """
    import paramiko
    from paramiko.buffered_pipe import BufferedPipe

    window = flow.Window()

    def read(count: int) -> int:
        with channel.lock:
            if channel.closed or channel.eof_received or not channel.active:
                return 0
            return window.read(count, time.monotonic())

    class Limited(BufferedPipe):  # type: ignore[type-arg]
        def feed(self, data: bytes) -> None:
            if len(self) + len(data) > window.size:
                raise paramiko.SSHException('the server sends more than its window')
            super().feed(data)

    channel.in_buffer, channel.in_stderr_buffer = Limited(), Limited()
    vars(channel)['_check_add_window'] = read
    channel.out_max_packet_size = min(channel.out_max_packet_size, flow.PIECE)
    return channel


def known_keys(endpoint: Endpoint, settings: Settings | None = None) -> Known:
    """
    Return the accepted host keys: the pinned one, or those of known_hosts.

    :raises HostKeyError: the pinned key is no key, or known_hosts cannot be read.
    """
    if endpoint.host_key is None:
        return known_hosts.look_up(settings or ssh_config.of(endpoint))
    words = endpoint.host_key.split()
    if len(words) < 2:
        raise HostKeyError(f"'{endpoint.host_key}' is no host key",
                           "host_key= takes 'ssh-ed25519 AAAA...'")
    return Known((' '.join(words[:2]),))


def _verify(
    endpoint: Endpoint, settings: Settings, name: str, key: paramiko.PKey, known: Known,
) -> None:
    line, label = f'{key.get_name()} {key.get_base64()}', known_hosts.label_of(settings)
    where = f"'{name}' ({settings.host})"
    if line in known.revoked:
        raise HostKeyError(f'{where} shows a host key that known_hosts revokes',
                           'another machine may answer there, with a stolen key')
    if known.authorities and key.public_blob is not None:
        fault = known_hosts.fault_of(
            key.public_blob.key_blob, settings.label or settings.host, known)
        if fault:
            raise HostKeyError(f'the certificate of {where} {fault}',
                               'ask who signed it for a new one')
        if fault == '':
            return
    if line in known.keys:
        return
    if endpoint.host_key is not None:
        raise HostKeyError(
            f'{where} shows another host key than the pinned one',
            f'another machine answers there; its key is {line}')
    if known.keys:
        raise HostKeyError(
            f'{where} shows another host key than known_hosts has',
            f"if the machine was set up anew: ssh-keygen -R '{label}'")
    file = settings.known_hosts[0]
    raise HostKeyError(
        f"the host key of '{name}' ({settings.host}) is unknown", 'if it is right, ' + (
            f"give host_key='{line}'" if file in ('none', os.devnull) else
            f'add this line to {file}: {label} {line}'))


def _log_in(transport: paramiko.Transport, settings: Settings, name: str) -> None:
    import paramiko
    user, tried, locked = user_of(settings), 0, list[str]()
    where = f"'{name}' ({user}@{settings.host})"
    for key in _keys(settings, name, locked):
        tried += 1
        try:
            transport.auth_publickey(user, key)
            return
        except ConnectionAbortedError:
            raise AuthenticationError(
                f'{where} ended the login: it was offered too many keys, {tried}',
                'name the right one by key=, or by IdentityFile and IdentitiesOnly in '
                '~/.ssh/config') from None
        except paramiko.AuthenticationException as error:
            if not transport.is_active() or str(error) == 'Authentication timeout.':
                raise TimeoutError('the login got no answer') from error
    add = f'ssh-add {locked[0]}' if locked else ''
    if add and not os.environ.get('SSH_AUTH_SOCK'):
        add = f'eval "$(ssh-agent)"; {add}'
    if not tried:
        raise AuthenticationError(
            f"the key {locked[0]} for '{name}' has a passphrase" if locked else
            f"there is no key to log in to '{name}' with",
            add or 'give key=, or make one with: ssh-keygen -t ed25519')
    what = settings.keys[0] if settings.only_keys and settings.keys else "the user's own keys"
    raise AuthenticationError(
        f'{where} does not accept {what}',
        (f'{add}, which has a passphrase; or ' if add else '')
        + f'add the public key to ~{user}/.ssh/authorized_keys there')


def _keys(settings: Settings, name: str, locked: list[str]) -> Iterator[paramiko.PKey]:
    """
    Yield the keys in OpenSSH's order: those of the agent first, of these the named ones.

    :param locked: gets the files of keys with a passphrase.
    """
    import paramiko
    files = [Path(file).expanduser() for file in settings.keys]
    if not settings.only_keys:
        held = _agent_keys(settings.agent)
        named = [public for path in files if (public := _public(path)) in held]
        yield from (held[public] for public in dict.fromkeys([*named, *held]))
        files = [path for path in files if path.is_file() and _public(path) not in held]
    for path in files:
        try:
            yield load_key(path, name)
        except AuthenticationError as error:
            # the file may also be the public half, or missing beside it
            held = _agent_keys(settings.agent) if settings.only_keys else {}
            if _public(path) in held:
                yield held[_public(path)]
            elif isinstance(error.__cause__, paramiko.PasswordRequiredException):
                locked.append(str(path))
            elif len(files) == 1 and settings.only_keys:
                raise


def _agent_keys(socket_path: str) -> dict[str, paramiko.AgentKey]:
    """Return the keys of the agent by their base64, none if it does not answer."""
    import paramiko
    path = os.path.expandvars(os.path.expanduser(socket_path))
    try:
        if path in ('', 'SSH_AUTH_SOCK'):
            keys = paramiko.Agent().get_keys()
        elif path == 'none':
            keys = ()
        else:
            link = socket.socket(socket.AF_UNIX)
            link.connect(path)
            agent = paramiko.agent.AgentSSH()
            agent._connect(link)  # type: ignore[attr-defined]
            keys = agent.get_keys()
    except (paramiko.SSHException, OSError):
        keys = ()
    return {key.get_base64(): key for key in keys}


def _public(path: Path) -> str:
    """Return the base64 of a private key's public file, or of a public one; '' without one."""
    file = path if path.suffix == '.pub' else path.with_name(f'{path.name}.pub')
    try:
        return file.read_text().split()[1]
    except (OSError, ValueError, IndexError):
        return ''


def load_key(path: Path, name: str) -> paramiko.PKey:
    """
    Load a private key.

    :raises AuthenticationError: the key cannot be read, or has a passphrase.
    """
    import paramiko
    for kind in (paramiko.Ed25519Key, paramiko.ECDSAKey, paramiko.RSAKey):
        try:
            key: paramiko.PKey = kind.from_private_key_file(str(path))
            return key
        except paramiko.PasswordRequiredException as error:
            raise AuthenticationError(f'the key {path} has a passphrase',
                                      f'ssh-add {path}') from error
        except OSError as error:
            raise AuthenticationError(
                f"the key {path} for '{name}' can not be read: {error.strerror}",
                'check the owner and the mode of the file') from error
        except (paramiko.SSHException, ValueError, IndexError):
            continue  # another type of key
    if (converted := _pkcs8_key(path)) is not None:
        return converted
    raise AuthenticationError(f'{path} is no private key that SSH knows',
                              'check the content of the file; a full disk leaves it empty')


def _pkcs8_key(path: Path) -> Optional[paramiko.PKey]:
    """
    Load a private key in the form of OpenSSL, PKCS#8, without a passphrase; None for other files.

    OpenSSH reads that form, paramiko does not.
    """
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives import serialization
    import paramiko
    try:
        text = serialization.load_pem_private_key(path.read_bytes(), None).private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.OpenSSH,
            serialization.NoEncryption()).decode()
    except (TypeError, ValueError, UnsupportedAlgorithm):
        return None
    for kind in (paramiko.Ed25519Key, paramiko.ECDSAKey, paramiko.RSAKey):
        with contextlib.suppress(paramiko.SSHException):
            key: paramiko.PKey = kind.from_private_key(io.StringIO(text))
            return key
    return None


def _explained(
    error: Exception, settings: Settings, name: str, known: bool, sock: socket.socket,
) -> ConnectError | HostKeyError | AuthenticationError:
    text = str(error) or type(error).__name__
    if known and 'host key' in text.lower() or 'ncompatible ssh peer (no acceptable host' in text:
        return HostKeyError(
            f"'{name}' ({settings.host}) has no host key of the type that is known",
            'another machine answers there, or the machine was reinstalled')
    where = f"'{name}' ({settings.host} port {settings.port})"
    if isinstance(sock, proxy.ProxySocket) and (complaint := sock.complaint()):
        return ConnectError(f'the way to {where} fails: {complaint}',
                            f"try it with ssh; it is: {' '.join(settings.proxy)}")
    if 'banner' in text or isinstance(error, EOFError):
        return ConnectError(f'{where} does not answer as an SSH server',
                            'it may still be starting, or limit connections')
    return ConnectError(f'the connection to {where} failed: {text}')
