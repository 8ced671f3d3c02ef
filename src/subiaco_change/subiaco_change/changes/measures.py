"""What two matched objects differ by (method, part E, Decision 13)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field
from scipy import ndimage
from scipy.spatial import cKDTree
from shapely.geometry.base import BaseGeometry

from subiaco_change.changes.objects import Voxels
from subiaco_change.changes.outline import Outline, OutlineConfig
from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats, Ints

NO_OUTLINE = Outline()
NO_COLUMNS: Ints = np.zeros(0, dtype=np.int64)


class MeasureConfig(StrictModel):
    """Voxels and histograms of the measures."""

    voxel: float = Field(0.5, gt=0, description="edge of the voxels, paper [m]")
    tolerance: float = Field(
        0.5, gt=0, description="distance of voxels of two objects that overlap: undoes voxel aliasing [m]"
    )
    same_low: float = Field(0.35, gt=0, description="least distance at which a place counts as occupied [m]")
    same_high: float = Field(
        1.0, gt=0, description="largest such distance, where the other epoch is sparse [m]"
    )
    same_factor: float = Field(1.25, gt=0, description="that distance in spacings of the other epoch")
    crossing: float = Field(
        1.0, gt=0, description="looked so far on both sides of a surface, an epoch crossed its place [m]"
    )
    closing: float = Field(
        1.5, ge=0, description="columns out of sight between others up to twice this apart are filled [m]"
    )
    bins: int = Field(10, ge=2, description="bins of the height histogram, paper")
    top_quantile: float = Field(0.95, gt=0.5, le=1, description="h95, paper")
    outline: OutlineConfig = OutlineConfig()


@dataclass(frozen=True)
class Measures:
    """Differences, after minus before, in space that both epochs observed.

    Lengths [m], volumes [m3]; NaN where a side is empty. ``volume`` is the
    larger column volume of the two; ``seen_voxels`` the number that entered.
    ``carried`` is the share of the surface that is new (positive) or gone
    (negative) on balance, counting only places that the other epoch looked across.
    """

    iou: float
    d_perp: float
    delta_c: float
    delta_h: float
    delta_v: float
    delta_v_surface: float
    volume: float
    chi2: float
    gone_share: float
    new_share: float
    observed_fraction: float
    seen_voxels: int
    carried: float = 0.0
    outline: Outline = NO_OUTLINE


@dataclass(frozen=True)
class OpenGround:
    """Columns of the voxel grid in which an epoch met the ground, as sorted keys: nothing stands there."""

    before: Ints
    after: Ints


#: Nobody met the ground.
BUILT_UP = OpenGround(NO_COLUMNS, NO_COLUMNS)


def ground_columns(xyz: Floats, cell: float) -> Ints:
    """Return the sorted keys of the columns of ground points (N, 3)."""
    return np.unique(_column_keys(xyz, cell))


def _column_keys(xyz: Floats, cell: float) -> Ints:
    return voxel_keys(voxel_indices(xyz * (1.0, 1.0, 0.0), cell))


def measure(
    before: Voxels, after: Voxels, config: MeasureConfig, ground: OpenGround | None = None
) -> Measures:
    """Compare the voxels of one object in two epochs; either may be empty."""
    bare = ground or BUILT_UP
    seen_b, seen_a = before.select(before.seen), after.select(after.seen)
    lonely_b, lonely_a = int(np.count_nonzero(~seen_b.still)), int(np.count_nonzero(~seen_a.still))
    whole_b, whole_a = _completed(seen_b, seen_a), _completed(seen_a, seen_b)
    columns_b, columns_a = (
        columns_of(v, config.voxel, config.closing, bare_columns)
        for v, bare_columns in ((whole_b, bare.before), (whole_a, bare.after))
    )
    common = 0.5 * (len(seen_b) - lonely_b + len(seen_a) - lonely_a)
    both = len(before) > 0 and len(after) > 0
    return Measures(
        iou=common / max(common + lonely_b + lonely_a, 1e-9) if both else 0.0,
        d_perp=_separation(seen_b, seen_a, config),
        delta_c=_distance(whole_b, whole_a) if both else float("nan"),
        delta_h=_top(whole_a, config) - _top(whole_b, config) if both else float("nan"),
        delta_v=columns_a.volume - columns_b.volume,
        delta_v_surface=float(lonely_a - lonely_b) * config.voxel**3,
        volume=max(_whole_volume(c, v) for c, v in ((columns_b, whole_b), (columns_a, whole_a))),
        chi2=histogram_distance(seen_b.height, seen_a.height, config.bins),
        gone_share=lonely_b / max(len(seen_b), 1),
        new_share=lonely_a / max(len(seen_a), 1),
        observed_fraction=(len(seen_b) + len(seen_a)) / max(len(before) + len(after), 1),
        seen_voxels=len(seen_b) + len(seen_a),
        carried=_carried(seen_b, seen_a),
    )


def _carried(before: Voxels, after: Voxels) -> float:
    """Surface that is new less surface that is gone, relative to the mean surface of the two."""
    net = int(np.count_nonzero(after.crossed)) - int(np.count_nonzero(before.crossed))
    return net / max(0.5 * (len(before) + len(after)), 1.0)


def _completed(own: Voxels, other: Voxels) -> Voxels:
    """Add to an epoch's voxels those of the other epoch that it occupies too.

    Two samplings of one surface then differ only by what is new or gone, not
    by where the beams happened to fall (Decision 13).
    """
    shared = other.select(other.still)
    names = Voxels.__dataclass_fields__
    return Voxels(*(np.concatenate([getattr(own, name), getattr(shared, name)]) for name in names))


def _separation(before: Voxels, after: Voxels, config: MeasureConfig) -> float:
    """Median distance along the normal of *before* over the shared voxels [m]."""
    if len(before) == 0 or len(after) == 0:
        return float("nan")
    distance, slot = cKDTree(after.xyz).query(before.xyz, distance_upper_bound=config.tolerance)
    shared = np.isfinite(distance)
    if not shared.any():
        return float("nan")
    step = after.xyz[slot[shared]] - before.xyz[shared]
    return float(np.median(np.einsum("ij,ij->i", before.normal[shared], step)))


def _distance(before: Voxels, after: Voxels) -> float:
    if len(before) == 0 or len(after) == 0:
        return float("nan")
    return float(np.linalg.norm(after.xyz.mean(axis=0) - before.xyz.mean(axis=0)))


def _top(voxels: Voxels, config: MeasureConfig) -> float:
    return float(np.quantile(voxels.height, config.top_quantile)) if len(voxels) else float("nan")


@dataclass(frozen=True)
class Columns:
    """Columns between the ground and their tops: volume [m3] and area [m2]."""

    volume: float
    area: float


def columns_of(voxels: Voxels, cell: float, closing: float = 0.0, ground: Ints = NO_COLUMNS) -> Columns:
    """Volume and area of the columns that voxels stand in.

    Columns that nobody looked into, but that stand between others no more
    than twice ``closing`` [m] apart, are filled to the lower of these: a wing
    whose walls were seen has a volume although its roof was not. Where the
    epoch met the ground (``ground``, sorted keys) there is nothing to fill.
    """
    if len(voxels) == 0:
        return Columns(0.0, 0.0)
    index = np.floor(voxels.xyz[:, :2] / cell).astype(np.int64)
    margin = round(closing / cell)
    corner = index.min(axis=0) - margin
    index -= corner
    tops = np.zeros(tuple((index.max(axis=0) + 1 + margin).tolist()))
    np.maximum.at(tops, (index[:, 0], index[:, 1]), voxels.height)
    if margin > 0:
        bare = tops == 0.0
        middle = (np.argwhere(bare) + corner + 0.5) * cell
        bare[bare] = _among(_column_keys(np.column_stack([middle, np.zeros(len(middle))]), cell), ground)
        closed = ndimage.grey_closing(tops, size=(2 * margin + 1, 2 * margin + 1), mode="constant")
        tops = np.where(bare, 0.0, closed)
    return Columns(float(tops.sum()) * cell**2, float(np.count_nonzero(tops > 0)) * cell**2)


def _among(keys: Ints, known: Ints) -> NDArray[np.bool_]:
    """Tell which keys (N,) are among the known ones (M,), sorted: many, and the same for every object."""
    if len(known) == 0:
        return np.zeros(len(keys), dtype=bool)
    return np.asarray(known[np.minimum(np.searchsorted(known, keys), len(known) - 1)] == keys)


def _whole_volume(columns: Columns, voxels: Voxels) -> float:
    """Volume of a body of which a part was seen: its outline from above at its mean height [m3].

    Of most houses the street sees the front, half of the roof and no inside.
    """
    if columns.area == 0.0:
        return 0.0
    outline = float(shapely.MultiPoint(voxels.xyz[:, :2]).convex_hull.area)
    return columns.volume * max(1.0, outline / columns.area)


def histogram_distance(before: Floats, after: Floats, bins: int) -> float:
    """Chi-square distance, 0 to 1, of two height histograms over their common range."""
    if len(before) == 0 or len(after) == 0:
        return 1.0
    span = (min(before.min(), after.min()), max(before.max(), after.max()) + 1e-6)
    h, g = (np.histogram(v, bins, span)[0] / len(v) for v in (before, after))
    return float(0.5 * np.sum((h - g) ** 2 / np.maximum(h + g, 1e-12)))


def oriented_rectangle(xy: Floats) -> BaseGeometry:
    """Smallest-area rectangle around points (N, 2), at least 0.25 m wide."""
    hull = shapely.MultiPoint(xy).convex_hull.buffer(0.125, cap_style="square", join_style="mitre")
    return shapely.minimum_rotated_rectangle(hull)


def rectangle_iou(first: BaseGeometry, second: BaseGeometry) -> float:
    """Area of the intersection over the union of two footprints."""
    common = float(first.intersection(second).area)
    return common / max(float(first.area) + float(second.area) - common, 1e-9)


def footprint(parts: Sequence[Floats], cell: float = 0.5) -> BaseGeometry:
    """Outline [m] of the cells that points (N, 2) occupy, small gaps closed."""
    xy = np.concatenate(list(parts))
    cells = np.unique(np.floor(xy / cell).astype(np.int64), axis=0) * cell
    boxes = shapely.box(cells[:, 0], cells[:, 1], cells[:, 0] + cell, cells[:, 1] + cell)
    outline = shapely.union_all(boxes).buffer(cell, join_style="mitre").buffer(-cell, join_style="mitre")
    return outline.simplify(0.2 * cell)
