# SPDX-License-Identifier: Apache-2.0
"""
How good an estimated trajectory is, by ``evo``: the two errors that papers on SLAM give.

ATE is the root mean square of the distances after the best rigid alignment, RPE that of the
translation's error over each metre of the way (Sturm et al., IROS 2012).
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import math

import numpy

from fogros2_examples.slam.geometry import Array

#: Metres of way over which RPE is taken.
WAY = 1.0


@dataclasses.dataclass(frozen=True)
class Accuracy:
    """
    Errors of a trajectory, metres.

    :param rpe: nan where the way is shorter than a metre.
    :param aligned: (N, 3), the estimated places where they fit best; ``truth`` (N, 3).
    :param errors: (N,).
    """

    ate: float
    rpe: float
    aligned: Array
    truth: Array
    errors: Array


def accuracy(truth: Sequence[Array], estimate: Sequence[Array]) -> Accuracy:
    """
    Return how far poses are from those that were true at the same times.

    :param truth: N poses (4, 4), at least 3; ``estimate`` as many.
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
