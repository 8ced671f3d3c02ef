"""Could the other epoch's drive see a place? Rays from its poses, through its scene, to the place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.frames import Floats, Ints
from subiaco_sim.config import TruthConfig
from subiaco_sim.scene import CompiledScene

_LIFT = np.array([0.0, 0.0, 0.4])
_CELL = 0.25  # one test a cell and object [m]


@dataclass(frozen=True)
class OtherDrive:
    """The other epoch: its scene, its LiDAR poses (N, 4, 4) in ENU and how far it sees [m].

    ``view_deg`` is the elevation of the lowest and of the highest beam [deg].
    """

    scene: CompiledScene
    poses: Floats
    max_range: float
    view_deg: tuple[float, float] = (-22.5, 22.5)

    def spaced(self, spacing: float) -> Floats:
        """Return poses at least ``spacing`` apart along the path."""
        kept = [0]
        for k in range(1, len(self.poses)):
            if np.linalg.norm(self.poses[k, :3, 3] - self.poses[kept[-1], :3, 3]) >= spacing:
                kept.append(k)
        return self.poses[kept]


def seen_from(
    drive: OtherDrive, xyz: Floats, object_id: Ints, reshaped: Ints, config: TruthConfig
) -> NDArray[np.bool_]:
    """Tell which places (N, 3) in ENU the other drive could see.

    A place is seen when, from some pose of the other drive, a beam within the
    sensor's vertical field and range reaches the place (or the place 0.4 m
    above it, so that a raised or lowered surface still counts), or is stopped
    within ``seen_radius`` of it. Places of ``reshaped`` objects are also seen
    when the beam is stopped by the same object within ``own_body``: the inside
    of a grown body cannot be looked into, but its skin tells.

    Decided once a 0.25 m cell and object; every point of the cell shares it.
    """
    first, inverse = _distinct(voxel_keys(voxel_indices(xyz, _CELL)), object_id)
    places, owner = xyz[first], object_id[first]
    grown = np.isin(owner, reshaped)
    seen = np.zeros(len(places), dtype=np.bool_)
    poses = drive.spaced(config.pose_spacing)
    nearest = _nearest_poses(poses, places, min(drive.max_range, config.seen_range))
    for rank in range(nearest.shape[1]):
        for lift in (np.zeros(3), _LIFT):
            near = np.flatnonzero(~seen & (nearest[:, rank] < len(poses)))
            pose = poses[nearest[near, rank]]
            inside = _in_view(pose, places[near] + lift, drive)
            near, pose = near[inside], pose[inside]
            if len(near):
                reach = _reaches(
                    drive.scene, pose[:, :3, 3], places[near], lift, owner[near], grown[near], config
                )
                seen[near[reach]] = True
    return np.asarray(seen[inverse])


def _distinct(keys: Ints, object_id: Ints) -> tuple[Ints, Ints]:
    """Return the first place of every pair of key and object, and the pair of every place (N,)."""
    order = np.lexsort((object_id, keys))
    new = np.ones(len(order), dtype=np.bool_)
    new[1:] = (np.diff(keys[order]) != 0) | (np.diff(object_id[order]) != 0)
    inverse = np.empty(len(order), dtype=np.int64)
    inverse[order] = np.cumsum(new) - 1
    return order[new], inverse


def _nearest_poses(poses: Floats, places: Floats, reach: float) -> Ints:
    """Return the poses around every place, nearest first (N, K); their number where there are no more."""
    spots = poses[:, :3, 3]
    tree = cKDTree(spots)
    most = int(tree.query_ball_point(places, reach, return_length=True).max(initial=0))
    _, index = tree.query(places, k=range(1, most + 1), distance_upper_bound=reach)
    return np.asarray(index, dtype=np.int64).reshape(len(places), most)


def _in_view(poses: Floats, places: Floats, drive: OtherDrive) -> NDArray[np.bool_]:
    local = np.einsum("nji,nj->ni", poses[:, :3, :3], places - poses[:, :3, 3])
    distance = np.linalg.norm(local, axis=1)
    elevation = np.arcsin(np.clip(local[:, 2] / np.maximum(distance, 1e-6), -1, 1))
    low, high = np.radians(drive.view_deg)
    within = (elevation > low) & (elevation < high)
    return np.asarray((distance < drive.max_range) & (distance > 0.5) & within)


def _reaches(
    scene: CompiledScene,
    eyes: Floats,
    places: Floats,
    lift: Floats,
    owner: Ints,
    grown: NDArray[np.bool_],
    config: TruthConfig,
) -> NDArray[np.bool_]:
    ray = places + lift - eyes
    distance = np.linalg.norm(ray, axis=1)
    direction = ray / distance[:, None]
    hits = scene.cast(eyes, direction)
    stop = eyes + np.minimum(hits.distance, distance)[:, None] * direction
    gap = np.linalg.norm(stop - places, axis=1)
    own = grown & (hits.object_id == owner) & (gap < config.own_body)
    return np.asarray((gap < config.seen_radius) | own)
