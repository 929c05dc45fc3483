# SPDX-License-Identifier: Apache-2.0
"""Look up on the machine what a NodeSpec names: packages, executables, sent files."""

from __future__ import annotations

from collections.abc import Mapping
import json
import os
import re

from fogros2.agent.protocol import Refused

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

#: Folder of an ament prefix that has a file for each package.
INDEX = 'share/ament_index/resource_index/packages'


def resolve(text: Any, files: Mapping[str, str], path: str) -> str:
    """
    Replace the markers in a ``fogros2.model.Text`` by this machine's paths.

    :param files: path of each received file.
    :param path: AMENT_PREFIX_PATH.
    :raises Refused: a package is not on this machine.
    """
    parts = []
    for part in [text] if isinstance(text, str) else text:
        if isinstance(part, str):
            parts.append(part)
        elif 'share' in part:
            parts.append(f"{prefix_of(part['share'], path)}/share/{part['share']}")
        elif 'prefix' in part:
            parts.append(prefix_of(part['prefix'], path))
        elif part.get('file') in files:
            parts.append(files[part['file']])
        else:
            raise Refused(f'{json.dumps(part)} means nothing to this version of fogros2')
    return ''.join(parts)


def prefix_of(package: str, path: str) -> str:
    """
    Return the first prefix of AMENT_PREFIX_PATH that a package is installed in.

    :raises Refused: the package is not on this machine.
    """
    for prefix in path.split(':'):
        if prefix and '/' not in package and os.path.isfile(f'{prefix}/{INDEX}/{package}'):
            return prefix
    raise Refused(f"package '{package}' not found on the machine",
                  'is its workspace the one that travels?')


def find_executable(package: str, executable: str, path: str) -> str:
    """
    Return the path of a package's executable.

    :raises Refused: the package or the executable is not on this machine.
    """
    program = f'{prefix_of(package, path)}/lib/{package}/{executable}'
    if '/' not in executable and os.path.isfile(program) and os.access(program, os.X_OK):
        return program
    raise Refused(f"executable '{executable}' not found in package '{package}' on the machine")


def check_program(program: str, path: str, cwd: str) -> None:
    """
    Check that a program exists, with the rules of exec.

    :raises Refused: it is missing, or not executable.
    """
    folders = [''] if '/' in program else path.split(':')
    candidates = [os.path.join(cwd, folder, program) for folder in folders]
    if any(os.path.isfile(each) and os.access(each, os.X_OK) for each in candidates):
        return
    for each in candidates:
        if os.path.exists(each):
            raise Refused(f"'{each}' isn't executable on the machine")
    raise Refused(f"'{program}' not found on the machine",
                  '' if '/' in program else 'the executable of a package needs package=')


def interpreter(command: list[str]) -> list[str]:
    """
    Return ['python3'] for a Python program whose interpreter is missing, else [].

    A build in a virtual environment writes that environment's Python into the first line of each
    program. A machine may lack that Python.

    :raises Refused: the first line names a missing interpreter that is not Python.
    """
    # the agent would wait for the writer of a named pipe
    if not command or not os.path.isfile(command[0]):
        return []
    try:
        with open(command[0], 'rb') as file:
            line = file.readline(1024)
    except OSError:
        return []
    match = re.match(rb'#!\s*(/\S+)', line)
    if match is None or os.path.exists(match[1]):
        return []
    named = os.fsdecode(match[1])
    if re.fullmatch(r'python[\d.]*', os.path.basename(named)):
        return ['python3']
    raise Refused(f"'{command[0]}' is for the interpreter '{named}', "
                  'which is not on the machine', 'install it there')
