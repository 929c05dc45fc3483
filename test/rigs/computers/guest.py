# SPDX-License-Identifier: Apache-2.0
"""
What an instance runs as its first process: a small cloud-init, an SSH server, and a way to end.

Standard library alone; it is copied into the instance. The order is that of an Ubuntu image
(``cloud_init_modules`` and so on in its cloud.cfg): bootcmd, then the keys, then sshd, then the
commands of runcmd. What belongs to the first boot alone is done
again when the instance's id is another, as after an image was made of it.

With an argument it is a program of the instance, such as ``shutdown``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import contextlib
import json
import os
import pwd
import select
import signal
import subprocess
import sys
import time
from typing import Any

PLAN = '/opt/ec2/plan.json'
STATE = '/var/lib/cloud'
SSHD_PID = '/run/sshd.pid'
PATH = '/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin'
#: Exit status by which the box knows that the instance wants to start again.
REBOOT = 85


def say(text: str) -> None:
    """Write a line to the instance's console."""
    print(f'[{time.monotonic():.3f}] {text}', flush=True)


def write(path: str, data: bytes, mode: int = 0o644) -> None:
    """Write a file and the folders above it."""
    os.makedirs(os.path.dirname(path), exist_ok=True)
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode)
    with os.fdopen(handle, 'wb') as file:
        file.write(data)
    os.chmod(path, mode)


def run(words: Sequence[str], **variables: str) -> None:
    """Run a command of the user data; its failure is no end."""
    try:
        code = subprocess.call(words, stdin=subprocess.DEVNULL, cwd='/',
                               env={**os.environ, **variables})
    except OSError as error:
        say(f'cloud-init: {words[0]}: {error}')
        return
    if code != 0:
        say(f'cloud-init: exit status {code} of {words!r}')


def authorize(user: str, keys: Sequence[str]) -> None:
    """Let ``keys`` log in as ``user``."""
    known = pwd.getpwnam(user)
    folder = os.path.join(known.pw_dir, '.ssh')
    os.makedirs(folder, mode=0o700, exist_ok=True)
    path = os.path.join(folder, 'authorized_keys')
    there = ''
    with contextlib.suppress(FileNotFoundError), open(path) as file:
        there = file.read()
    new = [key.strip() for key in keys if key.strip() and key.strip() not in there]
    write(path, (there + ''.join(f'{key}\n' for key in new)).encode(), 0o600)
    for name in (folder, path):
        os.chown(name, known.pw_uid, known.pw_gid)


def host_keys(plan: Mapping[str, Any]) -> None:
    """Put the host keys of the user data in place, or make some."""
    for name in os.listdir('/etc/ssh'):
        if name.startswith('ssh_host_'):
            os.unlink(f'/etc/ssh/{name}')
    if plan['ssh_keys']:
        write('/etc/ssh/ssh_host_ed25519_key', plan['ssh_keys']['ed25519_private'].encode(), 0o600)
        write('/etc/ssh/ssh_host_ed25519_key.pub', plan['ssh_keys']['ed25519_public'].encode())
    else:
        run(['ssh-keygen', '-q', '-t', 'ed25519', '-N', '', '-C', 'root@instance',
             '-f', '/etc/ssh/ssh_host_ed25519_key'])


def google_guest_agent() -> None:
    """Make other host keys, unless the agent's configuration says otherwise."""
    with contextlib.suppress(FileNotFoundError), open('/etc/default/instance_configs.cfg') as file:
        if '[InstanceSetup]\nset_host_keys = false\n' in file.read():
            return
    host_keys({'ssh_keys': {}})


def first_stage(plan: Mapping[str, Any], new: bool) -> None:
    """Do what comes before sshd."""
    for command in plan['bootcmd']:
        run(command, INSTANCE_ID=plan['instance'])
    if not new:
        return
    if plan['hostname']:
        write('/etc/hostname', plan['hostname'].encode() + b'\n')
    host_keys(plan)
    if plan.get('google'):
        google_guest_agent()
    authorize(plan['user'], [*plan['keys'], *plan['ssh_authorized_keys']])


def last_stage() -> None:
    """Do what comes after sshd, in a process of its own."""
    with open(PLAN) as file:
        plan = json.load(file)
    if new_instance(plan):
        for words in plan['runcmd']:
            run(words)
        write(f'{STATE}/data/instance-id', plan['instance'].encode())
    say('cloud-init: finished')


def new_instance(plan: Mapping[str, Any]) -> bool:
    """Return whether this is the first boot of this instance."""
    try:
        with open(f'{STATE}/data/instance-id') as file:
            return bool(file.read() != plan['instance'])
    except FileNotFoundError:
        return True


def start_sshd() -> subprocess.Popen[bytes]:
    """Start the SSH server, whose process id lies where Ubuntu's does."""
    os.makedirs('/run/sshd', exist_ok=True)
    return subprocess.Popen(['/usr/sbin/sshd', '-D', '-e'], stdin=subprocess.DEVNULL)


def first_process() -> None:
    """Boot, take in orphans until a request to end the instance, and end it."""
    code: list[int] = []
    wake, waker = os.pipe()
    for end in (wake, waker):
        os.set_blocking(end, False)
    signal.set_wakeup_fd(waker)
    signal.signal(signal.SIGCHLD, lambda _number, _frame: None)
    signal.signal(signal.SIGTERM, lambda _number, _frame: code.append(0))
    signal.signal(signal.SIGINT, lambda _number, _frame: code.append(REBOOT))

    def wait(seconds: float) -> None:
        if select.select([wake], [], [], seconds)[0]:
            os.read(wake, 4096)

    os.environ.clear()
    os.environ.update(PATH=PATH, LANG='C.UTF-8', HOME='/root')
    with open(PLAN) as file:
        plan = json.load(file)
    write('/etc/hosts', f'127.0.0.1 localhost\n127.0.1.1 {os.uname().nodename}\n'.encode())
    say('cloud-init: begins')
    first_stage(plan, new_instance(plan))
    sshd = start_sshd()
    say('sshd: started')
    subprocess.Popen([sys.executable, '-IS', __file__, 'final'], stdin=subprocess.DEVNULL)
    while not code:
        try:
            pid, _ = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            pid = 0
        if pid == sshd.pid:
            sshd = start_sshd()
        elif pid == 0:
            wait(5.0)
    say('going down')
    with contextlib.suppress(ProcessLookupError):
        os.kill(-1, signal.SIGTERM)
    deadline = time.monotonic() + 1.0
    while time.monotonic() < deadline:
        try:
            if os.waitpid(-1, os.WNOHANG)[0] == 0:
                wait(0.05)
        except ChildProcessError:
            break
    sys.exit(code[0])


def systemctl(words: Sequence[str]) -> None:
    """Answer the few orders to systemd that make sense here; others fail as they do without it."""
    order = [word for word in words if not word.startswith('-')]
    ssh = {'ssh', 'sshd', 'ssh.service', 'sshd.service'}
    if order[:1] in (['poweroff'], ['reboot']):
        os.kill(1, signal.SIGINT if order == ['reboot'] else signal.SIGTERM)
    elif order[:1] and set(order[1:]) & ssh and order[0] in (
            'reload', 'restart', 'try-restart', 'reload-or-restart'):
        with open(SSHD_PID) as file:
            os.kill(int(file.read()), signal.SIGHUP)
    elif order[:1] == ['is-active'] and set(order[1:]) <= ssh:
        print('active')
    elif order[:1] != ['daemon-reload']:
        print(f'systemctl of a cloud in a box knows no {" ".join(words)!r}', file=sys.stderr)
        sys.exit(1)


def shutdown(program: str, words: Sequence[str]) -> None:
    """End the instance, as ``shutdown``, ``poweroff`` and ``reboot`` do."""
    when = 0.0 if program != 'shutdown' else 60.0
    again = program == 'reboot'
    for word in words:
        if word in ('now', '+0'):
            when = 0.0
        elif word[:1] == '+':
            when = 60.0 * int(word[1:])
        elif word in ('-r', '--reboot'):
            again = True
    if when and os.fork():
        return
    time.sleep(when)
    os.kill(1, signal.SIGINT if again else signal.SIGTERM)


def main() -> None:
    """Be what this is called as."""
    program = sys.argv[1] if len(sys.argv) > 1 else ''
    if program == 'final':
        last_stage()
    elif program == 'systemctl':
        systemctl(sys.argv[2:])
    elif program:
        shutdown(program, sys.argv[2:])
    else:
        first_process()


if __name__ == '__main__':
    main()
