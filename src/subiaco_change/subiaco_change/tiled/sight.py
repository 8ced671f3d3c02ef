"""What tiles must know beforehand: lines of sight where beams were not counted, and which way is up."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from subiaco_change.observation.common_frame import upright_turn
from subiaco_change.observation.evidence import draw_lines_of_sight
from subiaco_change.tiled.cutting import Side
from subiaco_geo.clouds import PointCloud, unpack_voxel_keys, voxel_downsample
from subiaco_geo.tiles import tile_named
from subiaco_geo.work.store import Arrays
from subiaco_geo.work.tasks import Inputs


def draw_tile(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Draw the lines of sight that cross a tile of an epoch, from its trajectory.

    Parameters
    ----------
    inputs : Inputs
        ``cloud/<tile>`` as far around as a line may be long; ``trajectory``.
    params : mapping
        ``tile size side config``, the configuration of the evidence.

    Returns
    -------
    arrays
        ``keys hits passes`` of the voxels of the tile, as beams counted by mapping.
    """
    side: Side = params["side"]
    config = params["config"]
    tile = tile_named(params["tile"], params["size"], config.max_range)
    world = np.concatenate([inputs[f"cloud/{n}"]["xyz"] for n in inputs.under("cloud")]) + side.origin
    world = world[tile.in_buffered(world[:, :2])]
    grid = draw_lines_of_sight(world, inputs["trajectory"]["positions"], config, side.corner)
    centres = (unpack_voxel_keys(grid.keys)[:, :2] + 0.5) * grid.voxel + grid.origin[:2]
    inside = tile.in_core(centres)
    return {"keys": grid.keys[inside], "hits": grid.hits[inside], "passes": grid.passes[inside]}


def find_upright(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Find the rotation that makes the streets of an epoch lie level: ``turn`` (3, 3), if any."""
    side: Side = params["side"]
    thin = [
        voxel_downsample(PointCloud(np.asarray(inputs[f"cloud/{name}"]["xyz"])), 1.0).xyz
        for name in inputs.under("cloud")
    ]
    turn = upright_turn(PointCloud(np.concatenate(thin), side.origin))
    return {} if turn is None else {"turn": turn}
