"""Contiguous changed cells as rows of the table, and labels for every point."""

from __future__ import annotations

import math

import numpy as np
import shapely
from scipy import ndimage

from subiaco_change.records import ChangeRecord
from subiaco_change.segmentation.ground_model import Mask
from subiaco_evaluation.baselines.cells import CellVerdict, Codes, EpochCells, Pair
from subiaco_evaluation.config import BaselineConfig
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import CHANGED, ONE_EPOCH, Change, Semantic
from subiaco_geo.frames import Floats, Ints


def connect(code: Codes) -> tuple[Ints, list[Change]]:
    """Return contiguous cells of one label as numbers (rows, columns), -1 elsewhere, and their labels."""
    number = np.full(code.shape, -1, dtype=np.int64)
    names: list[Change] = []
    for change in CHANGED:
        labels, count = ndimage.label(code == change, structure=np.ones((3, 3)))
        number[labels > 0] = labels[labels > 0] + len(names) - 1
        names += [change] * count
    return number, names


def label_points(
    pair: Pair, verdict: CellVerdict, number: Ints, config: BaselineConfig
) -> tuple[PointCloud, ...]:
    """Give the points of both epochs the labels of their cells."""
    sides = (pair.before, pair.after)
    return tuple(_label(side, epoch, pair, verdict, number, config) for epoch, side in enumerate(sides))


def _label(
    side: EpochCells, epoch: int, pair: Pair, verdict: CellVerdict, number: Ints, config: BaselineConfig
) -> PointCloud:
    code = verdict.code.ravel()[side.cell]
    takes = np.ones(len(side.cell), dtype=bool)
    if config.cells.paint == "surface":
        takes = _of_surface(side, epoch, pair, code) | (code >= Change.UNCHANGED)
    fields = {name: side.cloud.fields[name] for name in ("intensity", "normals") if name in side.cloud.fields}
    return PointCloud(side.cloud.xyz, side.cloud.origin, side.cloud.crs, fields).with_fields(
        change=np.where(takes, code, Change.UNCHANGED).astype(np.uint8),
        semantic=np.where(side.thing, Semantic.OTHER, Semantic.GROUND).astype(np.uint8),
        instance=np.where(takes, number.ravel()[side.cell], -1).astype(np.int32),
        confidence=verdict.confidence.ravel()[side.cell].astype(np.float32),
        lod95=verdict.lod95.ravel()[side.cell].astype(np.float32),
    )


def _of_surface(side: EpochCells, epoch: int, pair: Pair, code: Codes) -> Mask:
    """Tell which points belong to what changed: the things of a cell, or its ground where it has none."""
    things = (pair.before.things + pair.after.things > 0).ravel()[side.cell]
    gone_or_new = np.where(code == Change.ADDED, epoch == 1, (code != Change.REMOVED) | (epoch == 0))
    return np.asarray((side.thing | ~things) & gone_or_new)


def make_records(
    pair: Pair,
    verdict: CellVerdict,
    number: Ints,
    names: list[Change],
    clouds: tuple[PointCloud, ...],
    method: str,
) -> tuple[ChangeRecord, ...]:
    """Return a row for every contiguous change."""
    counts = [
        np.bincount(np.asarray(c.fields["instance"]).astype(np.int64) + 1, minlength=len(names) + 1)[1:]
        for c in clouds
    ]
    cells = np.flatnonzero(number.ravel() >= 0)
    order = np.argsort(number.ravel()[cells], kind="stable")
    groups = np.split(cells[order], np.cumsum(np.bincount(number.ravel()[cells], minlength=len(names)))[:-1])
    return tuple(
        _record(i, names[i], groups[i], pair, verdict, (int(counts[0][i]), int(counts[1][i])), method)
        for i in range(len(names))
    )


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else math.nan


def _record(
    number: int,
    change: Change,
    cells: Ints,
    pair: Pair,
    verdict: CellVerdict,
    counts: tuple[int, int],
    method: str,
) -> ChangeRecord:
    rise = pair.rise.ravel()[cells]
    seen = np.isfinite(rise)
    tops = np.fmax(pair.before.top.ravel()[cells], pair.after.top.ravel()[cells])
    ground = (pair.before.things + pair.after.things).ravel()[cells].sum() == 0
    outline = _outline(cells, pair)
    area = len(cells) * pair.grid.cell**2
    return ChangeRecord(
        object_id=number,
        semantic=Semantic.GROUND if ground else Semantic.OTHER,
        change=change,
        id_before=(number,) if counts[0] else (),
        id_after=(number,) if counts[1] else (),
        match_kind="none" if change in ONE_EPOCH else "one_to_one",
        delta_h_m=_median(rise),
        delta_v_m3=float(rise[seen].sum() * pair.grid.cell**2) if seen.any() else math.nan,
        delta_v_surface_m3=math.nan,
        delta_c_m=math.nan,
        iou_3d=math.nan,
        d_perp_m=_median(verdict.distance.ravel()[cells]),
        lod95_m=_median(verdict.lod95.ravel()[cells]),
        observed_fraction=float(seen.mean()),
        evidence="assumed",
        score_paper=math.nan,
        confidence=float(verdict.confidence.ravel()[cells].mean()),
        n_before=counts[0],
        n_after=counts[1],
        x=outline.centroid.x,
        y=outline.centroid.y,
        z=_median(tops) + float(pair.after.cloud.origin[2]),
        footprint=outline,
        reason=f"{method}: {area:.2f} m2 of contiguous cells",
    )


def _outline(cells: Ints, pair: Pair) -> shapely.Geometry:
    """Return the union of cells in world coordinates."""
    row, column = np.divmod(cells, pair.grid.shape[1])
    low = np.column_stack([column, row]) * pair.grid.cell + pair.grid.corner + pair.after.cloud.origin[:2]
    low = np.round(low / pair.grid.cell) * pair.grid.cell
    return shapely.union_all(shapely.box(*low.T, *(low + pair.grid.cell).T))
