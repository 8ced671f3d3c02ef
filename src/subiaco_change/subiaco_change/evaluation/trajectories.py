"""Errors of a trajectory against a reference, in the map frame and relative."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, invert_pose
from subiaco_geo.trajectories import Trajectory


def _overlap(estimate: Trajectory, reference: Trajectory) -> tuple[Floats, Floats]:
    """Return estimated and reference poses (M, 4, 4) at the estimate's times within the reference."""
    inside = (estimate.times_ns >= reference.times_ns[0]) & (estimate.times_ns <= reference.times_ns[-1])
    if inside.sum() < 2:
        raise InputError(
            "trajectory: fewer than two poses lie within the time of the reference; check its clock"
        )
    return estimate.poses[inside], reference.at(estimate.times_ns[inside])


def _angles_deg(poses: Floats) -> Floats:
    return np.degrees(Rotation.from_matrix(poses[:, :3, :3]).magnitude())


def _rmse(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def absolute_error(estimate: Trajectory, reference: Trajectory) -> dict[str, float]:
    """Return the absolute trajectory error without any alignment (ATE).

    Both are georeferenced, so that an offset is an error too. The reference
    is interpolated to the times of the estimate.

    Returns
    -------
    dict
        RMSE in space, horizontal and vertical, largest [m]; rotation RMSE [deg]; poses.
    """
    poses, truth = _overlap(estimate, reference)
    offset = poses[:, :3, 3] - truth[:, :3, 3]
    distance = np.linalg.norm(offset, axis=1)
    return {
        "ate_rmse_m": _rmse(distance),
        "ate_horizontal_rmse_m": _rmse(np.linalg.norm(offset[:, :2], axis=1)),
        "ate_vertical_rmse_m": _rmse(offset[:, 2]),
        "ate_max_m": float(distance.max()),
        "rotation_rmse_deg": _rmse(_angles_deg(invert_pose(truth) @ poses)),
        "poses": float(len(poses)),
    }


def relative_error(estimate: Trajectory, reference: Trajectory, length: float = 10.0) -> dict[str, float]:
    """Return the relative pose error (RPE) over stretches of a travelled length [m].

    For every pose, its motion to the first pose at least ``length`` metres
    of driving later is compared with the reference's motion in that time.

    Returns
    -------
    dict
        RMSE of translation [m] and [percent of the length], of rotation [deg]; pairs.
    """
    poses, truth = _overlap(estimate, reference)
    steps = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    end = np.searchsorted(travelled, travelled + length - 1e-9)
    start = np.flatnonzero(end < len(travelled))
    if len(start) == 0:
        raise InputError(f"trajectory: the reference is shorter than the {length:g} m of a stretch")
    stop = end[start]
    moved = invert_pose(poses[start]) @ poses[stop]
    true = invert_pose(truth[start]) @ truth[stop]
    error = invert_pose(true) @ moved
    drift = np.linalg.norm(error[:, :3, 3], axis=1)
    return {
        "rpe_length_m": length,
        "rpe_translation_rmse_m": _rmse(drift),
        "rpe_translation_percent": 100.0 * _rmse(drift / (travelled[stop] - travelled[start])),
        "rpe_rotation_rmse_deg": _rmse(_angles_deg(error)),
        "pairs": float(len(start)),
    }
