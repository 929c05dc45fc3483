# SPDX-License-Identifier: Apache-2.0
"""A Python program's function that reads a cloud's metadata service, on the machine."""

#: Begins a program: ``ask(path, head)`` returns an answer's body; OSError without status 200. It
#: uses a socket, because an HTTP library takes five times as long to load as the request takes.
ASK = """\
import os, socket, sys
def ask(path, head, method='GET'):
    with socket.create_connection(('169.254.169.254', 80), 2) as link:
        link.settimeout(2)
        lines = f'{method} {path} HTTP/1.0', 'Host: 169.254.169.254', head, '', ''
        link.sendall('\\r\\n'.join(lines).encode())
        answer = b''.join(iter(lambda: link.recv(4096), b''))
    top, _, body = answer.partition(b'\\r\\n\\r\\n')
    if top.split(b' ')[1:2] != [b'200']:
        raise OSError(top)
    return body.decode()
"""
