"""Velocity at the start of a drive, from its first two scans.

No motion is known yet that could straighten the first scan of a vehicle that is already moving. Left as
it is, it lies half a turn's way off a straightened one (0.6 m at 11 m/s), and the odometry, which straightens
each scan with the velocity that it found from the one before, swings for a second. Two scans straightened
alike do not shift against each other, whatever the velocity; so it is found in two or three rounds.
"""

from __future__ import annotations

import numpy as np

from subiaco_geo.frames import Floats
from subiaco_mapping.measurements import Scan
from subiaco_mapping.method_numbers import NUMBERS
from subiaco_mapping.odometry.config import OdometryConfig
from subiaco_mapping.odometry.scan_matching import KissOdometry
from subiaco_mapping.preprocessing.deskew import straighten_by_twist

ROUNDS = NUMBERS.odometry.first_rounds
SETTLED = NUMBERS.odometry.first_settled


def first_twist(first: Scan, second: Scan, config: OdometryConfig, threads: int = 1) -> Floats | None:
    """Return the body twist (6,) of the LiDAR over two scans, rotation first [rad/s, m/s].

    Parameters
    ----------
    first, second : Scan
        In order, with the times of their points.
    config : OdometryConfig
    threads : int

    Returns
    -------
    (6,) float64 or None
        None where they could not be registered.
    """
    twist = np.zeros(6)
    seconds = (second.end_ns - first.end_ns) * 1e-9
    for _ in range(ROUNDS):
        odometry = KissOdometry(config, threads)
        odometry.register(straighten_by_twist(first, twist))
        pose = odometry.register(straighten_by_twist(second, twist, first.end_ns))
        if pose.predicted or odometry.twist is None:
            return None
        change = float(np.linalg.norm(odometry.twist[3:] - twist[3:])) * seconds
        twist = odometry.twist
        if change < SETTLED:
            break
    return twist
