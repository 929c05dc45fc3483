# SPDX-License-Identifier: Apache-2.0
"""A machine that talks without end takes at most 100 MB of the robot's memory."""

from __future__ import annotations

from pathlib import Path

import pytest

from rigs.memory import measure

pytest.importorskip('launch.actions', reason='launch is not installed')

LIMIT = 100e6


@pytest.mark.parametrize('character', ['x', '\\U0001f916'])
def test_the_answer_of_a_command_is_kept_up_to_a_limit(character: str, tmp_path: Path) -> None:
    taken, said = measure(f"""\
from fogros2.shell import lines
chunk = ('{character}' * 65536).encode()[:65536]
count = [0]
def line(text):
    count[0] += 1
output = lines.Output(line)
# attack
for _ in range(800):
    output.add(chunk, chunk)
output.add(b'the end', b'')
out, err = output.text()
print(out.endswith('the end'), 'earlier bytes were dropped' in out, count[0] > 0)
""", tmp_path)
    assert said == ['True True True'] and taken < LIMIT


@pytest.mark.parametrize('part', ['[],', '1e9,'])
def test_a_line_of_the_agent_is_parsed_up_to_a_limit(part: str, tmp_path: Path) -> None:
    taken, said = measure(f"""\
import itertools
from fogros2 import untrusted
from fogros2.agent_client import connection
from fogros2.shell.lines import LineStream
class Endless:
    data = itertools.chain([b'{{"ok": true, "a": ['], itertools.repeat({part.encode() * 20000!r}))
    left = 30 << 20
    def recv(self, size):
        part = next(self.data) if self.left > 0 else b'1]}}\\n'
        self.left -= len(part)
        return part
    def recv_stderr_ready(self):
        return False
    def close(self):
        pass
stream = LineStream(Endless(), 'planner')
# attack
try:
    print(len(connection._parsed(stream.readline())))
except untrusted.InvalidMessage as error:
    print(error)
""", tmp_path)
    assert taken < LIMIT


#: Events of a node that prints without end, while launch's event loop is at work elsewhere.
FLOOD = """\
import asyncio, sys, time
from launch import LaunchContext, Event
from launch.logging import get_logger
from fogros2.launch_internals import private
from fogros2.model import MachineSpec
from fogros2.runtime.session import Session
from fogros2.runtime import session as module
context, seen = LaunchContext(), []
loop = asyncio.new_event_loop()
class Run:
    class node:
        id = '1'
    def on_event(self, event):
        if event['event'] == 'output':
            context.emit_event_sync(Event())
            last[0] = event['seq']
        else:
            seen.append(event['event'])
last = [0]
session = Session(MachineSpec('planner', 'container'), loop, in_thread=None, fail=None,
                  changed=lambda: None, preempted=None,
                  busy=lambda: private.waiting_events(context))
put = session._backlog.put
session._runs['1'] = Run()
# attack
node = {'node': '1', 'name': 'talker'}
put({**node, 'event': 'started', 'pid': 1, 'cmd': []})
begin = time.monotonic()
for number in range(200_000):
    put({**node, 'event': 'output', 'stream': 'stdout', 'text': TEXT, 'seq': number})
    if number % 1000 == 0:  # launch handles one event in the time of a thousand
        loop.run_until_complete(asyncio.sleep(0))
        if private.waiting_events(context):
            context._event_queue.get_nowait()
put({**node, 'event': 'exited', 'returncode': 0, 'respawns': False})
print(time.monotonic() - begin < 30, private.waiting_events(context) <= 100)
async def rest():
    while len(seen) < 2:
        while private.waiting_events(context):
            context._event_queue.get_nowait()
        await asyncio.sleep(0)
loop.run_until_complete(asyncio.wait_for(rest(), 40))
print(seen, last[0])
"""


@pytest.mark.parametrize('text', ["'y'", "'\\U0001f916' * 100"])
def test_output_without_end_takes_a_bounded_memory(text: str, tmp_path: Path) -> None:
    taken, said = measure(FLOOD.replace('TEXT', text), tmp_path)
    assert said[0] == 'True True' and taken < LIMIT
    # what is dropped is the oldest output, never a start or an exit
    assert said[1] == "['started', 'exited'] 199999"
