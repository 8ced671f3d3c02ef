"""Spread of a fit over displaced starts: what its own covariance cannot know of sparse clouds.

Walls and roofs bring a fit back to one pose from wherever it starts. Leaves and flat ground that were
sampled a metre apart do not: every start ends where the patterns of the two scans interlock nearby, all
blocks of points agree with that, and the covariance of the fit promises centimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from subiaco_change.geometry import Level
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.registration.config import RegistrationConfig
from subiaco_change.registration.icp import Noise, Target, align_icp
from subiaco_geo.frames import Floats, invert_pose, transform_points

_ASIDE = NUMBERS.displaced_starts.aside
_STARTS = NUMBERS.displaced_starts.starts


@dataclass(frozen=True)
class PoseSpread:
    """Covariance (6, 6) of a pose about a centre (3,): rotation vector [rad], then shift [m]."""

    covariance: Floats
    centre: Floats

    @property
    def level(self) -> float:
        """Standard deviation of the horizontal place of the centre [m]."""
        return float(np.sqrt(self.covariance[3, 3] + self.covariance[4, 4]))

    def about(self, centre: Floats) -> Floats:
        """Return the covariance (6, 6) about another centre (3,)."""
        x, y, z = centre - self.centre
        moved = np.eye(6)
        moved[3:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
        return np.asarray(moved @ self.covariance @ moved.T)


def twist_between(one: Floats, other: Floats, centre: Floats) -> Floats:
    """Twist (6,) about a centre (3,) from one pose to another: rotation vector [rad], then shift [m]."""
    delta = one @ invert_pose(other)
    turn = Rotation.from_matrix(delta[:3, :3]).as_rotvec()
    return np.concatenate([turn, transform_points(delta, centre[None])[0] - centre])


def spread_of_starts(
    source: Level, target: Target, pose: Floats, noise: Noise, spacing: float, config: RegistrationConfig
) -> PoseSpread:
    """Fit again from starts around a pose ``T_after_before``, half a point spacing [m] aside.

    Every kind of neighbourhood keeps the weight that it had at the pose (``noise``).
    """
    centre = transform_points(pose, source.xyz).mean(axis=0)
    ends = []
    for k in range(_STARTS):
        angle = 2.0 * np.pi * k / _STARTS
        start = pose.copy()
        start[:2, 3] += _ASIDE * spacing * np.array([np.cos(angle), np.sin(angle)])
        end, _, _ = align_icp(
            source, target, start, tukey=config.tukey, huber=config.huber, reach=2.0 * source.leaf,
            min_eigenvalue=config.min_eigenvalue, max_iterations=config.icp_iterations, noise=noise,
        )  # fmt: skip
        ends.append(twist_between(end, pose, centre))
    twists = np.array(ends)
    return PoseSpread(twists.T @ twists / len(twists), centre)
