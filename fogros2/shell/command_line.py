# SPDX-License-Identifier: Apache-2.0
"""Build command lines for a remote shell, and check the results of commands; pure."""

from __future__ import annotations

import dataclasses
import re
import shlex

from fogros2.errors import CommandError
from fogros2.model import Command, Result

#: What a machine prints before the output of a command.
MARK = b'fogros2 begins here\n'
_ANNOUNCE = 'echo $$; exec "$@"'


def words(command: Command, *, root: bool) -> list[str]:
    """
    Return a command's argument list, with sudo and the environment in front if necessary.

    :param root: whether the login user is root.
    """
    line = [f'{name}={value}' for name, value in command.environment.items()]
    argv = ['env', *line, *command.argv] if line else list(command.argv)
    return ['sudo', '-n', '--', *argv] if command.sudo and not root else argv


def quiet(command: Command) -> Command:
    """Return a command without standard error, which would stop it if nobody reads it."""
    return dataclasses.replace(
        command, argv=('sh', '-c', 'exec "$@" 2>/dev/null', 'sh', *command.argv))


def remote_line(command: Command, *, user: str) -> str:
    """Return a command as a line for the login shell of ``user``."""
    return ' '.join(shlex.quote(word) for word in words(command, root=user == 'root'))


def announced_line(command: Command, *, user: str) -> str:
    """Return the line of a command that first prints its process id."""
    return f'exec sh -c {shlex.quote(_ANNOUNCE)} sh {remote_line(command, user=user)}'


def marked_line(line: str) -> str:
    """
    Return a line that prints a mark before the output of its command, in the user's home.

    The login shell may have printed something before, and have changed its folder; with a trap of
    bash it prints each of its commands. csh and fish read quotes and lines in another way than sh.
    """
    script = f"cd; echo {MARK.decode().strip()}; exec {line.removeprefix('exec ')}"
    encoded = re.sub(r'[\\\'"$`!\n]', lambda found: f'\\0{ord(found[0]):03o}', script)
    return f"""exec sh -c 'eval "$(printf %b "{encoded}")"'"""


def end_script(pid: int) -> str:
    """Return a script that ends a process group: SIGTERM, and SIGKILL after two seconds."""
    return (f'kill -s TERM -- -{pid} || exit 0; n=0; '
            f'while [ $n -lt 20 ] && kill -s 0 -- -{pid}; do sleep 0.1; n=$((n + 1)); done; '
            f'kill -s KILL -- -{pid}')


def remote_path(path: str) -> str:
    """Quote a path for a remote shell; a leading ``~/`` is the login user's home."""
    if path == '~':
        return '"$HOME"'
    if path.startswith('~/'):
        return f'"$HOME"/{shlex.quote(path[2:])}'
    return shlex.quote(path)


def write_script(target: str, mode: int) -> str:
    """Return a script that writes its standard input to a file, atomically by a rename."""
    path = remote_path(target)
    return (
        f'umask 077; target={path}; mkdir -p -- "$(dirname -- "$target")"; '
        'aside="$target.$$.new"; trap \'rm -f -- "$aside"\' EXIT; '
        f'cat > "$aside"; chmod {mode:o} "$aside"; mv -f -- "$aside" "$target"')


def writing(data: bytes, target: str, mode: int) -> Command:
    """Return the command that writes a file and creates its folders."""
    return Command(('sh', '-ec', write_script(target, mode)), input=data,
                   what=f'writing {target}')


def checked(command: Command, result: Result, where: str) -> Result:
    """
    Return the result if the command succeeded.

    :raises CommandError: the exit status is not zero.
    """
    if result.returncode != 0:
        raise CommandError(command, result, where, hint_for(command, result, where))
    return result


def hint_for(command: Command, result: Result, where: str) -> str:
    """Return the remedy for a common failure of commands, or ''; machines speak any language."""
    if 'No space left on device' in result.stderr or 'Disk quota exceeded' in result.stderr:
        return f'the disk of {where} is full'
    last = (result.stderr.splitlines() or [''])[-1]
    program = words(command, root=True)[0]
    if result.returncode == 127 or last.startswith(f'sudo: {program}: '):
        return f'install what is missing on {where}'
    if last.startswith('sudo: ') and 'unable to resolve host' not in last:
        return f'let the login user of {where} use sudo without a password'
    return ''
