# SPDX-License-Identifier: Apache-2.0
"""How an instance finds out that AWS takes it back."""

# Runs on the machine every few seconds; asks AWS's metadata service there, with a token. By a
# plain socket: the library for it takes five times as long to load as this to run.
_PROGRAM = """\
import socket, sys
def ask(method, path, head):
    with socket.create_connection((sys.argv[1], int(sys.argv[2])), 2) as link:
        link.settimeout(2)
        lines = f'{method} /latest/{path} HTTP/1.0', 'Host: ' + sys.argv[1], head, '', ''
        link.sendall('\\r\\n'.join(lines).encode())
        answer = b''.join(iter(lambda: link.recv(4096), b''))
    top, _, body = answer.partition(b'\\r\\n\\r\\n')
    if top.split(b' ')[1:2] != [b'200']:
        sys.exit(1)
    return body.decode()
try:
    token = ask('PUT', 'api/token', 'X-aws-ec2-metadata-token-ttl-seconds: 60')
    print(ask('GET', 'meta-data/spot/instance-action', 'X-aws-ec2-metadata-token: ' + token))
except OSError:
    sys.exit(1)
"""
#: The command line whose success is the notice, and whose output says when.
NOTICE = ('python3', '-ISc', _PROGRAM, '169.254.169.254', '80')
