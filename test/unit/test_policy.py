# SPDX-License-Identifier: Apache-2.0
"""The example's policy: messages, models, servers of openpi, training, the arm, the picture."""

from __future__ import annotations

import contextlib
import json
import math
import os
import subprocess
import sys
import textwrap

from builtin_interfaces.msg import Duration
import numpy
import pytest

pytest.importorskip('onnxruntime', reason='ONNX Runtime is in the extra applications')
pytest.importorskip('cv2', reason='OpenCV is in the extra applications')

import cv2
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from fogros2.host import modules
from fogros2_examples.policy import arm, messages, training
from fogros2_examples.policy.chunks import SECOND
from fogros2_examples.policy.onnx_file import perceptron
from fogros2_examples.policy.picture import summary
from fogros2_examples.policy.policies import BadPolicy, Onnx, Openpi, small
from fogros2_examples.slam.messages import image, rgb, time

IMAGES = {f'observation.images.{name}': (1, 3, 24, 32) for name in ('top', 'side')}
NAMES = [*IMAGES, 'observation.state', 'prompt']
CPU = ['TensorrtExecutionProvider', 'CPUExecutionProvider']


def observation(chance=None):
    chance = chance or numpy.random.default_rng(0)
    return {**{name: chance.integers(0, 256, (48, 64, 3), numpy.uint8) for name in IMAGES},
            'observation.state': chance.uniform(-1, 1, 2), 'prompt': 'reach'}


def layers(chance, sizes=(4610, 5, 6)):
    return [(chance.normal(0, 0.1, (a, b)), chance.normal(0, 0.1, b))
            for a, b in zip(sizes, sizes[1:])]


# --- messages -----------------------------------------------------------------------------------

@pytest.mark.parametrize('velocity', [False, True])
def test_chunk_survives_its_message(velocity):
    actions = numpy.arange(8.0).reshape(4, 2)
    message = messages.chunk_message(1_800_000_000_123_456_789, ['a', 'b'], actions, 20, velocity)
    assert bool(message.points[0].velocities) == velocity
    found = messages.chunk_of(message, ['a', 'b'], velocity)
    assert found.stamp == 1_800_000_000_123_456_789
    assert found.times.tolist() == [0, 0.05 * SECOND, 0.1 * SECOND, 0.15 * SECOND]
    assert (found.values == actions).all()


def points(*rows, step=100, **fields):
    return JointTrajectory(header=Header(stamp=time(5)), joint_names=['a', 'b'], points=[
        JointTrajectoryPoint(positions=row, time_from_start=Duration(nanosec=number * step))
        for number, row in enumerate(rows)], **fields)


@pytest.mark.parametrize('message, reason', [
    (JointTrajectory(joint_names=['b', 'a']), 'actions for b, a'),
    (JointTrajectory(), 'no joints'), (points(), 'no positions'),
    (points([1.0]), 'no positions'), (points([1.0, 2.0], [1.0]), 'no positions'),
    (points([1.0, math.nan]), 'no numbers'), (points([1.0, math.inf]), 'no numbers'),
    (points([1.0, 2.0], [1.0, 2.0], step=0), 'do not increase')])
def test_invalid_chunk_is_refused(message, reason):
    with pytest.raises(ValueError, match=reason):
        messages.chunk_of(message, ['a', 'b'], False)


def test_angles_are_those_of_the_named_joints():
    state = JointState(name=['gripper', 'b', 'a'], position=[9.0, 2.0, 1.0])
    assert messages.angles_of(state, ['a', 'b']).tolist() == [1, 2]
    with pytest.raises(ValueError, match='no position of c, d'):
        messages.angles_of(state, ['a', 'c', 'd'])
    with pytest.raises(ValueError, match='no position of a'):
        messages.angles_of(JointState(name=['a']), ['a'])


@pytest.mark.parametrize('encoding, pixel, expected', [
    ('bgr8', [1, 2, 3], [3, 2, 1]), ('rgb8', [1, 2, 3], [1, 2, 3]), ('mono8', [7], [7, 7, 7]),
    ('bgra8', [1, 2, 3, 9], [3, 2, 1]), ('rgba8', [1, 2, 3, 9], [1, 2, 3])])
def test_images_of_all_encodings_become_rgb(encoding, pixel, expected):
    pixels = numpy.tile(numpy.array(pixel, numpy.uint8), (4, 6, 1))
    assert rgb(image(Header(), pixels, encoding))[3, 5].tolist() == expected


@pytest.mark.parametrize('bad', [
    Image(encoding='16UC1', width=2, height=2, step=4, data=bytes(8)),
    Image(encoding='rgb8', width=2, height=2, step=6, data=bytes(11)),
    Image(encoding='rgb8', width=3, height=2, step=6, data=bytes(12)), Image(encoding='rgb8')])
def test_invalid_image_is_refused(bad):
    with pytest.raises(ValueError, match='image'):
        rgb(bad)


# --- ONNX ---------------------------------------------------------------------------------------

def test_model_computes_what_its_layers_say():
    chance = numpy.random.default_rng(3)
    (w0, b0), (w1, b1) = made = layers(chance)
    policy = Onnx(perceptron(IMAGES, made, 3), NAMES, CPU)
    seen = observation(chance)
    flat = numpy.concatenate([*(small(seen[name], 32, 24).ravel() for name in IMAGES),
                              seen['observation.state']])
    expected = numpy.maximum(flat @ w0 + b0, 0) @ w1 + b1
    assert policy.infer(seen) == pytest.approx(
        expected.reshape(3, 2) + seen['observation.state'], abs=1e-4)
    assert policy.runs_on == 'CPUExecutionProvider'


def test_images_are_scaled_to_the_models_size():
    ones = numpy.zeros((48, 64, 3), numpy.uint8)
    ones[:24, :, 0] = 255
    scaled = small(ones, 32, 24)
    assert scaled.shape == (3, 24, 32) and scaled.dtype == numpy.float32
    assert (scaled[0, :12] == 1).all() and scaled[0, 12:].max() == scaled[1:].max() == 0


def extent(pixels):
    """Return where an image has something else than black: left, top, width, height."""
    return cv2.boundingRect(numpy.asarray(pixels > 127, numpy.uint8))


@pytest.mark.parametrize('width, height, size, circle', [
    (640, 480, (224, 224), (77, 77, 70, 70)), (480, 640, (224, 224), (77, 77, 70, 70)),
    (1280, 720, (224, 224), (94, 94, 35, 35)), (640, 480, (320, 240), (110, 70, 100, 100)),
    (480, 480, (320, 240), (110, 70, 100, 100)), (160, 120, (640, 480), (220, 140, 200, 200))])
def test_circle_stays_a_circle(width, height, size, circle):
    across = circle[2] / min(size[0] / width, size[1] / height)
    rows, columns = numpy.mgrid[:height, :width]
    disc = 255 * (numpy.hypot(columns - (width - 1) / 2, rows - (height - 1) / 2) < across / 2)
    pixels = numpy.repeat(disc.astype(numpy.uint8)[:, :, None], 3, axis=2)
    scaled = numpy.rint(255 * small(pixels, *size)[0]).astype(numpy.uint8)
    assert extent(scaled) == pytest.approx(circle, abs=4 if width < size[0] else 2)
    _, _, wide, high = extent(scaled)
    assert abs(wide - high) <= 1
    for encoding, channels in (('mono8', 1), ('bgr8', 3), ('rgba8', 4)):
        made = image(Header(), pixels[:, :, :1].repeat(channels, axis=2), encoding)
        assert (rgb(made, size)[:, :, 1] == scaled).all()


def test_bars_of_a_wide_image_are_black_and_even():
    white = numpy.full((360, 640, 3), 255, numpy.uint8)
    scaled = small(white, 224, 224)
    assert extent((255 * scaled[2]).astype(numpy.uint8)) == (0, 49, 224, 126)
    assert set(numpy.unique(scaled)) == {0, 1}
    assert small(numpy.full((9, 4000, 3), 255, numpy.uint8), 32, 24)[0].sum() == 32


@pytest.mark.parametrize('model, names, reason', [
    (b'no model', NAMES, 'cannot be loaded'), (b'', NAMES, 'cannot be loaded'),
    ('/nowhere/policy.onnx', NAMES, 'cannot be loaded'),
    (None, ['observation.images.top', 'prompt'], 'observation.images.side, observation.state')])
def test_unusable_model_is_refused(model, names, reason):
    made = perceptron(IMAGES, layers(numpy.random.default_rng(0)), 3) if model is None else model
    with pytest.raises(BadPolicy, match=reason):
        Onnx(made, names, CPU)


LOADS = ('import sys\nfrom fogros2_examples.policy.policies import Onnx\n'
         'Onnx(sys.argv[1], sys.argv[2:], ["CPUExecutionProvider"])')


@pytest.mark.parametrize('program', [LOADS, modules._ASK], ids=['node', 'launch'])
def test_nothing_is_reported_to_microsoft(tmp_path, program):
    """Tests that ONNX Runtime makes none of the files with which it prepares its telemetry."""
    model = tmp_path / 'policy.onnx'
    model.write_bytes(perceptron(IMAGES, layers(numpy.random.default_rng(0)), 3))
    (tmp_path / 'home').mkdir()
    environment = {name: value for name, value in os.environ.items()
                   if name not in ('CI', 'GITHUB_ACTIONS', 'TF_BUILD', 'ORT_DISABLE_TELEMETRY')}
    for name in ('HOME', 'TMPDIR', 'XDG_CACHE_HOME', 'XDG_STATE_HOME', 'XDG_DATA_HOME'):
        environment[name] = str(tmp_path / 'home')
    words = [model, *NAMES] if program is LOADS else [
        json.dumps([['onnxruntime', ['onnxruntime'], []]])]
    subprocess.run([sys.executable, '-c', program, *words], env=environment, check=True,
                   timeout=60)
    assert not list((tmp_path / 'home').rglob('*'))


@pytest.mark.parametrize('state', [numpy.zeros(3), numpy.array([math.nan, 0])])
def test_failing_model_is_reported(state):
    policy = Onnx(perceptron(IMAGES, layers(numpy.random.default_rng(0)), 3), NAMES, CPU)
    with pytest.raises(BadPolicy, match='failed|no finite'):
        policy.infer({**observation(), 'observation.state': state})


# --- openpi -------------------------------------------------------------------------------------

#: openpi's own server, with a policy that answers what the observation says.
SERVER = textwrap.dedent("""\
    import socket, sys
    import numpy
    from openpi_server import WebsocketPolicyServer

    class Policy:
        def infer(self, seen):
            if seen['prompt'] == 'fail':
                raise RuntimeError('out of memory')
            image, state = seen['observation/image'], seen['observation/state']
            assert image.dtype == numpy.uint8 and image.shape == (48, 64, 3), image.shape
            if seen['prompt'] == 'wrong':
                return {'actions': state}
            return {'actions': state + numpy.arange(3.0)[:, None] + float(image[0, 0, 0])}

    with socket.socket() as free:
        free.bind(('127.0.0.1', 0))
        port = free.getsockname()[1]
    print(port, flush=True)
    WebsocketPolicyServer(Policy(), '127.0.0.1', port).serve_forever()
    """)


@contextlib.contextmanager
def openpi_server():
    """Run a server of openpi; yield a function that connects to it."""
    from fogros2.waiting import wait_until
    process = subprocess.Popen([sys.executable, '-c', SERVER], stdout=subprocess.PIPE, text=True)
    try:
        port = int(process.stdout.readline())
        found = []

        def there():
            with contextlib.suppress(BadPolicy):
                found.append(Openpi(port))
            return found or None

        wait_until(there, timeout=60, what='the server of openpi')
        yield found[0], lambda: Openpi(port)
    finally:
        process.terminate()
        process.wait(30)
        process.stdout.close()


def test_openpi_server_answers_by_its_own_protocol():
    pytest.importorskip('openpi_server', reason='tools/setup.sh test installs it')
    seen = {'observation/image': numpy.full((48, 64, 3), 5, numpy.uint8),
            'observation/state': numpy.array([0.5, -0.5]), 'prompt': 'reach'}
    with openpi_server() as (policy, again):
        assert policy.infer(seen).tolist() == [[5.5, 4.5], [6.5, 5.5], [7.5, 6.5]]
        with pytest.raises(BadPolicy, match=r'shape \(2,\)'):
            policy.infer({**seen, 'prompt': 'wrong'})
        with pytest.raises(BadPolicy, match='out of memory'):
            policy.infer({**seen, 'prompt': 'fail'})
        # the server has closed that connection
        with pytest.raises(BadPolicy, match='failed'):
            policy.infer(seen)
        assert again().infer(seen).shape == (3, 2)


def test_absent_openpi_server_is_reported():
    pytest.importorskip('openpi_client', reason='tools/setup.sh test installs it')
    with pytest.raises(BadPolicy, match='no server of openpi at port 1: '):
        Openpi(1)


# --- the arm, and its training ------------------------------------------------------------------

def test_reaching_is_the_inverse_of_the_arms_corners():
    chance = numpy.random.default_rng(0)
    for target in arm.targets(50, chance):
        assert arm.corners(arm.reaching(target))[-1] == pytest.approx(target, abs=1e-9)
    far = [numpy.linalg.norm(target) for target in arm.targets(200, chance)]
    assert arm.NEAR <= min(far) and max(far) <= arm.FAR


def test_expert_reaches_the_target_with_limited_speed():
    times = numpy.arange(200) / 50
    start, target = numpy.array([0.2, 2.0]), numpy.array([-0.3, 0.4])
    plan = arm.expert(start, target, times)
    assert plan[0] == pytest.approx(start)
    assert arm.corners(plan[-1])[-1] == pytest.approx(target, abs=1e-3)
    speed = numpy.linalg.norm(numpy.diff(plan, axis=0), axis=1) * 50
    assert speed.max() == pytest.approx(arm.FASTEST, rel=0.01) and (numpy.diff(speed) < 1e-6).all()
    # a plan from the way is the rest of the same plan
    assert arm.expert(plan[30], target, times[:100]) == pytest.approx(plan[30:130], abs=1e-9)


def test_both_cameras_see_arm_and_target():
    for view in arm.cameras(640, 480).values():
        seen = [arm.picture(view, arm.reaching(at), at) for at in arm.targets(
            8, numpy.random.default_rng(0))]
        for colour, least in ((arm.LINK, 2000), (arm.TARGET, 40)):
            assert min((picture == colour).all(axis=2).sum() for picture in seen) > least


def test_motors_follow_with_limited_speed():
    joints = numpy.zeros(2)
    assert arm.moved(joints, numpy.array([0.01, -9.0]), 0.01) == pytest.approx(
        [0.01 / 3, -0.02 * arm.FASTEST])
    assert arm.moved(joints, numpy.array([0.01, 0.0]), 1.0) == pytest.approx([0.01, 0])


def test_training_learns_a_function_that_is_not_linear():
    chance = numpy.random.default_rng(0)
    seen = chance.normal(3, 1, (4000, 6)).astype(numpy.float32)
    plans = numpy.stack([5 * abs(seen[:, 0] - 3), seen[:, 1] + seen[:, 2]], 1)
    (w0, b0), (w1, b1), (w2, b2) = training.train(seen[:3500], plans[:3500], 20)
    found = numpy.maximum(numpy.maximum(seen[3500:] @ w0 + b0, 0) @ w1 + b1, 0) @ w2 + b2
    assert (abs(found - plans[3500:]).mean(axis=0) < 0.25 * plans.std(axis=0)).all()


def test_demonstrations_are_what_the_expert_does():
    seen, plans = training.demonstrations(20, 1)
    assert seen.shape == (20, 6 * 24 * 32 + 2) and plans.shape == (20, 100)
    assert seen.dtype == plans.dtype == numpy.float32
    # the table's red, in a corner of the picture, is about the same in all
    assert seen[:, 0] == pytest.approx(arm.TABLE[2] / 255, abs=0.2)
    turns = plans.reshape(20, 50, 2)
    assert (turns[:, 0] == 0).all()
    goals = arm.corners(seen[0, -2:] + turns[0, -1])[-1]
    assert arm.NEAR - 0.02 < numpy.linalg.norm(goals) < arm.FAR + 0.02
    assert (training.demonstrations(20, 1)[0] == seen).all()


def test_existing_policy_is_not_trained_again(tmp_path, monkeypatch):
    path = tmp_path / 'policy.onnx'
    path.write_bytes(b'there')
    monkeypatch.setattr(sys, 'argv', ['training', str(path)])
    training.main()
    assert path.read_bytes() == b'there'


def run_of(label, **given):
    return {'label': label, 'targets': [[0.3, 0.4], [-0.3, 0.4]], 'shown': 4.0,
            'reached': {'0': 1.0, '1': 2.0}, 'ages': [[0.1, 0.05], [0.2, 0.07], [0.3, 0.06]],
            'course': [[0.0, 0.5, 0.1, 0.4], [1.0, 0.3, 0.4, 0.0]], **given}


def test_summary_counts_targets_and_ages():
    assert summary(run_of('here')) == (
        'here: 2 of 2 targets reached, after 1.50 s; median age of an action 60 ms')
    assert '0 of 2 targets reached, after nan s' in summary(run_of('here', reached={}))
