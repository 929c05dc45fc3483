# SPDX-License-Identifier: Apache-2.0
"""The dashboard's page in a browser, over states that a test has made up."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import threading
import time
from typing import Any, Optional

import cv2
import numpy
import pytest

pytest.importorskip('websocket', reason='the extra "kubernetes" is not installed')

from fogros2.errors import NameTaken
from fogros2.waiting import wait_until
from fogros2_monitor.browser import Ticket
from fogros2_monitor.dashboard.server import Dashboard
from rigs.browser import Browser, program

pytestmark = [
    pytest.mark.skipif(program() is None, reason='needs Chromium'),
]
BAD = '"><img src=x onerror="document.title=1"><script>document.title=1</script>&amp;\x1b[31m'
NOW = 1_800_000_000.0


def machine(name: str, **changes: Any) -> dict[str, Any]:
    return {
        'key': name, 'name': name, 'provider': 'aws', 'id': 'i-0123456789', 'state': 'running',
        'phase': 'running', 'launch': 'abc123', 'launch_pid': 4711, 'launch_alive': True,
        'created': NOW - 3600, 'expires': NOW + 7200, 'ended': None, 'address': '198.51.100.7',
        'place': 'eu-central-1', 'kind': 'g4dn.xlarge', 'cost_per_hour': 0.658,
        'on_exit': 'delete', 'deleting': False, 'trouble': '', 'problems': [],
        'replicas': [],
        'agent': {'since': NOW - 3500, 'rss': 16_000_000, 'heartbeat_age': 1.0},
        'vpn': {'address': '198.18.0.2', 'interface': 'fogabc123', 'received': 9_500_000,
                'sent': 1_200_000, 'latency': 23.4, 'receiving': 250_000.0, 'sending': 90_000.0,
                'handshake': NOW - 600},
        'steps': [step('machine', 0, 31.2), step('VPN', 31.2, 0.4), step('agent', 31.6, 0.2)],
        'nodes': [{'name': 'slam-1', 'state': 'running', 'pid': 41, 'returncode': None,
                   'restarts': 2, 'error': None}], 'log': 1, **changes}


def step(name: str, begin: float, seconds: Optional[float], state: str = 'done',
         **changes: Any) -> dict[str, Any]:
    return {'machine': 'm', 'step': name, 'begin': NOW - 3600 + begin, 'state': state,
            'seconds': seconds, 'detail': '', 'done': 0, 'total': 0, **changes}


class Story:
    """A source whose state a test changes."""

    def __init__(self) -> None:
        self._news = threading.Condition()
        self._state: dict[str, Any] = {}
        self.deleted: list[tuple[str, bool]] = []
        self.line = 'all is well'
        self.tell(machines=[])

    def tell(self, **changes: Any) -> None:
        """Have the state be another one."""
        with self._news:
            self._state = {
                'version': self._state.get('version', 0) + 1, 'robot': 'rover-0', 'warnings': [],
                'launches': [], 'machines': [], 'streams': [], 'topics': [], **changes}
            self._news.notify_all()

    def state(self, after: int, timeout: float) -> dict[str, Any]:
        with self._news:
            self._news.wait_for(lambda: self._state['version'] > after, timeout)
            return {**self._state, 'now': NOW}

    def log(self, machine: str, after: int) -> list[dict[str, Any]]:
        return [] if after else [{'number': 1, 'time': NOW, 'node': 'slam-1', 'error': True,
                                  'text': self.line}]

    def picture(self, stream: str) -> Optional[bytes]:
        return cv2.imencode('.jpg', numpy.full((48, 64, 3), 90, numpy.uint8))[1].tobytes()

    def delete(self, machine: str, force: bool) -> None:
        self.deleted.append((machine, force))
        if not force:
            raise NameTaken(f'a launch has {BAD}', 'end that launch')


@pytest.fixture(scope='module')
def browser() -> Iterator[Browser]:
    made = Browser(width=1300, height=900)
    yield made
    made.close()


@pytest.fixture
def story() -> Story:
    return Story()


@pytest.fixture
def page(story: Story, browser: Browser) -> Iterator[Browser]:
    dashboard = Dashboard(story)
    browser.complaints.clear()
    browser.open(dashboard.url)
    browser.until('document.getElementById("link").textContent === "live"')
    yield browser
    dashboard.close()


def test_card_shows_the_data_of_a_machine(story: Story, page: Browser) -> None:
    page.until('!document.getElementById("empty").hidden')
    assert 'No machine in the cloud' in page.text()
    story.tell(
        machines=[machine('mapper', phase='coming', nodes=[], vpn=None, steps=[
            step('machine', 0, 3.0),
            step('workspace', 3.0, None, 'running', done=5_000_000, total=20_000_000)]),
            machine('planner')],
        launches=[{'id': 'abc123', 'pid': 4711, 'alive': True,
                   'steps': [step('VPN interface', 0, 0.12)]}],
        topics=[{'topic': '/odom', 'type': 'nav_msgs/msg/Odometry', 'from': ['planner'],
                 'to': [''], 'rate': 50.02, 'bandwidth': 36_100.0, 'large': False},
                {'topic': '/points', 'type': 'sensor_msgs/msg/PointCloud2', 'from': ['planner'],
                 'to': [''], 'rate': None, 'bandwidth': None, 'large': True}],
        streams=[{'topic': '/camera', 'id': 'abc123 /camera', 'transport': 'h264', 'source': '',
                  'target': 'planner', 'note': '', 'rate': 29.97, 'bandwidth': 81_000.0,
                  'sampled': True, 'picture': 1}])
    page.until('document.querySelectorAll("article").length === 2')
    page.until('[...document.querySelectorAll(".log")].some('
               'e => e.textContent.includes("all is well"))')
    text = page.text()
    for words in ('rover-0', '$1.32', 'up for\n60 min', 'time left\n2 h 00 min', '23 ms',
                  '$0.66', 'at $0.66/h', '10 min ago', '250 kB/s', '90.0 kB/s', '10.7 MB',
                  'coming up', '5.0 MB of 20.0 MB', 'process 4711', '30.0 Hz', '81.0 kB/s',
                  'robot → planner', 'planner → robot', '50.0', '36.1 kB/s',
                  'not measured', 'all is well'):
        assert words in text, words
    page.until('document.querySelector("figure img")?.naturalWidth === 64')
    # what a screen reader and a keyboard need
    assert page.ask('[...document.querySelectorAll("button, select")].every('
                    'e => (e.getAttribute("aria-label") || e.textContent).trim())')
    assert page.ask('[...document.querySelectorAll("img")].every(e => e.alt)')
    assert page.ask('[...document.querySelectorAll("table")].every(e => e.caption)')
    bar = page.ask('document.querySelectorAll("article .bar i")[0].style.width')
    story.tell(machines=[
        machine('mapper', steps=[step('machine', 0, 3.0), step('workspace', 3.0, 9.0)]),
        machine('planner', phase='gone', ended=NOW, launch_alive=False)])
    page.until(f'document.querySelectorAll("article .bar i")[0].style.width !== "{bar}"')
    story.tell(machines=[machine('planner', phase='gone', ended=NOW, launch_alive=False)])
    page.until('document.getElementById("told").textContent === '
               '"mapper is running, planner is gone"')
    page.until('document.querySelectorAll("article").length === 1')
    assert page.ask('document.querySelector("article button.delete") === null')
    assert page.complaints == []


def test_data_never_become_markup(story: Story, page: Browser) -> None:
    story.line = BAD
    told = machine(
        BAD, provider=BAD, id=BAD, state=f'{BAD} (x)', launch=BAD, address=BAD, place=BAD,
        kind=BAD, problems=[BAD], trouble=BAD,
        steps=[step(BAD, 0, 1.0, 'failed', detail=BAD)],
        nodes=[{'name': BAD, 'state': BAD, 'pid': BAD, 'returncode': BAD, 'restarts': BAD}])
    told['vpn'].update(address=BAD, interface=BAD)
    story.tell(
        robot=BAD, warnings=[BAD], graph_trouble=[BAD], machines=[told],
        launches=[{'id': BAD, 'pid': BAD, 'alive': True, 'steps': [step(BAD, 0, None, BAD)]}],
        topics=[{'topic': BAD, 'type': BAD, 'from': [BAD], 'to': [BAD], 'rate': None,
                 'bandwidth': None, 'sampled': False}],
        streams=[{'topic': BAD, 'id': BAD, 'transport': BAD, 'source': BAD, 'target': BAD,
                  'note': BAD, 'rate': None, 'bandwidth': None, 'sampled': False, 'picture': 1}])
    page.until('document.querySelectorAll("figure img").length === 1')
    page.until('document.querySelector(".log")?.textContent.includes("onerror=")')
    assert page.text().count('<img src=x onerror=') > 15
    page.ask('document.querySelector("article button.delete").click()')
    page.until('document.getElementById("ask").open')
    page.press('Escape', 27)
    assert page.ask('document.querySelectorAll("img[src=x], main script").length') == 0
    assert page.ask('document.title') == 'FogROS2'
    assert page.complaints == []


def test_deletion_asks_and_shows_its_result(story: Story, page: Browser) -> None:
    story.tell(machines=[machine('planner', launch_alive=False, launch_pid=0)])
    page.until('!!document.querySelector("article")')
    page.ask('document.querySelector("button.delete").focus()')
    page.press('Enter', 13)
    page.until('document.getElementById("ask").open')
    page.press('Enter', 13)  # on what keeps it
    page.until('!document.getElementById("ask").open')
    assert story.deleted == []
    page.press('Enter', 13)  # the button has the focus again
    page.until('document.getElementById("ask").open')
    page.press('Tab', 9)
    page.press('Enter', 13)
    page.until('document.getElementById("notices").textContent.includes("is not deleted")')
    assert story.deleted == [('planner', False)]
    assert 'end that launch' in page.text()
    # under a launch that runs the question says so, and the answer means it
    story.tell(machines=[machine('planner', kind='t3.small')])
    page.until('document.querySelector("article").innerText.includes("t3.small")')
    page.ask('document.querySelector("button.delete").click()')
    page.until('document.getElementById("ask").open')
    asked = page.ask('document.getElementById("ask").innerText')
    assert 'launch with process 4711 has this machine' in asked and 'nodes there (1)' in asked
    page.ask('document.getElementById("ask-yes").click()')
    page.until('!document.getElementById("ask").open')
    wait_until(lambda: story.deleted[1:] == [('planner', True)], timeout=60.0, what='the wish')
    page.complaints.clear()  # the browser counts the refusal as one


def test_machines_of_one_name_have_separate_cards(story: Story, page: Browser) -> None:
    other = {'key': 'planner i-2', 'id': 'i-2', 'launch_alive': False}
    story.tell(machines=[machine('planner'), machine('planner', **other)])
    page.until('[...document.querySelectorAll("article h3")].map(e => e.textContent).join() '
               '=== "planner (i-0123456789),planner (i-2)"')
    page.ask('document.querySelectorAll("button.delete")[1].click()')
    page.until('document.getElementById("ask").open')
    assert page.ask('document.getElementById("ask-title").innerText') == 'Delete planner (i-2)?'
    page.ask('document.getElementById("ask-yes").click()')
    wait_until(lambda: story.deleted == [('planner i-2', False)], timeout=60.0, what='the wish')
    story.tell(machines=[machine('planner')])
    page.until('[...document.querySelectorAll("article h3")].map(e => e.textContent).join() '
               '=== "planner"')
    page.complaints.clear()  # the browser counts the refusal as one


def test_selection_survives_an_update(story: Story, page: Browser) -> None:
    story.tell(machines=[machine('planner'), machine('mapper')])
    page.until('document.querySelectorAll("article details[open]").length === 2')
    page.until('document.querySelectorAll("option[value=slam-1]").length === 2')
    page.ask('document.querySelector("article details").open = false')
    page.ask('document.querySelector("article select").value = "slam-1"')
    page.ask('document.querySelectorAll("button.delete")[1].focus()')
    story.tell(machines=[machine('alpha'), machine('planner', cost_per_hour=2),
                         machine('mapper')])
    page.until('document.querySelectorAll("article").length === 3')
    # the second on the page is the one that was first
    assert page.ask('document.querySelectorAll("article details[open]").length') == 2
    assert page.ask('document.querySelectorAll("article select")[1].value') == 'slam-1'
    assert page.ask('document.activeElement.getAttribute("aria-label")') == 'Delete mapper'


def test_page_fits_dark_mode_and_narrow_screens(story: Story, page: Browser) -> None:
    story.tell(machines=[machine('planner')])
    page.until('!!document.querySelector("article")')
    grounds = []
    for dark in (False, True):
        page.prefer(dark=dark)
        grounds.append(page.ask('getComputedStyle(document.body).backgroundColor'))
    page.prefer(dark=False)
    assert grounds[0] != grounds[1]
    for width in (320, 420, 800):
        page.size(width, 900)
        assert page.ask('document.documentElement.scrollWidth') <= width
    page.size(1300, 900)


def test_page_survives_a_reload_and_needs_its_own_token(story: Story, browser: Browser) -> None:
    dashboard = Dashboard(story)
    with contextlib.closing(Ticket(dashboard.url)) as ticket:
        browser.open(ticket.url)
        browser.until('document.getElementById("link").textContent === "live"')
    browser.reload()  # the ticket is used, the token kept
    browser.until('document.getElementById("link").textContent === "live"')
    # nobody but the page may ask, not even from the same browser
    other = browser.ask(
        f'fetch("http://localhost:{dashboard.server_port}/api/state").then(() => 1, () => 0)')
    assert other == 0
    began = time.monotonic()
    assert browser.ask('fetch("/api/state").then(answer => answer.status)') == 401
    assert time.monotonic() - began < 30
    dashboard.close()
