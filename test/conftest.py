# SPDX-License-Identifier: Apache-2.0
"""What all tests share: state of their own, and the reasons why this computer can't run some."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path
import shutil
import signal
import socket
import subprocess

import pytest

#: What ``colcon test`` runs unless it is told otherwise: what makes no machine.
QUICK = ['test/unit', 'test/contract', 'test/launch']


def pytest_configure(config: pytest.Config) -> None:
    """
    Take signals as a terminal would hand them over, and run the quick part for colcon.

    What a shell without job control starts in the background ignores SIGINT and SIGQUIT, and so
    would all that the tests start and then interrupt; nohup does the same to SIGHUP.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGQUIT, signal.SIG_DFL)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    # colcon names the package so; ``colcon test --pytest-args test`` runs all
    if config.getoption('junitprefix', None) == 'fogros2' \
            and config.args_source is pytest.Config.ArgsSource.TESTPATHS:
        config.args[:] = [str(config.rootpath / name) for name in QUICK]


@pytest.hookimpl(tryfirst=True)  # xdist reads the marks in its own hook of this name
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """
    Keep together, where several processes share the tests, what shares something costly.

    That is the cluster of the pods and the simulated EC2; of all else, the fixtures of a module.
    The two take longest, so they come first.
    """
    def group(item: pytest.Item) -> str:
        folder = item.path.parent.name
        return folder if folder in ('kubernetes', 'aws') else str(item.path)

    for item in items:
        item.add_marker(pytest.mark.xdist_group(group(item)))
    items.sort(key=lambda item: group(item) not in ('kubernetes', 'aws'))


@pytest.fixture(autouse=True)
def state_home(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Path]:
    """Give each test a state folder of its own, so that none sees the user's machines."""
    path = tmp_path_factory.mktemp('state')
    monkeypatch.setenv('FOGROS2_STATE_HOME', str(path))
    yield path
    shutil.rmtree(path, ignore_errors=True)


@pytest.fixture(scope='session')
def upstream() -> Path:
    """Return a folder with checkouts of FogROS2's repositories, which tests run unedited."""
    named = os.environ.get('FOGROS2_UPSTREAM', '')
    if not Path(named, 'FogROS2', 'fogros2_examples').is_dir() or not named:
        pytest.skip('needs FOGROS2_UPSTREAM: a folder with checkouts of FogROS2 (branch humble) '
                    'and fogros2-examples')
    return Path(named)


@pytest.fixture
def jammy(tmp_path: Path) -> dict[str, str]:
    """Return the environment on a simulated Ubuntu 22.04, the release that FogROS2 asks for."""
    modules = tmp_path / 'jammy'
    modules.mkdir()
    (modules / 'lsb_release.py').write_text(
        "def get_os_release():\n    return {'RELEASE': '22.04'}\n")
    before = os.environ.get('PYTHONPATH')
    return {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, (str(modules), before)))}


@pytest.fixture
def free_udp_port() -> int:
    """Return a UDP port that was free a moment ago."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(('127.0.0.1', 0))
        port: int = probe.getsockname()[1]
    return port


@pytest.fixture(scope='session')
def root() -> None:
    """Skip where commands can't run as root: neither root nor sudo without a question."""
    if os.geteuid() == 0:
        return
    if shutil.which('sudo') is None or subprocess.run(
            ['sudo', '-n', 'true'], capture_output=True).returncode != 0:
        pytest.skip('needs root, or sudo without a password')


@pytest.fixture(scope='session')
def tun(root: None) -> None:
    """Skip where no TUN device can be opened."""
    if not os.path.exists('/dev/net/tun'):
        pytest.skip('needs /dev/net/tun')
