# SPDX-License-Identifier: Apache-2.0
"""Look for planted credentials and a launch's own keys wherever others could read them."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
import contextlib
import gzip
import json
import os
from pathlib import Path
import secrets
import subprocess
import time
from typing import Optional
from urllib.parse import unquote

from figures.places import Boxed, Container, Ec2, Host, Place, Pod
from figures.robots import Robot, robot, UP
from fogros2.waiting import wait_until

#: Folders of a machine in which files may be new; the rest is its system's.
FOLDERS = ('etc', 'home', 'root', 'opt', 'run', 'tmp', 'var', 'srv', 'dev/shm')
LARGEST = 20 << 20
KINDS = ('argv', 'environ', 'logs', 'store', 'files', 'tags', 'user data')
Found = Iterator[tuple[str, str, bytes]]


def forms(secret: str) -> Iterator[bytes]:
    """Yield how a secret may be written: plain, hexadecimal, and in base64 at each offset."""
    data = secret.encode()
    yield data
    yield data.hex().encode()
    for offset in range(3):
        coded = base64.b64encode(bytes(offset) + data).rstrip(b'=')
        yield coded[offset * 2:-2]  # without what depends on the bytes beside it


def plant(its: Robot) -> dict[str, str]:
    """Give the robot's user credentials, and return them by name."""
    found = {name: f'planted{secrets.token_hex(16)}' for name in ('variable', 'netrc', 'docker')}
    (its.home / '.netrc').write_text(f"machine h login u password {found['netrc']}\n")
    (its.home / '.docker').mkdir()
    (its.home / '.docker' / 'config.json').write_text(json.dumps(
        {'auths': {'registry.invalid': {'auth': found['docker']}}}))
    os.environ['SOME_API_TOKEN'] = found['variable']
    if isinstance(its.place, Ec2):
        its.place.environment = {
            **its.place.environment,
            'AWS_SECRET_ACCESS_KEY': f'planted{secrets.token_hex(16)}'}
    if isinstance(its.place, Boxed):
        found |= {f'{its.place.cloud.name} {at}': secret for at, secret in enumerate(
            its.place.cloud.secrets(its.place.environment))}
    if isinstance(its.place, Pod):
        config = json.loads(Path(its.place.environment['KUBECONFIG']).read_text())
        found['kubernetes'] = config['users'][0]['user']['token']
    if isinstance(its.place, Host):
        found['login key'] = its.place.computer.key.read_text().splitlines()[-3]
    return found


def own_keys(its: Robot, agent: Path) -> dict[str, str]:
    """Return the launch's own secrets."""
    found = {}
    for path in its.state.rglob('*'):
        text = path.read_text(errors='replace') if path.is_file() else ''
        if 'OPENSSH PRIVATE KEY' in text:
            found['login key'] = text.splitlines()[-3]
        elif path.name == 'vpn.key':
            found['VPN key'] = text.strip()
    config = json.loads((agent / 'config.json').read_text())
    found['heartbeat key'] = config['heartbeat']['key']
    found["machine's VPN key"] = (agent / 'vpn.key').read_text().strip()
    return found


def agent_of(name: str) -> Optional[tuple[int, Path]]:
    """Return the process of a machine's agent, and its folder as seen from here."""
    for process in Path('/proc').glob('[0-9]*'):
        with contextlib.suppress(OSError, ValueError):
            words = (process / 'cmdline').read_bytes().decode().split('\0')
            if not {'serve', '--config'} <= set(words):
                continue
            parent = os.path.dirname(words[words.index('--config') + 1])
            for folder in (parent, '/run/fogros2'):
                here = Path(f'{process}/root{folder}')
                with contextlib.suppress(OSError, ValueError, KeyError):
                    if json.loads((here / 'config.json').read_text())['machine'] == name:
                        return int(process.name), here
    return None


def processes(agent: int) -> Found:
    """Yield arguments of all processes, and variables of the machine's."""
    space = os.readlink(f'/proc/{agent}/ns/pid')
    for process in Path('/proc').glob('[0-9]*'):
        with contextlib.suppress(OSError):
            yield 'argv', str(process), (process / 'cmdline').read_bytes()
            if os.readlink(process / 'ns/pid') == space:
                yield 'environ', str(process), (process / 'environ').read_bytes()


def files(kind: str, top: Path, since: float) -> Found:
    """Yield the files below a folder that changed since then."""
    for folder, _, names in os.walk(top):
        for name in names:
            path = Path(folder, name)
            with contextlib.suppress(OSError):
                status = path.lstat()
                if path.is_file() and not path.is_symlink() and status.st_ctime >= since \
                        and status.st_size < LARGEST:
                    private = '' if status.st_mode & 0o077 else ' (private)'
                    log = '.log' in name or '/var/log/' in str(path)
                    yield 'logs' if log else kind, f'{path}{private}', path.read_bytes()


def described(here: Place, name: str) -> Found:
    """Yield what the provider tells of a machine."""
    if isinstance(here, Container):
        thing, = here.things(name)
        text = subprocess.check_output(['podman', 'inspect', thing.split()[1]], timeout=60)
        yield 'tags', 'podman inspect', json.dumps(
            json.loads(text)[0]['Config']['Labels']).encode()
        yield 'user data', 'podman inspect', text
    elif isinstance(here, Boxed):
        (mine,) = here.instances(name)
        yield 'tags', mine.id, repr([here.cloud.tags(mine), here.cloud.described(
            here.box)]).encode()
        data = here.box.user_data(mine.id)
        yield 'user data', mine.id, gzip.decompress(data) if data[:2] == b'\x1f\x8b' else data
    elif isinstance(here, Pod):
        for kind in ('jobs', 'pods', 'services', 'configmaps', 'events'):
            for each in here.space.all(kind):
                yield 'tags', kind, json.dumps(each['metadata']).encode()
                yield 'user data', kind, json.dumps(each).encode()
        # the commands of each exec are in its address
        for each in here.nodes.requests('robot'):
            yield 'logs', 'audit', unquote(each['requestURI']).encode()


def scan(here: Place) -> tuple[dict[str, bool], list[str], int]:
    """
    Launch a machine and scan.

    :returns: for each kind of source whether the word that stands in all of them was found; where
        secrets were found; how many sources there were.
    """
    name = f'canary{secrets.token_hex(4)}'
    # what a user names deliberately travels: by it the scan is known to see
    here.options += f", environment={{'CONTROL': '{name}'}}"
    with robot(here, name) as its:
        planted, begin = plant(its), time.time()
        run = its.launch()
        try:
            run.wait_for(UP, timeout=180.0)
            agent, folder = wait_until(lambda: agent_of(name), timeout=10.0, what='the agent')
            own = own_keys(its, folder)
            assert len(own) == (3 if isinstance(here, (Pod, Host)) else 4), own
            sources = [
                *processes(agent), *described(here, name), ('logs', 'output', run.text.encode()),
                *files('store', its.state, begin), *files('logs', its.home / 'log', begin),
                *(each for top in FOLDERS
                  for each in files('files', Path(f'/proc/{agent}/root', top), begin))]
            run.interrupt()
            run.ended(120.0)
        finally:
            run.kill()
            here.clear(name)
            os.environ.pop('SOME_API_TOKEN')
    # nobody tags a computer that exists already, or hands it user data
    kinds = KINDS[:5] if isinstance(here, Host) else KINDS
    return judge(sources, planted, own, name, kinds)


def judge(
    sources: list[tuple[str, str, bytes]], planted: Mapping[str, str], own: Mapping[str, str],
    control: str, kinds: Sequence[str],
) -> tuple[dict[str, bool], list[str], int]:
    """Return what ``scan`` does; the launch's own keys may stand in private files alone."""
    sees = {kind: any(control.encode() in data for its, _, data in sources if its == kind)
            for kind in kinds}
    leaks = [f'{name} in {kind}: {where}' for kind, where, data in sources
             for name, secret in [*planted.items(), *own.items()]
             if not (name in own and where.endswith('(private)'))
             and any(form in data for form in forms(secret))]
    return sees, leaks, len(sources)
