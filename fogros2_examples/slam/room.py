# SPDX-License-Identifier: Apache-2.0
"""
Render a synthetic room, and its depth, from any pose.

The room is a box of 6 by 5 by 2.7 metres with furniture of boxes. x and y lie in the floor, z
points up. Each pixel's ray is intersected with the boxes (slabs; Kay and Kajiya, 1986), and looked
up in a texture whose resolution fits the distance. The sensor adds noise to the image. It adds
noise to the depth as measured for Kinects (Nguyen, Izadi and Lovell, 3DIMPVT 2012), which see
nothing beyond 6 metres.
"""

from __future__ import annotations

import math

import cv2
import numpy
from numpy.typing import NDArray

from fogros2_examples.letterbox import Pixels
from fogros2_examples.slam import textures
from fogros2_examples.slam.geometry import Array, Camera

Floats = NDArray[numpy.float32]
SIZE = (6.0, 5.0, 2.7)
#: Furniture: lower and upper corner, metres, and the look of its sides.
FURNITURE = (
    ((0.0, 1.2, 0.0), (0.35, 2.9, 2.0), 'books'),
    ((4.6, 4.3, 0.0), (6.0, 5.0, 0.9), 'planks'),
    ((5.5, 0.6, 0.0), (6.0, 1.9, 1.6), 'books'),
    ((1.0, 0.0, 0.0), (2.6, 0.6, 0.75), 'planks'),
    ((1.2, 0.1, 0.75), (1.7, 0.4, 1.15), 'poster'),
    ((2.0, 4.5, 0.0), (3.4, 5.0, 1.1), 'poster'),
    ((2.75, 2.25, 0.0), (3.25, 2.75, 0.7), 'planks'),
)
#: Metres per texel of the finest texture, and number of resolutions.
TEXEL, LEVELS = 0.004, 3
FAR = 6.0
#: Standard deviation of the image's noise, in levels of 255.
NOISE = 2.0


def camera(width: int = 640, height: int = 480) -> Camera:
    """Return a camera with the field of view of TUM's (fr2) and a stereo baseline of 12 cm."""
    focal = 520.0 * width / 640
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, 0.12)


def trajectory(count: int, lap: int = 174) -> list[Array]:
    """
    Return the poses of a hand-held camera that circles the room and revisits places.

    :param lap: number of poses per circle.
    """
    poses = []
    for number in range(count):
        phi = 2 * math.pi * number / lap
        radius = 1.3 + 0.3 * math.cos(3.2 * phi)
        position = numpy.array([3.0 + radius * math.cos(phi), 2.5 + 0.8 * radius * math.sin(phi),
                                1.35 + 0.12 * math.sin(2.3 * phi)])
        yaw = phi + 0.7 + 0.25 * math.sin(1.7 * phi)
        pitch = -0.12 + 0.08 * math.sin(3.1 * phi)
        forward = numpy.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch),
                               math.sin(pitch)])
        roll = 0.04 * math.sin(2.7 * phi)
        right = numpy.array([math.sin(yaw), -math.cos(yaw), 0.0])
        down = numpy.cross(forward, right)
        pose = numpy.eye(4)
        pose[:3, 0] = math.cos(roll) * right + math.sin(roll) * down
        pose[:3, 1] = math.cos(roll) * down - math.sin(roll) * right
        pose[:3, 2], pose[:3, 3] = forward, position
        poses.append(pose)
    return poses


class Room:
    """
    Render images of the room.

    :param camera: the camera; its baseline is that of the right image.
    :param seed: seed of textures and noise; frame ``n`` from a pose is always the same.
    """

    def __init__(self, camera: Camera, seed: int = 1) -> None:
        self.camera = camera
        self._boxes = [(numpy.zeros(3), numpy.array(SIZE), 'room'), *(
            (numpy.array(low), numpy.array(high), look) for low, high, look in FURNITURE)]
        self._paint(numpy.random.default_rng(seed))
        x, y = numpy.meshgrid(numpy.arange(camera.width), numpy.arange(camera.height))
        self._rays = numpy.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy,
                                  numpy.ones_like(x)], 2).astype(numpy.float32)
        self._lengths = numpy.linalg.norm(self._rays, axis=2)
        self._seed = seed

    def colour_and_depth(self, pose: Array, number: int) -> tuple[Pixels, NDArray[numpy.uint16]]:
        """Return an image (height, width, 3) of BGR and depths (height, width) in millimetres."""
        random = numpy.random.default_rng((self._seed, number, 0))
        image, depth = self.exact(pose)
        spread = 0.0012 + 0.0019 * (depth - 0.4) ** 2
        noisy = depth + spread * random.standard_normal(depth.shape, numpy.float32)
        # A pixel between two surfaces has no valid depth.
        edge = cv2.morphologyEx(depth, cv2.MORPH_GRADIENT, numpy.ones((3, 3), numpy.uint8)) > 0.15
        noisy[edge | (depth > FAR)] = 0.0
        return self._grainy(image, random), numpy.round(1000 * noisy).astype(numpy.uint16)

    def pair(self, pose: Array, number: int) -> tuple[Pixels, Pixels]:
        """Return the left and the right image."""
        random = numpy.random.default_rng((self._seed, number, 0))
        other = pose.copy()
        other[:3, 3] += self.camera.baseline * pose[:3, 0]
        left, right = (self._grainy(self.exact(one)[0], random) for one in (pose, other))
        return left, right

    def exact(self, pose: Array) -> tuple[Pixels, Floats]:
        """Return image and depth, metres, without noise."""
        rays = self._rays @ pose[:3, :3].T.astype(numpy.float32)
        # Avoid division by zero; a ray along an axis then meets its planes very far away.
        rays[numpy.abs(rays) < 1e-7] = 1e-7
        origin = pose[:3, 3].astype(numpy.float32)
        steps = 1 / rays
        first = [numpy.where(rays[..., a] > 0, numpy.float32(SIZE[a]) - origin[a], -origin[a])
                 * steps[..., a] for a in range(3)]
        depth = numpy.minimum(numpy.minimum(first[0], first[1]), first[2])
        axis = numpy.where(depth == first[0], 0, numpy.where(depth == first[1], 1, 2))
        face = 2 * axis + (numpy.take_along_axis(rays, axis[..., None], 2)[..., 0] > 0)
        for number, (low, high, _) in enumerate(self._boxes[1:], 1):
            self._cut(number, low, high, pose, rays, steps, depth, face)
        return self._looked_up(rays, origin, depth, face), depth

    def _cut(self, number: int, low: Array, high: Array, pose: Array, rays: Floats,
             steps: Floats, depth: Floats, face: NDArray[numpy.int64]) -> None:
        """Draw a box in front of everything behind it."""
        rows, columns = self._window(low, high, pose)
        near, far = None, None
        part = (rows, columns)
        side = numpy.zeros(depth[part].shape, face.dtype)
        for a in range(3):
            here = steps[part][..., a]
            one = (low[a] - pose[a, 3]).astype(numpy.float32) * here
            two = (high[a] - pose[a, 3]).astype(numpy.float32) * here
            enter, leave = numpy.minimum(one, two), numpy.maximum(one, two)
            if near is None or far is None:
                near, far = enter, leave
            else:
                side[enter > near] = a
                near, far = numpy.maximum(near, enter), numpy.minimum(far, leave)
        assert near is not None and far is not None
        hit = (near < far) & (near > 0.05) & (near < depth[part])
        ahead = numpy.take_along_axis(rays[part], side[..., None], 2)[..., 0] > 0
        depth[part][hit] = near[hit]
        # A box is seen from outside: a ray in the direction of an axis hits the lower side.
        face[part][hit] = (6 * number + 2 * side + ~ahead)[hit]

    def _window(self, low: Array, high: Array, pose: Array) -> tuple[slice, slice]:
        """Return the rows and columns in which a box may be visible."""
        corners = numpy.array(numpy.meshgrid(*zip(low, high))).reshape(3, -1).T
        seen = (corners - pose[:3, 3]) @ pose[:3, :3]
        if (seen[:, 2] < 0.1).any():
            if (seen[:, 2] < 0.1).all():
                return slice(0, 0), slice(0, 0)
            return slice(0, self.camera.height), slice(0, self.camera.width)
        pixels = self.camera.project(seen)
        left, top = numpy.maximum(0, numpy.floor(pixels.min(0))).astype(int)
        right, bottom = numpy.maximum(0, numpy.ceil(pixels.max(0)) + 1).astype(int)
        return slice(top, bottom), slice(left, right)

    def _looked_up(self, rays: Floats, origin: Floats, depth: Floats,
                   face: NDArray[numpy.int64]) -> Pixels:
        axis = face % 6 // 2
        points = [origin[a] + depth * rays[..., a] for a in range(3)]
        across = numpy.where(axis == 0, points[1], points[0])
        up = numpy.where(axis == 2, points[1], points[2])
        x = (across - self._low[face, 0]) / TEXEL
        y = (self._low[face, 1] - up) / TEXEL + self._rows[face]
        # Texels per pixel, more where the surface is seen at a slant.
        slant = numpy.abs(numpy.take_along_axis(rays, axis[..., None], 2)[..., 0]) / self._lengths
        size = depth / (self.camera.fx * TEXEL * numpy.maximum(slant, 0.2))
        level = numpy.clip(numpy.round(numpy.log2(size)), 0, LEVELS - 1)
        image = numpy.empty((*depth.shape, 3), numpy.uint8)
        for number, atlas in enumerate(self._atlases):
            here = level == number
            if here.any():
                scale = 0.5 ** number
                seen = cv2.remap(atlas, (x * scale).astype(numpy.float32),
                                 (y * scale).astype(numpy.float32), cv2.INTER_LINEAR,
                                 borderMode=cv2.BORDER_REPLICATE)
                image[here] = seen[here]
        return image

    def _grainy(self, image: Pixels, random: numpy.random.Generator) -> Pixels:
        noise = NOISE * random.standard_normal(image.shape[:2], numpy.float32)[..., None]
        return numpy.clip(image + noise + 0.5, 0, 255).astype(numpy.uint8)

    def _paint(self, random: numpy.random.Generator) -> None:
        """Create the textures of all faces, one below the other in an atlas."""
        sheets, rows, lows = [], [], []
        top = 0
        for low, high, look in self._boxes:
            for number in range(6):
                axis = number // 2
                u, v = (1 if axis == 0 else 0), (1 if axis == 2 else 2)
                width, height = (math.ceil((high[a] - low[a]) / TEXEL) for a in (u, v))
                sheet = _surface(random, look, number, height, width)
                if number in ((1, 2) if look == 'room' else (0, 3)):
                    sheet = sheet[:, ::-1]  # otherwise the text would be mirrored
                # A margin, because a coarse texel may cover two neighbouring textures.
                sheets.append(cv2.copyMakeBorder(sheet, 0, 16 - height % 8, 0, 0,
                                                 cv2.BORDER_REPLICATE))
                rows.append(top)
                lows.append((low[u], high[v]))
                top += sheets[-1].shape[0]
        widest = max(sheet.shape[1] for sheet in sheets)
        atlas = numpy.concatenate([cv2.copyMakeBorder(
            sheet, 0, 0, 0, widest - sheet.shape[1], cv2.BORDER_REPLICATE) for sheet in sheets])
        self._rows = numpy.array(rows, numpy.float32)
        self._low = numpy.array(lows, numpy.float32)
        self._atlases = [atlas]
        for _ in range(LEVELS - 1):
            finer = self._atlases[-1]
            self._atlases.append(cv2.resize(finer, (finer.shape[1] // 2, finer.shape[0] // 2),
                                            interpolation=cv2.INTER_AREA))


def _surface(random: numpy.random.Generator, look: str, number: int, height: int,
             width: int) -> Pixels:
    """Return the texture of a box's side; the last two sides are its bottom and its top."""
    if look == 'room':
        if number == 4:
            return textures.planks(random, height, width, 30)
        colours = [(205, 215, 220), (190, 205, 205), (215, 210, 195), (200, 205, 215), (0, 0, 0),
                   (235, 235, 235)]
        wall = textures.plaster(random, height, width, colours[number])
        if number < 4:
            textures.hang(random, wall, 6, 90, 190)
        else:
            textures.hang(random, wall, 5, 60, 110)
        return wall
    if look == 'books' and number < 4:
        return textures.books(random, height, width, 90)
    if look == 'poster':
        return textures.poster(random, height, width)
    return textures.planks(random, height, width, 25)
