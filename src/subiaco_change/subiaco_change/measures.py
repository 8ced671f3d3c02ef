"""What two matched objects differ by (method, part E, Decision 13)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree
from shapely.geometry.base import BaseGeometry
from subiaco_geo.config import StrictModel
from subiaco_geo.frames import Floats

from subiaco_change.objects import Voxels


class MeasureConfig(StrictModel):
    """Voxels and histograms of the measures."""

    voxel: float = Field(0.5, gt=0, description="edge of the voxels, paper [m]")
    tolerance: float = Field(
        0.5,
        gt=0,
        description="distance at which a voxel counts as occupied in both epochs: undoes voxel aliasing [m]",
    )
    bins: int = Field(10, ge=2, description="bins of the height histogram, paper")
    top_quantile: float = Field(0.95, gt=0.5, le=1, description="h95, paper")


@dataclass(frozen=True)
class Measures:
    """Differences, after minus before, in space that both epochs observed.

    Lengths [m], volumes [m3]; NaN where a side is empty. ``volume`` is the
    larger column volume of the two; ``seen_voxels`` the number that entered.
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


def measure(before: Voxels, after: Voxels, config: MeasureConfig) -> Measures:
    """Compare the voxels of one object in two epochs; either may be empty."""
    seen_b, seen_a = before.select(before.seen), after.select(after.seen)
    seen = len(seen_b) + len(seen_a)
    total = len(before) + len(after)
    iou, d_perp = _overlap(seen_b, seen_a, config)
    volume_b, volume_a, delta_v = column_volumes(seen_b, seen_a, config.voxel)
    lonely_b, lonely_a = np.count_nonzero(~seen_b.still), np.count_nonzero(~seen_a.still)
    return Measures(
        iou=iou,
        d_perp=d_perp,
        delta_c=_distance(seen_b, seen_a),
        delta_h=_top(seen_a, config) - _top(seen_b, config),
        delta_v=delta_v,
        delta_v_surface=float(lonely_a - lonely_b) * config.voxel**3,
        volume=max(volume_b, volume_a),
        chi2=histogram_distance(seen_b.height, seen_a.height, config.bins),
        gone_share=lonely_b / max(len(seen_b), 1),
        new_share=lonely_a / max(len(seen_a), 1),
        observed_fraction=seen / max(total, 1),
        seen_voxels=seen,
    )


def _overlap(before: Voxels, after: Voxels, config: MeasureConfig) -> tuple[float, float]:
    """Occupancy IoU, and the median distance along the normal of *before*, over the shared voxels."""
    if len(before) == 0 or len(after) == 0:
        return 0.0, float("nan")
    tree = cKDTree(after.xyz)
    distance, slot = tree.query(before.xyz)
    shared = distance <= config.tolerance
    back = cKDTree(before.xyz).query(after.xyz)[0] <= config.tolerance
    common = 0.5 * (np.count_nonzero(shared) + np.count_nonzero(back))
    iou = common / (len(before) + len(after) - common)
    if not shared.any():
        return float(iou), float("nan")
    step = after.xyz[slot[shared]] - before.xyz[shared]
    return float(iou), float(np.median(np.einsum("ij,ij->i", before.normal[shared], step)))


def _distance(before: Voxels, after: Voxels) -> float:
    if len(before) == 0 or len(after) == 0:
        return float("nan")
    return float(np.linalg.norm(after.xyz.mean(axis=0) - before.xyz.mean(axis=0)))


def _top(voxels: Voxels, config: MeasureConfig) -> float:
    return float(np.quantile(voxels.height, config.top_quantile)) if len(voxels) else float("nan")


def column_volumes(before: Voxels, after: Voxels, cell: float) -> tuple[float, float, float]:
    """Volumes under the tops of the columns [m3], and their difference.

    A column that only one epoch has, and whose top the other epoch still
    occupies, is a gap in the sampling: it does not count as a difference.
    """
    top_b, top_a = _column_tops(before, cell), _column_tops(after, cell)
    volume_b = sum(top for top, _ in top_b.values()) * cell**2
    volume_a = sum(top for top, _ in top_a.values()) * cell**2
    delta = 0.0
    for key in sorted(top_b.keys() | top_a.keys()):
        if key in top_b and key in top_a:
            delta += top_a[key][0] - top_b[key][0]
        elif key in top_a:
            delta += 0.0 if top_a[key][1] else top_a[key][0]
        else:
            delta -= 0.0 if top_b[key][1] else top_b[key][0]
    return volume_b, volume_a, delta * cell**2


def _column_tops(voxels: Voxels, cell: float) -> dict[tuple[int, int], tuple[float, bool]]:
    """Height of the highest voxel of every column, and whether the other epoch still has it."""
    index = np.floor(voxels.xyz[:, :2] / cell).astype(np.int64)
    order = np.lexsort((voxels.height, index[:, 1], index[:, 0]))
    tops = {}
    for i in order.tolist():
        tops[(int(index[i, 0]), int(index[i, 1]))] = (
            max(float(voxels.height[i]), 0.0),
            bool(voxels.still[i]),
        )
    return tops


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


def padded_bounds(xyz: NDArray[np.float64], pad: float) -> tuple[float, float, float, float]:
    """West, south, east, north of points (N, 3), widened [m]."""
    low, high = xyz[:, :2].min(axis=0) - pad, xyz[:, :2].max(axis=0) + pad
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
