"""Stage: labelled points of an epoch, cut by the tiles of the common frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_change.segmentation.ground_model import Mask
from subiaco_change.tiling.epoch_tiles import Side
from subiaco_change.tiling.frame_arrays import in_frame, load_frame
from subiaco_change.tiling.instance_merging import object_numbers
from subiaco_geo.clouds import PointCloud
from subiaco_geo.tiles import tile_named
from subiaco_geo.work.store import Arrays
from subiaco_geo.work.tasks import Inputs

_PREPARED = ("normals", "semantic", "score", "height", "passed", "moved")


def recut_tile(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Take those points of an epoch that the registration brings into a tile.

    Parameters
    ----------
    inputs : Inputs
        ``cloud/<tile> prepared/<tile>`` of the epoch's own tiles, ``united``, ``registration``.
    params : mapping
        ``tile size side origin``.

    Returns
    -------
    arrays
        In the epoch's own frame ``xyz`` (N, 3) float64 and ``normals`` (N, 3) float32; ``semantic``
        uint8; ``score height passed moved`` float32; ``number`` int32, object of the epoch, -1 for none;
        ``intensity`` where known.
    """
    side: Side = params["side"]
    frame = load_frame(inputs, params["origin"])
    tile = tile_named(params["tile"], params["size"], 0.0)
    columns: dict[str, list[NDArray[Any]]] = {}
    for name in inputs.under("cloud"):
        cloud, prepared = inputs[f"cloud/{name}"], inputs[f"prepared/{name}"]
        inside = tile.in_core(in_frame(cloud["xyz"], side, frame).world()[:, :2])
        values = {field: cloud[field] for field in ("xyz", "intensity") if field in cloud}
        values |= {field: prepared[field] for field in _PREPARED}
        values["number"] = object_numbers(inputs, name, len(inside))
        for field, column in values.items():
            columns.setdefault(field, []).append(column[inside] if len(column) == len(inside) else column)
    return {field: np.concatenate(parts) for field, parts in columns.items()}


def place_tile(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Bring the points of a tile into the common frame, once for all that follows: ``xyz normals``."""
    side: Side = params["side"]
    piece = inputs[f"points/{side.epoch}/{params['tile']}"]
    cloud = in_frame(piece["xyz"], side, load_frame(inputs, params["origin"]), piece["normals"])
    return {"xyz": cloud.xyz, "normals": np.asarray(cloud.fields["normals"], dtype=np.float32)}


def load_points(inputs: Inputs, side: Side, tile: str, params: Mapping[str, Any]) -> PointCloud:
    """Points of a tile in the common frame, with normals.

    From ``placed/<epoch>/<tile>`` where they were brought there; else from ``points`` and the frame.
    """
    alias = f"{side.epoch}/{tile}"
    if f"placed/{alias}" in inputs:
        piece = inputs[f"placed/{alias}"]
        normals = np.asarray(piece["normals"], dtype=np.float64)
        return PointCloud(piece["xyz"], np.asarray(params["origin"]), side.crs, {"normals": normals})
    piece = inputs[f"points/{alias}"]
    return in_frame(piece["xyz"], side, load_frame(inputs, params["origin"]), piece["normals"])


def near_tile(tile: str, rim: float, params: Mapping[str, Any]) -> Any:
    """Tell which places (N, 3) of the common frame lie in a tile or within ``rim`` [m] of it."""
    square = tile_named(tile, params["size"], rim)
    origin = np.asarray(params["origin"])

    def near(xyz: NDArray[np.float64]) -> Mask:
        return square.in_buffered(xyz[:, :2] + origin[:2])

    return near
