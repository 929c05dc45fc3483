# SPDX-License-Identifier: Apache-2.0
"""Convert scenes to markers, which viewers show and the planner reads; also poses and paths."""

from __future__ import annotations

from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Vector3
from nav_msgs.msg import Path
import numpy
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from fogros2_examples.meshes import Floats, Mesh
from fogros2_examples.planning.scene import Scene

#: Colours of the parts of a scene: red, green, blue, opacity.
COLOURS = {'body': (0.85, 0.45, 0.15, 1.0), 'walls': (0.75, 0.77, 0.8, 0.9),
           'shell': (0.6, 0.6, 0.6, 0.15), 'bounds': (0.0, 0.0, 0.0, 0.0),
           'start': (0.2, 0.6, 0.3, 1.0), 'goal': (0.2, 0.4, 0.9, 1.0)}


def pose_message(pose: Floats) -> Pose:
    """Return a pose x, y, z, qx, qy, qz, qw as a message."""
    x, y, z, qx, qy, qz, qw = map(float, pose)
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def pose_of(message: Pose) -> Floats:
    """
    Return the pose of a message.

    :raises ValueError: the pose is not finite, or its quaternion is zero.
    """
    p, q = message.position, message.orientation
    pose = numpy.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])
    length = float(numpy.linalg.norm(pose[3:]))
    if not numpy.isfinite(pose).all() or length < 1e-6:
        raise ValueError(f'{pose.tolist()} is no pose: x, y, z and a quaternion x, y, z, w')
    pose[3:] /= length
    return pose


def path_message(poses: Floats, scene: str) -> Path:
    """Return poses (n, 7) as a path in the frame of the scene's name."""
    path = Path()
    path.header.frame_id = scene
    for pose in poses:
        stamped = PoseStamped(pose=pose_message(pose))
        stamped.header.frame_id = scene
        path.poses.append(stamped)
    return path


def mesh_marker(mesh: Mesh, name: str, number: int, scene: str, pose: Pose,
                colour: tuple[float, float, float, float]) -> Marker:
    """Return a mesh as a marker of triangles."""
    r, g, b, a = colour
    marker = Marker(ns=name, id=number, type=Marker.TRIANGLE_LIST, action=Marker.ADD, pose=pose,
                    scale=Vector3(x=1.0, y=1.0, z=1.0), color=ColorRGBA(r=r, g=g, b=b, a=a),
                    points=[Point(x=x, y=y, z=z)
                            for x, y, z in mesh.corners.reshape(-1, 3).tolist()])
    marker.header.frame_id = scene
    return marker


def scene_message(scene: Scene) -> MarkerArray:
    """Return a scene as a marker for each of its parts, with the body at the start."""
    still = pose_message(numpy.array([0, 0, 0, 0, 0, 0, 1]))
    markers = [
        mesh_marker(scene.body, 'body', 0, scene.name, pose_message(scene.start),
                    COLOURS['body']),
        mesh_marker(scene.walls, 'walls', 0, scene.name, still, COLOURS['walls']),
        mesh_marker(scene.shell, 'shell', 0, scene.name, still, COLOURS['shell'])]
    middle, size = (scene.low + scene.high) / 2, scene.high - scene.low
    for name, kind, pose, scale in (
            ('bounds', Marker.CUBE, numpy.array([*middle, 0, 0, 0, 1]), size),
            ('start', Marker.ARROW, scene.start, (0.6, 0.08, 0.08)),
            ('goal', Marker.ARROW, scene.goal, (0.6, 0.08, 0.08))):
        x, y, z = map(float, scale)
        r, g, b, a = COLOURS[name]
        marker = Marker(ns=name, type=kind, action=Marker.ADD, pose=pose_message(pose),
                        scale=Vector3(x=x, y=y, z=z), color=ColorRGBA(r=r, g=g, b=b, a=a))
        marker.header.frame_id = scene.name
        markers.append(marker)
    return MarkerArray(markers=markers)


def scene_of(message: MarkerArray) -> Scene:
    """
    Return the scene of markers.

    :raises ValueError: a part is missing, or its triangles, bounds or pose are invalid.
    """
    parts: dict[str, Marker] = {marker.ns: marker for marker in message.markers}
    for name in COLOURS:
        if name not in parts:
            raise ValueError(f"no marker '{name}'")
    box = parts['bounds']
    middle, size = (numpy.array([v.x, v.y, v.z]) for v in (box.pose.position, box.scale))
    if not (numpy.isfinite(middle).all() and numpy.isfinite(size).all() and (size > 0).all()):
        raise ValueError(f"the marker 'bounds' has no size: {size.tolist()}")
    start, goal = pose_of(parts['start'].pose), pose_of(parts['goal'].pose)
    return Scene(box.header.frame_id, _mesh(parts['body']), _mesh(parts['walls']),
                 _mesh(parts['shell'], empty=True), middle - size / 2, middle + size / 2,
                 start, goal)


def _mesh(marker: Marker, *, empty: bool = False) -> Mesh:
    points = numpy.array([(p.x, p.y, p.z) for p in marker.points]).reshape(-1, 3)
    if len(points) % 3 or not (len(points) or empty) or not numpy.isfinite(points).all():
        raise ValueError(f"the marker '{marker.ns}' has {len(points)} points, which are no "
                         'finite triangles')
    vertices, indices = numpy.unique(points, axis=0, return_inverse=True)
    return Mesh(vertices, indices.reshape(-1, 3).astype(numpy.int32))
