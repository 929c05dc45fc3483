# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C reaches the threads that a verb waits for."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
import os
import signal

import pytest

from ros2fog_cli.api.interrupts import interruptible


def test_ctrl_c_ends_waiting_threads():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), interruptible() as cancel, \
            ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(cancel.wait, 30.0)
        os.kill(os.getpid(), signal.SIGINT)
        waiting.result()
    assert waiting.result() is True
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize('own', [signal.SIG_IGN, lambda number, frame: None])
def test_other_signal_handlers_are_kept(own):
    before = signal.signal(signal.SIGINT, own)
    try:
        with interruptible() as cancel:
            assert signal.getsignal(signal.SIGINT) is own
            os.kill(os.getpid(), signal.SIGINT)
            assert not cancel.is_set()
    finally:
        signal.signal(signal.SIGINT, before)


def test_only_the_main_thread_handles_signals():
    def inside():
        with interruptible() as cancel:
            return cancel.is_set()

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(inside).result() is False
