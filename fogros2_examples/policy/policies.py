# SPDX-License-Identifier: Apache-2.0
"""
Run a policy: an ONNX model, or a server of openpi on this computer.

An observation has by name images of RGB (height, width, 3), states (n,), and the task as PROMPT.
Nothing is unpickled: ONNX is Protocol Buffers, and openpi's messages are msgpack.
"""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
import os
from typing import Any

import numpy
from numpy.typing import NDArray

from fogros2_examples.letterbox import letterbox, Pixels
from fogros2_examples.meshes import Floats

Singles = NDArray[numpy.float32]
#: Name of the task; prefix of a policy that is a server of openpi, whose port follows.
PROMPT, OPENPI = 'prompt', 'openpi:'


class BadPolicy(ValueError):
    """A policy cannot be run; the text has the reason."""


def small(image: Pixels, width: int, height: int) -> Singles:
    """Return an image of RGB as a model takes it: (3, height, width), letterboxed, from 0 to 1."""
    scaled = letterbox(image, width, height)
    return numpy.asarray(scaled.transpose(2, 0, 1) / numpy.float32(255), numpy.float32)


class Policy(abc.ABC):
    """
    A policy.

    :param runs_on: the hardware or server, for the log.
    :param sizes: width and height to which an image may be letterboxed before, by name.
    """

    runs_on: str
    sizes: Mapping[str, tuple[int, int]] = {}

    @abc.abstractmethod
    def run(self, seen: Mapping[str, Any]) -> Any:
        """Return the output for an observation; may raise anything."""

    def infer(self, seen: Mapping[str, Any]) -> Floats:
        """
        Return the next actions for an observation, (n, joints).

        :raises BadPolicy: the policy fails, or its output is something else.
        """
        try:
            values = numpy.asarray(self.run(seen), float)
        except Exception as error:
            raise BadPolicy(f'the policy on {self.runs_on} failed: {error}') from error
        if values.ndim != 2 or not values.size or not numpy.isfinite(values).all():
            raise BadPolicy(f'the output of shape {values.shape} is no finite numbers (n, joints)')
        return values


class Onnx(Policy):
    """
    A model whose inputs have the names of an observation.

    Images are float (1, 3, height, width) from 0 to 1, letterboxed to the size that the model
    names. States are float (1, n), PROMPT is (1,) of strings. The first output is (1, n, joints).

    :param model: name or content of the file.
    :param names: of the observation.
    :param providers: of ONNX Runtime, the preferred first; absent ones are left out.
    :raises BadPolicy: it is no model, or one with other inputs.
    """

    def __init__(self, model: str | bytes, names: Sequence[str], providers: Sequence[str]) -> None:
        # its releases send records of use to Microsoft unless this is set before the import
        os.environ.setdefault('ORT_DISABLE_TELEMETRY', '1')
        import onnxruntime
        available = [name for name in providers if name in onnxruntime.get_available_providers()]
        options = onnxruntime.SessionOptions()
        # the decoders of the streams need the processor between two observations
        options.add_session_config_entry('session.intra_op.allow_spinning', '0')
        try:
            self._session = onnxruntime.InferenceSession(model, options, providers=available)
        except Exception as error:
            raise BadPolicy(f'the ONNX model cannot be loaded: {error}') from error
        self._inputs = {one.name: one.shape for one in self._session.get_inputs()}
        self.sizes = {name: (shape[3], shape[2]) for name, shape in self._inputs.items()
                      if len(shape) == 4 and all(isinstance(size, int) for size in shape[2:])}
        missing = sorted(set(self._inputs) - set(names))
        if missing:
            raise BadPolicy(f"nothing for the model's inputs {', '.join(missing)}: there are "
                            f"{', '.join(names)}")
        self.runs_on = self._session.get_providers()[0]

    def run(self, seen: Mapping[str, Any]) -> Any:
        """Run the model."""
        feed = {}
        for name in self._inputs:
            value = numpy.asarray(seen[name])
            if value.ndim == 3:
                value = small(value, *self.sizes.get(name, value.shape[1::-1]))
            feed[name] = value[None].astype(object if name == PROMPT else numpy.float32)
        return self._session.run(None, feed)[0][0]


class Openpi(Policy):
    """
    A server of openpi on this computer, such as its ``scripts/serve_policy.py``.

    :raises BadPolicy: none is at this port.
    """

    def __init__(self, port: int) -> None:
        from openpi_client.websocket_client_policy import WebsocketClientPolicy
        self.runs_on = f'openpi at port {port}'
        try:
            self._client = WebsocketClientPolicy('127.0.0.1', port)
        except OSError as error:
            raise BadPolicy(f'no server of {self.runs_on}: {error}') from error

    def run(self, seen: Mapping[str, Any]) -> Any:
        """Ask the server."""
        return self._client.infer(dict(seen))['actions']
