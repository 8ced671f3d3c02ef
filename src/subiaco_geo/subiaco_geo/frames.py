"""Rigid transforms as 4x4 arrays, named right to left: ``p_a = T_a_b @ p_b``."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from subiaco_geo.errors import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def make_pose(rotation: ArrayLike, translation: ArrayLike) -> Floats:
    """Stack rotations and translations into homogeneous poses.

    Parameters
    ----------
    rotation : (..., 3, 3) float
        Rotation matrices.
    translation : (..., 3) float
        Translations [m].

    Returns
    -------
    (..., 4, 4) float64
    """
    rot = np.asarray(rotation, dtype=np.float64)
    pose = np.zeros((*rot.shape[:-2], 4, 4))
    pose[..., :3, :3] = rot
    pose[..., :3, 3] = translation
    pose[..., 3, 3] = 1.0
    return pose


def pose_from_quaternion(translation: ArrayLike, quaternion_xyzw: ArrayLike) -> Floats:
    """Build poses (..., 4, 4) from translations [m] and x, y, z, w quaternions."""
    quaternion = np.asarray(quaternion_xyzw, dtype=np.float64)
    rotation = Rotation.from_quat(quaternion.reshape(-1, 4)).as_matrix()
    return make_pose(rotation.reshape(*quaternion.shape[:-1], 3, 3), translation)


def quaternion_from_pose(pose: ArrayLike) -> Floats:
    """Return the x, y, z, w quaternions (..., 4) of poses (..., 4, 4)."""
    rotation = np.asarray(pose, dtype=np.float64)[..., :3, :3]
    flat = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat()
    return np.asarray(flat.reshape(*rotation.shape[:-2], 4))


def invert_pose(pose: ArrayLike) -> Floats:
    """Invert rigid poses (..., 4, 4)."""
    pose_array = np.asarray(pose, dtype=np.float64)
    rotation_t = np.swapaxes(pose_array[..., :3, :3], -1, -2)
    translation = -np.einsum("...ij,...j->...i", rotation_t, pose_array[..., :3, 3])
    return make_pose(rotation_t, translation)


def transform_points(pose: ArrayLike, points: ArrayLike) -> Floats:
    """Apply one pose (4, 4) to points (N, 3) [m]."""
    pose_array = np.asarray(pose, dtype=np.float64)
    pts = np.asarray(points, dtype=np.float64)
    if pts.ndim != 2 or pts.shape[1] != 3:
        raise InputError(f"points must have shape (N, 3), got {pts.shape}")
    moved = np.asarray(pts @ pose_array[:3, :3].T)
    moved += pose_array[:3, 3]
    return moved


def exp_se3(twist: ArrayLike) -> Floats:
    """Map twists (..., 6), rotation first [rad, m], to poses (..., 4, 4).

    Rotation and translation are exponentiated separately (``R = Exp(w)``,
    ``t = v``): the retraction used by our Gauss-Newton solvers.
    """
    twist_array = np.asarray(twist, dtype=np.float64)
    flat = Rotation.from_rotvec(twist_array[..., :3].reshape(-1, 3)).as_matrix()
    return make_pose(flat.reshape(*twist_array.shape[:-1], 3, 3), twist_array[..., 3:])


def rotation_angle(pose: ArrayLike) -> float:
    """Return the rotation angle [rad] of one pose (4, 4)."""
    rotation = np.asarray(pose, dtype=np.float64)[:3, :3]
    return float(Rotation.from_matrix(rotation).magnitude())


def interpolate_poses(times_ns: Ints, poses: Floats, query_ns: Ints) -> Floats:
    """Interpolate poses in time: linear in position, slerp in rotation.

    Parameters
    ----------
    times_ns : (N,) int64
        Strictly increasing times, N >= 1.
    poses : (N, 4, 4) float64
    query_ns : (M,) int64
        Times outside the span take the nearest end pose.

    Returns
    -------
    (M, 4, 4) float64
    """
    if len(times_ns) == 0 or np.any(np.diff(times_ns) <= 0):
        raise InputError("times_ns must be strictly increasing and not empty")
    if len(times_ns) == 1:
        return np.repeat(poses, len(query_ns), axis=0)
    start_ns = times_ns[0]
    times = (times_ns - start_ns).astype(np.float64)
    query = np.clip((query_ns - start_ns).astype(np.float64), 0.0, times[-1])
    rotation = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(query).as_matrix()
    translation = np.stack([np.interp(query, times, poses[:, i, 3]) for i in range(3)], axis=1)
    return make_pose(rotation, translation)


def is_rigid(T: Floats, tolerance: float) -> bool:
    """Tell whether an array is a transform (4, 4) of a rotation and a shift.

    Parameters
    ----------
    T : array
    tolerance : float
        Largest departure of ``R @ R.T`` from the identity.
    """
    if T.shape != (4, 4) or not np.isfinite(T).all() or not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        return False
    R = T[:3, :3]
    return bool(np.abs(R @ R.T - np.eye(3)).max() <= tolerance and np.linalg.det(R) > 0)
