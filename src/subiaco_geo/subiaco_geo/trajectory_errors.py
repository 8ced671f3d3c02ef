"""Errors of a trajectory against a reference: absolute (APE, ATE) and relative (RPE)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints, invert_pose, make_pose
from subiaco_geo.trajectories import Trajectory


@dataclass(frozen=True)
class PoseErrors:
    """Absolute errors of poses.

    Parameters
    ----------
    times_ns : (N,) int64
    offset : (N, 3) float64
        Estimate minus reference, axes of the map [m].
    angle_deg : (N,) float64
    """

    times_ns: Ints
    offset: Floats
    angle_deg: Floats

    @property
    def distance(self) -> Floats:
        """Errors in space (N,) [m]."""
        return np.asarray(np.linalg.norm(self.offset, axis=1))


@dataclass(frozen=True)
class StretchErrors:
    """Relative errors over stretches of a travelled length.

    Parameters
    ----------
    length : float
        Asked for [m].
    start, stop : (M,) int64
        Poses within the overlap.
    travelled : (M,) float64
        [m].
    drift : (M,) float64
        [m].
    angle_deg : (M,) float64
    """

    length: float
    start: Ints
    stop: Ints
    travelled: Floats
    drift: Floats
    angle_deg: Floats


def overlap(estimate: Trajectory, reference: Trajectory) -> tuple[Ints, Floats, Floats]:
    """Return times (M,), estimated and reference poses (M, 4, 4) while both last.

    Raises
    ------
    InputError
        Fewer than two poses lie in the time of the reference.
    """
    inside = (estimate.times_ns >= reference.times_ns[0]) & (estimate.times_ns <= reference.times_ns[-1])
    if inside.sum() < 2:
        raise InputError(
            "trajectory: fewer than two poses lie within the time of the reference; check its clock"
        )
    times_ns = estimate.times_ns[inside]
    return times_ns, estimate.poses[inside], reference.at(times_ns)


def _angles_deg(poses: Floats) -> Floats:
    return np.degrees(Rotation.from_matrix(poses[:, :3, :3]).magnitude())


def _rmse(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def aligned(estimate: Trajectory, reference: Trajectory) -> tuple[Trajectory, Floats]:
    """Move a trajectory rigidly onto its reference (Kabsch), scale left alone.

    Returns
    -------
    trajectory : Trajectory
    T_reference_estimate : (4, 4) float64

    Raises
    ------
    InputError
        They share no time, or the positions lie on one line, so that no rotation is determined.
    """
    _, poses, truth = overlap(estimate, reference)
    source, target = poses[:, :3, 3], truth[:, :3, 3]
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    left, strength, right = np.linalg.svd(b.T @ a)
    if strength[1] < 1e-6 * max(float(strength[0]), 1e-12):
        raise InputError("trajectory: the positions lie on one line; compare without alignment")
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    move = make_pose(turn, target.mean(axis=0) - turn @ source.mean(axis=0))
    return Trajectory(estimate.times_ns, move @ estimate.poses), move


def pose_errors(estimate: Trajectory, reference: Trajectory) -> PoseErrors:
    """Return the error of every pose, the reference interpolated to the times of the estimate."""
    times_ns, poses, truth = overlap(estimate, reference)
    offset = poses[:, :3, 3] - truth[:, :3, 3]
    return PoseErrors(times_ns, offset, _angles_deg(invert_pose(truth) @ poses))


def absolute_error(estimate: Trajectory, reference: Trajectory) -> dict[str, float]:
    """Return the absolute trajectory error without any alignment (ATE).

    Both are georeferenced, so that an offset is an error too. The reference
    is interpolated to the times of the estimate.

    Returns
    -------
    dict
        RMSE in space, horizontal and vertical, largest [m]; rotation RMSE [deg]; poses.
    """
    errors = pose_errors(estimate, reference)
    return {
        "ate_rmse_m": _rmse(errors.distance),
        "ate_horizontal_rmse_m": _rmse(np.linalg.norm(errors.offset[:, :2], axis=1)),
        "ate_vertical_rmse_m": _rmse(errors.offset[:, 2]),
        "ate_max_m": float(errors.distance.max()),
        "rotation_rmse_deg": _rmse(errors.angle_deg),
        "poses": float(len(errors.offset)),
    }


def stretch_errors(estimate: Trajectory, reference: Trajectory, length: float = 10.0) -> StretchErrors:
    """Compare, for every pose, its motion to the first pose at least ``length`` [m] of driving later.

    Raises
    ------
    InputError
        They share no time, or the reference is shorter than ``length``.
    """
    _, poses, truth = overlap(estimate, reference)
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
    way = travelled[stop] - travelled[start]
    return StretchErrors(length, start, stop, way, drift, _angles_deg(error))


def relative_error(estimate: Trajectory, reference: Trajectory, length: float = 10.0) -> dict[str, float]:
    """Return the relative pose error (RPE) over stretches of a travelled length [m].

    Returns
    -------
    dict
        RMSE of translation [m] and [percent of the length], of rotation [deg]; pairs.
    """
    errors = stretch_errors(estimate, reference, length)
    return {
        "rpe_length_m": length,
        "rpe_translation_rmse_m": _rmse(errors.drift),
        "rpe_translation_percent": 100.0 * _rmse(errors.drift / errors.travelled),
        "rpe_rotation_rmse_deg": _rmse(errors.angle_deg),
        "pairs": float(len(errors.start)),
    }
