# SPDX-License-Identifier: Apache-2.0
"""
The web application beside the bridge, by an image that stands for Lichtblick: it serves HTTP.

What an image lacks or an engine refuses is said, and nothing else of the bridge suffers.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import http.client
import io
import os
from pathlib import Path
import queue
import secrets
import socket
import subprocess
import sys
import tarfile
import threading

import pytest

from fogros2.model import Command
from fogros2.process import run
from fogros2.waiting import wait_until
from fogros2_monitor import page, urls


@pytest.fixture(scope='module')
def image(engine: str, busybox: Path) -> Iterator[str]:
    """Import an image whose busybox serves a page at port 8080, as Lichtblick's."""
    name = f'localhost/fogt-{secrets.token_hex(4)}:1'
    packed = io.BytesIO(busybox.read_bytes())
    with tarfile.open(fileobj=packed, mode='a') as archive:
        text = tarfile.TarInfo('www/index.html')
        text.size = len(b'the application')
        archive.addfile(text, io.BytesIO(b'the application'))
    run(Command((
        engine, 'import', '-c',
        'CMD ["/bin/busybox", "httpd", "-f", "-p", "8080", "-h", "/www"]', '-', name),
        sudo=True, input=packed.getvalue()), timeout=60)
    yield name
    run(Command((engine, 'rmi', '-f', name), sudo=True), timeout=60)


def there(port: int) -> str:
    return run(Command(('podman', 'ps', '-aq', '--filter', f'name=fogros2-application-{port}$'),
                       sudo=True), timeout=60).stdout


def free_port() -> int:
    with socket.create_server(('127.0.0.1', 0)) as probe:
        return int(probe.getsockname()[1])


def status(port: int) -> int:
    """Return how the gate answers a request with its token."""
    with contextlib.closing(http.client.HTTPConnection('localhost', port, timeout=60)) as link:
        link.request('GET', '/?token=sesame')
        return link.getresponse().status


@contextlib.contextmanager
def program(module: str, *words: str) -> Iterator[queue.Queue[str]]:
    """Run one of the monitor's programs until the block's end; yield what it says."""
    said: queue.Queue[str] = queue.Queue()
    process = subprocess.Popen(
        [sys.executable, '-m', f'fogros2_monitor.{module}', *words], stdin=subprocess.PIPE,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        cwd=Path(__file__).parents[2], env=dict(os.environ))
    reader = threading.Thread(target=lambda: [said.put(line.strip()) for line in process.stdout])
    reader.start()
    try:
        yield said
    finally:
        process.stdin.close()  # as when the bridge ends
        assert process.wait(60) == 0
        reader.join(60)
        process.stdout.close()


def test_application_is_served_until_the_bridge_ends(image, tmp_path):
    token = tmp_path / 'token'
    token.write_text('sesame\n')
    inside, outside = free_port(), free_port()
    with program('gate', '--to', '127.0.0.1:1', '--listen', f'127.0.0.1:{outside}',
                 '--application', f'127.0.0.1:{inside}', '--token-file', str(token),
                 '--until-eof') as gate:
        assert gate.get(timeout=60) == f'listening on 127.0.0.1:{outside}'
        assert status(outside) == 200, 'the page with links'
        with program('application', '--image', image, '--port', str(inside),
                     '--name', 'planner') as said:
            assert said.get(timeout=60) == (
                'the web application is there: ros2 fog monitor planner')
            assert status(outside) == 303
            link = http.client.HTTPConnection('127.0.0.1', outside, timeout=60)
            with contextlib.closing(link):
                place = urls.served('', 'sesame').removeprefix('http://')
                link.request('GET', place)
                led = link.getresponse()
                led.read()
                assert led.getheader('Location').startswith('/?ds=')
                link.request('GET', led.getheader('Location'), headers={
                    'Cookie': led.getheader('Set-Cookie').partition(';')[0]})
                assert link.getresponse().read() == b'the application'
            assert there(inside)
        assert not there(inside)
        assert status(outside) == 200
        link = http.client.HTTPConnection('127.0.0.1', outside, timeout=60)
        with contextlib.closing(link):
            link.request('GET', '/?token=sesame')
            answer = link.getresponse()
            assert answer.getheader(page.MARK) and urls.LICHTBLICK.encode() in answer.read()


def test_missing_image_is_reported(engine):
    port = free_port()
    with program('application', '--image', 'localhost/fogt-no-such-image:1', '--port', str(port),
                 '--name', 'x') as said:
        assert said.get(timeout=60) == 'getting localhost/fogt-no-such-image:1'
        assert said.get(timeout=60).startswith('no web application here: ')
    assert not there(port)


@pytest.mark.skipif(os.geteuid() != 0, reason='sudo looks for podman in folders of its own')
def test_slow_image_download_does_not_delay_the_bridges_end(tmp_path, monkeypatch):
    slow = tmp_path / 'podman'
    slow.write_text('#!/bin/sh\ncase " $* " in *" pull "*) exec sleep 600; esac\nexit 1\n')
    slow.chmod(0o755)
    monkeypatch.setenv('PATH', f'{tmp_path}{os.pathsep}{os.environ["PATH"]}')
    with program('application', '--image', 'x', '--port', str(free_port()), '--name', 'x') as said:
        assert said.get(timeout=60) == 'getting x'
    wait_until(lambda: said.empty() or None, timeout=60, what='silence')
