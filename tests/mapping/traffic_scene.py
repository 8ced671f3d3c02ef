"""A street with known things in it, cast by hand: a car that passes; a pole, a fence, a hedge and a wire."""

from collections.abc import Callable
from functools import cache

import numpy as np

from subiaco_geo.frames import Floats, make_pose
from subiaco_mapping.preprocessing.scan_spool import SpooledScan

SPEED = 5.0  # of the survey vehicle along x [m/s]
EYE = 1.8
CAR_SPEED = -8.0
CAR_SIZE = np.array([2.1, 0.9, 0.7])  # half of it [m]
POLE = np.array([22.0, 6.0])
WIRE = np.array([8.0, 6.0])  # y, z
Region = Callable[[Floats], np.ndarray]

#: Where each thing may be found in the map.
REGIONS: dict[str, Region] = {
    "car": lambda p: (p[:, 1] > 1.8) & (p[:, 1] < 4.2) & (p[:, 2] > 0.3) & (p[:, 2] < 1.9),
    "pole": lambda p: (np.hypot(*(p[:, :2] - POLE).T) < 0.3) & (p[:, 2] > 0.4) & (p[:, 2] < 4.5),
    "fence": lambda p: (np.abs(p[:, 1] + 7.0) < 0.2) & (p[:, 2] > 0.2) & (p[:, 2] < 1.3),
    "hedge": lambda p: (np.abs(p[:, 1] - 11.0) < 1.1) & (p[:, 2] > 0.3) & (p[:, 2] < 1.7),
    "wire": lambda p: np.abs(p[:, 2] - WIRE[1]) < 0.2,
}


def directions(rings: int = 48, columns: int = 400) -> Floats:
    """Unit beams (rings * columns, 3), 22.5 deg up and down."""
    azimuth = np.linspace(0, 2 * np.pi, columns, endpoint=False) + 1e-3  # none along an axis
    rise = np.radians(np.linspace(22.5, -22.5, rings))[:, None]
    beams = np.stack(
        [np.cos(rise) * np.cos(azimuth), np.cos(rise) * np.sin(azimuth), 0 * azimuth + np.sin(rise)]
    )
    return np.moveaxis(beams, 0, -1).reshape(-1, 3)


def _box(eye: Floats, ray: Floats, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Distances at which rays enter and leave a box; inf where they miss."""
    near, far = np.sort(np.stack([(low - eye) / ray, (high - eye) / ray]), axis=0)
    enter, leave = near.max(axis=1), far.min(axis=1)
    met = (enter < leave) & (enter > 0)
    return np.where(met, enter, np.inf), np.where(met, leave, np.inf)


def _plane(eye: Floats, ray: Floats, axis: int, at: float) -> Floats:
    distance = (at - eye[axis]) / ray[:, axis]
    return np.where(distance > 0, distance, np.inf)


def _line(eye: Floats, ray: Floats, axes: tuple[int, int], at: Floats, radius: float) -> Floats:
    """Distance to a straight thing along the third axis; inf where rays miss it."""
    flat, towards = ray[:, axes], at - eye[list(axes)]
    length = np.linalg.norm(flat, axis=1)
    aside = np.abs(flat[:, 0] * towards[1] - flat[:, 1] * towards[0]) / length
    along = flat @ towards / length**2
    return np.where((aside < radius) & (along > 0), along, np.inf)


def cast(eye: Floats, ray: Floats, seconds: float, rng: np.random.Generator) -> Floats:
    """Distance (N,) to the first thing that each ray meets."""
    car = np.array([45.0 + CAR_SPEED * seconds, 3.0, 0.9])
    enter, leave = _box(eye, ray, np.array([-5.0, 10.0, 0.0]), np.array([60.0, 12.0, 1.6]))
    inside = enter + rng.exponential(0.3, len(ray))
    fence = _plane(eye, ray, 1, -7.0)
    top = eye[2] + np.where(np.isfinite(fence), fence, 0.0) * ray[:, 2]
    return np.min(
        [
            _plane(eye, ray, 2, 0.0),
            _plane(eye, ray, 1, 15.0),
            _plane(eye, ray, 1, -12.0),
            _box(eye, ray, car - CAR_SIZE, car + CAR_SIZE)[0],
            np.where(inside < leave, inside, np.inf),
            np.where((top < 1.2) & (rng.random(len(ray)) < 0.35), fence, np.inf),
            _line(eye, ray, (0, 1), POLE, 0.06),
            _line(eye, ray, (1, 2), WIRE, 0.04),
        ],
        axis=0,
    )


@cache
def drive(scans: int, seed: int, shift: tuple[float, float] = (0.0, 0.0)) -> list[tuple[SpooledScan, Floats]]:
    """Scans with their poses, 10 a second, the whole street moved by ``shift`` [m]."""
    rng, ray, found = np.random.default_rng(seed), directions(), []
    for k in range(scans):
        eye = np.array([SPEED * k / 10, 0.0, EYE])
        distance = cast(eye, ray, k / 10, rng)
        met = distance < 45.0
        xyz = ray[met] * (distance[met] + 0.01 * rng.standard_normal(int(met.sum())))[:, None]
        none = np.zeros((0, 3))
        empty = np.zeros(0, np.float32)
        scan = SpooledScan(xyz, np.full(len(xyz), 9, np.float32), none, empty, none)
        found.append((scan, make_pose(np.eye(3), eye + np.array([*shift, 0.0]))))
    return found
