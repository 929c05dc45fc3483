# SPDX-License-Identifier: Apache-2.0
"""Scripts that run as root take a path with a blank for one path: others can choose paths."""

from __future__ import annotations

import os
from pathlib import Path
import re
import subprocess

import fogros2
from fogros2.shell import host_key

PACKAGE = Path(fogros2.__file__).parent
#: A loop over words or arguments of a shell, and text that the shell splits: not in quotes.
LIST = re.compile(r'^\s*(?:for \w+ in|set --) ([^;\n]*)', re.MULTILINE)
QUOTED = re.compile('"[^"]*"')
#: Texts with no path in them, and a list whose parts a colon ends.
NO_PATHS = ('$(cat "$1/cgroup.procs")', '$({_FROM})', '$AMENT_PREFIX_PATH', '$(stat -c %u ')


def test_no_script_splits_a_list_of_paths_at_blanks() -> None:
    found = [f'{path.relative_to(PACKAGE)}: {match[0].strip()}'
             for path in sorted(PACKAGE.rglob('*.py')) for match in LIST.finditer(path.read_text())
             if '$' in QUOTED.sub('', match[1])
             and not any(text in match[1] for text in NO_PATHS)]
    assert found == []


def test_host_key_with_a_blank_in_its_path_is_one_file(tmp_path: Path) -> None:
    """Split, the path leads to a key of another user, which root would replace."""
    victim, own = tmp_path / 'victim', tmp_path / 'ssh_host_ed25519_key'
    for key in (victim, own):
        subprocess.run(['ssh-keygen', '-q', '-t', 'ed25519', '-N', '', '-f', key], check=True)
    before = victim.read_bytes()
    for name, text in (('sshd', f'echo "hostkey {tmp_path}/a {victim}"'), ('systemctl', 'exit 1')):
        (tmp_path / name).write_text(f'#!/bin/sh\n{text}\n')
        (tmp_path / name).chmod(0o755)
    script = host_key.renew().argv[-1].replace('/etc/ssh', str(tmp_path))
    # no server above this test is to read its keys again, nor to be asked for them
    script = re.sub('listener=.pid line', 'listener= line', script).replace('server=${', 'x=${')
    said = subprocess.run(
        ['sh', '-ec', script], check=True, capture_output=True, text=True,
        env={**os.environ, 'PATH': f'{tmp_path}:{os.environ["PATH"]}'}).stdout
    assert victim.read_bytes() == before
    assert own.with_suffix('.pub').read_text() == said
