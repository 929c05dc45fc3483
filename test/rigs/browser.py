# SPDX-License-Identifier: Apache-2.0
"""
A headless Chromium, driven by a test over the DevTools protocol.

https://chromedevtools.github.io/devtools-protocol/; needs ``websocket-client``.
"""

from __future__ import annotations

import base64
import itertools
import json
import os
from pathlib import Path
import shutil
import subprocess
import tempfile
import time
from typing import Any, Optional
import urllib.request

from fogros2.waiting import wait_until

_NAMES = ('chromium', 'chromium-browser', 'google-chrome')


def program() -> Optional[str]:
    """Return where a Chromium is, None where there is none."""
    return next(filter(None, map(shutil.which, _NAMES)), None)


class Browser:
    """
    One page in a browser of its own.

    :param width: of the window, ``height`` too, in pixels.
    """

    def __init__(self, *, width: int = 1280, height: int = 900) -> None:
        import websocket
        found = program()
        assert found is not None
        self._folder = tempfile.mkdtemp(prefix='fog-browser-')
        #: What it says, which is much; kept until the end.
        with open(Path(self._folder, 'log'), 'wb') as log:
            self._process = subprocess.Popen(
                [found, '--headless=new', '--disable-gpu', '--no-first-run', '--mute-audio',
                 '--disable-background-networking', '--disable-component-update',
                 '--disable-dev-shm-usage', '--disable-sync', '--no-proxy-server',
                 '--remote-debugging-port=0',
                 f'--user-data-dir={self._folder}/profile',
                 # as root it has no sandbox
                 *(['--no-sandbox'] if os.geteuid() == 0 else []), 'about:blank'],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
                env={**os.environ, 'HOME': self._folder})
        try:
            at = Path(self._folder, 'profile', 'DevToolsActivePort')
            # its second line is the browser's own path: with that, the file is whole
            wait_until(lambda: at.exists() and len(at.read_text().split()) == 2,
                       timeout=60.0, what='the browser', longest=0.1)
            port = at.read_text().split()[0]
            with urllib.request.urlopen(f'http://127.0.0.1:{port}/json/list') as answer:
                pages = [page for page in json.load(answer) if page['type'] == 'page']
            self._link = websocket.create_connection(
                pages[0]['webSocketDebuggerUrl'], timeout=30, suppress_origin=True)
        except BaseException:
            self.close()
            raise
        self._numbers = itertools.count(1)
        #: What the page complained about: errors, and what its policy has refused.
        self.complaints: list[str] = []
        #: Every address that it asked for.
        self.requested: list[str] = []
        for part in ('Page', 'Runtime', 'Network', 'Log'):
            self.do(f'{part}.enable')
        self.prefer(dark=False)
        self.size(width, height)

    def do(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command, and return its result."""
        number = next(self._numbers)
        self._link.send(json.dumps({'id': number, 'method': method, 'params': parameters}))
        while True:
            told = json.loads(self._link.recv())
            if told.get('id') == number:
                if 'error' in told:
                    raise AssertionError(f"{method}: {told['error']}")
                result: dict[str, Any] = told['result']
                return result
            self._note(told)

    def _note(self, told: dict[str, Any]) -> None:
        about = told.get('params', {})
        if told.get('method') == 'Network.requestWillBeSent':
            self.requested.append(about['request']['url'])
        elif told.get('method') == 'Runtime.exceptionThrown':
            self.complaints.append(json.dumps(about['exceptionDetails'])[:600])
        elif (told.get('method') == 'Log.entryAdded' and about['entry']['level'] == 'error'
              # Chromium ends requests when an interface of any other test comes or goes
              and not about['entry']['text'].endswith('net::ERR_NETWORK_CHANGED')):
            self.complaints.append(about['entry']['text'])

    def prefer(self, *, dark: bool) -> None:
        """Have the user prefer dark or light colours."""
        self.do('Emulation.setEmulatedMedia', features=[
            {'name': 'prefers-color-scheme', 'value': 'dark' if dark else 'light'}])

    def size(self, width: int, height: int) -> None:
        """Give the window another size."""
        self.do('Emulation.setDeviceMetricsOverride', width=width, height=height,
                deviceScaleFactor=1, mobile=False)

    def open(self, url: str) -> None:
        """Go to an address, and wait until what it leads to is there."""
        self.do('Page.navigate', url=url)
        self.until('document.readyState === "complete"')

    def reload(self) -> None:
        """Load the page anew."""
        self.ask('window.before = true')
        self.do('Page.reload')
        self.until('!window.before && document.readyState === "complete"')

    def ask(self, expression: str) -> Any:
        """Return the value of an expression in the page, awaited where it is a promise."""
        answer = self.do('Runtime.evaluate', expression=expression, returnByValue=True,
                         awaitPromise=True)
        if 'exceptionDetails' in answer:
            raise AssertionError(f"{expression}: {answer['exceptionDetails']}")
        return answer['result'].get('value')

    def until(self, expression: str, *, timeout: float = 60.0) -> Any:
        """Wait until an expression is true in the page, and return its value."""
        try:
            return wait_until(lambda: self.ask(expression), timeout=timeout, what=expression,
                              longest=0.1)
        except RuntimeError as error:
            raise AssertionError(
                f'{error}; the page shows: {self.text()[:3000]} {self.complaints}') from error

    def text(self) -> str:
        """Return what the page shows, as text."""
        return str(self.ask('document.body ? document.body.innerText : ""'))

    def press(self, key: str, code: int) -> None:
        """Press a key: its name and Windows' code for it, as ('Tab', 9)."""
        text = {'text': '\r'} if key == 'Enter' else {}
        for kind in ('keyDown', 'keyUp'):
            self.do('Input.dispatchKeyEvent', type=kind, key=key, code=key,
                    windowsVirtualKeyCode=code, **(text if kind == 'keyDown' else {}))

    def screenshot(self, path: Path) -> None:
        """Write the whole page as PNG."""
        path.write_bytes(base64.b64decode(self.do(
            'Page.captureScreenshot', format='png', captureBeyondViewport=True)['data']))

    def close(self) -> None:
        """End the browser and forget what it kept."""
        link = getattr(self, '_link', None)
        if link is not None:
            try:
                link.send(json.dumps({'id': 0, 'method': 'Browser.close'}))
                link.close()
            except OSError:
                pass  # it has gone
        try:
            self._process.wait(10 if link is not None else 0)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, 9)
            self._process.wait()
        deadline = time.monotonic() + 5.0
        while Path(self._folder).exists() and time.monotonic() < deadline:
            shutil.rmtree(self._folder, ignore_errors=True)  # its children still end
