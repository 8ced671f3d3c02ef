"""Moving or standing: probability by voxel and connected component, from the times of hits and passes.

A thing that stands is hit whenever it is looked at, or, where it is thin or porous, in a share of the looks,
again and again. Something that moved is hit in one short run of looks, or in a few runs where a queue crawls,
and passed through before and after. For the sequence of hits and looks through a voxel two models compete:

* standing: every look is a hit with one unknown probability, which follows a beta distribution; hits may fall
  anywhere among the looks (beta-binomial model);
* moving: something is in the voxel during a share of the looks, which follows a beta distribution too; the
  hits come in runs, every further run takes a constant factor, and arrangements in as many runs are equally
  likely.

A pole seems to shift where the poses drift: the voxels beside one another take turns at holding it. The hits
of a voxel are therefore counted together with those of the eight around at the same height, as far as they
follow each other without a pause. What moves is gone from all nine a moment later.

The logarithm of the ratio of the two likelihoods is averaged over the 27 voxels around: the edge of a
standing surface, which beams from afar pass and beams from near meet, takes part in the verdict on the
surface. Voxels with positive mean evidence that touch form a connected component, which gets one verdict. Its
voxels are not independent: a component counts as many of them as fit along its edge, the cube root of their
number.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numba
import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.special import betaln, gammaln

from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.observation_times import VoxelObservations
from subiaco_geo.visibility import NO_VERDICT, SURELY_MOVED
from subiaco_geo.voxel_components import connected_voxels

_BELOW = (-2, -3, -4, -5)  # voxels under one that is not ground


class MovementConfig(StrictModel):
    """Verdict on what returned from a voxel: it moved, it stands, or nobody can tell."""

    window: float = Field(
        0.2,
        ge=0.05,
        le=2.0,
        description="Length of a time window [s]. A window with returns from a voxel is a hit; one with "
        "no return by whose end enough beams have passed since the last look is a look through the voxel",
    )
    least_beams: int = Field(
        3,
        ge=1,
        le=255,
        description="Number of traced beams (visibility_stride) that must pass through a voxel, in one "
        "window or several, for a look through. Raise it if edges of static objects count as moving",
    )
    standing_share: float = Field(
        2.0,
        gt=0,
        description="First parameter of the beta distribution of the hit fraction of a static object [1]; "
        "above 1, dense objects are likelier than porous ones",
    )
    moving_share: float = Field(
        3.0,
        gt=0,
        description="Second parameter of the beta distribution of the fraction of time that a moving "
        "object spends in a voxel [1]; above 1, short times are likelier",
    )
    further_run: float = Field(
        0.25,
        gt=0,
        lt=1,
        description="Factor on the likelihood of movement per run of hits after the first. Raise it for "
        "busy traffic, lower it if sparse foliage counts as moving",
    )
    weight: float = Field(
        6.0,
        gt=0,
        description="Greatest evidence of one voxel, as the natural logarithm of a likelihood ratio [1]",
    )
    touching: float = Field(
        -1.0,
        le=0,
        description="Evidence (log likelihood ratio) from which a voxel beside a moving component moved "
        "too [1]; just below 0 includes voxels without evidence",
    )
    standing: float = Field(
        -2.0,
        le=0,
        description="Evidence (log likelihood ratio) below which a voxel is static although its component "
        "moved [1]",
    )
    layer: float = Field(
        2.0,
        ge=1,
        description="Mean number of voxels in a column up to which a component may be the top of a static "
        "object, which beams skim",
    )
    attached: float = Field(
        0.6,
        gt=0,
        le=1,
        description="Fraction of the voxels of this thin component beside raised static voxels from "
        "which the component belongs to a static object",
    )
    lasting: float = Field(
        2.0,
        ge=0,
        description="Time span of hits from which a voxel beside a component counts as static there [s]",
    )
    passed_by: float = Field(
        0.1,
        ge=0,
        lt=1,
        description="Largest fraction of the looks at a voxel that go through it and all voxels beside it, "
        "for what they hold in turns to be one static object that drifting poses shift",
    )
    thin: int = Field(
        4,
        ge=1,
        description="Largest number of voxels of a thin object (pole, trunk) at one height and time. Raise "
        "it to keep wider objects that drifting poses shift; their second images stay in the map too",
    )
    prior: float = Field(-4.0, description="Log odds that a component moved, before any evidence [1]")
    sure: float = Field(
        0.9,
        gt=0.5,
        le=1,
        description="Probability of having moved from which points leave the map for `moving.laz`; other "
        "points keep their probability in the field `moving`",
    )
    brief: float = Field(
        1.5,
        ge=0,
        description="Time span of hits up to which a voxel is uncertain (probability 0.5), as a slow "
        "vehicle passes in that time [s]; from twice the span on, the voxel is static",
    )
    gaps: float = Field(
        3.0,
        ge=1,
        description="Largest ratio of the span between first and last hit to the time with hits that "
        "counts; longer spans may be two vehicles",
    )


def evidence_of_movement(looks: VoxelObservations, config: MovementConfig) -> NDArray[np.float32]:
    """Log likelihood ratio (M,) of moving against standing of every voxel; NaN where nothing returned."""
    hits, through = looks.hits.astype(np.float64), looks.through.astype(np.float64)
    runs = np.maximum(looks.runs, 1.0)
    stands = betaln(hits + config.standing_share, through + 1.0) - betaln(config.standing_share, 1.0)
    present = betaln(hits + 1.0, through + config.moving_share) - betaln(1.0, config.moving_share)
    ways = _log_choose(hits - 1, runs - 1) + _log_choose(through + 1, runs)
    moves = present + _log_choose(hits + through, hits) - ways + np.log(config.further_run) * (runs - 1)
    return np.where(hits > 0, moves - stands, np.nan).astype(np.float32)


def stood(looks: VoxelObservations, config: MovementConfig) -> NDArray[np.bool_]:
    """Tell in which voxels (M,) something certainly stood: it was hit for long, and hardly ever missed."""
    lasted = _lasted(looks, config) >= 2 * config.brief
    return np.asarray(lasted & (evidence_of_movement(looks, config) <= config.standing))


def steadied(keys: Ints, looks: VoxelObservations, config: MovementConfig) -> VoxelObservations:
    """Return the looks of voxels (M,) with hits of neighbours that precede or follow without a pause.

    Looks through a voxel while a neighbour was hit count as hits: poses that drift by less than a voxel shift
    a thin standing object from one voxel to the next. A wall that they shift is a second wall, which better
    leaves the map. Voxels of several runs stay as they are.
    """
    first, last = looks.first.astype(np.int64), looks.last.astype(np.int64)
    added = _windows_beside(keys, first, last, looks.runs == 1, config.thin)
    span = (last - first + 1 + added) * config.window
    hits, through = looks.hits.astype(np.int64), looks.through.astype(np.int64)
    added = np.minimum(added, through)
    stayed = (through - added <= config.passed_by * (hits + through)) & (span >= config.lasting)
    added = np.where(stayed, added, 0)
    whole, rest = ((hits + added).astype(np.uint16), (through - added).astype(np.uint16))
    return replace(looks, hits=whole, through=rest)


@numba.njit(cache=True)
def _windows_beside(keys, first, last, single, thin):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Count the windows (N,) by which the neighbours of a voxel prolong its one run; keys are sorted.

    None where more than ``thin`` voxels within two cells at its height were hit in the middle of that run.
    """
    added = np.zeros(len(keys), dtype=np.int64)
    near, places = np.empty(9, dtype=np.int64), np.zeros(25, dtype=np.int64)
    for i in range(len(keys)):
        if not single[i]:
            continue
        number, wide = _neighbours(keys, i, first, last, single, near, places)
        if wide > thin:
            continue
        begin, end, grows = first[i], last[i], True
        while grows:
            grows = False
            for j in near[:number]:
                if first[j] <= end + 1 and last[j] >= begin - 1 and (first[j] < begin or last[j] > end):
                    begin, end, grows = min(begin, first[j]), max(end, last[j]), True
        added[i] = (end - begin) - (last[i] - first[i])
    return added


@numba.njit(cache=True)
def _neighbours(keys, i, first, last, single, near, places):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Write voxels of one run beside a voxel to ``near`` (9,); return their number, and how many were hit.

    The latter are counted within two cells at its height, in the middle of its run. ``places`` (25,) are
    where the neighbours of an earlier voxel lay or would lie in the sorted keys.
    """
    number, wide, middle = 0, 0, (first[i] + last[i]) // 2
    for dx in range(-2, 3):
        for dy in range(-2, 3):
            key = keys[i] + (dx << 42) + (dy << 21)
            column = 5 * (dx + 2) + dy + 2
            j = places[column]
            while j < len(keys) and keys[j] < key:
                j += 1
            places[column] = j
            if j < len(keys) and keys[j] == key:
                wide += first[j] <= middle <= last[j]
                if single[j] and abs(dx) < 2 and abs(dy) < 2:
                    near[number] = j
                    number += 1
    return number, wide


def _log_choose(total: Floats, chosen: Floats) -> Floats:
    """Logarithm of the number of ways to choose; 0 where the arguments make no sense."""
    rest = np.maximum(total - chosen, 0.0)
    return np.asarray(gammaln(np.maximum(total, 0.0) + 1) - gammaln(chosen + 1) - gammaln(rest + 1))


@numba.njit(cache=True)
def _around(keys, values, reach):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Mean (N, C) of values (N, C) over the voxels within ``reach`` cells of each; keys are sorted."""
    count, width = values.shape
    total = np.zeros((count, width), dtype=np.float64)
    number = np.zeros(count, dtype=np.int64)
    for dx in range(-reach, reach + 1):
        for dy in range(-reach, reach + 1):
            step, j = (dx << 42) + (dy << 21), 0
            for i in range(count):
                low = keys[i] + step - reach
                while j < count and keys[j] < low:
                    j += 1
                other = j
                while other < count and keys[other] <= low + 2 * reach:
                    for column in range(width):
                        total[i, column] += values[other, column]
                    number[i] += 1
                    other += 1
    for i in range(count):
        total[i] /= number[i]
    return total


@dataclass(frozen=True)
class _Doubtful:
    """Voxels that may have moved: row in the grid, own evidence, and whether their component may."""

    row: Ints
    own: Floats
    candidate: NDArray[np.bool_]


def verdicts(
    keys: Ints, looks: VoxelObservations, config: MovementConfig, most: int = 1 << 22
) -> NDArray[np.uint8]:
    """Decide of every voxel whether what returned from it moved.

    Parameters
    ----------
    keys : (M,) int64
        Sorted packed voxel indices (:func:`subiaco_geo.clouds.voxel_keys`); may be mapped from disk.
    looks : VoxelObservations
        At these voxels.
    config : MovementConfig
    most : int
        Voxels taken at a time; does not change the result.

    Returns
    -------
    (M,) uint8
        Probability in steps of 1/200; :data:`NO_VERDICT` where nothing returned.
    """
    code = np.full(len(keys), NO_VERDICT, dtype=np.uint8)
    parts = [_judge_part(keys, looks, config, start, most, code) for start in range(0, len(keys), most)]
    if not parts:
        return code
    names = [field.name for field in fields(_Doubtful)]
    found = _Doubtful(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in names})
    open_ = found.row[found.candidate & (found.own > config.standing)]
    static = _StaticSurroundings(keys, looks, open_, config)
    chance = _component_chance(np.asarray(keys[found.row]), found, static, config)
    code[found.row] = np.maximum(code[found.row], np.round(chance * SURELY_MOVED))
    return code


def _judge_part(
    keys: Ints,
    looks: VoxelObservations,
    config: MovementConfig,
    start: int,
    most: int,
    code: NDArray[np.uint8],
) -> _Doubtful:
    """Write the verdict on the voxels of a part as if all stood; return those that may have moved."""
    stop = min(start + most, len(keys))
    low, high = (int(keys[start]) >> 42) - 3, (int(keys[stop - 1]) >> 42) + 4
    first, last = np.searchsorted(keys, [low << 42, high << 42])
    hit = first + np.flatnonzero(looks.hits[first:last])
    seen = looks.select(hit)
    own = evidence_of_movement(seen, config).astype(np.float64)
    together = evidence_of_movement(steadied(np.asarray(keys[hit]), seen, config), config).astype(np.float64)
    own = np.minimum(own, together)
    own = np.clip(own, -config.weight, config.weight)
    span = np.minimum(_lasted(seen, config), 2 * config.brief)
    mean, around = _around(np.asarray(keys[hit]), np.column_stack([own, span]), 1).T
    brief = 0.5 * np.clip(2.0 - around / max(config.brief, 1e-9), 0.0, 1.0)
    mine = (hit >= start) & (hit < stop)
    code[hit[mine]] = np.round(brief * SURELY_MOVED)[mine]
    doubtful = mine & ((mean > 0) | (own > config.touching))
    return _Doubtful(hit[doubtful], own[doubtful], (mean > 0)[doubtful])


@dataclass(frozen=True)
class _StaticSurroundings:
    """Voxels (M,) of a map, when they were hit, and which of them (C,) may have moved."""

    keys: Ints
    looks: VoxelObservations
    candidates: Ints
    config: MovementConfig

    def beside(self, keys: Ints) -> NDArray[np.bool_]:
        """Tell which voxels (N,) touch one that was hit for long and that stands on another: no ground."""
        found = np.zeros(len(keys), dtype=bool)
        for step in _steps(1, (-1, 0, 1)):
            near = keys + step
            row, static = self._hit(near)
            static[static] = _lasted(self.looks.select(row[static]), self.config) >= self.config.lasting
            static[static] = ~np.isin(row[static], self.candidates)
            for below in _steps(1, _BELOW):
                raised = np.flatnonzero(static & ~found)
                found[raised] = self._hit(near[raised] + below)[1]
        return found

    def _hit(self, keys: Ints) -> tuple[Ints, NDArray[np.bool_]]:
        """Return the rows of voxels (N,), and from which of these voxels something returned."""
        row = np.minimum(self.keys.searchsorted(keys), len(self.keys) - 1)
        return row, np.asarray((self.keys[row] == keys) & (self.looks.hits[row] > 0))


def _lasted(looks: VoxelObservations, config: MovementConfig) -> Floats:
    """Time span of the hits of voxels (N,) [s]."""
    windows = np.minimum(looks.last - looks.first + 1.0, config.gaps * looks.hits)
    return np.asarray(windows * config.window)


def _steps(reach: int, heights: tuple[int, ...]) -> list[int]:
    """Differences of packed keys to the columns within ``reach`` cells, at some heights."""
    columns = range(-reach, reach + 1)
    return [(dx << 42) + (dy << 21) + dz for dx in columns for dy in columns for dz in heights]


def _component_chance(
    keys: Ints, found: _Doubtful, static: _StaticSurroundings, config: MovementConfig
) -> Floats:
    """Probability (D,) that the doubtful voxels moved, with their component or beside one that did.

    A thin component most of which touches static voxels above the ground is part of the static object: the
    roof of a parked van, whose voxels beams from afar skim, and which returns beams from near alone.
    """
    chance = np.zeros(len(keys))
    inside = np.flatnonzero(found.candidate)
    if len(inside) == 0:
        return chance
    part = connected_voxels(keys[inside])
    size = np.maximum(np.bincount(part), 1)
    mean = np.bincount(part, found.own[inside]) / size
    odds = config.prior + mean * np.cbrt(size)
    likely = (1.0 / (1.0 + np.exp(-np.clip(odds, -50.0, 50.0))))[part]
    columns = np.bincount(part[np.unique(keys[inside] >> 21, return_index=True)[1]], minlength=len(size))
    layer = size <= config.layer * np.maximum(columns, 1)
    check = np.flatnonzero((likely >= 0.5) & layer[part])
    beside = np.zeros(len(inside))
    beside[check] = static.beside(keys[inside[check]])
    attached = np.bincount(part, beside) >= config.attached * size
    chance[inside] = np.where((attached & layer)[part], 0.0, likely)
    moved = np.where(chance >= config.sure, chance, 0.0)
    near = _around(keys, np.column_stack([moved, moved > 0]), 1)
    around = near[:, 0] / np.maximum(near[:, 1], 1e-9)
    joins = (near[:, 1] > 0) & (found.own > config.touching)
    chance = np.where(joins, np.maximum(chance, around), chance)
    return np.where(found.own > config.standing, chance, 0.0)
