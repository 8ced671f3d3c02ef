"""Height differences of the ground, cell by cell."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pydantic import Field
from scipy import ndimage
from scipy.spatial import cKDTree

from subiaco_change.geometry import tree_for_few
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.method_rules.switches import none_like_second, switchable
from subiaco_change.objects.known_space import Empty
from subiaco_change.objects.voxel_objects import UNCERTAIN, EpochView, is_ghost_trail
from subiaco_change.segmentation.ground_model import Mask, fill_gaps
from subiaco_geo.codes import Semantic
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

NO_CLAIM = NUMBERS.ground_cells.no_claim_lod
_WALL_POINTS = NUMBERS.ground_cells.wall_points
_WALL_SHARE = NUMBERS.ground_cells.wall_share
_WALL_TOP = NUMBERS.ground_cells.wall_top
_WALL_DEPTH = NUMBERS.ground_cells.wall_depth
_FLOOR_REACH = NUMBERS.ground_cells.floor_reach
_DENSE = NUMBERS.ground_cells.dense_share
_BELOW = NUMBERS.ground_cells.seen_below


class GroundChangeConfig(StrictModel):
    """Ground differencing."""

    cell: float = Field(
        0.5, gt=0, description="Edge of the cells in which ground heights are compared [m] (Decision 12)"
    )
    report_cell: float = Field(
        2.0, gt=0, description="Edge of the cells of the delivered raster of height differences [m] (paper)"
    )
    threshold: float = Field(
        0.15, gt=0, description="Change of the ground level beyond which a cell counts as changed [m] (paper)"
    )
    area: float = Field(
        25.0, gt=0, description="Contiguous area above which changed ground is reported [m2] (paper)"
    )
    small_area: float = Field(
        6.25,
        gt=0,
        description="Area above which a smaller patch is reported if it moved as much ground as the "
        "smallest patch above `area` does at the threshold [m2]",
    )
    lod_factor: float = Field(
        1.2, gt=0, description="Limit of a ground change as a multiple of the level of detection (paper)"
    )
    evenness: float = Field(
        1.2,
        ge=0,
        description="Smallest ratio of the median height difference of a patch to the standard deviation of "
        "its cells (a cone of earth, however high, has 1.24)",
    )
    max_spread: float = Field(
        0.12,
        gt=0,
        description="Largest height distance from the median of a cell at which its points belong to one "
        "level [m]",
    )
    level_share: float = Field(
        0.6,
        gt=0,
        le=1,
        description="Fraction of the ground points of a cell that must lie on one level; a cell with fewer "
        "holds no clean ground",
    )
    bridge: int = Field(
        3, ge=1, description="Window in which an empty cell takes the height of its neighbours [cells]"
    )
    same_surface: float = Field(
        0.3,
        gt=0,
        description="Largest height distance of a point from the other epoch's ground at which both "
        "epochs contain that surface, so that no ground moved [m]",
    )
    same_beside: float = Field(
        0.7,
        gt=0,
        description="Largest horizontal distance of a point from a cell centre at which the point shows "
        "the other epoch's ground surface [m]",
    )
    same_above: float = Field(
        1.5,
        gt=0,
        description="Height above the other epoch's ground up to which points of a building, vehicle or "
        "other object show that a side rises there, and no surface ends [m]",
    )
    same_share: float = Field(
        0.5,
        gt=0,
        le=1,
        description="Fraction of a patch whose surfaces exist in both epochs from which the patch is no "
        "ground change",
    )
    same_inside: float = Field(
        0.2,
        ge=0,
        le=1,
        description="Fraction of a patch in whose own cells the other surface must have points; the rim of "
        "a pit has points beside the patch alone",
    )
    measured_share: float = Field(
        0.3,
        ge=0,
        le=1,
        description="Smallest fraction of the cells of a patch that both epochs measured, or in which walls "
        "and free space show the change; other cells have the height of their neighbours",
    )
    closing: int = Field(
        5,
        ge=0,
        description="Half width of occluded gaps between changed cells that are filled and count towards "
        "the area [cells]; 5 covers a parked car",
    )

    @property
    def volume(self) -> float:
        """Ground that the smallest and lowest patch above ``area`` moved [m3]."""
        return self.threshold * self.area


@dataclass(frozen=True)
class GroundCells:
    """Cells (rows, columns) of two epochs, row 0 in the south.

    ``dz`` after minus before, NaN where either epoch has no ground; ``lod`` [m], NaN where either has
    none; ``bridged``: took a neighbour's height in an epoch; ``height`` in *after* [m]; ``other``: one epoch
    holds the ground of the other under another class, in the cell or beside it; ``inside``: in the cell
    itself; ``raised`` and ``lowered``: wall or hidden floor of a pit of *before* and of *after*, whose height
    is not known.
    """

    dz: Floats
    lod: Floats
    bridged: Mask
    height: Floats
    other: Mask
    inside: Mask
    raised: Mask
    lowered: Mask


def difference_cells(
    before: EpochView,
    after: EpochView,
    corner: Floats,
    shape: tuple[int, int],
    config: GroundChangeConfig,
    empty: tuple[Empty | None, Empty | None] = (None, None),
) -> GroundCells:
    """Difference the ground of two epochs in the cells of a window that all their ground points lie in.

    ``empty`` tells which places the beams of *before* and of *after* went through, where they were counted.
    """
    views = (before, after)
    cells = [_cell_heights(v, _still_ground(v), corner, shape, config) for v in views]
    own = [np.isfinite(height) for height, _ in cells]
    (first, second), bridged = _bridge(cells[0][0], cells[1][0], config)
    walls = [_pit_walls(v, h, corner, config) for v, (h, _) in zip(views, cells[::-1], strict=True)]
    pits = [_floor_of_pits(w, mine, its, config) for w, mine, its in zip(walls, own, own[::-1], strict=True)]
    free = [
        _seen_below(height, mine, corner, saw, config)
        for mine, (height, _), saw in zip(own, cells[::-1], empty, strict=True)
    ]
    heights = tuple(
        np.where(np.isfinite(wall), wall, np.where(around | below, np.nan, height))
        for height, wall, (around, _), below in zip((first, second), walls, pits, free, strict=True)
    )
    pit = np.isfinite(walls[0]) | np.isfinite(walls[1])
    lod = np.maximum(cells[0][1], cells[1][1])
    other, inside = _other_surface(views, (heights[0], heights[1]), corner, config)
    dug = [np.isfinite(w) | floor | below for w, (_, floor), below in zip(walls, pits, free, strict=True)]
    surfaces = (heights[1], other & ~pit, inside & ~pit)
    return GroundCells(heights[1] - heights[0], lod, bridged & ~pit, *surfaces, *dug)


def _no_walls(_: EpochView, other: Floats, *__: object) -> Floats:
    """Return no walls of pits."""
    return np.full(other.shape, np.nan)


@switchable("pit_walls", _no_walls)
def _pit_walls(view: EpochView, other: Floats, corner: Floats, config: GroundChangeConfig) -> Floats:
    """Height of the points of an epoch that lie under the ground of the other epoch; NaN in other cells.

    A surface has nothing beneath it: where there is something, the ground lies lower in this epoch. ``other``
    (rows, columns) height of the other epoch's ground.
    """
    row, column = (np.floor((view.xyz[:, 1::-1] - corner[::-1]) / config.cell).astype(np.int64)).T
    inside = (row >= 0) & (column >= 0) & (row < other.shape[0]) & (column < other.shape[1])
    kept = inside & ~is_ghost_trail(view)
    z, flat = view.xyz[kept, 2], row[kept] * other.shape[1] + column[kept]
    above = z - other.ravel()[flat]
    low = above < -config.threshold
    covered = (np.abs(above) <= config.max_spread) & (view.semantic[kept] != Semantic.GROUND)
    lows, near, deep, cover = (
        np.bincount(flat, m, other.size) for m in (low, above < _WALL_TOP, above < -_WALL_DEPTH, covered)
    )
    wall = (lows >= _WALL_POINTS) & (lows >= _WALL_SHARE * near) & (deep == 0) & (cover < lows)
    below = _medians(flat[low], z[low], np.bincount(flat[low], minlength=other.size))
    return np.where(wall, below, np.nan).reshape(other.shape)


def _floor_of_pits(wall: Floats, own: Mask, other: Mask, config: GroundChangeConfig) -> tuple[Mask, Mask]:
    """Tell in which cells beside the walls of pits an epoch has no ground, and in which the pit hides it.

    The near edge of a pit hides its floor. Where the epoch measured less than half of the ground (``own``)
    that the other epoch measured (``other``), its scan lines lie far apart, and nothing is hidden.
    """
    steps = round(_FLOOR_REACH / config.cell)
    found = np.isfinite(wall)
    if not found.any():
        return found, found
    around = ndimage.binary_dilation(found, np.ones((3, 3)), iterations=steps) & ~own & ~found
    size = 2 * config.closing + 1
    mine, its = (ndimage.uniform_filter(m.astype(np.float64), size) for m in (own, other))
    return around, around & other & (mine >= _DENSE * its)


@switchable("seen_below_ground", none_like_second)
def _seen_below(
    other: Floats, mine: Mask, corner: Floats, empty: Empty | None, config: GroundChangeConfig
) -> Mask:
    """Tell in which cells an epoch looked through the ground of the other one, and has none (not ``mine``).

    Its beams went on well below the ground (heights ``other``, rows, columns), to the floor or the far wall
    of a pit whose near edge hides the floor in these cells.
    """
    found = np.zeros(mine.shape, dtype=bool)
    row, column = np.nonzero(~mine & np.isfinite(other))
    if empty is not None and len(row):
        middle = _middles(row, column, corner, config)
        found[row, column] = empty(np.column_stack([middle, other[row, column] - _BELOW]))
    return found


@switchable("ground_of_moving_objects", lambda view: view.semantic == Semantic.GROUND)
def _still_ground(view: EpochView) -> Mask:
    """Tell which points (N,) are ground: low parts of a moving object that pass for it are not."""
    ground = view.semantic == Semantic.GROUND
    return ground if view.moved is None else np.asarray(ground & (view.moved <= UNCERTAIN))


def _other_surface(
    views: tuple[EpochView, EpochView],
    heights: tuple[Floats, Floats],
    corner: Floats,
    config: GroundChangeConfig,
) -> tuple[Mask, Mask]:
    """Tell in which cells, with what lies beside them and alone, two grounds are not one that moved.

    Grass that one epoch saw through, a deck above a street, a bank that passed for a plant: the epoch
    that calls the one surface ground holds points of the other too, of another class.
    """
    apart = np.abs(heights[1] - heights[0])
    row, column = np.nonzero(apart > config.threshold)
    other, inside = np.zeros(apart.shape, dtype=bool), np.zeros(apart.shape, dtype=bool)
    if len(row) == 0:
        return other, inside
    middle = _middles(row, column, corner, config)
    limit = np.minimum(config.same_surface, 0.5 * apart[row, column])
    reaches = (config.same_beside, math.sqrt(0.5) * config.cell)
    held = np.zeros((len(reaches), len(row)), dtype=bool)
    for e, view in enumerate(views):
        off = (view.semantic != Semantic.GROUND) & ~is_ghost_trail(view)
        upright = view.semantic != Semantic.VEGETATION
        surface = np.column_stack([middle, heights[1 - e][row, column]])
        held |= _holds(view.xyz[off & ~upright], surface, limit, reaches, 0.0)
        held |= _holds(view.xyz[off & upright], surface, limit, reaches, config.same_above)
        ground = views[1 - e].xyz[_still_ground(views[1 - e])]
        held |= _coincides(ground, view.xyz[off], apart, corner, config)[row, column]
    other[row, column], inside[row, column] = held
    return other, inside


def _middles(row: Ints, column: Ints, corner: Floats, config: GroundChangeConfig) -> Floats:
    """Middles (N, 2) of cells [m]."""
    return np.asarray(corner + (np.column_stack([column, row]) + 0.5) * config.cell)


@switchable("coinciding_ground", lambda _, __, apart, *___: np.zeros(apart.shape, dtype=bool))
def _coincides(
    ground: Floats, points: Floats, apart: Floats, corner: Floats, config: GroundChangeConfig
) -> Mask:
    """Tell in which cells most ground points (N, 3) of an epoch lie at points (M, 3) above the other ground.

    In all three dimensions, unlike what rises beside a cell. A cell without ground points takes the verdict
    of its neighbours, as it took their height.
    """
    index = np.floor((ground[:, :2] - corner) / config.cell).astype(np.int64)
    index = np.clip(index, 0, np.array(apart.shape[::-1]) - 1)
    limit = np.minimum(config.same_surface, 0.5 * np.nan_to_num(apart[index[:, 1], index[:, 0]]))
    asked = limit > 0.5 * config.threshold
    index, limit, ground = index[asked], limit[asked], ground[asked]
    if len(ground) == 0 or len(points) == 0:
        return np.zeros(apart.shape, dtype=bool)
    near = tree_for_few(points).query(ground, distance_upper_bound=config.same_surface)[0] <= limit
    flat = index[:, 1] * apart.shape[1] + index[:, 0]
    count, held = (np.bincount(flat, w, apart.size).reshape(apart.shape) for w in (None, near))
    around = ndimage.uniform_filter(
        np.stack([count, held]).astype(np.float64), (0, config.bridge, config.bridge)
    )
    count, held = np.where(count > 0, np.stack([count, held]), around)
    return np.asarray((count > 1e-9) & (held >= config.same_share * count))


def _holds(points: Floats, places: Floats, limit: Floats, reaches: tuple[float, ...], above: float) -> Mask:
    """Tell at which places (M, 3) points (N, 3) lie within each reach (R,) and, in height, ``limit`` (M,).

    Returns (R, M). A side that rises beside the place is no surface at its height: more of its points lie
    ``above``, up to so much [m].
    """
    held = np.zeros((len(reaches), len(places)), dtype=bool)
    widest = max(reaches)
    low, high = places.min(axis=0) - widest, places.max(axis=0) + widest
    high[2] += above
    points = points[((points >= low) & (points <= high)).all(axis=1)]
    if len(points) == 0:
        return held
    near = cKDTree(points[:, :2]).query_ball_point(places[:, :2], widest)
    slot = np.repeat(np.arange(len(places)), [len(n) for n in near])
    step = points[np.concatenate([np.asarray(n, dtype=np.int64) for n in near])] - places[slot]
    level = np.abs(step[:, 2]) <= limit[slot]
    higher = (step[:, 2] > limit[slot]) & (step[:, 2] <= above)
    away = np.hypot(step[:, 0], step[:, 1])
    for row, reach in enumerate(reaches):
        masks = (level & (away <= reach), higher & (away <= reach))
        at, over = (np.bincount(slot[mask], minlength=len(places)) for mask in masks)
        held[row] = (at > 0) & (over <= at)
    return held


def shown_lod(lod: Floats) -> Floats:
    """Fill the level of detection of cells that have none from those around."""
    shown = fill_gaps(lod) if np.isfinite(lod).any() else np.full_like(lod, NO_CLAIM)
    return np.where(np.isfinite(lod), lod, shown)


def _cell_heights(
    view: EpochView, mask: Mask, corner: Floats, shape: tuple[int, int], config: GroundChangeConfig
) -> tuple[Floats, Floats]:
    """Height and LoD of every cell; NaN where empty or where no level holds most of the points.

    The height is the mean of the points near the median: a cell that the edge of a pit runs through has two
    levels, and that of the larger part counts.
    """
    xyz, lod = view.xyz[mask], view.lod[mask]
    index = np.floor((xyz[:, :2] - corner) / config.cell).astype(np.int64)
    # The window was cut in world coordinates: on its rim, the last digits of the local ones may differ.
    index = np.clip(index, 0, np.array(shape[::-1]) - 1)
    flat = index[:, 1] * shape[1] + index[:, 0]
    size = shape[0] * shape[1]
    count = np.bincount(flat, minlength=size)
    level = np.abs(xyz[:, 2] - _medians(flat, xyz[:, 2], count)[flat]) <= config.max_spread
    near = np.bincount(flat, level, size)
    mean = np.bincount(flat, np.where(level, xyz[:, 2], 0.0), size) / np.maximum(near, 1)
    finite = np.isfinite(lod)
    total = np.bincount(flat, np.where(finite, lod, 0.0), size)
    some = np.bincount(flat, finite, size)
    lods = np.where(some > 0, total / np.maximum(some, 1), np.nan)
    good = (count > 0) & (near >= config.level_share * count)
    return np.where(good, mean, np.nan).reshape(shape), np.where(good, lods, np.nan).reshape(shape)


def _medians(cell: Ints, values: Floats, count: Ints) -> Floats:
    """Median of the values (N,) of every cell (C,), of an even number the lower one; NaN where none."""
    if len(values) == 0:
        return np.full(len(count), np.nan)
    ordered = values[np.lexsort((values, cell))]
    start = np.cumsum(count) - count
    middle = np.minimum(start + np.maximum(count - 1, 0) // 2, len(values) - 1)
    return np.where(count > 0, ordered[middle], np.nan)


def _unbridged(before: Floats, after: Floats, *_: object) -> tuple[tuple[Floats, Floats], Mask]:
    """Return the heights of cells as they are, and those without a height in either epoch."""
    return (before, after), ~(np.isfinite(before) & np.isfinite(after))


@switchable("bridged_cells", _unbridged)
def _bridge(before: Floats, after: Floats, config: GroundChangeConfig) -> tuple[tuple[Floats, Floats], Mask]:
    """Bridge empty cells next to known ones, so that sparse ground stays contiguous; tell which they are.

    Heights are carried over relative to a smooth surface through both
    epochs: on a slope nothing is gained or lost.
    """
    known = [np.isfinite(v) for v in (before, after)]
    if not all(k.any() for k in known):
        return (before, after), np.zeros(before.shape, dtype=bool)
    smooth = ndimage.gaussian_filter(fill_gaps(np.fmin(before, after)), 2.0 / config.cell, mode="nearest")
    bridged = []
    for values, mask in zip((before, after), known, strict=True):
        weight = ndimage.uniform_filter(mask.astype(float), config.bridge, mode="constant")
        total = ndimage.uniform_filter(np.where(mask, values - smooth, 0.0), config.bridge, mode="constant")
        mean = smooth + total / np.maximum(weight, 1e-9)
        enough = weight * config.bridge**2 > 1.5
        bridged.append(np.where(mask, values, np.where(enough, mean, np.nan)))
    return (bridged[0], bridged[1]), ~(known[0] & known[1])


def block_median(values: Floats, factor: int) -> Floats:
    """Median of the finite values of blocks of ``factor`` by ``factor`` cells; NaN where there is none."""
    rows, columns = (-(-n // factor) for n in values.shape)
    padded = np.full((rows * factor, columns * factor), np.nan)
    padded[: values.shape[0], : values.shape[1]] = values
    blocks = padded.reshape(rows, factor, columns, factor).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    medians = np.full((rows, columns), np.nan)
    some = np.isfinite(blocks).any(axis=2)
    medians[some] = np.nanmedian(blocks[some], axis=1)
    return medians
