# SPDX-License-Identifier: Apache-2.0
"""The dashboard in a browser, from before a launch begins until its machine is deleted there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import json
import os
from pathlib import Path
import secrets
import signal
import subprocess
import time
from typing import Any

import pytest

pytest.importorskip('websocket', reason='the extra "kubernetes" is not installed')
pytest.importorskip('cv2', reason='the extra "video" is not installed')

from fogros2.store import Store
from fogros2.waiting import wait_until
from rigs.browser import Browser, program
from rigs.dashboard import Dashboard
from rigs.launched import launching, ros2
from rigs.terminal import screen

pytestmark = [
    pytest.mark.skipif(program() is None, reason='needs Chromium'),
]
MARKUP = '</pre><img src=x onerror="document.title=1"><script>document.title=1</script>'
LAUNCH_FILE = """
from fogros2 import CloudGroup, CloudNode, ContainerInstance, FogROSLaunchDescription, StreamTopic
from launch.actions import ExecuteProcess
from launch_ros.actions import Node


def generate_launch_description():
    machine = ContainerInstance(name={name!r}, on_exit='keep')
    return FogROSLaunchDescription([
        CloudNode(machine=machine, package='fogros2_examples', executable='image_processor',
                  stream_topics=[('/camera', 'h264'),
                                 StreamTopic('/annotated', 'h264', 'to_robot')]),
        CloudNode(machine=machine, package='fogros2_examples', executable='talker'),
        CloudGroup(machine=machine, actions=[ExecuteProcess(cmd=['echo', {markup!r}])]),
        Node(package='fogros2_examples', executable='camera',
             parameters=[{{'width': 320, 'height': 240, 'rate': 10.0}}]),
        Node(package='fogros2_examples', executable='listener'),
    ])
"""


@pytest.fixture
def dashboard(nothing_left: None) -> Iterator[Dashboard]:
    made = Dashboard()
    try:
        yield made
    finally:
        if made.child.poll() is None:
            made.close()


@pytest.fixture
def browser() -> Iterator[Browser]:
    made = Browser(width=1400, height=1180)
    try:
        yield made
    finally:
        made.close()


@pytest.fixture
def name(engine: str, nothing_left: None) -> Iterator[str]:
    """Return a machine's name; one that is left under it is ended."""
    made = f'dash-{secrets.token_hex(2)}'
    yield made
    if Store().exists(made):
        ros2('fog', 'delete', made, '--yes', '--force')


def article(name: str) -> str:
    return f'document.querySelector(\'article[data-key="{name}"]\')'


def quiet(dashboard: Dashboard, browser: Browser) -> None:
    """Look at the page without a machine: it comes within a second, and then nothing works."""
    browser.until('document.getElementById("link").textContent === "live"')

    def painted() -> bool:
        browser.reload()
        milliseconds: float = browser.until(
            'performance.getEntriesByName("first-contentful-paint")[0]?.startTime')
        return milliseconds < 1000

    # at the first time on an idle computer
    wait_until(painted, timeout=60.0, what='a page within a second')
    # neither in the address nor in what was asked for
    token = dashboard.url.partition('#')[2]
    assert browser.ask('location.href') == dashboard.url.partition('#')[0]
    assert len(token) > 20 and not any(token in url for url in browser.requested[1:])
    browser.until('document.getElementById("link").textContent === "live"')

    def idle() -> bool:
        begin, before = time.monotonic(), dashboard.seconds()
        browser.ask('new Promise(done => setTimeout(done, 1000))')
        return (dashboard.seconds() - before) / (time.monotonic() - begin) < 0.02

    # other runs on this computer may have machines that come and go
    wait_until(idle, timeout=180.0, what='a dashboard without work')


def test_dashboard_shows_a_launch_until_its_end(
    dashboard: Dashboard, browser: Browser, tmp_path: Path, name: str,
    watched: Callable[[str], Path],
) -> None:
    browser.open(dashboard.url)
    quiet(dashboard, browser)
    watching = watched(name)
    file = tmp_path / 'dash.launch.py'
    file.write_text(LAUNCH_FILE.format(name=name, markup=MARKUP))
    browser.ask("""
        window.seen = new Set();
        new MutationObserver(() => document.querySelectorAll('article').forEach(
            a => { seen.add(a.dataset.phase);
                   a.querySelectorAll('.steps > li').forEach(s => seen.add(s.className)); })
        ).observe(document.body, {subtree: true, childList: true, attributes: true});""")
    with launching() as launch:
        launched = launch(str(file))
        launched.wait_for('process started')
        browser.until(f'{article(name)} && {article(name)}.dataset.phase === "running"',
                      timeout=60)
        assert {'coming', 'running', 'done'} <= set(browser.ask('[...seen]'))
        steps = browser.ask(
            f'[...{article(name)}.querySelectorAll(".steps .label")].map(e => e.innerText)')
        assert {'machine', 'connect', 'VPN', 'agent'} <= {
            step.split('\n')[0].split(' ')[0] for step in steps}

        # nodes, the VPN, what crosses it
        browser.until(f'/talker-\\d+\\s+running/.test({article(name)}.innerText)')
        browser.until(f'/round trip\\s+[0-9.]+ ms/.test({article(name)}.innerText)')
        browser.until('/\\/chatter\\s+std_msgs.*\\s+' + name
                      + ' → robot\\s+[0-9.]+\\s+[0-9]+ B\\/s/'
                      '.test(document.getElementById("topics").innerText)', timeout=30)
        pictures_move(browser)
        drawn = screen('ros2', 'fog', 'status', name, '--watch',
                       until=lambda text: 'talker' in text and 'handshake' in text)
        assert drawn.startswith('\x1b[?1049h') and drawn.rstrip().endswith('\x1b[?1049l')
        assert 'handshake' in drawn and 'round trip' in drawn and '\x1b[32m' in drawn

        # what a node prints is text
        browser.until(f'{article(name)}.querySelector(".log")?.textContent.includes('
                      '"<img src=x onerror=")')
        assert browser.ask('document.querySelector("img[src=x]") === null')
        assert browser.ask('document.title') == 'FogROS2'

        launched.interrupt()
        assert launched.ended() == 0, launched.text
    browser.until(f'/keep\\s+done/.test({article(name)}.innerText)')
    browser.until('document.querySelector(".launch").innerText.includes("launch over")')
    browser.ask(f'{article(name)}.querySelector("button.delete").click()')
    browser.until('document.getElementById("ask").open')
    browser.ask('document.getElementById("ask-yes").click()')
    browser.until(f'{article(name)}.dataset.phase === "gone"', timeout=120)
    assert name not in ros2('fog', 'list').stdout
    assert browser.complaints == []
    assert all(url.startswith(('http://127.0.0.1:', 'blob:http://127.0.0.1:', 'data:'))
               for url in browser.requested)
    assert dashboard.close() == 0

    def told() -> list[Any]:
        return [json.loads(line)['machine']
                for line in watching.read_text().splitlines(keepends=True) if line.endswith('\n')]

    wait_until(lambda: told()[-1]['phase'] == 'gone', timeout=60.0, what='its end')
    first, *others = told()
    assert first is None  # there was no such machine yet
    assert {'coming', 'running', 'gone'} <= {one['phase'] for one in others}
    assert any(node['state'] == 'running' for one in others for node in one['nodes'])
    assert any(topic['topic'] == '/chatter' and topic['rate'] for one in others
               for topic in one['topics'])


def pictures_move(browser: Browser) -> None:
    """See that both streams have pictures that change, of the camera's size."""
    seen: dict[str, set[Any]] = {'/camera': set(), '/annotated': set()}

    def moved() -> bool:
        for topic, shots in seen.items():
            at = f'document.querySelector(\'figure[data-topic="{topic}"] img\')'
            shot = browser.ask(f'{at} && {at}.complete && {at}.naturalWidth === 320 && {at}.src')
            if shot:
                shots.add(shot)
        return all(len(shots) >= 3 for shots in seen.values())

    wait_until(moved, timeout=60.0, what='pictures that move', longest=0.2)
    browser.until('[...document.querySelectorAll("figure .rates b")].every('
                  'e => Number(e.textContent) > 1)', timeout=30)


@pytest.fixture
def watched(tmp_path: Path, nothing_left: None) -> Iterator[Callable[[str], Path]]:
    """Return what watches a machine into a file, from before it is there until the test's end."""
    watching: list[subprocess.Popen[bytes]] = []

    def watch(name: str) -> Path:
        with open(tmp_path / 'watched', 'wb') as said:
            watching.append(subprocess.Popen(
                ['ros2', 'fog', 'status', name, '--watch', '--json', '--topics'],
                stdin=subprocess.DEVNULL, stdout=said, preexec_fn=os.setpgrp))
        return tmp_path / 'watched'

    yield watch
    for child in watching:
        child.send_signal(signal.SIGINT)
        try:
            assert child.wait(60) == 0
        finally:
            child.kill()
