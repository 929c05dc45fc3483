# SPDX-License-Identifier: Apache-2.0
"""The Python modules that the examples' nodes import besides ROS 2."""

from __future__ import annotations

from fogros2.host.modules import Module, NUMPY, OPENCV

# wheels that need only NumPy
_GTSAM = Module('gtsam', ('gtsam',))
_OMPL = Module('ompl', ('ompl',), (2,))
_FCL = Module('fcl', ('python-fcl',))
_ONNX = Module('onnxruntime', ('onnxruntime', 'onnxruntime-gpu'))
NEEDS = {
    'lidar': (NUMPY,), 'obstacle_finder': (NUMPY,), 'camera': (NUMPY, OPENCV),
    'image_processor': (NUMPY, OPENCV), 'slam': (NUMPY, OPENCV, _GTSAM),
    'grasp_planner': (NUMPY, OPENCV, _FCL), 'motion_planner': (NUMPY, _OMPL, _FCL),
    'policy_server': (NUMPY, OPENCV, _ONNX), 'policy_client': (NUMPY, OPENCV)}
