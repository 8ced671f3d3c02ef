"""Plants whose leaf density and lean are drawn per epoch and per plant, and the forms of crowns.

A plant keeps its form from epoch to epoch. Its leaves, how many they are and how far the wind leans it are
those of an epoch: the fuller epoch of a pair has up to three times the leaves of the barer one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from subiaco_geo.frames import Floats
from subiaco_sim.plants import Hedge, Palm, Tree
from subiaco_sim.primitives import Material, Mesh, cylinder, facets, join
from subiaco_sim.scene import Item, Placed

_LEAVES = 75.0  # facets per square metre of radius times crown height, as of a tree


class Profile(StrEnum):
    """Outline of a crown of revolution."""

    CONE = "cone"
    COLUMN = "column"
    BALL = "ball"
    UMBRELLA = "umbrella"


@dataclass(frozen=True)
class Crown:
    """A plant whose crown is a lumpy body of revolution [m]; ``form`` and ``leaves`` are seeds."""

    profile: Profile
    height: float
    radius: float
    crown: float
    trunk: float
    form: int
    leaves: int
    density: float = 1.0
    sway: float = 0.0

    def solid(self) -> Crown:
        """Return the same form with dense leaves that do not depend on the season."""
        return replace(self, leaves=0, density=4.0, sway=0.0)

    def mesh(self) -> Mesh:
        """Return the plant on z = 0."""
        bare = self.height - self.crown
        stem = cylinder(self.trunk, bare + 0.5 * self.crown + 0.3, Material.BARK, 8).placed(0, 0, -0.3)
        return join([stem, self._foliage(bare)])

    def _foliage(self, bare: float) -> Mesh:
        rng = np.random.default_rng([self.leaves, 7])
        count = max(30, int(self.density * _LEAVES * self.radius * self.crown))
        level = rng.uniform(0.0, 1.0, count) ** 0.8  # more leaves where the crown is wide
        turn = rng.uniform(0, 2 * np.pi, count)
        reach = self.radius * self._reach(level) * rng.uniform(0.5, 1.0, count) ** 0.5
        reach *= 1.0 + 0.12 * self._lumps(turn, level)
        points = np.column_stack([reach * np.cos(turn), reach * np.sin(turn), bare + level * self.crown])
        if self.sway:
            lean = np.clip(points[:, 2] / self.height - 0.3, 0.0, 1.0)
            way = rng.uniform(0, 2 * np.pi)
            points += self.sway * lean[:, None] * np.array([np.cos(way), np.sin(way), 0.0])
        return facets(points, 0.12, rng, Material.LEAF)

    def _reach(self, level: Floats) -> Floats:
        """Return the share of the radius at a level of the crown, 0 at its foot and 1 at its top (N,)."""
        if self.profile is Profile.CONE:
            return 1.0 - 0.95 * level
        if self.profile is Profile.COLUMN:
            return np.asarray(np.minimum(1.0, 3.0 * (1.0 - level) + 0.1))
        if self.profile is Profile.UMBRELLA:
            return np.asarray(
                np.minimum(1.0, 0.35 + 1.3 * level) * np.sqrt(np.clip(1.15 - level, 0.0, 1.0)) * 1.2
            )
        return np.asarray(np.sqrt(np.clip(1.0 - (2.0 * level - 1.0) ** 2, 0.02, 1.0)))

    def _lumps(self, turn: Floats, level: Floats) -> Floats:
        rng = np.random.default_rng([self.form, 8])
        phases = rng.uniform(0, 2 * np.pi, 4)
        waves = [np.sin((k + 2) * turn + 5.0 * level * (k - 1) + phases[k]) for k in range(4)]
        return np.asarray(np.sum(waves, axis=0) / 2.0)


Plant = Tree | Crown | Hedge | Palm


@dataclass(frozen=True)
class Season:
    """Of one epoch: the average leaf density of plants [ratio] and the lean of crowns at most [m]."""

    density: float
    sway: float


def seasons_of(ratio: float | None, sway: float, rng: np.random.Generator) -> tuple[Season, Season]:
    """Draw the seasons of both epochs; either may be the fuller one, by ``ratio`` or 1 to 3 where null."""
    drawn = float(rng.uniform(1.0, 3.0)) if ratio is None else ratio
    fuller = float(rng.uniform(0.9, 1.3))
    densities = [fuller, fuller / drawn]
    if rng.random() < 0.5:
        densities.reverse()
    leans = [float(rng.uniform(0.2, 1.0)) * sway for _ in range(2)]
    return Season(densities[0], leans[0]), Season(densities[1], leans[1])


def dressed(item: Item, seasons: tuple[Season, Season], rng: np.random.Generator) -> Item:
    """Give a plant the leaves and the lean of both epochs; anything else is returned as it is.

    Three in ten plants are evergreen and keep nearly the same density; the others follow the season, each by
    a factor of its own with a standard deviation of a quarter.
    """
    if not any(
        placed is not None and isinstance(placed.shape, Plant) for placed in (item.before, item.after)
    ):
        return item
    evergreen = rng.random() < 0.3
    states: list[Placed | None] = []
    for placed, season in zip((item.before, item.after), seasons, strict=True):
        own = float(np.exp(rng.normal(0.0, 0.25)))
        density = (1.0 if evergreen else season.density) * own
        sway, leaves = float(rng.uniform(0.0, season.sway)), int(rng.integers(2**31))
        if placed is not None and isinstance(placed.shape, Plant):
            shape: Plant = replace(placed.shape, density=float(np.clip(density, 0.12, 1.8)), leaves=leaves)
            if isinstance(shape, Tree | Crown):
                shape = replace(shape, sway=sway)
            states.append(replace(placed, shape=shape))
        else:
            states.append(placed)
    return replace(item, before=states[0], after=states[1])


def random_plant(rng: np.random.Generator, height: tuple[float, float]) -> Tree | Crown:
    """Draw a tree of any form, of a range of heights [m]."""
    total = float(rng.uniform(*height))
    form, leaves = (int(v) for v in rng.integers(0, 2**31, 2))
    trunk = 0.05 + 0.014 * total
    drawn = rng.random()
    if drawn < 0.55:
        crown = total * float(rng.uniform(0.5, 0.75))
        return Tree(total, crown * float(rng.uniform(0.36, 0.6)), crown, trunk, form, leaves)
    if drawn < 0.70:
        crown = total * float(rng.uniform(0.8, 0.92))
        return Crown(Profile.CONE, total, crown * float(rng.uniform(0.2, 0.32)), crown, trunk, form, leaves)
    if drawn < 0.80:
        crown = total * float(rng.uniform(0.82, 0.94))
        return Crown(Profile.COLUMN, total, crown * float(rng.uniform(0.1, 0.17)), crown, trunk, form, leaves)
    if drawn < 0.92:
        crown = total * float(rng.uniform(0.45, 0.65))
        return Crown(Profile.BALL, total, crown * float(rng.uniform(0.42, 0.62)), crown, trunk, form, leaves)
    crown = total * float(rng.uniform(0.3, 0.42))
    return Crown(Profile.UMBRELLA, total, crown * float(rng.uniform(0.8, 1.1)), crown, trunk, form, leaves)
