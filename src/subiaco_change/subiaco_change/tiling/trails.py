"""Ghost trails in the tiles of a cloud without counts and times of beams."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from subiaco_change.segmentation.ground_model import fit_ground
from subiaco_change.segmentation.raised_surfaces import find_raised
from subiaco_change.segmentation.trail_shape import trail_probability
from subiaco_change.tiling.epoch_tiles import Side
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.tiles import tile_named
from subiaco_geo.work.store import Arrays
from subiaco_geo.work.tasks import Inputs

#: Surroundings in which the length of a trail is measured [m].
AROUND = 50.0


def find_trails(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Tell how probable it is that the points of a tile were left by a moving vehicle, by their shape.

    Parameters
    ----------
    inputs : Inputs
        ``cloud/<tile>`` of the tile and its neighbours; ``levelling`` for local clouds.
    params : mapping
        ``tile size side semantics``: the configuration of the semantics, its lengths for this epoch.

    Returns
    -------
    arrays
        ``moved`` (N,) float32 of the points of the tile, in their order.
    """
    side: Side = params["side"]
    config = params["semantics"]
    tile = tile_named(params["tile"], params["size"], AROUND)
    own = inputs[f"cloud/{params['tile']}"]["xyz"]
    others = [inputs[f"cloud/{name}"]["xyz"] for name in inputs.under("cloud") if name != params["tile"]]
    xyz = np.concatenate([own, *(part[tile.in_buffered(part[:, :2] + side.origin[:2])] for part in others)])
    turn = inputs.get("levelling")
    if "turn" in turn:
        xyz = xyz @ turn["turn"].T
    ground = fit_ground(xyz, config.ground, find_raised(xyz, config.raised))
    height = xyz[:, 2] - ground.height(xyz[:, :2])
    moved = trail_probability(xyz, height, config.trail_shape)
    return {"moved": moved[: len(own)].astype(np.float32)}


def load_moved(inputs: Inputs, tile: str, names: Sequence[str], where: Sequence[Ints]) -> Floats | None:
    """Put together what :func:`find_trails` left of a tile and of places of its neighbours, if anything."""
    if not inputs.under("trails"):
        return None
    parts = [inputs[f"trails/{tile}"]["moved"]]
    parts += [inputs[f"trails/{name}"]["moved"][index] for name, index in zip(names, where, strict=True)]
    return np.concatenate(parts).astype(np.float64)
