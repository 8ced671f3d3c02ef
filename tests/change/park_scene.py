"""Two airborne surveys of a park: rolling ground and trees, each beam with up to three returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_geo.clouds import PointCloud
from subiaco_geo.survey_map import SurveyMap

HALF = 35.0  # of the park's edge [m]
Tree = tuple[float, float, float, float]  # x, y, height, radius of the crown [m]


def ground_z(x, y):
    """Height of rolling ground."""
    return 0.02 * x + 0.8 * np.sin(x / 25) * np.cos(y / 30)


def survey(trees, spacing, seed):
    """Scan a park from straight above; beams drawn evenly, one in a square of ``spacing`` [m]."""
    rng = np.random.default_rng(seed)
    beams = int((2 * HALF / spacing) ** 2)
    xy = rng.uniform(-HALF, HALF, (beams, 2))
    ground, (top, bottom) = ground_z(*xy.T), _crowns(xy, trees)
    alive, depth, points = np.ones(beams, dtype=bool), np.zeros(beams), []
    for _ in range(3):
        depth = depth + rng.exponential(0.8, beams)
        leaf = alive & (top - depth > bottom)
        below = alive & ~leaf & (np.isinf(top) | (rng.random(beams) < 0.5))
        points += [np.c_[xy[leaf], (top - depth)[leaf]], np.c_[xy[below], ground[below]]]
        alive = leaf & (rng.random(beams) < 0.5)
    xyz = np.concatenate(points)
    return SurveyMap(PointCloud(xyz + rng.normal(scale=0.03, size=xyz.shape)))


def _crowns(xy, trees):
    """Top and bottom (N,) of the foliage above places (N, 2), infinite where there is none."""
    top, bottom = np.full(len(xy), -np.inf), np.full(len(xy), np.inf)
    for x, y, height, radius in trees:
        off = ((xy - (x, y)) ** 2).sum(axis=1) / radius**2
        half = 0.5 * min(0.8 * height, 2.4 * radius)
        rise = half * np.sqrt(np.maximum(1 - off, 0))
        middle = ground_z(x, y) + height - half
        higher = (off < 1) & (middle + rise > top)
        top[higher], bottom[higher] = (middle + rise)[higher], (middle - rise)[higher]
    return top, bottom


@dataclass(frozen=True)
class Park:
    """Trees by what becomes of them."""

    felled: tuple[Tree, ...]
    planted: tuple[Tree, ...]
    grown: tuple[Tree, ...]
    same: tuple[Tree, ...]

    def before(self, spacing, seed=1):
        """The first epoch."""
        return survey(self.felled + self.grown + self.same, spacing, seed)

    def after(self, spacing, seed=2):
        """The second epoch: crowns that grew are 2 m higher and 0.6 m wider."""
        grew = tuple((x, y, height + 2.0, radius + 0.6) for x, y, height, radius in self.grown)
        return survey(self.planted + grew + self.same, spacing, seed)


def make_park(seed=5):
    """36 places 11 m apart: 5 felled, 5 planted, 6 grown, 20 that stay; crowns 2.2 to 4 m in radius."""
    rng = np.random.default_rng(seed)
    places = [(x, y) for x in np.arange(-27.5, 28, 11.0) for y in np.arange(-27.5, 28, 11.0)]
    trees = [
        (x + rng.uniform(-1, 1), y + rng.uniform(-1, 1), rng.uniform(6, 13), rng.uniform(2.2, 4))
        for x, y in places
    ]
    order = rng.permutation(len(trees)).tolist()
    felled, planted, grown, same = (
        tuple(trees[i] for i in order[a:b]) for a, b in ((0, 5), (5, 10), (10, 16), (16, 36))
    )
    return Park(felled, planted, grown, same)
