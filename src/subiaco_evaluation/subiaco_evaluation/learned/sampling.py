"""Which cylinders and patches are learned and predicted, and how they are varied."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_evaluation.learned.labels import CLASSES, EXCHANGED, IGNORED
from subiaco_evaluation.learned.pyramids import Cylinder, Indices, Pyramid, cut_cylinder, nearest_across
from subiaco_evaluation.learned.surveys import PointPair, RasterPair
from subiaco_geo.frames import Floats, Ints

Singles = NDArray[np.float32]


@dataclass(frozen=True)
class CylinderPair:
    """A cylinder of both clouds at one place.

    ``nearest`` holds for every level the nearest reference point of every compared point. ``classes``
    (N,) are those of the compared cloud's finest level, -1 where unknown.
    """

    reference: Cylinder
    compared: Cylinder
    nearest: tuple[Indices, ...]
    classes: Ints


@dataclass(frozen=True)
class Place:
    """Survey, epoch of the labelled cloud (0 or 1), and centre (3,) [m] of a cylinder."""

    survey: int
    epoch: int
    centre: Floats


class CylinderSampler:
    """Draw cylinders so that every class is the class of the centre equally often.

    Parameters
    ----------
    pairs : sequence of PointPair
    radius : float
        Of the cylinders [m].
    """

    def __init__(self, pairs: Sequence[PointPair], radius: float) -> None:
        self.pairs, self.radius = pairs, radius
        tables = [
            np.column_stack([np.full(len(c), survey), np.full(len(c), epoch), np.arange(len(c)), c])
            for survey, pair in enumerate(pairs)
            for epoch, c in enumerate(pair.classes)
        ]
        rows = np.concatenate(tables)
        by_class = (rows[rows[:, 3] == index, :3] for index in range(len(CLASSES)))
        self._rows = [found for found in by_class if len(found)]

    def draw(self, rng: np.random.Generator, count: int) -> list[Place]:
        """Return random places."""
        chosen = rng.integers(len(self._rows), size=count)
        rows = [self._rows[index][rng.integers(len(self._rows[index]))] for index in chosen]
        return [Place(int(s), int(e), self._xyz(s, e)[n]) for s, e, n in rows]

    def draw_evenly(self, rng: np.random.Generator, count: int) -> list[Place]:
        """Return random places that no label decides."""
        sides = [(survey, epoch) for survey in range(len(self.pairs)) for epoch in (0, 1)]
        sizes = [len(self._xyz(*side)) for side in sides]
        starts = np.cumsum([0, *sizes])
        chosen = rng.integers(starts[-1], size=count)
        side = np.searchsorted(starts, chosen, side="right") - 1
        places = []
        for number, row in zip(side, chosen - starts[side], strict=True):
            survey, epoch = sides[number]
            places.append(Place(survey, epoch, self._xyz(survey, epoch)[row]))
        return places

    def spread(self, rng: np.random.Generator, count: int) -> list[Place]:
        """Return random places of the regular grids that predictions use, without their overlap."""
        every = [
            Place(survey, epoch, centre)
            for survey in range(len(self.pairs))
            for epoch in (0, 1)
            for centre in grid_centres(self._xyz(survey, epoch), self.radius, 0.0)
        ]
        return [every[index] for index in rng.permutation(len(every))[:count]]

    def _xyz(self, survey: int, epoch: int) -> Floats:
        return self.pairs[survey].pyramids[epoch].levels[0].xyz

    def cut(self, place: Place) -> CylinderPair | None:
        """Return the cylinder at a place, None where a cloud has no points there."""
        pair = self.pairs[place.survey]
        pyramids, classes = pair.pyramids, pair.classes[place.epoch]
        return cut_pair(pyramids[1 - place.epoch], pyramids[place.epoch], place.centre, self.radius, classes)


def cut_pair(
    reference: Pyramid, compared: Pyramid, centre: Floats, radius: float, classes: Ints | None = None
) -> CylinderPair | None:
    """Cut one cylinder out of both clouds; None where one of them is empty."""
    first, second = (cut_cylinder(pyramid, centre, radius) for pyramid in (reference, compared))
    if first is None or second is None:
        return None
    labels = np.full(len(second.picked), IGNORED) if classes is None else classes[second.picked]
    return CylinderPair(first, second, nearest_across(first, second), labels)


def grid_centres(xyz: Floats, radius: float, overlap: float) -> Floats:
    """Return centres (M, 3) of a regular grid of cylinders that covers points (N, 3) [m]."""
    step = 2.0 * radius * (1.0 - overlap)
    cells, member = np.unique(np.round(xyz[:, :2] / step).astype(np.int64), axis=0, return_inverse=True)
    height = np.bincount(member.ravel(), xyz[:, 2]) / np.bincount(member.ravel())
    return np.column_stack([cells * step, height])


def vary(levels: Sequence[Floats], turn: float, noise: Floats) -> list[Singles]:
    """Turn the points of all levels about the vertical axis [rad] and add noise (N, 3) [m] to the finest."""
    c, s = np.cos(turn), np.sin(turn)
    matrix = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = [xyz @ matrix for xyz in levels]
    moved[0] = moved[0] + noise
    return [xyz.astype(np.float32) for xyz in moved]


def clipped_noise(rng: np.random.Generator, count: int, sigma: float, limit: float) -> Floats:
    """Return Gaussian noise (count, 3) [m], limited in each coordinate."""
    return np.clip(rng.normal(0.0, sigma, (count, 3)), -limit, limit)


class PatchSampler:
    """Draw patches of surface models so that every label is the one of the centre equally often."""

    def __init__(self, pairs: Sequence[RasterPair], patch: int, scale: float, *, exchange: bool) -> None:
        self.patch, self.scale, self.exchange = patch, scale, exchange
        self.pairs = [padded(pair, patch) for pair in pairs]
        tables = []
        for survey, pair in enumerate(self.pairs):
            row, column = np.nonzero(pair.codes >= 0)
            tables.append(np.column_stack([np.full(len(row), survey), row, column, pair.codes[row, column]]))
        rows = np.concatenate(tables)
        by_code = (rows[rows[:, 3] == code, :3] for code in range(5))
        self._rows = [found for found in by_code if len(found)]

    def draw(self, rng: np.random.Generator) -> tuple[Singles, Ints]:
        """Return heights (2, patch, patch) as network input, and codes (patch, patch), turned at random."""
        rows = self._rows[rng.integers(len(self._rows))]
        survey, row, column = rows[rng.integers(len(rows))]
        half = self.patch // 2
        jitter = rng.integers(-half, half, size=2)
        pair = self.pairs[survey]
        top, left = np.clip(
            np.array([row, column]) + jitter - half, 0, np.array(pair.codes.shape) - self.patch
        )
        heights, codes = self._cut(pair, top, left)
        heights, codes = turned(heights, codes, int(rng.integers(8)))
        if self.exchange and rng.random() < 0.5:
            heights, codes = heights[::-1], exchanged(codes)
        return network_input(heights, self.scale), np.ascontiguousarray(codes)

    def spread(self, rng: np.random.Generator, count: int) -> list[tuple[Singles, Ints]]:
        """Return random ones of the adjacent patches that hold labels, as they lie."""
        every = []
        for pair in self.pairs:
            rows, columns = (patch_corners(size, self.patch, 0.0) for size in pair.codes.shape)
            cut = (self._cut(pair, top, left) for top in rows for left in columns)
            every += [(heights, codes) for heights, codes in cut if (codes >= 0).any()]
        chosen = (every[index] for index in rng.permutation(len(every))[:count])
        return [
            (network_input(heights, self.scale), np.ascontiguousarray(codes)) for heights, codes in chosen
        ]

    def _cut(self, pair: RasterPair, top: int, left: int) -> tuple[Floats, Ints]:
        window = (slice(top, top + self.patch), slice(left, left + self.patch))
        return pair.heights[(slice(None), *window)], pair.codes[window]


def padded(pair: RasterPair, patch: int) -> RasterPair:
    """Extend rasters that are smaller than a patch by their edges, without labels."""
    rows, columns = (max(patch - size, 0) for size in pair.codes.shape)
    ends = ((0, rows), (0, columns))
    heights = np.pad(pair.heights, ((0, 0), *ends), mode="edge")
    return RasterPair(heights, np.pad(pair.codes, ends, constant_values=IGNORED))


def turned(heights: Floats, codes: Ints, number: int) -> tuple[Floats, Ints]:
    """Turn and mirror a patch in one of eight ways."""
    heights, codes = np.rot90(heights, number % 4, axes=(1, 2)), np.rot90(codes, number % 4)
    return (heights[:, :, ::-1], codes[:, ::-1]) if number >= 4 else (heights, codes)


def exchanged(codes: Ints) -> Ints:
    """Return codes as they are when the epochs are exchanged; -1 stays."""
    return np.where(codes >= 0, EXCHANGED[np.clip(codes, 0, 4)], codes)


def network_input(heights: Floats, scale: float) -> Singles:
    """Return heights (2, rows, columns) less their common median, in units of ``scale`` [m]."""
    return ((heights - np.median(heights)) / scale).astype(np.float32)


def patch_corners(size: int, patch: int, overlap: float) -> Ints:
    """Return the first cells of patches that cover ``size`` cells; the last one ends at the border."""
    step = max(int(patch * (1.0 - overlap)), 1)
    last = max(size - patch, 0)
    return np.unique(np.append(np.arange(0, last, step), last))
