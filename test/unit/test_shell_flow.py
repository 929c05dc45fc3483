# SPDX-License-Identifier: Apache-2.0
"""Channels of a slow connection have little under way."""

from __future__ import annotations

from collections import deque
import contextlib
import signal
import socket
import sys
import threading

import pytest

from fogros2.shell import flow, multiplexed
from fogros2.shell import multiplexer as mux
from fogros2.shell.flow import LEAST, MOST, Window
from fogros2.waiting import wait_until

PACKET = 1400


def carry(rate: float, trip: float, seconds: float) -> tuple[Window, float]:
    """Read from a sender that fills its window; return the window and the bytes per second."""
    window, now, total = Window(), 0.0, 0
    # when the sender learns of how many bytes that it may send
    granted = deque([(0.0, window.size)])
    while now < seconds:
        learnt, size = granted.popleft()
        for begin in range(0, size, PACKET):
            part = min(PACKET, size - begin)
            now = max(now, learnt + trip / 2) + part / rate
            total += part
            if more := window.read(part, now):
                granted.append((now + trip / 2, more))
    return window, total / now


@pytest.mark.parametrize('rate, most_seconds', [(125e3, 0.6), (12.5e3, 2.7)])
def test_slow_links_have_little_under_way(rate: float, most_seconds: float) -> None:
    window, speed = carry(rate, 0.02, 60)
    assert window.size / rate <= most_seconds and speed > 0.99 * rate


@pytest.mark.parametrize('trip', [0.001, 0.1, 0.3])
def test_fast_links_reach_the_largest_window(trip: float) -> None:
    window, _ = carry(125e6, trip, 1 + 10 * trip)
    assert window.size == MOST


def test_reader_that_is_slow_gets_no_larger_window() -> None:
    window, given = Window(), 0
    for second in range(1000):
        given += window.read(LEAST // 4 + 1, float(second))
    assert window.size == LEAST and given <= 1000 * (LEAST // 4 + 1)


def test_no_byte_is_promised_twice() -> None:
    window, read, promised = Window(), 0, LEAST
    for _ in range(10_000):
        promised += window.read(1000, 0.0)
        read += 1000
        assert promised - read <= window.size


def test_tcp_connections_hold_little_that_is_unsent() -> None:
    with socket.socket() as connection:
        flow.keep_prompt(connection)
        assert connection.getsockopt(
            socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT) == flow.UNSENT
    ours, theirs = socket.socketpair()
    with ours, theirs:
        flow.keep_prompt(ours)


def test_machine_that_sends_all_the_time_hears_of_the_robot(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(multiplexed, 'ASK', 0.2)
    ours, theirs = socket.socketpair()
    link, heard = multiplexed.Link(ours, 'm', 'root'), bytearray()
    with theirs:
        theirs.settimeout(0.02)

        def tells() -> bool:
            theirs.sendall(mux.frame(mux.PONG, 0, b''))
            with contextlib.suppress(TimeoutError):
                heard.extend(theirs.recv(4096))
            return any(mux.frames(heard))

        wait_until(tells, timeout=10.0, longest=0.02, what='a sign of life')
        link.close()


def waits(thread: threading.Thread) -> bool:
    """Return whether a thread waits for a condition."""
    frame = sys._current_frames().get(thread.ident or 0)
    return frame is not None and frame.f_code is threading.Condition.wait.__code__


def test_turns_are_taken_in_the_order_of_asking() -> None:
    turns, order = flow.Turns(), list[int]()
    threads = []

    def take(number: int) -> None:
        with turns:
            order.append(number)

    with turns:
        for number in range(20):
            threads.append(threading.Thread(target=take, args=(number,)))
            threads[-1].start()
            wait_until(lambda: waits(threads[-1]) or None, timeout=60.0,
                       what='the thread to ask')
    for thread in threads:
        thread.join(60.0)
    assert order == list(range(20))


def test_interrupted_thread_holds_nobody_up() -> None:
    turns = flow.Turns()

    def take() -> None:
        with turns:
            pass

    class Interrupted(BaseException):
        pass

    def interrupt(number: int, frame: object) -> None:
        raise Interrupted

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        with turns:
            other = threading.Thread(target=take)
            signal.setitimer(signal.ITIMER_REAL, 0.05)
            with pytest.raises(Interrupted), turns:
                raise AssertionError('two threads have the lock')
            other.start()
        other.join(60.0)
        assert not other.is_alive()
    finally:
        signal.signal(signal.SIGALRM, before)
