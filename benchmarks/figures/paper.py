# SPDX-License-Identifier: Apache-2.0
"""
The figures of the paper's tables, as printed (Ichnowski et al., arXiv 2205.09778).

Its robot was a computer with two cores of 1.5 GHz (Pentium Silver J5005) behind a link of
10 Mbit/s, and its cloud was AWS. The paper states no delay of the link, and its averages are
means. None stands for a cell that the paper leaves empty.
"""

from __future__ import annotations

import dataclasses
from typing import Optional

#: Table I by codec: images per second in the cloud, and round trip in ms.
STREAMING = {'raw': (1.42, 1401), 'jpeg': (15.0, 333), 'theora': (29.6, 83), 'h264': (29.0, 38)}
#: Table II, ORB-SLAM2 with 36 cores, seconds a frame: robot only, FogROS1 compressed, FogROS2
#: compressed, FogROS2 H.264. It has no column of computing.
SLAM = {'fr1/xyz': (0.52, 1.62, 0.82, 0.24), 'fr2/xyz': (0.43, 1.61, 0.75, 0.25),
        'fr2/loop': (0.68, 1.63, 0.89, 0.22)}


@dataclasses.dataclass(frozen=True)
class Offloaded:
    """A row of Table III or IV, s; ``network`` and ``total`` are those of FogROS2."""

    robot: float
    compute: float
    fogros1_network: Optional[float]
    fogros1_total: Optional[float]
    network: float
    total: float

    @property
    def ratio(self) -> float:
        """How much longer the robot takes to compute than the cloud."""
        return self.robot / self.compute


#: Table III, Dex-Net on an NVIDIA T4, by codec; "compressed" is PNG there.
GRASPS = {'raw': Offloaded(14.0, 0.6, 5.0, 5.6, 5.0, 5.6),
          'png': Offloaded(14.0, 0.6, 1.3, 1.9, 0.7, 1.3),
          'h264': Offloaded(14.0, 0.6, None, None, 0.6, 1.2)}
#: Table IV, Motion Planning Templates on 96 cores, by scenario.
PLANS = {'Apartment': Offloaded(157.6, 3.46, 0.07, 3.53, 0.04, 3.50),
         'Cubicles': Offloaded(35.8, 1.51, 0.07, 1.58, 0.05, 1.56),
         'Home': Offloaded(161.8, 4.73, 0.08, 4.81, 0.05, 4.78),
         'TwistyCool': Offloaded(167.9, 4.76, 0.08, 4.84, 0.05, 4.81)}
#: Table V, s: FogROS1's default and custom image, then FogROS2's. On Kubernetes, the cluster ran.
STARTUP = {'FogROS1 default': '228±25', 'FogROS1 custom': '155±32', 'AWS default': '275±61',
           'AWS custom': '85±11', 'GCP': '29±2.1', 'local': '27±0.83'}
#: Table VI, round trip in ms: from the west coast, from the east coast.
REGIONS = {'us-west-1': (6.1, 72), 'us-east-2': (74, 13)}
