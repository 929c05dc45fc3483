# SPDX-License-Identifier: Apache-2.0
"""
What rsync calls as its remote shell: hands its streams to the process that called rsync.

That process has a connection to the machine already, which saves a second one, with its own
login. Run by path, standard library only: ``python3 -I -S rsh.py SOCKET HOST WORD...``.
"""

import os
import socket
import sys


def main() -> int:
    """Hand over the streams and the command line; return the exit status that comes back."""
    link = socket.socket(socket.AF_UNIX)
    # a name without a file: nothing to leave behind
    link.connect('\0' + sys.argv[1])
    socket.send_fds(link, [' '.join(sys.argv[3:]).encode()], [0, 1, 2])
    os.close(0)
    os.close(1)
    return (link.recv(1) or b'\xff')[0]


if __name__ == '__main__':
    sys.exit(main())
