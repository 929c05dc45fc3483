# SPDX-License-Identifier: Apache-2.0
"""
Plan motions of rigid bodies: service ``plan``, in the scene on ``environment``.

The result of each plan is on ``planning_status``, because the path of a failure is only empty.
"""

from __future__ import annotations

import signal

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from nav_msgs.srv import GetPlan
import numpy
import rclpy
from rclpy.node import Node
from visualization_msgs.msg import MarkerArray

from fogros2_examples.nodes import LATCHED, run
from fogros2_examples.parameters import within
from fogros2_examples.planning.messages import path_message, pose_of, scene_of
from fogros2_examples.planning.racing import Racer

WHY = {'start': 'the start touches something, or is out of bounds',
       'goal': 'the goal touches something, or is out of bounds'}


class MotionPlanner(Node):
    """
    The planner.

    Parameters: ``time``, time-out of a plan in s; ``workers``, number of parallel searches, 0 for
    one per core; ``planners``, names of OMPL's planners, which the searches use in turn; ``seed``
    of the first search, increased by one for each further search.
    """

    def __init__(self) -> None:
        super().__init__('motion_planner')
        self.seconds = within(self, 'time', 30.0, 0.1)
        self.seed = within(self, 'seed', 1, 1)
        self.scene = ''
        self.racer = Racer(within(self, 'workers', 0, 0),
                           list(self.declare_parameter('planners', ['RRTConnect']).value))
        self.status = self.create_publisher(DiagnosticStatus, 'planning_status', LATCHED)
        self.create_subscription(MarkerArray, 'environment', self.enter, LATCHED)
        self.create_service(GetPlan, 'plan', self.plan)

    def enter(self, markers: MarkerArray) -> None:
        """Use a new scene; keep the last scene if the new one is invalid."""
        try:
            scene = scene_of(markers)
            self.racer.enter(scene)
        except (RuntimeError, ValueError) as error:
            self.tell(DiagnosticStatus.ERROR, 'environment', f'no environment: {error}')
            return
        self.scene = scene.name
        self.tell(DiagnosticStatus.OK, 'environment', (
            f"environment '{scene.name}': {len(scene.walls.triangles)} triangles of walls, "
            f'{len(scene.body.triangles)} of the body; {self.racer.workers} searches at once'))

    def plan(self, request: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
        """Answer with a path, or with an empty path if there is none."""
        wanted = request.start.header.frame_id
        if not self.scene or wanted != self.scene:
            self.tell(DiagnosticStatus.ERROR, 'plan', (
                f"no plan: the start is in the frame '{wanted}', the environment is "
                + (f"'{self.scene}'" if self.scene else 'not there yet')))
            return response
        try:
            start, goal = pose_of(request.start.pose), pose_of(request.goal.pose)
            outcome = self.racer.plan(start, goal, seconds=self.seconds, seed=self.seed)
        except (RuntimeError, ValueError) as error:
            self.tell(DiagnosticStatus.ERROR, 'plan', f'no plan: {error}')
            return response
        # A repeated request should search with other random numbers.
        self.seed += self.racer.workers
        figures = {name: outcome[name] for name in ('end', 'seconds', 'checks', 'length')}
        took = f"{outcome['seconds']:.2f} s, {outcome['checks']} checks"
        if outcome['end'] == 'found':
            response.plan = path_message(numpy.array(outcome['path']), self.scene)
            response.plan.header.stamp = self.get_clock().now().to_msg()
            self.tell(DiagnosticStatus.OK, 'plan',
                      f"path of {outcome['length']:.1f} m in {took}", figures)
        else:
            why = WHY.get(outcome['end'], f'no way was found in {self.seconds:g} s')
            self.tell(DiagnosticStatus.ERROR, 'plan', f'no plan: {why} ({took})', figures)
        return response

    def tell(self, level: bytes, name: str, message: str,
             figures: dict[str, object] | None = None) -> None:
        """Log a result, and publish it as status."""
        # Separate calls, because rclpy allows only one severity per call site.
        if level == DiagnosticStatus.OK:
            self.get_logger().info(message)
        else:
            self.get_logger().error(message)
        self.status.publish(DiagnosticStatus(
            level=level, name=name, message=message, hardware_id=self.scene,
            values=[KeyValue(key=key, value=str(value))
                    for key, value in (figures or {}).items()]))


def serve(node: MotionPlanner) -> None:
    """Answer requests until a signal, then stop the searches."""
    try:
        rclpy.spin(node)
    finally:
        # A second Ctrl-C must not interrupt the end of the searches.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        node.racer.close()


def main() -> None:
    """Run until a signal; exit at once on an invalid parameter."""
    run('motion_planner', MotionPlanner, serve)
