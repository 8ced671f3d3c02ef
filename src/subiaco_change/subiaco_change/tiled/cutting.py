"""Epochs cut into tiles, points and beams alike, and put together again around a place."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_change.observation.evidence import EvidenceConfig, Kind, Observer, make_observer
from subiaco_geo.clouds import PointCloud, unpack_voxel_keys
from subiaco_geo.crs import transformer
from subiaco_geo.frames import Floats
from subiaco_geo.maps import SurveyMap
from subiaco_geo.tiles import split_by_tile
from subiaco_geo.visibility import VisibilityGrid
from subiaco_geo.work.bench import Workbench
from subiaco_geo.work.store import Arrays
from subiaco_geo.work.tasks import Inputs

#: Fields of points that a run reads, where they are there.
FIELDS = ("intensity", "semantic", "instance")


@dataclass(frozen=True)
class Side:
    """What every task must know of one epoch.

    Parameters
    ----------
    epoch : str
        ``before`` or ``after``.
    origin : (3,) float64
        Of its points, in world coordinates [m].
    crs : str or None
        Of the pair.
    kind : str
        Of its evidence (see :class:`~subiaco_change.observation.evidence.Observer`).
    beams_crs : str or None
        CRS in which its beams are counted, where it is not that of the pair.
    corner : (3,) float64
        Origin of its voxels of beams [m].
    voxel : float
        Their edge [m].
    """

    epoch: str
    origin: Floats
    crs: str | None
    kind: Kind
    beams_crs: str | None
    corner: Floats
    voxel: float


def cut_cloud(bench: Workbench, stage: str, cloud: PointCloud, size: float) -> dict[str, str]:
    """Keep the points of every tile of the world; return keys by tile."""
    keys = {}
    for name, members in split_by_tile(cloud.xyz[:, :2] + cloud.origin[:2], size).items():
        fields = {field: cloud.fields[field][members] for field in FIELDS if field in cloud.fields}
        keys[name] = bench.put(stage, name, {"xyz": cloud.xyz[members], **fields})
    return keys


def cut_beams(bench: Workbench, stage: str, grid: VisibilityGrid, size: float) -> dict[str, str]:
    """Keep the voxels of beams of every tile; return keys by tile."""
    centres = (unpack_voxel_keys(grid.keys)[:, :2] + 0.5) * grid.voxel + grid.origin[:2]
    return {
        name: bench.put(stage, name, {"keys": grid.keys[m], "hits": grid.hits[m], "passes": grid.passes[m]})
        for name, m in split_by_tile(centres, size).items()
    }


def join(parts: Iterable[Arrays], names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """Concatenate arrays of pieces, field by field; a field counts where all have it."""
    opened = list(parts)
    return {
        name: np.concatenate([part[name] for part in opened])
        for name in names
        if opened and all(name in part for part in opened)
    }


def no_beams(corner: Floats, voxel: float) -> VisibilityGrid:
    """Return the grid of an epoch that saw nothing."""
    none = np.zeros(0, dtype=np.uint32)
    return VisibilityGrid(corner, voxel, np.zeros(0, dtype=np.int64), none, none)


def load_beams(inputs: Inputs, alias: str, corner: Floats, voxel: float) -> VisibilityGrid:
    """Put the tiles of beams under ``alias/`` together."""
    found = join((inputs[f"{alias}/{name}"] for name in inputs.under(alias)), ("keys", "hits", "passes"))
    if not found:
        return no_beams(corner, voxel)
    order = np.argsort(found["keys"], kind="stable")
    return VisibilityGrid(corner, voxel, found["keys"][order], found["hits"][order], found["passes"][order])


def load_observer(inputs: Inputs, side: Side, points: Floats, config: EvidenceConfig) -> Observer:
    """Build the observer of an epoch around a place.

    Parameters
    ----------
    inputs : Inputs
        Beams under ``beams/<epoch>/``.
    side : Side
    points : (N, 3) float64
        Points of the epoch around, in its world coordinates: what shadow tests rest on.
    config : EvidenceConfig
    """
    cloud = PointCloud(points - side.origin, side.origin, side.crs)
    kind = "observed" if side.kind == "trajectory" else side.kind
    least = 1 if side.kind == "trajectory" else config.min_beams
    if kind == "shadow" and len(cloud) == 0:  # nothing stands around, nothing was seen
        kind = "observed"
    grid = load_beams(inputs, f"beams/{side.epoch}", side.corner, side.voxel) if kind == "observed" else None
    asked = config.model_copy(update={"source": kind, "min_beams": least})
    back = None if side.beams_crs is None else transformer(str(side.crs), side.beams_crs).apply
    found = make_observer(SurveyMap(cloud, visibility=grid), asked, back)
    return Observer(side.kind, found.test, found.to_own)


def tiles_between(low: Floats, high: Floats, size: float) -> list[str]:
    """Return the tiles that a box (2,), (2,) [m, world] touches."""
    first, last = np.floor(low / size).astype(int), np.floor(high / size).astype(int)
    return [
        f"{column}_{row}" for column in range(first[0], last[0] + 1) for row in range(first[1], last[1] + 1)
    ]
