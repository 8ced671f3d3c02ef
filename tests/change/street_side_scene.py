"""Shapes beside a street as a spinning LiDAR on a passing vehicle measures them, from one side."""

import numpy as np
from scipy.spatial import cKDTree

from subiaco_geo.clouds import PointCloud, voxel_downsample

#: Vertical field of view [deg] of sensors by their number of beams.
FIELDS = {16: (-15.0, 15.0), 32: (-30.0, 10.0), 64: (-22.5, 22.5)}
SENSOR_HEIGHT = 2.0
COLUMNS = 512
LEAF_RADIUS = 0.06
NOISE = 0.02


def prism(outline, width):
    """Triangles (T, 3, 3) of a convex upright outline (K, 2) of x and z, extruded over a width along y."""
    side = np.asarray(outline, dtype=float)
    near, far = (np.column_stack([side[:, 0], np.full(len(side), y), side[:, 1]]) for y in (0.0, width))
    faces = []
    for k in range(len(side)):
        j = (k + 1) % len(side)
        faces += [[near[k], near[j], far[j]], [near[k], far[j], far[k]]]
    for cap in (near, far):
        faces += [[cap[0], cap[k], cap[k + 1]] for k in range(1, len(side) - 1)]
    return np.array(faces)


def box(length, width, height):
    return prism([(0, 0), (length, 0), (length, height), (0, height)], width)


def car():
    """A saloon of 4.5 x 1.8 x 1.5 m: body, cabin and four wheels, open between them."""
    body = prism([(0, 0.3), (4.5, 0.3), (4.5, 0.75), (3.4, 0.95), (0, 0.95)], 1.8)
    cabin = prism([(0.5, 0.95), (3.3, 0.95), (2.5, 1.5), (1.0, 1.5)], 1.6) + np.array([0, 0.1, 0])
    return np.concatenate([body, cabin, *_wheels((0.5, 3.3), 1.6)])


def van():
    """A van of 5.2 x 2.0 x 2.2 m on four wheels."""
    body = prism([(0, 0.35), (5.2, 0.35), (5.2, 1.1), (4.3, 1.3), (3.9, 2.2), (0, 2.2)], 2.0)
    return np.concatenate([body, *_wheels((0.6, 3.9), 1.8)])


def _wheels(along, across):
    return [box(0.6, 0.2, 0.4) + np.array([x, y, 0]) for x in along for y in (0.0, across)]


def hedge(rng, size, count=4000):
    """Leaves (M, 3) of a clipped box hedge of a size: most of them near its faces."""
    places, face, depth = (
        rng.uniform(0, 1, (count, 3)),
        rng.integers(0, 5, count),
        rng.exponential(0.08, count),
    )
    for k, (axis, far) in enumerate([(0, 0), (0, 1), (1, 0), (1, 1), (2, 1)]):
        inward = depth[face == k] / size[axis]
        places[face == k, axis] = 1 - inward if far else inward
    return np.clip(places, 0, 1) * size


def drive_past(distance, beams, rng, triangles=None, leaves=None):
    """Measure a thing on flat ground, its near side so far to the left of a drive of 30 m along x [m].

    ``triangles`` (T, 3, 3) of a solid; ``leaves`` (M, 3) centres of spheres of 6 cm. A house stands 7 m
    behind.
    Returns the cloud, thinned to 0.25 m, and which of its points are of the thing.
    """
    shift = np.array([0.0, distance, 0.0])
    house = box(12.0, 6.0, 5.0) + np.array([-4.0, distance + 7.0, 0.0])
    azimuth, elevation = np.meshgrid(
        np.arange(COLUMNS) * 2 * np.pi / COLUMNS, np.radians(np.linspace(*FIELDS[beams], beams))
    )
    flat = np.cos(elevation.ravel())
    points, kinds = [], []
    for x in np.arange(-14.0, 19.0, 3.0):
        origin, turned = np.array([x, 0.0, SENSOR_HEIGHT]), azimuth.ravel() + rng.uniform(0, 0.02)
        rays = np.column_stack([flat * np.cos(turned), flat * np.sin(turned), np.sin(elevation.ravel())])
        down = np.where(rays[:, 2] < 0, SENSOR_HEIGHT / np.maximum(-rays[:, 2], 1e-9), np.inf)
        thing = np.full(len(rays), np.inf) if triangles is None else _solid(origin, rays, triangles + shift)
        if leaves is not None:
            thing = np.minimum(thing, _foliage(origin, rays, leaves + shift))
        other = np.minimum(down, _solid(origin, rays, house))
        reach = np.minimum(thing, other)
        seen = reach < 40.0
        points.append(origin + rays[seen] * (reach[seen] + rng.normal(0, NOISE, seen.sum()))[:, None])
        kinds.append((thing <= other)[seen])
    xyz, own = np.concatenate(points), np.concatenate(kinds)
    cloud = voxel_downsample(PointCloud(xyz), 0.25)
    return cloud, own[cKDTree(xyz).query(cloud.xyz, k=5)[1]].mean(axis=1) > 0.5


def _solid(origin, rays, triangles):
    """Distance (N,) to the first triangle along rays (N, 3), inf where none is hit."""
    best = np.full(len(rays), np.inf)
    corners = triangles.reshape(-1, 3) - origin
    angles = np.arctan2(corners[:, 1], corners[:, 0])
    angle = np.arctan2(rays[:, 1], rays[:, 0])
    may = np.flatnonzero((angle >= angles.min()) & (angle <= angles.max()))
    towards = rays[may]
    for a, b, c in triangles:
        cross = np.cross(towards, c - a)
        scale = cross @ (b - a)
        scale = 1.0 / np.where(np.abs(scale) > 1e-9, scale, np.inf)
        aside = np.cross(origin - a, b - a)
        u, v, t = (cross @ (origin - a)) * scale, (towards @ aside) * scale, (aside @ (c - a)) * scale
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0.1) & (t < best[may])
        best[may[hit]] = t[hit]
    return best


def _foliage(origin, rays, leaves):
    """Distance (N,) to the first leaf that each ray meets."""
    offset = leaves - origin
    far = np.linalg.norm(offset, axis=1)
    best = np.full(len(rays), np.inf)
    met = cKDTree(rays).query_ball_point(offset / far[:, None], LEAF_RADIUS / far)
    for distance, found in zip(far, met, strict=True):
        best[found] = np.minimum(best[found], distance)
    return best
