"""Two epochs of a small street: ground with a slope, houses, trees, cars; deterministic by seed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.survey_map import SurveyMap

DENSITY = 40.0  # points a square metre before thinning to the leaf
NOISE = 0.015


def rectangle(rng, corner, u, v, density=DENSITY):
    """Sample a parallelogram."""
    u, v = np.asarray(u, float), np.asarray(v, float)
    n = int(np.linalg.norm(np.cross(u, v)) * density)
    return np.asarray(corner, float) + rng.random((n, 1)) * u + rng.random((n, 1)) * v


def ground_z(x, y, slope=0.03):
    """Height of the undisturbed ground: a slope along x and a crossfall along y."""
    return slope * x + 0.01 * y


def house(rng, x, y, length=10.0, width=8.0, height=5.0):
    """Walls and a flat roof; x, y is the centre."""
    z = ground_z(x, y)
    west, south = x - length / 2, y - width / 2
    faces = [
        rectangle(rng, (west, south, z), (length, 0, 0), (0, 0, height)),
        rectangle(rng, (west, south + width, z), (length, 0, 0), (0, 0, height)),
        rectangle(rng, (west, south, z), (0, width, 0), (0, 0, height)),
        rectangle(rng, (west + length, south, z), (0, width, 0), (0, 0, height)),
        rectangle(rng, (west, south, z + height), (length, 0, 0), (0, width, 0)),
    ]
    return np.concatenate(faces)


def tree(rng, x, y, height=7.0, radius=2.0):
    """A ball of leaves on a trunk."""
    z = ground_z(x, y)
    n = int(4.2 * radius**3 * 40)
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    ball = direction * (radius * rng.random((n, 1)) ** (1 / 3)) + (x, y, z + height - radius)
    steps = rng.random(int(60 * (height - radius)))
    angle = rng.random(len(steps)) * 2 * np.pi
    trunk = np.stack(
        [x + 0.15 * np.cos(angle), y + 0.15 * np.sin(angle), z + steps * (height - 1.5 * radius)], axis=1
    )
    return np.concatenate([ball, trunk])


def car(rng, x, y, length=4.4, width=1.8, height=1.5):
    """A body and a cabin."""
    z, low, cabin = ground_z(x, y) + 0.2, 0.8, 0.55 * length
    west, south = x - length / 2, y - width / 2
    front = (length - cabin) / 2
    parts = [
        rectangle(rng, (west + shift, south, z + low), (front, 0, 0), (0, width, 0), 80)
        for shift in (0, length - front)
    ]
    for base, tall, long in ((z, low, length), (z + low, height - low - 0.2, cabin)):
        west = x - long / 2
        parts += [
            rectangle(rng, (west, south, base), (long, 0, 0), (0, 0, tall), 80),
            rectangle(rng, (west, south + width, base), (long, 0, 0), (0, 0, tall), 80),
            rectangle(rng, (west, south, base), (0, width, 0), (0, 0, tall), 80),
            rectangle(rng, (west + long, south, base), (0, width, 0), (0, 0, tall), 80),
        ]
    parts.append(rectangle(rng, (x - cabin / 2, south, z + height - 0.2), (cabin, 0, 0), (0, width, 0), 80))
    return np.concatenate(parts)


def pole(rng, x, y, height=6.0):
    """A lamp post."""
    n = int(150 * height)
    angle = rng.random(n) * 2 * np.pi
    z = ground_z(x, y) + rng.random(n) * height
    return np.stack([x + 0.08 * np.cos(angle), y + 0.08 * np.sin(angle), z], axis=1)


@dataclass
class Scene:
    """Things that stand on 60 m x 40 m of ground; ``lift`` changes the ground height."""

    houses: list = field(default_factory=lambda: [(-15, 12), (5, 12), (20, -13)])
    trees: list = field(default_factory=lambda: [(-20, -8), (-5, -12), (10, -6)])
    cars: list = field(default_factory=lambda: [(-10, 0), (12, 1)])
    poles: list = field(default_factory=lambda: [(0, 4)])
    lift: object = None

    def cloud(self, seed=0):
        """Sample the scene anew."""
        rng = np.random.default_rng(seed)
        makers = ((house, self.houses), (tree, self.trees), (car, self.cars), (pole, self.poles))
        parts = [self._ground(rng)]
        parts += [make(rng, *values) for make, listed in makers for values in listed]
        xyz = np.concatenate(parts)
        return PointCloud(xyz + rng.normal(scale=NOISE, size=xyz.shape))

    def _ground(self, rng):
        ground = rectangle(rng, (-30, -20, 0), (60, 0, 0), (0, 40, 0))
        ground[:, 2] = ground_z(ground[:, 0], ground[:, 1])
        if self.lift is not None:
            ground[:, 2] += self.lift(ground[:, 0], ground[:, 1])
        for x, y, *size in self.houses:
            length, width = (*size, 10.0, 8.0)[:2] if len(size) >= 2 else (10.0, 8.0)
            inside = (abs(ground[:, 0] - x) < length / 2) & (abs(ground[:, 1] - y) < width / 2)
            ground = ground[~inside]
        return ground

    def survey(self, seed=0, leaf=0.25):
        """The scene as a survey map at the working leaf, without trajectory and visibility."""
        return SurveyMap(voxel_downsample(self.cloud(seed), leaf))
