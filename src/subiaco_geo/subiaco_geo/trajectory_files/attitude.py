"""Conventions of attitude: angles of navigation systems as rotations between right-handed axes.

Navigation systems measure in north, east, down with a body of forward, right, down; robots in east, north,
up with a body of forward, left, up. Rotations here bring the latter body to the latter axes.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from subiaco_geo.frames import Floats

_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])
_STEP = 0.5  # travelled between the positions that tell a direction [m]


def rotation_from_ned(roll: Floats, pitch: Floats, heading: Floats) -> Floats:
    """Return rotations (N, 3, 3) of aerospace angles (N,) [rad].

    Roll is positive with the right side down, pitch with the nose up, heading clockwise from north.
    """
    angles = np.stack([heading, pitch, roll], axis=1)
    body_to_ned = Rotation.from_euler("ZYX", angles).as_matrix()
    return np.asarray(_ENU_FROM_NED @ body_to_ned @ _FRD_FROM_FLU)


def rotation_from_enu(roll: Floats, pitch: Floats, yaw: Floats) -> Floats:
    """Return rotations (N, 3, 3) of angles (N,) [rad]: yaw counter-clockwise from east, pitch nose down."""
    angles = np.stack([yaw, pitch, roll], axis=1)
    return np.asarray(Rotation.from_euler("ZYX", angles).as_matrix())


def directions_of_travel(positions: Floats) -> Floats:
    """Return the direction (N,) of travel [rad], counter-clockwise from east.

    It is taken over half a metre at least; a vehicle that stands keeps the direction in which it came, and
    one that never moves faces east.

    Parameters
    ----------
    positions : (N, 3) float64
        East, north, up [m].
    """
    steps = np.linalg.norm(np.diff(positions[:, :2], axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    if len(positions) < 2 or travelled[-1] < _STEP:
        return np.zeros(len(positions))
    moving = np.concatenate([[True], steps > 0.0])
    ahead, behind = (np.clip(travelled + side * _STEP, 0.0, travelled[-1]) for side in (1.0, -1.0))
    way = travelled[moving]
    run = [
        np.interp(ahead, way, positions[moving, axis]) - np.interp(behind, way, positions[moving, axis])
        for axis in range(2)
    ]
    found = np.arctan2(run[1], run[0])
    still = np.hypot(*run) < 0.1 * _STEP  # there and back over the same place
    source = np.maximum.accumulate(np.where(still, -1, np.arange(len(found))))
    return np.asarray(np.where(source < 0, 0.0, found[np.maximum(source, 0)]))


def level_rotations(positions: Floats) -> Floats:
    """Return rotations (N, 3, 3) of a level body that faces its direction of travel."""
    yaw = directions_of_travel(positions)
    none = np.zeros_like(yaw)
    return rotation_from_enu(none, none, yaw)


def offset_from_travel(positions: Floats, rotations: Floats) -> float | None:
    """Return the median angle [rad] of the forward axes from the direction of travel; None while it stands.

    Only places where the vehicle moves on count: where positions (N, 3) [m] lie apart.
    """
    flat = positions[:, :2]
    steps = np.linalg.norm(np.diff(flat, axis=0, append=flat[-1:]), axis=1)
    moving = steps > 0.2 * np.quantile(steps, 0.9)
    if steps.sum() < 20 * _STEP or not moving.any():
        return None
    facing = np.arctan2(rotations[moving, 1, 0], rotations[moving, 0, 0])
    off = facing - directions_of_travel(positions)[moving]
    off = np.arctan2(np.sin(off), np.cos(off))
    middle = np.arctan2(np.median(np.sin(off)), np.median(np.cos(off)))
    return float(middle)
