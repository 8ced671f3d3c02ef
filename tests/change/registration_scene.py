"""Synthetic streets of planes and boxes, sampled anew for every epoch."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation


def rectangle(rng, corner, u, v, density):
    """Sample a rectangle spanned by u and v from a corner."""
    u, v = np.asarray(u, float), np.asarray(v, float)
    area = np.linalg.norm(np.cross(u, v))
    n = rng.poisson(area * density)
    return np.asarray(corner) + rng.random((n, 1)) * u + rng.random((n, 1)) * v


def box(rng, centre, size, density, yaw=0.0):
    """Sample the walls and the top of a box that stands on z = centre[2]."""
    (x, y, z), h = np.asarray(size, float), np.asarray(size, float) / 2
    faces = [
        rectangle(rng, (-h[0], -h[1], 0), (x, 0, 0), (0, 0, z), density),
        rectangle(rng, (-h[0], h[1], 0), (x, 0, 0), (0, 0, z), density),
        rectangle(rng, (-h[0], -h[1], 0), (0, y, 0), (0, 0, z), density),
        rectangle(rng, (h[0], -h[1], 0), (0, y, 0), (0, 0, z), density),
        rectangle(rng, (-h[0], -h[1], z), (x, 0, 0), (0, y, 0), density),
    ]
    return np.vstack(faces) @ Rotation.from_euler("z", yaw).as_matrix().T + centre


def ground_height(x, y):
    """A street that slopes and undulates gently [m]."""
    return 0.01 * x + 0.3 * np.sin(x / 40.0) + 0.2 * np.cos(y / 25.0)


@dataclass
class Street:
    """Houses, trees and cars along a street; ``seed`` fixes the layout, not the sampling."""

    seed: int = 0
    length: float = 120.0
    width: float = 60.0
    houses: list = field(default_factory=list)
    trees: list = field(default_factory=list)
    cars: list = field(default_factory=list)

    def __post_init__(self):
        rng = np.random.default_rng(self.seed)
        for side in (-1, 1):
            x = -self.length / 2 + 8 + rng.uniform(0, 4)
            while x < self.length / 2 - 8:
                size = rng.uniform((8, 7, 3), (14, 11, 7))
                y = side * (self.width / 2 - 8 - rng.uniform(0, 5))
                self.houses.append(((x, y), size, rng.normal(0, 0.08)))
                x += size[0] / 2 + rng.uniform(6, 14)
        for _ in range(int(self.length / 8)):
            y = rng.choice((-1, 1)) * rng.uniform(6, 12)
            place = rng.uniform(-self.length / 2, self.length / 2), y
            self.trees.append((place, rng.uniform(1.5, 3.0)))
        for _ in range(int(self.length / 12)):
            self.cars.append(((rng.uniform(-self.length / 2, self.length / 2), rng.choice((-4, 4))), 0.0))

    def sample(self, seed, density=25.0, noise=0.015):
        """One epoch: points (N, 3) with noise along every axis."""
        rng = np.random.default_rng(seed)
        parts = [
            rectangle(
                rng, (-self.length / 2, -self.width / 2, 0), (self.length, 0, 0), (0, self.width, 0), density
            )
        ]
        parts[0][:, 2] = ground_height(parts[0][:, 0], parts[0][:, 1])
        for (x, y), size, yaw in self.houses:
            parts.append(box(rng, (x, y, ground_height(x, y) - 0.3), size, density, yaw))
        for (x, y), radius in self.trees:
            n = rng.poisson(radius**3 * 4.2 * density / 4)
            crown = rng.normal(0, 1, (n, 3))
            crown *= (radius * rng.random((n, 1)) ** (1 / 3)) / np.linalg.norm(crown, axis=1, keepdims=True)
            parts.append(crown + np.array([x, y, ground_height(x, y) + radius + 2]))
        for (x, y), yaw in self.cars:
            parts.append(box(rng, (x, y, ground_height(x, y)), (4.4, 1.8, 1.5), density, yaw))
        points = np.vstack(parts)
        return points + rng.normal(0, noise, points.shape)


def pose(rotation_deg, translation):
    """A 4x4 from Euler xyz angles [deg] and a translation [m]."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix()
    T[:3, 3] = translation
    return T


def errors(estimate, truth, at):
    """Translation error at a point [m] and rotation error [deg]."""
    delta = np.linalg.inv(truth) @ estimate
    place = np.append(np.linalg.inv(truth)[:3, :3] @ (np.asarray(at) - truth[:3, 3]), 1.0)
    shift = float(np.linalg.norm((delta @ place - place)[:3]))
    return shift, float(np.degrees(Rotation.from_matrix(delta[:3, :3]).magnitude()))


def hummocks(x, y):
    """Ground of a park: slopes and hummocks [m]."""
    return 0.02 * x + 0.8 * np.sin(x / 13.0) * np.cos(y / 17.0) + 0.3 * np.sin(x / 5.0 + y / 6.0)


@dataclass
class Park:
    """Ground and crowns seen from the air: few planes, no walls; ``seed`` fixes the layout."""

    seed: int = 0
    size: float = 90.0
    trees: list = field(default_factory=list)

    def __post_init__(self):
        rng = np.random.default_rng(self.seed)
        for _ in range(int(self.size**2 / 130)):
            place = rng.uniform(-self.size / 2, self.size / 2, 2)
            self.trees.append((place, rng.uniform(1.5, 4.0), rng.uniform(5.0, 12.0)))

    def sample(self, seed, density=4.0, noise=0.03):
        """One epoch: points (N, 3) of the uppermost surfaces, and some of the ground below crowns."""
        rng = np.random.default_rng(seed)
        xy = rng.uniform(-self.size / 2, self.size / 2, (rng.poisson(self.size**2 * density), 2))
        z = hummocks(xy[:, 0], xy[:, 1])
        for place, radius, top in self.trees:
            away = np.linalg.norm(xy - place, axis=1) / radius
            under = (away < 1.0) & (rng.random(len(xy)) < 0.75)
            crown = hummocks(*place) + top - 0.6 * radius * away[under] ** 2
            z[under] = np.maximum(z[under], crown - rng.exponential(0.25, under.sum()))
        points = np.column_stack([xy, z])
        return points + rng.normal(0, noise, points.shape)


@dataclass
class Wood:
    """Trunks, ground and leaves as a scanner on the ground sees them; ``seed`` fixes the layout."""

    seed: int = 0
    size: float = 40.0
    trunks: list = field(default_factory=list)

    def __post_init__(self):
        rng = np.random.default_rng(self.seed)
        for _ in range(int(self.size**2 / 16)):
            place = rng.uniform(-self.size / 2, self.size / 2, 2)
            self.trunks.append((place, rng.uniform(0.12, 0.3), rng.normal(0, 0.04, 2), rng.uniform(1.0, 2.5)))

    def sample(self, seed, density=30.0, noise=0.02):
        """One epoch: points (N, 3)."""
        rng = np.random.default_rng(seed)
        xy = rng.uniform(-self.size / 2, self.size / 2, (rng.poisson(self.size**2 * density), 2))
        parts = [np.column_stack([xy, hummocks(*xy.T)])]
        for place, radius, lean, crown in self.trunks:
            n = rng.poisson(2 * np.pi * radius * 9.0 * 3 * density)
            height, angle = rng.uniform(0, 9.0, n), rng.uniform(0, 2 * np.pi, n)
            ring = radius * np.column_stack([np.cos(angle), np.sin(angle)])
            parts.append(np.column_stack([place + ring + height[:, None] * lean, hummocks(*place) + height]))
            n = rng.poisson(crown**3 * density)
            middle = np.array([*(place + 8.0 * lean), hummocks(*place) + 8.0])
            parts.append(rng.normal(middle, 0.5 * crown, (n, 3)))
        points = np.vstack(parts)
        return points + rng.normal(0, noise, points.shape)
