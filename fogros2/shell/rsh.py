# SPDX-License-Identifier: Apache-2.0
"""
Pass rsync's streams to the process that called rsync; rsync calls this as its remote shell.

That process already has a connection to the machine, which saves a second login. Run by path, with
only the standard library: ``python3 -I -S rsh.py SOCKET HOST WORD...``, with an inherited socket.
"""

import os
import socket
import sys


def main() -> int:
    """Send the streams and the command line; return the exit status of the command."""
    link = socket.socket(fileno=int(sys.argv[1]))
    socket.send_fds(link, [' '.join(sys.argv[3:]).encode()], [0, 1, 2])
    os.close(0)
    os.close(1)
    return (link.recv(1) or b'\xff')[0]


if __name__ == '__main__':
    sys.exit(main())
