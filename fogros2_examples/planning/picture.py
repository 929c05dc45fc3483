# SPDX-License-Identifier: Apache-2.0
"""Draw a motion: the body along its path through the walls."""

from __future__ import annotations

import cv2
import numpy
from numpy.typing import NDArray

from fogros2_examples.meshes import Floats, rotation, turned
from fogros2_examples.planning.scene import Scene
from fogros2_examples.rendering import Camera, looking, shaded

#: Colours of the body from start to goal, blue, green, red.
FIRST, LAST = numpy.array([60.0, 160.0, 70.0]), numpy.array([40.0, 90.0, 230.0])
WALLS, FLOOR, LINE = (205.0, 200.0, 195.0), (238.0, 236.0, 232.0), (60, 40, 30)


def between(path: Floats, step: float, turn: float = 0.1) -> Floats:
    """
    Interpolate a path, with poses at most ``step`` m and ``turn`` rad apart.

    :param path: poses (n, 7); between two of them, the body moves straight and turns the shorter
        way.
    """
    poses = [path[0]]
    for begin, end in zip(path, path[1:]):
        relative = rotation(begin[3:]).T @ rotation(end[3:])
        angle = float(numpy.arccos(numpy.clip((numpy.trace(relative) - 1) / 2, -1, 1)))
        far = float(numpy.linalg.norm(end[:3] - begin[:3]))
        count = max(1, int(numpy.ceil(max(far / step, angle / turn))))
        q, r = begin[3:], end[3:] if begin[3:] @ end[3:] >= 0 else -end[3:]
        half = float(numpy.arccos(numpy.clip(q @ r, -1, 1)))
        for share in numpy.arange(1, count + 1) / count:
            if half < 1e-6:
                middle = r
            else:  # slerp (Shoemake, 1985)
                middle = (numpy.sin((1 - share) * half) * q
                          + numpy.sin(share * half) * r) / numpy.sin(half)
            poses.append(numpy.array([*(begin[:3] + share * (end[:3] - begin[:3])), *middle]))
    return numpy.array(poses)


def spaced(path: Floats, apart: float) -> Floats:
    """Return poses of a path about ``apart`` m apart, with its first and last one."""
    fine = between(path, apart / 20)
    way = numpy.concatenate([[0.0], numpy.cumsum(
        numpy.linalg.norm(numpy.diff(fine[:, :3], axis=0), axis=1))])
    count = max(2, round(way[-1] / apart) + 1)
    poses: Floats = fine[[int(numpy.searchsorted(way, at))
                          for at in numpy.linspace(0, way[-1] - 1e-9, count)]]
    return poses


def camera_of(scene: Scene, width: int, height: int) -> Camera:
    """Return a camera that sees the whole scene diagonally from above."""
    middle = (scene.low + scene.high) / 2
    size = float(numpy.linalg.norm(scene.high - scene.low))
    way = turned((0, 0, 1), -0.35) @ numpy.array([0.0, -0.62, 0.95])
    return looking(middle - [0, 0, 0.1 * size],
                   middle + 1.75 * size * way / numpy.linalg.norm(way),
                   width=width, height=height, focal=1.95 * min(width / 1.25, height))


def picture(scene: Scene, path: Floats, title: str, *, width: int = 1000,
            height: int = 750) -> NDArray[numpy.uint8]:
    """
    Draw the scene without its ceiling, the body along its path, and the path.

    :param path: poses (n, 7), empty for no path.
    :return: array (height, width, 3) of BGR.
    """
    camera = camera_of(scene, width, height)
    shell = scene.shell.corners
    # Draw only the floor: the triangles below the bounds.
    floor = shell[(shell[:, :, 2] <= scene.low[2] + 1e-6).all(axis=1)]
    walls = scene.walls.corners
    covers = _covers(scene, walls)
    parts = [walls[~covers], floor]
    colours = [numpy.tile(WALLS, (len(parts[0]), 1)), numpy.tile(FLOOR, (len(floor), 1))]
    # 7 % of a room's diagonal, in any unit.
    apart = float(numpy.linalg.norm(scene.high - scene.low)) / 14
    poses = spaced(path, apart) if len(path) else numpy.array([scene.start, scene.goal])
    for number, pose in enumerate(poses):
        body = scene.at(pose).corners
        share = number / (len(poses) - 1)
        parts.append(body)
        colours.append(numpy.tile((1 - share) * FIRST + share * LAST, (len(body), 1)))
    image, depth = shaded(camera, numpy.concatenate(parts), numpy.concatenate(colours))
    if covers.any():
        # Ceilings between storeys are drawn half transparent.
        parts.append(walls[covers])
        colours.append(numpy.tile(WALLS, (int(covers.sum()), 1)))
        over, _ = shaded(camera, numpy.concatenate(parts), numpy.concatenate(colours))
        image = numpy.asarray(cv2.addWeighted(image, 0.5, over, 0.5, 0.0), numpy.uint8)
    if len(path):
        _draw_way(image, depth, camera, between(path, apart / 18)[:, :3], 0.8 * apart)
    for pose, word, colour in ((scene.start, 'start', FIRST), (scene.goal, 'goal', LAST)):
        x, y = map(int, camera.seen(pose[:3])[0])
        for thickness, shade in ((6, (255, 255, 255)), (2, tuple(map(float, 0.7 * colour)))):
            cv2.putText(image, word, (x - 30, y - 42), cv2.FONT_HERSHEY_SIMPLEX, 0.9, shade,
                        thickness, cv2.LINE_AA)
    cv2.putText(image, title, (24, height - 28), cv2.FONT_HERSHEY_SIMPLEX, 0.75, (40, 40, 40), 2,
                cv2.LINE_AA)
    return image


def _covers(scene: Scene, corners: Floats) -> NDArray[numpy.bool_]:
    """Return which triangles are ceilings or upper floors: level, high above the floor, wide."""
    normals = numpy.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = numpy.linalg.norm(normals, axis=1) / 2
    extent = scene.high - scene.low
    level = numpy.abs(normals[:, 2]) > 1.98 * area
    lowest = corners[:, :, 2].min(axis=1)
    covering = numpy.asarray(level & (lowest > scene.low[2] + 0.2 * extent[2]), bool)
    # The tops of walls are level too, but cover a small area.
    heights = numpy.rint(lowest / extent[2] * 1000)
    for height in numpy.unique(heights[covering]):
        same = covering & (heights == height)
        if area[same].sum() < 0.3 * extent[0] * extent[1]:
            covering &= ~same
    return covering


def _draw_way(image: NDArray[numpy.uint8], depth: NDArray[numpy.float32], camera: Camera,
              points: Floats, thick: float) -> None:
    """Draw a line through points (n, 3), pale where objects are ``thick`` m in front of it."""
    pixels, depths = camera.seen(points)
    corners = numpy.round(pixels * 16).astype(numpy.int32)
    limits = [camera.width - 1, camera.height - 1]
    columns, rows = numpy.clip(numpy.round(pixels).astype(int), 0, limits).T
    before = depth[rows, columns]
    hidden = (before > 0) & (before < depths - thick)
    pale = image.copy()
    cv2.polylines(pale, [corners], False, LINE, 2, cv2.LINE_AA, 4)
    cv2.addWeighted(pale, 0.35, image, 0.65, 0.0, dst=image)
    for number in numpy.flatnonzero(~hidden[:-1]):
        cv2.line(image, corners[number].tolist(), corners[number + 1].tolist(), LINE, 3,
                 cv2.LINE_AA, 4)
