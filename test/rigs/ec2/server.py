# SPDX-License-Identifier: Apache-2.0
"""
The process behind a box: Moto, the computers and the network; told what to do by its parent.

It reads JSON lines and answers each with one. When its input ends, the parent has closed the box
or has died, and everything is taken away.
"""

from __future__ import annotations

from collections.abc import Mapping
import contextlib
import dataclasses
import json
import os
from pathlib import Path
import signal
import sys
import threading
import time
from typing import Any

from fogros2.errors import FogError
from rigs.ec2 import computer, netns, network
from rigs.ec2.network import Network, ROUTER

PORT = 5000
#: Where the robot's network namespace finds names.
_NETNS_FILES = Path('/etc/netns')


def main() -> None:
    """Be a box until the input ends."""
    settings = json.loads(sys.stdin.readline())
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # the parent alone decides; a Ctrl-C in the terminal is the test's
        signal.signal(number, signal.SIG_IGN)
    for mark in computer.left_over():
        sweep(mark)
    Box(settings).run()


def sweep(mark: str) -> None:
    """Take away what a box has left behind."""
    network.sweep(mark)
    with contextlib.suppress(OSError):
        for path in (_NETNS_FILES / f'{network.PREFIX}{mark}r').glob('*'):
            path.unlink()
        (_NETNS_FILES / f'{network.PREFIX}{mark}r').rmdir()
        _NETNS_FILES.rmdir()
    computer.sweep(mark)
    with contextlib.suppress(OSError):
        computer.DISKS.rmdir()


class Box:
    """
    One box.

    :param settings: ``mark``, ``boot_delay``, ``mounts`` and ``regions``.
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        self.mark = str(settings['mark'])
        self.settings = settings
        self.net = Network(self.mark)

    def run(self) -> None:
        """Open everything, do what the parent says, and take everything away."""
        folder = computer.DISKS / self.mark
        folder.mkdir(parents=True)
        (folder / 'owner').write_text(f'{os.getpid()} {computer.started(os.getpid())}')
        try:
            self.net.open()
            self._names()
            self._serve()
        except BaseException as error:
            say({'ok': False, 'error': f'{type(error).__name__}: {error}'})
            raise
        finally:
            if hasattr(self, 'cloud'):
                self.cloud.close()
            sweep(self.mark)
        say({'ok': True, 'value': 'closed'})

    def _names(self) -> None:
        """Let the robot find the regions' API hosts at the router, as a DNS server would."""
        folder = _NETNS_FILES / self.net.robot
        folder.mkdir(parents=True)
        names = ''.join(f'{ROUTER} ec2.{region}.amazonaws.com\n'
                        for region in self.settings['regions'])
        (folder / 'hosts').write_text(Path('/etc/hosts').read_text() + names)
        # nobody answers there; the computer's own servers would be asked otherwise
        (folder / 'resolv.conf').write_text(f'nameserver {ROUTER}\n')

    def _serve(self) -> None:
        os.environ.update(
            MOTO_EC2_LOAD_DEFAULT_AMIS='false', MOTO_ENABLE_AMI_VALIDATION='true',
            MOTO_ENABLE_KEYPAIR_VALIDATION='true',
            MOTO_EC2_ENABLE_INSTANCE_TYPE_VALIDATION='true')
        from moto.moto_server.werkzeug_app import create_backend_app, DomainDispatcherApplication
        from werkzeug.serving import make_server, WSGIRequestHandler

        from rigs.ec2 import hooks
        from rigs.ec2.api import Api
        from rigs.ec2.cloud import Cloud

        class Quiet(WSGIRequestHandler):
            protocol_version = 'HTTP/1.1'

            def log(self, *_: Any) -> None:
                """Say nothing."""

        self.cloud = Cloud(self.mark, self.net, boot_delay=float(self.settings['boot_delay']),
                           mounts=tuple(self.settings['mounts']))
        hooks.install(self.cloud)
        self.api = Api(DomainDispatcherApplication(create_backend_app), self.cloud)
        inside = netns.listener(self.net.router, ROUTER, PORT)
        # accepts connections and answers nothing: the nearest region is the quickest to connect
        regions = netns.listener(self.net.router, ROUTER, 443)
        servers = [
            make_server('127.0.0.1', 0, self.api, threaded=True, request_handler=Quiet),
            make_server(ROUTER, PORT, self.api, threaded=True, request_handler=Quiet,
                        fd=os.dup(inside.fileno()))]
        for server in servers:
            threading.Thread(target=server.serve_forever, args=(0.1,), daemon=True).start()
        threading.Thread(target=_hang_up, args=(regions,), daemon=True).start()
        say({'ok': True, 'value': {'port': servers[0].server_port, 'robot': self.net.robot}})
        for line in sys.stdin:
            try:
                say({'ok': True, 'value': self._do(json.loads(line))})
            except (FogError, KeyError, OSError, ValueError) as error:
                say({'ok': False, 'error': f'{type(error).__name__}: {error}'})
        for server in servers:
            server.shutdown()

    def _do(self, order: Mapping[str, Any]) -> Any:
        from rigs.ec2 import hooks
        from rigs.ec2.api import Fault
        from rigs.ec2.market import PublicImage
        what = order['do']
        if what == 'fault':
            self.api.faults.append(Fault(**order['fault']))
        elif what == 'clear_faults':
            self.api.faults.clear()
        elif what == 'calls':
            return [dataclasses.asdict(call) for call in list(self.api.calls)]
        elif what == 'clear_calls':
            self.api.calls.clear()
        elif what == 'instances':
            return [_shown(machine) for machine in list(self.cloud.machines.values())]
        elif what == 'interrupt':
            when = time.strftime('%Y-%m-%dT%H:%M:%SZ', time.gmtime(time.time() + order['notice']))
            self.cloud.interrupt(order['instance'], notice=order['notice'], when=when)
        elif what == 'run':
            return self.cloud.machines[order['instance']].computer.run(
                order['script'], check=order['check'])
        elif what == 'console':
            return self.cloud.machines[order['instance']].computer.console()
        elif what == 'move_robot':
            self.net.move_robot(order['address'])
        elif what == 'publish':
            hooks.publish(order['region'], PublicImage(
                order['image'], order['name'], order['architecture'], '099720109477'))
            if order['files']:
                computer.new_disk(self.cloud.disks / order['image'])
                computer.put_files(self.cloud.disks / order['image'], order['files'])
        elif what == 'boot_delay':
            self.cloud.boot_delay = float(order['seconds'])
        else:
            raise ValueError(f'no such order: {what}')
        return None


def _hang_up(listener: Any) -> None:
    while True:
        connection, _ = listener.accept()
        connection.close()


def _shown(machine: Any) -> dict[str, Any]:
    instance = machine.instance
    return {
        'id': instance.id, 'region': instance.region_name, 'state': instance._state.name,
        'type': instance.instance_type, 'image': instance.image_id,
        'zone': str(instance.availability_zone), 'spot': machine.spot,
        'public': instance.public_ip or '', 'private': instance.private_ip or '',
        'reason': instance.state_reason.code or '', 'computer': machine.runs,
        'asked': machine.asked, 'ready': machine.ready,
        'tags': {tag['key']: tag['value'] for tag in instance.get_tags()},
    }


def say(data: Mapping[str, Any]) -> None:
    """Answer the parent, if it is still there."""
    with contextlib.suppress(BrokenPipeError):
        print(json.dumps(data), flush=True)


if __name__ == '__main__':
    main()
