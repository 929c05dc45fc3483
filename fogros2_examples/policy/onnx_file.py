# SPDX-License-Identifier: Apache-2.0
"""
Write a multi-layer perceptron as an ONNX model, and recognise models.

The messages are those of onnx.proto3 (https://github.com/onnx/onnx), in the encoding of Protocol
Buffers. A dozen of their fields is enough, so the package ``onnx`` is not needed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Union

import numpy
from numpy.typing import NDArray

from fogros2_examples.policy.policies import Singles

Layer = tuple[Singles, Singles]
#: Names as LeRobot has them, and types of numbers.
STATE, ACTION = 'observation.state', 'action'
_FLOAT, _INT64 = 1, 7
#: Tags with which a ModelProto can begin: its fields, integers (1 and 5) or of a length.
_FIRST = frozenset(number << 3 | 2 * (number not in (1, 5)) for number in (*range(1, 9), 14))


def check(path: Path) -> None:
    """
    Check that a file begins as an ONNX model does, without ONNX Runtime.

    :raises ValueError: the file is empty, a pointer of Git LFS, an archive or another text.
    """
    with path.open('rb') as file:
        first = file.read(1)
    if not first or first[0] not in _FIRST:
        raise ValueError('it is no ONNX model' if first else 'the file is empty')


def _number(value: int) -> bytes:
    """Encode an integer, seven bits in a byte."""
    more = value >> 7
    return bytes([value & 127 | 128]) + _number(more) if more else bytes([value])


def _message(*fields: tuple[int, Union[int, str, bytes]]) -> bytes:
    """Encode fields by their numbers: integers, or texts, messages and bytes with their length."""
    made = b''
    for number, value in fields:
        octets = value.encode() if isinstance(value, str) else value
        made += (_number(number << 3) + _number(octets) if isinstance(octets, int)
                 else _number(number << 3 | 2) + _number(len(octets)) + octets)
    return made


def _each(number: int, values: Iterable[Any]) -> list[tuple[int, Any]]:
    return [(number, value) for value in values]


def _tensor(name: str, values: NDArray[Any]) -> bytes:
    whole = values.dtype.kind == 'i'
    return _message(*_each(1, values.shape), (2, _INT64 if whole else _FLOAT), (8, name),
                    (9, values.astype('<i8' if whole else '<f4').tobytes()))


def _value(name: str, shape: Sequence[int]) -> bytes:
    sizes = _message(*_each(1, (_message((1, size)) for size in shape)))
    return _message((1, name), (2, _message((1, _message((1, _FLOAT), (2, sizes))))))


def _node(kind: str, inputs: Iterable[str], output: str, **attributes: int) -> bytes:
    return _message(*_each(1, inputs), (2, output), (4, kind), *_each(5, (
        _message((1, name), (3, value), (20, 2)) for name, value in attributes.items())))


def perceptron(images: Mapping[str, Sequence[int]], layers: Sequence[Layer], steps: int) -> bytes:
    """
    Return a model that adds a perceptron's output to STATE (1, joints), once for each step.

    The output is ACTION (1, steps, joints).

    :param images: names and shapes (1, channels, height, width) of the other inputs.
    :param layers: weights (inputs, outputs) and biases; inputs are all pixels, then the state.
    """
    joints = layers[-1][0].shape[1] // steps
    nodes = [_node('Flatten', [name], f'{name}.flat') for name in images]
    nodes.append(_node('Concat', [*(f'{name}.flat' for name in images), STATE], 'x0', axis=1))
    tensors = [_tensor('shape', numpy.array([1, steps, joints]))]
    for number, (weights, biases) in enumerate(layers):
        tensors += [_tensor(f'w{number}', weights), _tensor(f'b{number}', biases)]
        nodes += [_node('Gemm', [f'x{number}', f'w{number}', f'b{number}'], f'y{number}'),
                  _node('Relu', [f'y{number}'], f'x{number + 1}')]
    # the last layer has no Relu
    nodes[-1:] = [_node('Reshape', [f'y{len(layers) - 1}', 'shape'], 'turns'),
                  _node('Add', ['turns', STATE], ACTION)]
    inputs = [_value(*pair) for pair in {**images, STATE: (1, joints)}.items()]
    graph = _message(*_each(1, nodes), (2, 'policy'), *_each(5, tensors), *_each(11, inputs),
                     (12, _value(ACTION, (1, steps, joints))))
    # version 8 of the format, 13 of the operators
    return _message((1, 8), (7, graph), (8, _message((1, ''), (2, 13))))
