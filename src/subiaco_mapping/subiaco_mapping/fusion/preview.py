"""Preview of path and map between two solutions of the pose graph."""

from __future__ import annotations

import numpy as np

from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.frames import Floats, Ints

_RANGE = 40.0


class LivePreview:
    """Keep the poses of all scans and one point a voxel, in the frame of the newest solution.

    Every point belongs to the scan that brought it, so a new solution moves the map with its path.

    Parameters
    ----------
    voxel : float
        [m]
    most : int
        Points; the oldest go first.
    """

    def __init__(self, voxel: float, most: int) -> None:
        self._voxel = voxel
        self._most = most
        self._stamps: list[int] = []
        self._odometry: list[Floats] = []
        self._poses: list[Floats] = []
        self._seen: set[int] = set()
        self._points: list[tuple[int, Floats]] = []
        self._count = 0
        self._T_local_odom = np.eye(4)

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp_ns: int, T_odom_lidar: Floats, xyz: Floats) -> None:
        """Take a scan: its pose, and points (N, 3) in ``lidar_link``."""
        pose = self._T_local_odom @ T_odom_lidar
        self._stamps.append(stamp_ns)
        self._odometry.append(T_odom_lidar)
        self._poses.append(pose)
        near = xyz[(xyz * xyz).sum(axis=1) < _RANGE**2]
        keys = voxel_keys(voxel_indices(near @ pose[:3, :3].T + pose[:3, 3], self._voxel))
        _, first = np.unique(keys, return_index=True)
        fresh = np.array([k for k in first.tolist() if int(keys[k]) not in self._seen], dtype=np.int64)
        if len(fresh) == 0:
            return
        self._seen.update(keys[fresh].tolist())
        self._points.append((len(self._stamps) - 1, near[fresh].astype(np.float32)))
        self._count += len(fresh)
        while self._count > self._most and len(self._points) > 1:
            self._count -= len(self._points.pop(0)[1])

    def solved(self, stamps_ns: Ints, T_local_lidar: Floats, T_local_odom: Floats) -> None:
        """Take a solution: poses (S, 4, 4) of the scans at ``stamps_ns``, and what carries newer ones."""
        self._T_local_odom = T_local_odom
        known = dict(zip(stamps_ns.tolist(), T_local_lidar, strict=True))
        self._poses = [
            known.get(stamp, T_local_odom @ pose)
            for stamp, pose in zip(self._stamps, self._odometry, strict=True)
        ]

    @property
    def T_local_odom(self) -> Floats:
        """What carries fresh odometry over (4, 4)."""
        return self._T_local_odom

    def path(self) -> tuple[Ints, Floats]:
        """Return stamps (S,) and poses (S, 4, 4)."""
        return np.array(self._stamps, dtype=np.int64), np.array(self._poses).reshape(-1, 4, 4)

    def points(self) -> Floats:
        """Return the map (N, 3) [m]."""
        moved = [xyz @ self._poses[k][:3, :3].T + self._poses[k][:3, 3] for k, xyz in self._points]
        return np.concatenate([*moved, np.zeros((0, 3))])


class OdometrySegments:
    """Tie the runs of an odometry that was restarted into one: a new run begins where the last ended.

    A run numbers its segments from a base of its own, far above those of the run before; here they
    become 0, 1, 2 ... without holes, and poses of a new run continue from the last known one.

    Attributes
    ----------
    T_chain_odom : (4, 4) float64
        Of the present run.
    """

    #: Segments of one run stay below this; the base of a run is a multiple of seconds above.
    RUN = 1000

    def __init__(self) -> None:
        self._raw: int | None = None
        self._segment = 0
        self.T_chain_odom = np.eye(4)
        self._last = np.eye(4)

    def take(self, segment: int, T_odom_lidar: Floats) -> tuple[int, Floats]:
        """Return segment and pose (4, 4) in the one chain."""
        if self._raw is not None and segment != self._raw:
            self._segment += 1
            if abs(segment - self._raw) >= self.RUN:
                self.T_chain_odom = self._last @ np.linalg.inv(T_odom_lidar)
        self._raw = segment
        self._last = self.T_chain_odom @ T_odom_lidar
        return self._segment, self._last
