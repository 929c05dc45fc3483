# SPDX-License-Identifier: Apache-2.0
"""
A headless Chromium, driven through its DevTools protocol.

https://chromedevtools.github.io/devtools-protocol/
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import itertools
import json
from pathlib import Path
import shutil
import subprocess
import tempfile
import time
from typing import Any
import urllib.request

#: Seconds in which it has to do what it was asked for.
PATIENCE = 30.0
PROGRAMS = ('chromium', 'chromium-browser', 'google-chrome')


class Page:
    """One tab."""

    def __init__(self, link: Any) -> None:
        self._link = link
        self._numbers = itertools.count(1)

    def call(self, method: str, **parameters: Any) -> Any:
        """Return the answer to a call."""
        number = next(self._numbers)
        self._link.send(json.dumps({'id': number, 'method': method, 'params': parameters}))
        while True:
            answer = json.loads(self._link.recv(timeout=PATIENCE))
            if answer.get('id') == number:
                return answer['result']

    def value(self, expression: str) -> Any:
        """Return what a JavaScript expression is in it."""
        return self.call('Runtime.evaluate', expression=expression,
                         returnByValue=True)['result'].get('value')

    def first_paint(self, url: str) -> float:
        """Open an address; return how long (ms) its first content took to be seen."""
        self.call('Page.navigate', url=url)
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            found = self.value(
                "(performance.getEntriesByName('first-contentful-paint')[0] || {}).startTime")
            if found and self.value('location.href').startswith(url.partition('#')[0]):
                return float(found)
            time.sleep(0.05)
        raise SystemExit(f'{url} paints nothing')


class Browser:
    """A browser that runs."""

    def __init__(self, port: int) -> None:
        self._at = f'http://127.0.0.1:{port}'

    @contextlib.contextmanager
    def page(self) -> Iterator[Page]:
        """Yield an empty tab, closed after the block."""
        from websockets.sync.client import connect
        asked = urllib.request.Request(f'{self._at}/json/new?about:blank', method='PUT')
        with urllib.request.urlopen(asked, timeout=PATIENCE) as answer:
            made = json.load(answer)
        with connect(made['webSocketDebuggerUrl'], max_size=None) as link:
            yield Page(link)
        urllib.request.urlopen(f"{self._at}/json/close/{made['id']}", timeout=PATIENCE).close()


@contextlib.contextmanager
def browser() -> Iterator[Browser]:
    """Run one for the block."""
    program = next(filter(None, map(shutil.which, PROGRAMS)), None)
    if program is None:
        raise SystemExit('needs Chromium: sudo apt-get install chromium')
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        process = subprocess.Popen(
            [program, '--headless', '--no-sandbox', '--disable-gpu', '--no-first-run',
             '--disable-extensions', '--remote-debugging-port=0', f'--user-data-dir={folder}',
             'about:blank'], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            told = Path(folder, 'DevToolsActivePort')
            deadline = time.monotonic() + PATIENCE
            while not (told.exists() and told.read_text().count('\n')):
                if time.monotonic() > deadline:
                    raise SystemExit('Chromium does not start')
                time.sleep(0.05)
            yield Browser(int(told.read_text().split()[0]))
        finally:
            process.terminate()
            process.wait(PATIENCE)
