# SPDX-License-Identifier: Apache-2.0
"""
Feed mutations of valid inputs to what reads the inputs of others; see ``fuzz_targets``.

The same seed gives the same inputs. The mutations begin with valid inputs of each kind, and have
words that decide much (limits of numbers, nested brackets, markup). They know no coverage. With
``--guided``, Atheris (libFuzzer) makes the inputs, and keeps those that reach new Python code.

    python -m rigs.fuzzing TARGET [TARGET ...] SEED --count 400 | --seconds 60 [--guided]
"""

from __future__ import annotations

import argparse
import base64
from collections.abc import Iterator, Sequence
import contextlib
import json
import os
from pathlib import Path
import random
import signal
import sys
import tempfile
import time
import traceback
from types import FrameType
from typing import NoReturn, Optional

from rigs.fuzz_targets import peak, Target, TARGETS, WAIT

#: Seconds of the processor after which an input counts as a hang.
HANG = 10
LONGEST = 1 << 20
WORDS = [
    b'\0', b'\xff' * 4, b'\x7f\xff\xff\xff', b'\x80\0\0\0', b'\r\n\r\n', b'\n', b'"', b'\\ud800',
    b'null', b'true', b'NaN', b'-1', b'1e999', b'9' * 400, b'[' * 3000, b'{"a":' * 3000, b'<a>',
    b'<!--', b'&#0;', b']]>', b'%00', b'%ff', b'../', b'$(id)', b';', b'\xe2\x80\xae', b'\x1b[2J',
    b'\0\0\0\1', b'\0\0\1\x67', b'\0\0\1\x06\x05', b'IHDR', b'\xff\xc0']


def mutated(dice: random.Random, valid: Sequence[bytes]) -> bytes:
    """Return a mutation of one of the inputs."""
    data = bytearray(dice.choice(valid))
    for _ in range(1 << dice.randrange(5)):
        at = dice.randrange(len(data) + 1)
        end = min(len(data), at + (1 << dice.randrange(10)))
        how = dice.randrange(6)
        if how == 0 and at < len(data):
            data[at] ^= 1 << dice.randrange(8)
        elif how == 1:
            data[at:at + dice.randrange(4)] = dice.choice(WORDS)
        elif how == 2:
            del data[at:end]
        elif how == 3:
            data[at:at] = data[at:end] * dice.randrange(1, 5)
        elif how == 4:
            data[at:end] = dice.randbytes(end - at)
        else:
            other = dice.choice(valid)
            data[at:] = other[dice.randrange(len(other) + 1):]
    return bytes(data[:LONGEST])


def inputs(seed: int, valid: Sequence[bytes]) -> Iterator[bytes]:
    """Yield the valid inputs, then mutations without end."""
    yield from valid
    dice = random.Random(seed)
    while True:
        yield mutated(dice, valid)


def feed(target: Target, data: bytes) -> Optional[str]:
    """Have a target read an input; return what went wrong, None if nothing did."""
    try:
        target.read(data)
    except target.refusals:
        return None
    except Exception as error:  # noqa: BLE001  # all others are what is looked for
        last = traceback.extract_tb(error.__traceback__)[-1]
        return f'{type(error).__name__} in {last.name}, {Path(last.filename).name}:{last.lineno}'
    return None


def run(name: str, seed: int, *, count: int = 0, seconds: float = 0.0,
        note: Optional[Path] = None) -> tuple[int, dict[str, bytes]]:
    """
    Feed inputs to a target: so many, or for so long.

    :param note: file that always has the current input, for who sees this process crash.
    :returns: the number of inputs, and one input for each thing that went wrong.
    """
    found: dict[str, bytes] = {}
    until, done = time.monotonic() + seconds, 0
    signal.signal(signal.SIGALRM, _hung)
    signal.signal(signal.SIGPROF, _hung)
    with TARGETS[name]() as target:
        for data in inputs(seed, target.valid):
            if done >= count and time.monotonic() >= until:
                break
            if note is not None:
                note.write_bytes(data)
            signal.alarm(WAIT)
            signal.setitimer(signal.ITIMER_PROF, HANG)
            if wrong := feed(target, data):
                found.setdefault(wrong, data)
            signal.alarm(0)
            signal.setitimer(signal.ITIMER_PROF, 0)
            done += 1
    return done, found


def run_guided(name: str, seed: int, seconds: float, note: Path) -> NoReturn:
    """
    Feed a target inputs that coverage of Python code guides, print what ``main`` prints, and exit.

    :param note: start of the name of a file that gets the input of a crash or hang.
    """
    import atheris
    found: dict[str, bytes] = {}
    done = 0
    with contextlib.ExitStack() as stack:
        target = stack.enter_context(TARGETS[name]())
        seeds = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix='fogt-fuzz-')))
        for number, data in enumerate(target.valid):
            Path(seeds, str(number)).write_bytes(data)
        atheris.instrument_all()
        until = time.monotonic() + seconds

        def read(data: bytes) -> None:
            nonlocal done
            if wrong := feed(target, data):
                found.setdefault(wrong, data)
            done += 1
            if time.monotonic() >= until:
                stack.close()
                report(name, done, found)
                sys.stdout.flush()
                os._exit(0)  # libFuzzer has no other end without losing the result

        atheris.Setup([name, f'-seed={seed}', f'-timeout={HANG}', '-max_len=65536',
                       f'-artifact_prefix={note}-', str(seeds)], read)
        atheris.Fuzz()
    raise AssertionError('libFuzzer ends the process')


def report(target: str, done: int, found: dict[str, bytes]) -> None:
    """Print as JSON how many inputs a target got, what went wrong, and the memory it took."""
    print(json.dumps({'target': target, 'done': done, 'peak': peak(os.getpid()), 'found': {
        wrong: base64.b64encode(data).decode() for wrong, data in found.items()}}))


def _hung(number: int, frame: Optional[FrameType]) -> NoReturn:
    raise TimeoutError('an input takes too long')


def main() -> None:
    """Feed targets, and report on each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('targets', nargs='+', choices=TARGETS)
    parser.add_argument('seed', type=int)
    parser.add_argument('--count', type=int, default=0)
    parser.add_argument('--seconds', type=float, default=0.0)
    parser.add_argument('--note', type=Path, help='file that always has the current input')
    parser.add_argument('--guided', action='store_true',
                        help='by coverage; needs --note, and one target')
    given = parser.parse_args()
    if given.guided:
        run_guided(given.targets[0], given.seed, given.seconds, given.note)
    for target in given.targets:
        report(target, *run(target, given.seed, count=given.count, seconds=given.seconds,
                            note=given.note))


if __name__ == '__main__':
    main()
