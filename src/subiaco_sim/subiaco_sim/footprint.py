"""A beam is no line: at edges and wires a part of its light lands elsewhere.

Beams beside an edge are sampled twice within their footprint. What two samples meet nearer to one
another than the sensor can part is one mixed pixel between them; what lies farther apart gives two
returns, the stronger first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Floats, Ints
from subiaco_sim.scene import Hits

PARTING = 0.3  # the sensor cannot part two returns nearer than this [m]


@dataclass(frozen=True)
class Echoes:
    """What the light of N beams comes back from; ``share`` is the part of it that does (N,)."""

    hits: Hits
    share: Floats

    def put(self, index: Ints, others: Echoes) -> None:
        """Take the echoes of other beams (M,) for the beams of an index (M,)."""
        for name in ("distance", "object_id", "material", "cosine"):
            getattr(self.hits, name)[index] = getattr(others.hits, name)
        self.share[index] = others.share


def whole(hits: Hits) -> Echoes:
    """Return echoes of all the light."""
    return Echoes(hits, np.ones(len(hits.distance)))


def nothing(count: int) -> Echoes:
    """Return no echo of any of ``count`` beams."""
    ids, material = np.full(count, -1, dtype=np.int64), np.zeros(count, dtype=np.uint8)
    return whole(Hits(np.full(count, np.inf), ids, material, np.zeros(count)))


class Neighbours:
    """Finds the beams beside an edge, by the beams around them in the picture of a scan.

    Parameters
    ----------
    direction : (rows, columns, 3) float64
        Of the beams in the sensor's frame; rows may be staggered.
    """

    def __init__(self, direction: Floats) -> None:
        rows, columns = direction.shape[:2]
        azimuth = np.unwrap(np.arctan2(direction[..., 1], direction[..., 0]), axis=1)
        step = (azimuth[0, -1] - azimuth[0, 0]) / (columns - 1)
        stagger = np.round((azimuth[0, 0] - azimuth[:, 0]) / step).astype(np.int64)
        self._upright = np.arange(rows)[:, None] * columns + (np.arange(columns) + stagger[:, None]) % columns

    def at_edges(self, distance: Floats) -> Ints:
        """Return the beams (M,) beside an edge: the inverse range, even on any plane, has a kink there."""
        inverse = (1.0 / distance).astype(np.float32).ravel()[self._upright]
        kink = _kink(np.roll(inverse, 1, axis=1), inverse, np.roll(inverse, -1, axis=1))
        kink[1:-1] |= _kink(inverse[:-2], inverse[1:-1], inverse[2:])
        return np.sort(self._upright[kink])


def _kink(before: Floats, here: Floats, behind: Floats) -> NDArray[np.bool_]:
    most = np.maximum(np.maximum(before, here), behind)
    return np.asarray(np.abs(before + behind - 2 * here) > PARTING * most**2)


def merge(one: Hits, other: Hits, strength: tuple[Floats, Floats], spread: float) -> tuple[Echoes, Echoes]:
    """Join what two samples of the same beams met into first and second echoes.

    Parameters
    ----------
    strength : (N,) float64, twice
        Light that comes back from either, 0 where nothing does.
    spread : float
        Of the beam [rad]: a slanting surface stretches a pulse without parting it.
    """
    stronger = strength[0] >= strength[1]
    both = (strength[0] > 0) & (strength[1] > 0)
    near, far = (
        np.where(both, choose(one.distance, other.distance), 0.0) for choose in (np.minimum, np.maximum)
    )
    cosine = np.clip(np.maximum(one.cosine, other.cosine), 0.05, 1.0)
    stretch = 5.0 * spread * near * np.sqrt(1 / cosine**2 - 1)
    mixed = both & (far - near < PARTING + stretch)
    half = np.full(len(both), 0.5)
    first, second = _chosen(stronger, one, other), _chosen(~stronger, one, other)
    weight = strength[0][mixed] / (strength[0][mixed] + strength[1][mixed])
    first.distance[mixed] = weight * one.distance[mixed] + (1 - weight) * other.distance[mixed]
    second.distance[mixed] = np.inf
    return Echoes(first, np.where(mixed, 1.0, half)), Echoes(second, half)


def _chosen(which: NDArray[np.bool_], one: Hits, other: Hits) -> Hits:
    names = ("distance", "object_id", "material", "cosine")
    return Hits(*(np.where(which, getattr(one, name), getattr(other, name)) for name in names))
