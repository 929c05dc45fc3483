# SPDX-License-Identifier: Apache-2.0
"""
Evaluate an estimated trajectory by ``evo``: the two usual errors of papers on SLAM.

ATE is the root mean square of the distances after the best rigid alignment. RPE is the root mean
square of the translation's error over each metre of the trajectory (Sturm et al., IROS 2012).
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import math

import numpy

from fogros2_examples.slam.geometry import Array

#: Length of the segments of RPE, m.
WAY = 1.0


@dataclasses.dataclass(frozen=True)
class Accuracy:
    """
    Errors of a trajectory, metres.

    :param rpe: nan if the trajectory is shorter than a metre.
    :param aligned: (N, 3), the estimated positions after the alignment; ``truth`` (N, 3).
    :param errors: (N,), distance of each position.
    """

    ate: float
    rpe: float
    aligned: Array
    truth: Array
    errors: Array


def accuracy(truth: Sequence[Array], estimate: Sequence[Array]) -> Accuracy:
    """
    Compare estimated poses with the true poses at the same times.

    :param truth: N poses (4, 4), at least 3; ``estimate`` has as many.
    """
    from evo.core.filters import FilterException
    from evo.core.metrics import APE, PoseRelation, RPE, StatisticsType, Unit
    from evo.core.trajectory import PosePath3D

    reference, estimated = PosePath3D(poses_se3=list(truth)), PosePath3D(poses_se3=list(estimate))
    estimated.align(reference)
    absolute = APE(PoseRelation.translation_part)
    absolute.process_data((reference, estimated))
    relative = RPE(PoseRelation.translation_part, WAY, Unit.meters, all_pairs=True)
    try:
        relative.process_data((reference, estimated))
        rpe = float(relative.get_statistic(StatisticsType.rmse))
    except FilterException:
        rpe = math.nan
    return Accuracy(float(absolute.get_statistic(StatisticsType.rmse)), rpe,
                    numpy.asarray(estimated.positions_xyz), numpy.asarray(reference.positions_xyz),
                    numpy.asarray(absolute.error))
