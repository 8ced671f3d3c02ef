"""Randomly drawn trees on a street, surveyed twice by the ray-caster of :mod:`random_houses`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from random_houses import Box, Street, Survey, draw_sensor, survey

from subiaco_geo.codes import Semantic

_LEAF = 0.25  # half the edge of a leaf cluster [m]


@dataclass(frozen=True)
class Tree:
    """Trunk at x, y; a crown as an ellipsoid of leaf clusters: half width, half height and middle [m]."""

    x: float
    y: float
    radius: float
    half: float
    middle: float
    clusters: int
    seed: int

    def mesh(self):
        """Triangles of the leaf clusters, each a square of random attitude, and of the trunk."""
        rng = np.random.default_rng(self.seed)
        way = rng.normal(size=(self.clusters, 3))
        way *= (rng.random(self.clusters) ** 0.25 / np.linalg.norm(way, axis=1))[:, None]
        centre = way * (self.radius, self.radius, self.half) + (self.x, self.y, self.middle)
        first, second = rng.normal(size=(2, self.clusters, 3))
        first *= _LEAF / np.linalg.norm(first, axis=1)[:, None]
        second = np.cross(first, second)
        second *= _LEAF / np.linalg.norm(second, axis=1)[:, None]
        corners = np.stack([centre - first, centre - second, centre + first, centre + second], axis=1)
        faces = np.array([(0, 1, 2), (0, 2, 3)]) + 4 * np.arange(self.clusters)[:, None, None]
        trunk, sides = Box(self.x - 0.12, self.y - 0.12, 0.24, 0.24, self.middle - 0.5 * self.half).mesh()
        vertices = np.concatenate([corners.reshape(-1, 3), trunk])
        return vertices, np.concatenate([faces.reshape(-1, 3), sides + 4 * self.clusters])


@dataclass(frozen=True)
class Plants:
    """A street with fewer and with more plants, with a survey of either."""

    what: str  # planted, grown, joined
    surveys: tuple[Survey, Survey] = field(repr=False)


def draw_tree(rng, x=0.0):
    """Draw a tree beside the road."""
    radius, half = rng.uniform(1.2, 2.8), rng.uniform(1.0, 2.2)
    clusters = int(rng.uniform(25, 60) * radius**2 * half)
    return Tree(
        x, rng.uniform(5, 9), radius, half, half + rng.uniform(1.4, 2.4), clusters, int(rng.integers(1 << 30))
    )


def draw_tree_over_shrub(seed, what):
    """Draw a tree over a shrub that stays; a second drive after the tree was ``felled``, or ``pruned``.

    ``narrow view``: nothing changed, and the second sensor sees no higher than a shrub.
    """
    rng = np.random.default_rng(seed)
    y, radius, half = rng.uniform(5, 9), rng.uniform(1.4, 2.6), rng.uniform(1.5, 2.2)
    clusters = int(rng.uniform(35, 60) * radius**2 * half)
    tree = Tree(0.0, y, radius, half, half + rng.uniform(1.8, 2.6), clusters, int(rng.integers(1 << 30)))
    wide, high = rng.uniform(0.7, 1.1), rng.uniform(0.6, 0.85)
    beside = y - rng.uniform(-0.6, 0.9)
    shrub = Tree(
        rng.uniform(-0.9, 0.9), beside, wide, high, high, int(90 * wide**2 * high), int(rng.integers(1 << 30))
    )
    pruned = replace(
        tree,
        radius=0.7 * radius,
        half=0.7 * half,
        middle=tree.middle - 0.3 * half,
        clusters=int(0.35 * clusters),
    )
    left = {"felled": (shrub,), "pruned": (pruned, shrub), "narrow view": (tree, shrub)}[what]
    back = Box(-30.0, 16.0, 60.0, 1.0, 6.0)
    first, second = draw_sensor(rng), draw_sensor(rng)
    if what == "narrow view":
        second = replace(second, up=4.0)
    streets = [Street(plants, (back,), Semantic.VEGETATION) for plants in ((tree, shrub), left)]
    surveys = [
        survey(s, d, 2 * seed + k) for k, (s, d) in enumerate(zip(streets, (first, second), strict=True))
    ]
    return Plants(what, (surveys[0], surveys[1]))


def draw_plants(seed):
    """Draw a plant that is new, one that grew by a quarter to a half, or one beside another."""
    rng = np.random.default_rng(seed)
    what = ("planted", "grown", "joined")[seed % 3]
    tree = draw_tree(rng)
    if what == "grown":
        share = rng.uniform(1.25, 1.5)
        larger = replace(
            tree,
            radius=share * tree.radius,
            half=share * tree.half,
            middle=tree.middle + (share - 1) * tree.half,
            clusters=int(share**3 * tree.clusters),
        )
        few, many = (tree,), (larger,)
    elif what == "joined":
        few, many = (tree,), (tree, replace(draw_tree(rng, 1.5 * tree.radius), y=tree.y))
    else:
        few, many = (), (tree,)
    back = Box(-30.0, 16.0, 60.0, 1.0, 6.0)
    streets = [Street(trees, (back,), Semantic.VEGETATION) for trees in (few, many)]
    surveys = [survey(street, draw_sensor(rng), 2 * seed + k) for k, street in enumerate(streets)]
    return Plants(what, (surveys[0], surveys[1]))
