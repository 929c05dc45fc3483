# SPDX-License-Identifier: Apache-2.0
"""
The program on a host that serves container machines there to robots: one call for each run.

``hosted`` sends it with the modules that it imports; Python's standard library has the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
import json
import signal
import sys
import threading
from typing import Any

from fogros2 import model
from fogros2.errors import FogError
from fogros2.model import CreateRequest, MachineSpec
from fogros2.provider.container import ContainerProvider


def answer(provider: ContainerProvider, call: str, arguments: Mapping[str, Any]) -> Any:
    """
    Call a method of the provider with arguments that were JSON; return its result.

    :raises FogError: the method's error.
    """
    if call == 'create':
        spec = MachineSpec(**arguments['spec'])
        provider.check(spec)
        return provider.create(spec, CreateRequest(**arguments['request']))
    result = getattr(provider, call)(*arguments.values())
    return list(result) if call in ('find', 'volumes') else result


def main() -> None:
    """Read one call from the standard input, and print its result or its error in one line."""
    provider, ask = ContainerProvider(), json.load(sys.stdin)
    provider.cancel = cancel = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: cancel.set())
    try:
        reply = {'result': answer(provider, ask['call'], ask['given'])}
    except FogError as error:
        reply = {'error': type(error).__name__, 'message': error.args[0], 'hint': error.hint}
    print(model.to_json(reply))


if __name__ == '__main__':
    main()
