"""Trees and hedges whose foliage is many small leaf facets: rough, and open to some beams."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from subiaco_geo.frames import Floats
from subiaco_sim.primitives import Material, Mesh, cylinder, facets, join


@dataclass(frozen=True)
class Tree:
    """A tree: total height, crown radius and height [m]; shape from ``form``, leaves from ``leaves``.

    ``form`` and ``leaves`` are seeds: a tree keeps its form and changes its
    leaves from epoch to epoch.
    """

    height: float
    radius: float
    crown: float
    trunk: float
    form: int
    leaves: int
    density: float = 1.0
    sway: float = 0.0  # how far the wind leans the crown, in a direction of its own [m]

    def mesh(self) -> Mesh:
        """Return the tree on z = 0."""
        bare = self.height - self.crown
        stem = cylinder(self.trunk, bare + 0.4 * self.crown + 0.3, Material.BARK, 8).placed(0, 0, -0.3)
        return join([stem, *self._branches(bare), self._foliage()])

    def solid(self) -> Tree:
        """Return the same form with dense leaves that do not depend on the season."""
        return replace(self, leaves=0, density=4.0, sway=0.0)

    def _branches(self, bare: float) -> list[Mesh]:
        rng = np.random.default_rng([self.form, 1])
        parts = []
        for turn in rng.uniform(0, 2 * np.pi, 4):
            limb = cylinder(0.35 * self.trunk, 0.5 * self.crown, Material.BARK, 5)
            lean = limb.vertices + 0.9 * limb.vertices[:, 2:] * np.array([[1.0, 0.0, 0.0]])
            parts.append(Mesh(lean, limb.triangles, limb.material).placed(0, 0, bare, float(turn)))
        return parts

    def _foliage(self) -> Mesh:
        lobes = self._lobes()
        rng = np.random.default_rng([self.leaves, 2])
        count = int(self.density * 80.0 * self.radius * self.crown)
        which = rng.integers(0, len(lobes), count)
        direction = rng.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        depth = rng.uniform(0.55, 1.0, (count, 1)) ** 0.5
        scale = np.array([1.0, 1.0, self.crown / (2 * self.radius)]) * 0.5 * self.radius
        points = lobes[which] + depth * direction * scale
        points[:, 2] = np.clip(points[:, 2], self.height - self.crown, self.height)
        if self.sway:
            lean = np.clip((points[:, 2:] - 0.5 * self.height) / (0.5 * self.height), 0.0, 1.0)
            turn = rng.uniform(0, 2 * np.pi)
            points += self.sway * lean * np.array([np.cos(turn), np.sin(turn), 0.0])
        return facets(points, 0.13, rng, Material.LEAF)

    def _lobes(self) -> Floats:
        """Centres of the leaf clusters that make the crown lumpy."""
        rng = np.random.default_rng([self.form, 3])
        direction = rng.normal(size=(9, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        direction[0] = 0.0
        scale = np.array([self.radius, self.radius, self.crown / 2]) * 0.5
        centre = np.array([0.0, 0.0, self.height - self.crown / 2])
        return np.asarray(centre + direction * scale)


@dataclass(frozen=True)
class Hedge:
    """A clipped hedge: length, width and height [m]."""

    length: float
    width: float
    height: float
    leaves: int
    density: float = 1.0

    def solid(self) -> Hedge:
        """Return the same form with dense leaves that do not depend on the season."""
        return replace(self, leaves=0, density=4.0)

    def mesh(self) -> Mesh:
        """Return the hedge on z = 0: leaf facets in a shell of the block."""
        rng = np.random.default_rng([self.leaves, 4])
        count = int(130 * self.density * self.length * (self.height + self.width / 2))
        size = np.array([self.length, self.width, self.height])
        points = rng.uniform(-0.5, 0.5, (count, 3))
        axis = rng.choice(3, count, p=[0.1, 0.55, 0.35])
        side = np.where(axis == 2, 1.0, rng.choice([-1.0, 1.0], count))
        points[np.arange(count), axis] = side * rng.uniform(0.35, 0.5, count)
        return facets((points + np.array([0.0, 0.0, 0.5])) * size, 0.09, rng, Material.LEAF)


@dataclass(frozen=True)
class Palm:
    """A palm: total height [m]; a bare stem and a tuft of hanging fronds."""

    height: float
    leaves: int
    density: float = 1.0

    def solid(self) -> Palm:
        """Return the same form with fronds that do not depend on the season."""
        return replace(self, leaves=0, density=3.0)

    def mesh(self) -> Mesh:
        """Return the palm on z = 0."""
        rng = np.random.default_rng([self.leaves, 5])
        stem = cylinder(0.17, self.height - 1.0 + 0.3, Material.BARK, 8).placed(0, 0, -0.3)
        count = int(420 * self.density)
        turn = rng.integers(0, 14, count) * (2 * np.pi / 14) + rng.normal(0, 0.05, count)
        reach = rng.uniform(0.1, 2.2, count)
        drop = 0.25 * reach**2 - 0.35 * reach
        points = np.stack([reach * np.cos(turn), reach * np.sin(turn), self.height - 0.4 - drop], axis=1)
        return join([stem, facets(points, 0.12, rng, Material.LEAF)])
