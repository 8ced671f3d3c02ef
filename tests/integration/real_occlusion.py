"""Real objects put into real sweeps beam by beam: they hide what is behind them, and show what beams met."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from real_data import KittiScans
from real_street import Placed
from scipy.spatial import cKDTree

from subiaco_geo.frames import Floats, invert_pose, transform_points

SPLAT = 0.20  # half the size of a point of an object at the leaf of 0.25 m [m]
REACH = 60.0
NOISE = 0.02  # of a range [m]
BEAMS = 30  # least beams that met an object that counts


@dataclass(frozen=True)
class Sweep:
    """A sweep with objects in it: xyz (N, 3) [m], intensity (N,), and the rows that met each object."""

    xyz: Floats
    intensity: NDArray[np.float32]
    met: list[NDArray[np.int64]]


class FilledScans:
    """Scans at poses (N, 4, 4) with objects in them; remembers what the beams met of each object."""

    def __init__(self, scans: KittiScans, poses: Floats, objects: Sequence[Placed], seed: int) -> None:
        self._scans, self._poses, self._objects, self._seed = scans, poses, objects, seed
        self._met: list[list[Floats]] = [[] for _ in objects]

    def scan(self, i: int) -> tuple[Floats, NDArray[np.float32]]:
        """Return the points (N, 3) of a scan in the frame of the scanner [m], and their intensities (N,)."""
        sweep = into_sweep(*self._scans.scan(i), self._objects, self._poses[i], self._seed + i)
        for points, rows in zip(self._met, sweep.met, strict=True):
            points.append(transform_points(self._poses[i], sweep.xyz[rows]))
        return sweep.xyz, sweep.intensity

    def met(self) -> list[Placed]:
        """Return what the scans read so far met of each object, in the map, of those met often enough."""
        seen = [np.concatenate([np.zeros((0, 3)), *points]) for points in self._met]
        return [
            Placed(item.name, item.kind, xyz)
            for item, xyz in zip(self._objects, seen, strict=True)
            if len(xyz) >= BEAMS
        ]


def into_sweep(
    xyz: Floats, intensity: NDArray[np.float32], objects: Sequence[Placed], T_map_lidar: Floats, seed: int
) -> Sweep:
    """Let the beams of one sweep end where they meet objects.

    Parameters
    ----------
    xyz : (N, 3)
        Points of the sweep in the frame of the scanner [m].
    intensity : (N,)
    objects : sequence of Placed
        In the map.
    T_map_lidar : (4, 4) float64
    seed : int
        Of the noise of ranges.
    """
    found, shown = np.array(xyz, dtype=np.float64), np.array(intensity, dtype=np.float32)
    reach = np.linalg.norm(found, axis=1)
    way = found / np.maximum(reach, 1e-6)[:, None]
    noise = np.random.default_rng(seed).normal(0.0, NOISE, len(found))
    last = np.full(len(found), -1)
    for number, item in enumerate(objects):
        own = transform_points(invert_pose(T_map_lidar), item.xyz)
        far = np.linalg.norm(own, axis=1)
        if far.min() > REACH or far.min() < 1.0:
            continue
        middle = own.mean(axis=0) / np.linalg.norm(own.mean(axis=0))
        widest = np.arccos(np.clip((own @ middle) / far, -1.0, 1.0)).max() + SPLAT / far.min()
        beams = np.flatnonzero(way @ middle > np.cos(min(widest, np.pi)))
        if len(beams) == 0:
            continue
        distance = _met(way[beams], own, far)
        hit = distance < reach[beams] - 0.1
        at = beams[hit]
        reach[at] = distance[hit] + noise[at]
        found[at] = way[at] * reach[at, None]
        shown[at] = 50.0
        last[at] = number
    return Sweep(found, shown, [np.flatnonzero(last == number) for number in range(len(objects))])


def _met(way: Floats, own: Floats, far: Floats) -> Floats:
    """Range (B,) at which beams (B, 3) meet points (N, 3) at ranges (N,); infinite where they miss."""
    tree = cKDTree(own / far[:, None])
    near = tree.query_ball_point(way, SPLAT / max(float(far.min()), 1.0))
    found = np.full(len(way), np.inf)
    for beam, members in enumerate(near):
        if members:
            along = own[members] @ way[beam]
            beside = np.linalg.norm(own[members] - along[:, None] * way[beam], axis=1)
            held = along[beside < SPLAT]
            found[beam] = held.min() if len(held) else np.inf
    return found
