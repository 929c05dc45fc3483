# SPDX-License-Identifier: Apache-2.0
"""The thread beside the executor: the newest item, at most so many more, no silent end."""

from __future__ import annotations

import threading

import pytest

pytest.importorskip('numpy', reason='numpy is not installed')
from image_transport_h264.worker import Worker


def test_the_newest_waits_and_what_is_older_goes() -> None:
    begun, go, seen = threading.Event(), threading.Event(), []
    last = threading.Event()

    def work(item: int) -> None:
        begun.set()
        assert go.wait(60)
        seen.append(item)
        if item == 4:
            last.set()

    worker = Worker('test', work, lambda: None)
    worker.put(1)
    assert begun.wait(60)
    for item in (2, 3, 4):
        worker.put(item)
    assert worker.waiting == 1
    go.set()
    assert last.wait(60)
    worker.stop()
    assert seen == [1, 4]


def test_a_thread_that_ends_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(threading, 'excepthook', lambda args: told.append(str(args.exc_value)))
    failed = threading.Event()

    def work(item: int) -> None:
        raise ValueError(f'item {item}')

    worker = Worker('test', work, failed.set)
    worker.put(7)
    assert failed.wait(60)
    worker.stop()
    assert told == ['item 7']
