"""The paper's coarse alignment: ISS keypoints, FPFH descriptors, and a seeded RANSAC (method B2).

Keypoints and descriptors are Open3D's; its RANSAC gives another pose at
every call, so that part is written here.
"""

from __future__ import annotations

import numba
import numpy as np
from scipy.spatial import KDTree

from subiaco_change.geometry import Level
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.registration.coarse import StartPose, levelling
from subiaco_change.registration.config import KeypointConfig
from subiaco_geo.frames import Floats, Ints, make_pose, transform_points

_EDGE = NUMBERS.features.edge_ratio


def describe_keypoints(level: Level, config: KeypointConfig) -> tuple[Floats, Floats]:
    """Find ISS keypoints (K, 3) [m] of a level, and their FPFH (K, 33)."""
    import open3d as o3d

    known = np.any(level.planes.normals != 0, axis=1)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(level.xyz[known]))
    upright = level.planes.normals[known] @ levelling(level)[:3, :3].T
    sign = np.where(upright[:, 2:] < 0, -1.0, 1.0)
    cloud.normals = o3d.utility.Vector3dVector(level.planes.normals[known] * sign)
    keypoints = o3d.geometry.keypoint.compute_iss_keypoints(
        cloud, salient_radius=config.salient_radius, non_max_radius=config.support_radius
    )
    places = np.asarray(keypoints.points).reshape(-1, 3)
    if len(places) == 0:
        return places, np.zeros((0, 33))
    search = o3d.geometry.KDTreeSearchParamHybrid(radius=config.fpfh_radius, max_nn=200)
    described = o3d.pipelines.registration.compute_fpfh_feature(cloud, search)
    _, index = KDTree(level.xyz[known]).query(places)
    return places, np.asarray(described.data).T[index]


@numba.njit(cache=True)
def _triad(a: Floats, b: Floats, c: Floats) -> Floats:
    """Axes (3, 3), as columns, of the triangle of three points; zero if they lie on a line."""
    axes = np.zeros((3, 3))
    u, v = b - a, c - a
    w = np.cross(u, v)
    area, length = np.sqrt(np.sum(w * w)), np.sqrt(np.sum(u * u))
    if area > 1e-3 * length * length and length > 0:
        axes[:, 0], axes[:, 2] = u / length, w / area
        axes[:, 1] = np.cross(axes[:, 2], axes[:, 0])
    return axes


@numba.njit(cache=True)
def _edges_agree(source: Floats, target: Floats, triple: Ints, ratio: float) -> bool:
    """Tell whether three distinct pairs span triangles whose edges have the same lengths within the ratio."""
    for i in range(3):
        j, k = triple[i], triple[(i + 1) % 3]
        a = np.sqrt(np.sum((source[j] - source[k]) ** 2))
        b = np.sqrt(np.sum((target[j] - target[k]) ** 2))
        if j == k or min(a, b) < ratio * max(a, b):
            return False
    return True


@numba.njit(cache=True)
def _best_sample(
    source: Floats, target: Floats, triples: Ints, threshold: float, ratio: float
) -> tuple[int, int]:
    """Return the number of the triple whose motion carries most pairs together, and how many."""
    best, most = -1, 0
    for t in range(len(triples)):
        i, j, k = triples[t]
        if not _edges_agree(source, target, triples[t], ratio):
            continue
        rotation = _triad(target[i], target[j], target[k]) @ _triad(source[i], source[j], source[k]).T
        shift = (target[i] + target[j] + target[k]) / 3.0
        shift = shift - rotation @ ((source[i] + source[j] + source[k]) / 3.0)
        count = 0
        for n in range(len(source)):
            squared = 0.0
            for axis in range(3):
                d = shift[axis] - target[n, axis]
                for m in range(3):
                    d += rotation[axis, m] * source[n, m]
                squared += d * d
            count += squared < threshold * threshold
        if count > most:
            best, most = t, count
    return best, most


def _fit(source: Floats, target: Floats) -> Floats:
    """Least-squares rigid motion (4, 4) of pairs of points (N, 3), N >= 3."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - b).T @ (source - a))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return make_pose(rotation, b - rotation @ a)


def ransac(
    source: Floats, target: Floats, threshold: float, iterations: int, seed: int
) -> tuple[Floats, int] | None:
    """Find the rigid motion that most pairs of points agree on.

    Parameters
    ----------
    source, target : (N, 3) float64
        Supposed pairs, most of them wrong [m].
    threshold : float
        Largest distance of a pair that agrees [m].
    iterations : int
        Samples of three pairs.
    seed : int
        The same seed gives the same motion.

    Returns
    -------
    (T_target_source (4, 4), pairs that agree), or None where no three do.
    """
    if len(source) < 3:
        return None
    triples = np.random.default_rng(seed).integers(0, len(source), (iterations, 3))
    best, most = _best_sample(source, target, triples, threshold, _EDGE)
    if most < 3:
        return None
    pose = _fit(source[triples[best]], target[triples[best]])
    for _ in range(5):
        agree = np.linalg.norm(transform_points(pose, source) - target, axis=1) < threshold
        if agree.sum() < max(most, 3):
            break
        most = int(agree.sum())
        pose = _fit(source[agree], target[agree])
    return pose, most


def propose_by_features(before: Level, after: Level, config: KeypointConfig, seed: int) -> list[StartPose]:
    """Propose the one start pose that RANSAC finds; empty where no pairs agree.

    Parameters
    ----------
    before, after : Level
        At about 1 m leaf, z up within 25 deg.
    config : KeypointConfig
    seed : int
    """
    (places, described), (others, known) = (describe_keypoints(side, config) for side in (before, after))
    if len(places) < 3 or len(others) < 3:
        return []
    _, match = KDTree(known).query(described)
    found = ransac(places, others[match], config.inlier, config.iterations, seed)
    return [] if found is None else [StartPose(found[0], float(found[1]))]
