"""Stage: labelled points of an epoch, cut by the tiles of the common frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.tiling.epoch_tiles import Side, TilePoints
from subiaco_change.tiling.instance_merging import object_numbers
from subiaco_change.tiling.stored_frame import in_frame, load_frame
from subiaco_change.tiling.tile_segmentation import TileSegmentation
from subiaco_geo.clouds import PointCloud
from subiaco_geo.frames import Floats
from subiaco_geo.tiles import tile_named
from subiaco_geo.work.tasks import Inputs

_PREPARED = ("normals", "semantic", "score", "height", "passed", "moved")


@dataclass(frozen=True)
class EpochTileParams:
    """Parameters of a stage that looks at one epoch; ``origin`` (3,) is that of the common frame [m]."""

    tile: str
    size: float
    side: Side
    origin: Floats


@dataclass(frozen=True)
class LabelledPoints:
    """Points of an epoch in a tile of the common frame, in the epoch's own frame.

    ``xyz`` (N, 3) [m]; ``normals`` (N, 3); ``semantic`` (N,); ``score`` (N,) of the class; ``height`` (N,)
    above ground [m]; ``passed`` and ``moved`` (N,), empty where not known; ``number`` (N,), object,
    -1 for none; ``intensity`` (N,) where known.
    """

    xyz: Floats
    normals: NDArray[np.float32]
    semantic: NDArray[np.uint8]
    score: NDArray[np.float32]
    height: NDArray[np.float32]
    passed: NDArray[np.float32]
    moved: NDArray[np.float32]
    number: NDArray[np.int32]
    intensity: NDArray[Any] | None


@dataclass(frozen=True)
class PlacedPoints:
    """Points (N, 3) [m] of a tile in the common frame, and their normals (N, 3)."""

    xyz: Floats
    normals: NDArray[np.float32]


def recut_tile(inputs: Inputs, params: EpochTileParams) -> LabelledPoints:
    """Take those points of an epoch that the registration brings into a tile.

    ``inputs`` hold ``cloud/<tile> prepared/<tile>`` of the epoch's own tiles, ``united``, ``registration``.
    """
    frame = load_frame(inputs, params.origin)
    tile = tile_named(params.tile, params.size, 0.0)
    columns: dict[str, list[NDArray[Any]]] = {}
    names = inputs.under("cloud")
    for name in names:
        cloud = inputs.of(TilePoints, f"cloud/{name}")
        prepared = inputs.of(TileSegmentation, f"prepared/{name}")
        inside = tile.in_core(in_frame(cloud.xyz, params.side, frame).world()[:, :2])
        values: dict[str, NDArray[Any]] = {field: getattr(prepared, field) for field in _PREPARED}
        values |= {"xyz": cloud.xyz, "number": object_numbers(inputs, name, len(inside))}
        if cloud.intensity is not None:
            values["intensity"] = cloud.intensity
        for field, column in values.items():
            columns.setdefault(field, []).append(column[inside] if len(column) == len(inside) else column)
    whole: dict[str, Any] = {field: np.concatenate(parts) for field, parts in columns.items()}
    lit = len(columns.get("intensity", [])) == len(names)
    return LabelledPoints(**{**whole, "intensity": whole["intensity"] if lit else None})


def place_tile(inputs: Inputs, params: EpochTileParams) -> PlacedPoints:
    """Bring the points of a tile into the common frame, once for all that follows."""
    piece = inputs.of(LabelledPoints, f"points/{params.side.epoch}/{params.tile}")
    cloud = in_frame(
        piece.xyz, params.side, load_frame(inputs, params.origin), piece.normals.astype(np.float64)
    )
    return PlacedPoints(cloud.xyz, np.asarray(cloud.fields["normals"], dtype=np.float32))


def load_points(inputs: Inputs, side: Side, tile: str, origin: Floats) -> PointCloud:
    """Points of a tile in the common frame, with normals.

    From ``placed/<epoch>/<tile>`` where they were brought there; else from ``points`` and the frame.
    """
    alias = f"{side.epoch}/{tile}"
    placed = inputs.find(PlacedPoints, f"placed/{alias}")
    if placed is not None:
        return PointCloud(placed.xyz, origin, side.crs, {"normals": np.asarray(placed.normals, np.float64)})
    piece = inputs.of(LabelledPoints, f"points/{alias}")
    return in_frame(piece.xyz, side, load_frame(inputs, origin), piece.normals.astype(np.float64))


def near_tile(tile: str, rim: float, size: float, origin: Floats) -> Callable[[Floats], Mask]:
    """Tell which places (N, 3) of the common frame lie in a tile or within ``rim`` [m] of it."""
    square = tile_named(tile, size, rim)

    def near(xyz: Floats) -> Mask:
        return square.in_buffered(xyz[:, :2] + origin[:2])

    return near
