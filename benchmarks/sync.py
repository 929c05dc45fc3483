# SPDX-License-Identifier: Apache-2.0
"""A workspace of 1 GB in 10,000 files to a machine, beside tar, scp and untar of the whole."""

from __future__ import annotations

import os
from pathlib import Path
import subprocess
import tempfile

from figures import Row, seconds, write

from fogros2.deploy import Launch
from fogros2.model import Command, MachineSpec
from fogros2.shell import Shell

FILES, BYTES = 10_000, 1_000_000_000
RUNS = 3


def make(folder: Path) -> None:
    """Fill a folder with files of very different sizes, as a workspace has them."""
    # a tenth of the files hold nine tenths of the bytes
    large = int(BYTES * 0.9 / (FILES // 10))
    small = int(BYTES * 0.1 / (FILES - FILES // 10))
    data = os.urandom(large)
    for number in range(FILES):
        path = folder / f'package_{number % 100}' / f'file_{number}'
        path.parent.mkdir(exist_ok=True)
        size = large if number % 10 == 0 else small
        begin = number % 997
        path.write_bytes(data[begin:begin + size])


def tar_and_scp(folder: Path, shell: Shell, options: list[str], target: str) -> None:
    """Copy as FogROS2 does: an archive, made, sent, unpacked."""
    archive = folder.with_suffix('.tar')
    subprocess.run(['tar', '-cf', str(archive), '-C', str(folder), '.'], check=True)
    subprocess.run(['scp', '-q', *options, str(archive), f'{target}:archive.tar'], check=True)
    shell.run(Command(('sh', '-ec', 'rm -rf old; mkdir old; tar -xf archive.tar -C old; '
                       'rm archive.tar')), timeout=600)
    archive.unlink()


def main() -> None:
    """Take the ways in turn."""
    first, second, whole = [], [], []
    with tempfile.TemporaryDirectory() as top:
        folder = Path(top, 'workspace')
        folder.mkdir()
        make(folder)
        launch = Launch()
        try:
            machine = launch.up(MachineSpec('bench-sync', 'container'))
            endpoint = machine.machine.endpoint
            assert endpoint is not None
            known = Path(top, 'known_hosts')
            known.write_text(f'{endpoint.host} {endpoint.host_key}\n')
            options = ['-o', f'UserKnownHostsFile={known}', '-i',
                       str(launch.store.key_file('bench-sync'))]
            target = f'{endpoint.user}@{endpoint.host}'
            for _ in range(RUNS):
                machine.shell.run(Command(('rm', '-rf', 'new')), timeout=600)
                first.append(seconds(lambda: machine.shell.sync(
                    folder, 'new', excludes=(), timeout=600)))
                (folder / 'package_1' / 'file_1').write_bytes(os.urandom(5000))
                second.append(seconds(lambda: machine.shell.sync(
                    folder, 'new', excludes=(), timeout=600)))
                whole.append(seconds(
                    lambda: tar_and_scp(folder, machine.shell, options, target)))
        finally:
            launch.down()
    published = 'not published; its code: tar + scp + untar, each time'
    write('sync', 'A workspace of 1 GB in 10,000 files', [
        Row.of('tar + scp + untar', whole, 's'),
        Row.of('first sync', first, 's'),
        Row.of('sync with one changed file', second, 's'),
        Row.of('first sync', [tar / one for tar, one in zip(whole, first)], 'times faster', 2.2,
               'more', published),
        Row.of('with one changed file', [tar / one for tar, one in zip(whole, second)],
               'times faster', 40.0, 'more', published),
    ])


if __name__ == '__main__':
    main()
