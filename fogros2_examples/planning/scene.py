# SPDX-License-Identifier: Apache-2.0
"""Describe a motion planning problem: the moving body, its surroundings, start and goal."""

from __future__ import annotations

import dataclasses

import numpy

from fogros2_examples.meshes import box, Floats, joined, Mesh, quaternion, rotation, turned


@dataclasses.dataclass(frozen=True)
class Scene:
    """
    One problem.

    :param body: the body in its own frame; the bounds apply to the frame's origin.
    :param walls: obstacles.
    :param shell: floor and ceiling: also obstacles, but they hide the scene in pictures.
    :param low: lower bounds of the position, m; ``high`` are the upper ones.
    :param start: pose x, y, z, qx, qy, qz, qw; ``goal`` likewise.
    """

    name: str
    body: Mesh
    walls: Mesh
    shell: Mesh
    low: Floats
    high: Floats
    start: Floats
    goal: Floats

    def at(self, pose: Floats) -> Mesh:
        """Return the body at a pose."""
        return self.body.moved(rotation(pose[3:]), pose[:3])


def pose(x: float, y: float, z: float, *, yaw: float = 0.0, pitch: float = 0.0) -> Floats:
    """Return a pose; ``yaw`` turns about z after ``pitch`` about y, rad."""
    turn = turned((0, 0, 1), yaw) @ turned((0, 1, 0), pitch)
    return numpy.array([x, y, z, *quaternion(turn)])


#: Thickness and height of the walls of rooms, and height of a door, m.
WALL, STOREY, DOOR = 0.15, 2.6, 2.1


def _wall(begin: tuple[float, float], end: tuple[float, float], doors: tuple[float, ...] = (),
          width: float = 1.1, low: float = 0.0, high: float = STOREY) -> Mesh:
    """Return a wall along x or y; ``doors`` are distances of door centres from its begin."""
    axis = 0 if begin[1] == end[1] else 1
    along, across = begin[axis], begin[1 - axis]

    def piece(a: float, b: float, bottom: float, top: float) -> Mesh:
        corners = [[0.0, 0.0, bottom], [0.0, 0.0, top]]
        for corner, at, side in ((0, a, -1), (1, b, 1)):
            corners[corner][axis] = along + at
            corners[corner][1 - axis] = across + side * WALL / 2
        return box(corners[0], corners[1])

    parts, last = [], -WALL / 2
    for door in doors:
        parts += [piece(last, door - width / 2, low, high),
                  piece(door - width / 2, door + width / 2, low + DOOR, high)]
        last = door + width / 2
    return joined([*parts, piece(last, end[axis] - along + WALL / 2, low, high)])


def apartment() -> Scene:
    """
    Return an apartment of six rooms, with an upright piano to move through its doors.

    The piano is 1.2 m long, 1 m high and 0.45 m deep; a door is 1.1 m wide.
    """
    walls = joined([
        _wall((0, 0), (10, 0)), _wall((0, 8), (10, 8)),
        _wall((0, 0), (0, 8)), _wall((10, 0), (10, 8)),
        _wall((3.4, 0), (3.4, 3.0), (2.2,)), _wall((6.8, 0), (6.8, 3.0), (0.9,)),
        _wall((0, 3.0), (10, 3.0), (2.2, 8.6)), _wall((0, 5.0), (10, 5.0), (1.4, 5.2)),
        _wall((3.4, 5.0), (3.4, 8), (1.8,)), _wall((6.8, 5.0), (6.8, 8), (1.0,)),
        # furniture: a bed, a table, cupboards, a kitchen counter, a bench, a desk
        box((7.6, 6.9, 0), (9.9, 7.9, 0.55)), box((4.3, 6.7, 0.68), (5.9, 7.4, 0.74)),
        *(box((x, y, 0), (x + 0.06, y + 0.06, 0.68)) for x in (4.32, 5.82) for y in (6.72, 7.32)),
        box((0.1, 7.3, 0), (2.0, 7.9, 1.9)), box((0.1, 0.1, 0), (0.6, 1.2, 2.1)),
        box((4.0, 0.1, 0), (6.2, 0.7, 0.9)), box((7.8, 0.1, 0), (9.8, 0.8, 0.8)),
        box((3.6, 3.1, 0), (5.0, 3.45, 0.5)), box((0.1, 5.3, 0), (0.7, 6.6, 0.75))])
    shell = joined([box((-0.1, -0.1, -0.1), (10.1, 8.1, -0.01)),
                    box((-0.1, -0.1, STOREY), (10.1, 8.1, STOREY + 0.1))])
    piano = joined([box((-0.6, -0.18, -0.5), (0.6, 0.06, 0.5)),
                    box((-0.58, 0.06, -0.05), (0.58, 0.27, 0.08)),
                    box((-0.58, 0.2, -0.5), (-0.52, 0.26, -0.05)),
                    box((0.52, 0.2, -0.5), (0.58, 0.26, -0.05))])
    return Scene('apartment', piano, walls, shell,
                 numpy.array([0.0, 0.0, 0.0]), numpy.array([10.0, 8.0, STOREY]),
                 pose(1.6, 1.4, 0.6), pose(8.8, 5.6, 0.6, yaw=numpy.pi))


#: Height of a storey, height of the walls of cubicles, thickness of the floor, m.
OFFICE, CUBICLE, SLAB = 2.4, 1.5, 0.2


def cubicles() -> Scene:
    """
    Return two storeys of cubicles, with an L of 1.2 m by 0.8 m to move between them.

    The only way is a hole in the floor between the storeys, in the far corner.
    """
    size, hole = 12.0, (8.4, 8.4, 11.4, 11.4)
    top = OFFICE + SLAB
    low_x, low_y, high_x, high_y = hole
    parts = [
        box((0, 0, OFFICE), (size, low_y, top)), box((0, high_y, OFFICE), (size, size, top)),
        box((0, low_y, OFFICE), (low_x, high_y, top)),
        box((high_x, low_y, OFFICE), (size, high_y, top))]
    for floor, shift in ((0.0, 0.0), (top, 1.0)):
        high = floor + CUBICLE
        for row in range(3):
            y = 1.2 + 3.2 * row + shift
            # three sides of a cubicle, open towards the corridor
            for column in range(3):
                x = 1.2 + 2.8 * column
                if x > 6 and y > 7:
                    continue
                parts += [_wall((x, y), (x + 1.7, y), low=floor, high=high),
                          _wall((x, y), (x, y + 1.7), low=floor, high=high),
                          _wall((x + 1.7, y), (x + 1.7, y + 1.7), low=floor, high=high),
                          box((x + 0.15, y + 0.15, floor + 0.7),
                              (x + 1.55, y + 0.75, floor + 0.75))]
    # a wall from floor to ceiling with one door
    parts.append(_wall((0, 4.1), (size, 4.1), (10.2,), 1.8, 0.0, OFFICE))
    edges = [_wall(*ends, low=0.0, high=top + OFFICE) for ends in (
        ((0.0, 0.0), (size, 0.0)), ((0.0, size), (size, size)),
        ((0.0, 0.0), (0.0, size)), ((size, 0.0), (size, size)))]
    shell = joined([box((0, 0, -0.1), (size, size, -0.01)),
                    box((0, 0, top + OFFICE), (size, size, top + OFFICE + 0.1)), *edges])
    body = joined([box((-0.6, -0.12, -0.12), (0.6, 0.12, 0.12)),
                   box((0.36, -0.12, 0.12), (0.6, 0.12, 0.68))])
    return Scene('cubicles', body, joined(parts), shell,
                 numpy.zeros(3), numpy.array([size, size, top + OFFICE]),
                 pose(1.3, 0.6, 0.5), pose(1.6, 0.9, top + 0.6, yaw=numpy.pi / 2))


#: Built-in problems, by name.
MADE = {'apartment': apartment, 'cubicles': cubicles}
