# SPDX-License-Identifier: Apache-2.0
"""
Train the demo's policy by imitation: the arm's pictures and angles to the expert's next angles.

``python -m fogros2_examples.policy.training FILE`` writes it as ONNX unless the file exists. The
network is a perceptron, trained in NumPy by Adam (Kingma and Ba, 2015).
"""

from __future__ import annotations

from pathlib import Path
import sys

import numpy

from fogros2_examples.policy import arm
from fogros2_examples.policy.onnx_file import Layer, perceptron
from fogros2_examples.policy.policies import Singles, small

#: Size of the policy's images, and the cameras, whose images are larger.
WIDTH, HEIGHT = 32, 24
VIEWS = arm.cameras(10 * WIDTH, 10 * HEIGHT)
#: Actions of a chunk, and their number in a second.
STEPS, RATE = 50, 30.0
SAMPLES, EPOCHS, BATCH, HIDDEN, STEEP = 16000, 24, 128, (256, 128), 2e-3


def demonstrations(count: int, seed: int) -> tuple[Singles, Singles]:
    """Return observations (count, pixels and angles) and what the expert turns then, flat."""
    chance = numpy.random.default_rng(seed)
    goals = arm.targets(count, chance)
    # from everywhere on the way to the target, half of it near the target
    share = chance.uniform(0, 1, (count, 1))
    share[::2] = chance.uniform(0.9, 1, (len(share[::2]), 1))
    joints = arm.reaching(arm.targets(count, chance))
    joints += share * (arm.reaching(goals) - joints) + chance.normal(0, 0.05, joints.shape)
    plans = arm.expert(joints, goals, numpy.arange(STEPS) / RATE) - joints[:, None]
    images = numpy.array([[
        small(arm.picture(view, angles, goal)[..., ::-1], WIDTH, HEIGHT)
        for view in VIEWS.values()] for angles, goal in zip(joints, goals)])
    # no camera and no codec has quite the same colours
    for wide, shape in ((0.03, (count, 2, 3, 1, 1)), (0.03, images.shape)):
        images += wide * chance.standard_normal(shape, numpy.float32)
    seen = numpy.concatenate([images.reshape(count, -1), joints], axis=1, dtype=numpy.float32)
    return seen, plans.reshape(count, -1).astype(numpy.float32)


def train(seen: Singles, plans: Singles, epochs: int, seed: int = 0) -> list[Layer]:
    """Return weights and biases of a perceptron that computes plans from observations."""
    chance = numpy.random.default_rng(seed)
    middle, wide = seen.mean(axis=0), plans.std()
    sizes = [seen.shape[1], *HIDDEN, plans.shape[1]]
    values: list[Singles] = [made for a, b in zip(sizes, sizes[1:]) for made in (
        chance.normal(0, (2 / a) ** 0.5, (a, b)).astype(numpy.float32),
        numpy.zeros(b, numpy.float32))]
    means, squares = ([numpy.zeros_like(value) for value in values] for _ in range(2))
    orders = numpy.concatenate([chance.permutation(len(seen)) for _ in range(epochs)])
    total = len(orders) // BATCH
    for step in range(total):
        rows = orders[step * BATCH:][:BATCH]
        layers = [seen[rows] - middle]
        for weights, biases in zip(values[:-2:2], values[1:-2:2]):
            layers.append(numpy.maximum(layers[-1] @ weights + biases, 0))
        error = (layers[-1] @ values[-2] + values[-1] - plans[rows] / wide) * (2 / BATCH)
        speed = STEEP * (1 - step / total) * (1 - 0.999 ** (step + 1)) ** 0.5 / (
            1 - 0.9 ** (step + 1))
        for number in range(len(layers) - 1, -1, -1):
            slopes = layers[number].T @ error, error.sum(axis=0)
            error = (error @ values[2 * number].T) * (layers[number] > 0)
            for at, slope in enumerate(slopes, 2 * number):
                means[at] += 0.1 * (slope - means[at])
                squares[at] += 0.001 * (slope ** 2 - squares[at])
                values[at] -= speed * means[at] / (numpy.sqrt(squares[at]) + 1e-8)
    # the model takes pixels as they are, and answers in rad
    values[1] -= middle @ values[0]
    values[-2:] = [value * wide for value in values[-2:]]
    return list(zip(values[::2], values[1::2]))


def main() -> None:
    """Train the policy unless its file exists."""
    path = Path(sys.argv[1])
    if not path.exists():
        print(f'training the policy {path}, once: it takes a minute or more', flush=True)
        images = {f'observation.images.{name}': (1, 3, HEIGHT, WIDTH) for name in VIEWS}
        model = perceptron(images, train(*demonstrations(SAMPLES, 0), EPOCHS), STEPS)
        path.with_suffix('.part').write_bytes(model)
        path.with_suffix('.part').rename(path)


if __name__ == '__main__':
    main()
