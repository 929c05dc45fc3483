# SPDX-License-Identifier: Apache-2.0
"""What reads the inputs of others, each with valid inputs, for ``fuzzing``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import contextlib
import dataclasses
import importlib.util
import io
import json
import os
from pathlib import Path
import random
import socket
import struct
import subprocess
import sys
import tempfile
import time
from types import ModuleType
from typing import Any, cast, Optional

import numpy

from fogros2 import agent_client, events, untrusted
from fogros2.agent import protocol
from fogros2.agent_client import connection
from fogros2.dds.cyclonedds import CycloneDds
from fogros2.dds.fastdds import FastDds, VARIABLE
from fogros2.errors import FogError
from fogros2_examples.city import City
from fogros2_examples.lidar import message
from fogros2_features.guests import program as guests
from fogros2_monitor import assets
from fogros2_monitor import request as gate
from fogros2_monitor.dashboard import server as dashboard
from fogros2_replicas.pairs import header_of
from image_transport_h264 import message as images
from image_transport_h264 import repair, slices, stills
from image_transport_h264.cdr import CdrError, Header
from image_transport_h264.codec import Decoder, Encoder, Picture
from image_transport_h264.picture import CodecError
from point_cloud_stream import codec
from point_cloud_stream import message as point_clouds
from point_cloud_stream.cloud import CloudError, Field, Layout
from rigs import recorded_agent
from rigs.stranger import NOBODY

#: Seconds without an answer after which an input counts as a hang.
WAIT = 60
#: Bytes that an agent may take.
AGENT = 150e6
TOKEN, OTHER = 'a' * 32, 'z' * 32
KEY = 'Sg3Q0Y1Y0bZ2v6q0ZkzJbb0pRk3S8u1u4hJ0lWm8VHo='
HELPER = Path(__file__).resolve().parents[2] / 'packaging' / 'vpn_helper' / 'vpn.py'


@dataclasses.dataclass(frozen=True)
class Target:
    """
    A reader of inputs.

    :param valid: inputs that it accepts.
    :param read: reads one.
    :param refusals: exceptions by which it may refuse one.
    """

    valid: Sequence[bytes]
    read: Callable[[bytes], object]
    refusals: tuple[type[Exception], ...]


def peak(pid: int) -> int:
    """Return the most bytes of memory that a process has held."""
    status = Path(f'/proc/{pid}/status').read_text()
    return 1024 * int(status.partition('VmHWM:')[2].split()[0])


@contextlib.contextmanager
def _decoder() -> Iterator[Target]:
    def picture(encoding: str, size: int) -> Picture:
        noise = numpy.random.default_rng(1).integers(0, 256, 64 * 48 * size, numpy.uint8)
        return Picture(64, 48, encoding, 64 * size, noise.tobytes())

    encoder = Encoder()
    valid = [encoder.encode(picture('bgr8', 3)).data for _ in range(3)]
    valid += [Encoder().encode(picture(name, size)).data for name, size in
              (('rgba8', 4), ('mono8', 1), ('16UC1', 2), ('32FC1', 4))]
    decoder = Decoder()
    yield Target([bytes(data) for data in valid], decoder.decode, (CodecError,))


@contextlib.contextmanager
def _stills() -> Iterator[Target]:
    noise = Picture(64, 48, 'bgr8', 192, random.Random(1).randbytes(64 * 48 * 3))
    valid = [form.encode() + b'|' + bytes(data) for form, data in (
        stills.encode(noise, 'png'), stills.encode(noise, 'jpeg'))]

    def read(data: bytes) -> object:
        form, _, rest = data.partition(b'|')
        return stills.decode(form.decode('latin-1'), rest)
    yield Target(valid, read, (CodecError,))


@contextlib.contextmanager
def _clouds() -> Iterator[Target]:
    """Coded point clouds."""
    scan = City(8, 64).scan(1)
    made = message(scan)
    fields = tuple(Field(each.name, each.offset, each.datatype) for each in made.fields)
    valid = [codec.encode(
        Layout(rows, 512 // rows, fields, made.point_step, 512 // rows * made.point_step),
        scan.tobytes(), resolution).data for rows in (1, 8) for resolution in (0.0, 0.01)]
    yield Target(valid, codec.decode, (CloudError,))


@contextlib.contextmanager
def _slices() -> Iterator[Target]:
    """Slices of images and clouds, one assembler for all."""
    assembler = slices.Assembler(1 << 20)
    yield Target([slices.HEADER.pack(sender, number, 300, 100 * number) + bytes(100)
                  for sender in (1, 2) for number in range(3)], assembler.add, (struct.error,))


@contextlib.contextmanager
def _messages() -> Iterator[Target]:
    """Serialized messages; the first byte says which kind one is read as."""
    header, assembler = Header(1, 2, 'camera'), repair.Assembler()
    layout = Layout(1, 2, (Field('x', 0, 7), Field('y', 4, 7), Field('z', 8, 7)), 12, 24)

    def pieced(data: bytes) -> object:
        whole = assembler.add(images.piece(data))
        return whole and images.header_and_data(whole)

    def checked(data: bytes) -> object:
        found, points = point_clouds.cloud(data)[1:]
        return codec.encode(found, points, 0.01)

    read = [images.picture, images.coded, pieced, checked, header_of]
    packets = [images.with_header(header, bytes(3000)), b'short']
    valid = [
        [images.image(header, Picture(2, 2, 'mono8', 2, b'abcd'))],
        [images.compressed(header, 'h264', b'abcd')],
        [images.in_pieces(piece) for number, packet in enumerate(packets)
         for piece in repair.pieces(1, number, packet)],
        [point_clouds.points(header, layout, bytes(24))],
        [images.compressed(header, 'h264', b'')]]
    yield Target([bytes([kind]) + data for kind, each in enumerate(valid) for data in each],
                 lambda data: data and read[data[0] % len(read)](data[1:]),
                 (CdrError, CloudError))


@contextlib.contextmanager
def _calls() -> Iterator[Target]:
    """Read the requests of services that viewers send, and the files that they name."""
    from rcl_interfaces.msg import Parameter, ParameterValue
    from rcl_interfaces.srv import SetParameters
    from rclpy.serialization import deserialize_message, serialize_message
    from std_srvs.srv import Trigger

    value = ParameterValue(type=9, string_array_value=['a', 'bc'], double_array_value=[1.0])
    request = SetParameters.Request(parameters=[Parameter(name='speed', value=value)] * 2)
    valid = [b'\0' + serialize_message(request), b'\1' + serialize_message(Trigger.Request()),
             b'\2package://arm/meshes/upper%20arm.stl']

    def read(data: bytes) -> object:
        if data[:1] == b'\2':
            return assets.parse(data[1:].decode('utf-8', 'replace'))
        cls = SetParameters if data[:1] == b'\0' else Trigger
        return deserialize_message(data[1:], cls.Request)
    yield Target(valid, read, (RuntimeError, ValueError))


@contextlib.contextmanager
def _agent_messages() -> Iterator[Target]:
    """What a machine's agent sends, as the robot reads it."""
    valid = [json.dumps(each).encode() for each in [
        *recorded_agent.events(), *({'id': 1, 'ok': True, **said}
                                    for _, said in recorded_agent.answers())]]
    commands = sorted({command for command, _ in recorded_agent.answers()})

    def read(data: bytes) -> None:
        message: dict[str, Any] = {}
        with contextlib.suppress(untrusted.InvalidMessage):
            message = connection._parsed(data)
        for command in commands:
            with contextlib.suppress(untrusted.InvalidMessage):
                events.answer(command, dict(message))
        with contextlib.suppress(untrusted.InvalidMessage):
            events.event(message)
    yield Target(valid, read, ())


@contextlib.contextmanager
def _heartbeats() -> Iterator[Target]:
    key = '5a' * 32
    valid = [protocol.sign(key, protocol.BEAT.pack(n, 1.5)) for n in (0, 1, 2 ** 64 - 1)]

    def read(data: bytes) -> None:
        found = protocol.verify(key, protocol.BEAT, data)
        assert found is None or data in valid, 'a forged heartbeat'
    yield Target(valid, read, ())


@contextlib.contextmanager
def _agent() -> Iterator[Target]:
    """The requests of an agent that runs as the account 'nobody', and has to go on."""
    commands: list[dict[str, Any]] = [
        {'command': 'ping'}, {'command': 'status'}, {'command': 'log', 'from': 1},
        {'command': 'stop', 'nodes': ['a']},
        {'command': 'signal', 'node': 'a', 'signal': 'SIGINT'},
        {'command': 'configure', 'launch': 'abc123', 'environment': {'A': 'b'},
         'heartbeat': {'bind': '127.0.0.1', 'port': 9, 'peer': '127.0.0.1', 'key': '5a' * 32}},
        {'command': 'configure', 'launch': 'abc124', 'again': True, 'setup': [], 'user': ''},
        {'command': 'watch', 'what': 'x', 'argv': ['true'], 'interval': 5, 'repair': [['true']],
         'down': []},
        {'command': 'release', 'launch': 'abc123', 'on_exit': 'keep'}]
    with tempfile.TemporaryDirectory(prefix='fogt-fuzz-') as folder:
        if os.geteuid() == 0:
            os.chown(folder, NOBODY, NOBODY)
        Path(folder, 'agent.py').write_text(agent_client.agent_program())
        Path(folder, 'config').write_text(json.dumps({'directory': f'{folder}/agent'}))
        nobody: Any = {'user': NOBODY, 'group': NOBODY, 'extra_groups': []} \
            if os.geteuid() == 0 else {}
        child = subprocess.Popen(
            ['/usr/bin/python3', '-IS', f'{folder}/agent.py', 'serve', '--config',
             f'{folder}/config'], stderr=subprocess.PIPE, cwd=folder, **nobody)

        def talk(data: bytes) -> None:
            with socket.socket(socket.AF_UNIX) as link:
                link.settimeout(WAIT / 2)
                link.connect(f'{folder}/agent/agent.sock')
                with contextlib.suppress(BrokenPipeError):
                    link.sendall(data + b'\n{"id":"last","command":"ping"}\n')
                answer = b''
                while b'"last"' not in answer[-4096:]:
                    more = link.recv(1 << 16)
                    assert more or b'is longer than' in answer, 'the agent hung up'
                    if not more:
                        return
                    answer = answer[-4096:] + more

        try:
            while not os.path.exists(f'{folder}/agent/agent.sock'):
                assert child.poll() is None, 'the agent did not start'
                time.sleep(0.01)
            yield Target([json.dumps({'id': 1, **each}).encode() for each in commands], talk, ())
            assert peak(child.pid) < AGENT, 'the agent took too much memory'
        finally:
            child.kill()
            child.communicate()


@contextlib.contextmanager
def _door() -> Iterator[Target]:
    """What a guest sends to a machine's door before it has proved who it is."""
    class Door(guests.Door):
        def begin(self, link: socket.socket, user: str) -> subprocess.Popen[bytes]:
            raise AssertionError('opened without the secret')

    with tempfile.TemporaryDirectory() as folder:
        listed = guests.Guests('fogabc123m0', Path(folder))
        listed.state.write_text(json.dumps([{'address': '127.0.0.1', 'secret': '5a' * 32}]))
        with Door(listed, {'address': '127.0.0.1', 'port': 0, 'agent': os.devnull}) as door:
            def read(data: bytes) -> None:
                ours, theirs = socket.socketpair()
                with ours, theirs:
                    ours.sendall(data[:1 << 15])
                    ours.shutdown(socket.SHUT_WR)
                    door.answer(theirs, '127.0.0.1')
                    assert len(ours.recv(1 << 10)) == guests.CHALLENGE
            yield Target([bytes(32), b'\x5a' * 32, bytes(64)], read, ())


@contextlib.contextmanager
def _gate() -> Iterator[Target]:
    head = ('GET /?token={0} HTTP/1.1\r\nHost: 127.0.0.1:8765\r\nOrigin: https://app.foxglove.dev'
            '\r\nUpgrade: websocket\r\nCookie: a=b\r\n\r\n')

    def read(data: bytes) -> None:
        # the gate reads on until there is an empty line
        head, end, _ = data[1:].partition(b'\r\n\r\n')
        request = gate.parse(data[:1] + head + (end or b'\r\n\r\n'))
        gate.check_site(request, 'machine', encrypted=False)
        request.handed_on(closing=True)
        gate.check(request, OTHER)
        raise AssertionError('admitted without the token')
    yield Target([head.format(TOKEN).encode(), head.format('b').encode(),
                  b'GET / HTTP/1.1\r\nHost: [::1]:1\r\n\r\n'], read, (gate.Refused,))


class _Source:
    """A deployment that has nothing."""

    def state(self, after: int, timeout: float) -> dict[str, Any]:
        return {}

    def log(self, machine: str, after: int) -> list[dict[str, Any]]:
        return []

    def picture(self, stream: str) -> Optional[bytes]:
        return None

    def delete(self, machine: str, force: bool) -> None:
        raise FogError('there is no such machine')


class _Link:
    """A connection whose other end has sent all it will, and reads nothing."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def makefile(self, *_: Any) -> Any:
        return io.BytesIO(self._data)

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_: None


@contextlib.contextmanager
def _dashboard() -> Iterator[Target]:
    page = dashboard.Dashboard(cast(Any, _Source()))
    page.token = TOKEN
    host = f'Host: {page.hosts[0]}\r\n{dashboard.HEADER}: {TOKEN}\r\n'
    body = '{"name": "m", "force": true}'
    valid = [f'GET {path} HTTP/1.1\r\n{host}\r\n' for path in (
        '/', '/api/state?after=1', '/api/log?machine=m&after=1', '/api/picture?of=x')]
    valid.append(f'POST /api/delete HTTP/1.1\r\n{host}Content-Type: application/json\r\n'
                 f'Content-Length: {len(body)}\r\n\r\n{body}')
    try:
        yield Target(
            [each.encode() for each in valid], lambda data: dashboard._Handler(
                cast(Any, _Link(data)), ('127.0.0.1', 1), page),
            (ConnectionError, TimeoutError))
    finally:
        page.close()


def helper() -> ModuleType:
    """Return the VPN helper as a module; its folder is no package."""
    spec = importlib.util.spec_from_file_location('vpn_helper', HELPER)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules['vpn_helper'] = module
    path = list(sys.path)
    spec.loader.exec_module(module)
    sys.path[:] = path
    return module


@contextlib.contextmanager
def _vpn_helper() -> Iterator[Target]:
    vpn: Any = helper()
    up = {'name': 'fogabc123', 'network': '198.18.7.0/24', 'address': '198.18.7.1',
          'port': 40000, 'asked': [], 'ports': [[7000, 7119]],
          'peers': [{'key': KEY, 'address': '198.18.7.2', 'endpoint': 'host:51820'}]}

    def read(data: bytes) -> None:
        verb, _, rest = data.partition(b' ')
        request = vpn.parse(verb.decode('latin-1') if verb.decode('latin-1') in vpn.VERBS
                            else 'up', rest)
        network = vpn.network_of(request.get('network', '198.18.7.0/24'), ['198.18.0.0/15'])
        vpn.number(request.get('port', 40000), vpn.FIRST_PORT, 65535, 'the port')
        ports = vpn.ports_of(request.get('ports', []))
        own = vpn.own_address(request.get('address', '198.18.7.1'), network)
        peers = vpn.peers_of(request.get('peers', []), network, own)
        record = vpn.Record(request.get('name', 'fogabc123'), 0, 1, 1, network=network,
                            address=own, port=40000, ports=ports)
        for command in record.vpn().up(record.interface(), peers):
            assert '\0' not in ''.join(command.argv)
    yield Target([b'up ' + json.dumps(up).encode(), b'down {"name": "fogabc123"}',
                  b'keys {"name": "fogabc123", "pid": 1, "private": ""}'], read,
                 (vpn.Refused, ValueError))


@contextlib.contextmanager
def _dds() -> Iterator[Target]:
    """The user's configuration of Cyclone DDS and Fast DDS."""
    cyclone = (b'<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="eth0" '
               b'multicast="true"/></Interfaces></General><Discovery><Peers><Peer address="h"/>'
               b'</Peers></Discovery></Domain></CycloneDDS>')
    fast = (b'<dds xmlns="http://www.eprosima.com"><profiles><participant profile_name="p" '
            b'is_default_profile="true"><rtps><useBuiltinTransports>true</useBuiltinTransports>'
            b'</rtps></participant></profiles></dds>')
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'user.xml')

        def read(data: bytes) -> None:
            path.write_bytes(data)
            text = data.decode('latin-1').replace('\0', '')  # no variable has any
            vendor, fast_dds = CycloneDds(), FastDds()
            for ask in (lambda: vendor.robot_interfaces('fog', 'eth0', {'CYCLONEDDS_URI': text}),
                        lambda: vendor.robot_interfaces('fog', None,
                                                        {'CYCLONEDDS_URI': f'file://{path}'}),
                        lambda: fast_dds.render(
                            fast_dds.machine_interfaces('198.18.7.2'), [], {VARIABLE: str(path)})):
                with contextlib.suppress(FogError):
                    ask()
        yield Target([cyclone, fast, b'file:///nowhere,' + cyclone], read, ())


TARGETS: dict[str, Callable[[], contextlib.AbstractContextManager[Target]]] = {
    'decoder': _decoder, 'stills': _stills, 'clouds': _clouds, 'slices': _slices,
    'messages': _messages, 'calls': _calls, 'agent messages': _agent_messages,
    'heartbeats': _heartbeats, 'agent': _agent, 'door': _door, 'gate': _gate,
    'dashboard': _dashboard, 'VPN helper': _vpn_helper, 'DDS configuration': _dds}
#: Targets whose readers are Python code in the process that feeds them.
PYTHON = {'slices', 'messages', 'agent messages', 'heartbeats', 'door', 'gate', 'dashboard',
          'VPN helper', 'DDS configuration'}
