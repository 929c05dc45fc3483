# SPDX-License-Identifier: Apache-2.0
"""A machine's bridge to Foxglove, as the command line reaches it."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import http.client
from pathlib import Path
import threading

from fogros2.errors import AgentError, CommandError, ConfigurationError
from fogros2.model import Command
from fogros2.monitor import credentials, page
from fogros2.monitor.tunnel import Tunnel
from fogros2.shell import Shell
from ros2fog_cli.api.machines import Entry

#: Seconds in which the machine's gate has to answer.
_PATIENCE = 15.0


@contextlib.contextmanager
def carrying(tunnel: Tunnel) -> Iterator[threading.Event]:
    """Have a tunnel take connections, in threads; yield an event that is set when it doesn't."""
    ended = threading.Event()

    def carry() -> None:
        tunnel.serve()
        ended.set()

    thread = threading.Thread(target=carry, name='fog-monitor', daemon=True)
    thread.start()
    try:
        yield ended
    finally:
        tunnel.close()
        thread.join(5.0)


def has_application(port: int) -> bool:
    """Return whether the gate at a port of the loopback has the web application behind it."""
    connection = http.client.HTTPConnection('localhost', port, timeout=_PATIENCE)
    with contextlib.closing(connection):
        try:
            connection.request('GET', '/')
            answer = connection.getresponse()
        except (OSError, http.client.HTTPException):
            return False  # the tunnel says what is wrong
        return answer.getheader(page.MARK) is None and answer.status == 200


def credentials_of(entry: Entry, shell: Shell) -> tuple[str, str, str]:
    """
    Return where others reach the bridge (``host:port``), the token, the certificate's SHA-256.

    :raises ConfigurationError: nobody else is let in.
    :raises AgentError: this robot's launch isn't the one that lets them in.
    """
    record = entry.record
    if record is None or not record.monitor or not record.launch_alive or not record.agent:
        raise AgentError(f"no launch of this robot serves the topics of '{entry.name}' now",
                         'ros2 fog list shows whose it is')
    if not record.monitor_open:
        raise ConfigurationError(
            f"nobody but this robot may watch '{entry.name}'",
            "monitor_allow=['198.51.100.0/28'] in its launch file lets others in")
    made = credentials.Credentials(Path(
        credentials.folder_of(record.agent, record.monitor, record.launch)))
    try:
        said = shell.run(Command(
            ('cat', str(made.token), str(made.certificate)), sudo=True, what='read the token'),
            timeout=_PATIENCE).stdout
    except CommandError as error:
        raise AgentError(f"'{entry.name}' has no token yet, or can't make one: {error}",
                         f'ros2 fog logs {entry.name}') from error
    token, _, certificate = said.partition('\n')
    return record.monitor_open, token.strip(), credentials.fingerprint(certificate)
