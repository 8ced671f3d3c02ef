"""Ghost trails in the tiles of a cloud without counts and times of beams."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_change.method_rules.switches import obeys_rules
from subiaco_change.segmentation.classes import SemanticsConfig
from subiaco_change.segmentation.ghost_trails import trail_probability
from subiaco_change.segmentation.ground_model import fit_ground
from subiaco_change.segmentation.raised_surfaces import find_raised
from subiaco_change.tiling.epoch_tiles import Side, TilePoints
from subiaco_change.tiling.levelling import load_turn
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.tiles import tile_named
from subiaco_geo.work.tasks import Inputs

#: Surroundings in which the length of a trail is measured [m].
AROUND = 50.0


@dataclass(frozen=True)
class TrailParams:
    """Parameters of the search for ghost trails; the lengths of ``semantics`` are those for this epoch."""

    tile: str
    size: float
    side: Side
    semantics: SemanticsConfig
    rules_off: tuple[str, ...]


@dataclass(frozen=True)
class TileTrails:
    """Probability (N,) that each point of a tile, in their order, was left by a moving object."""

    moved: NDArray[np.float32]


@obeys_rules
def find_trails(inputs: Inputs, params: TrailParams) -> TileTrails:
    """Find how probable it is that the points of a tile were left by a moving vehicle, by their shape.

    ``inputs`` hold ``cloud/<tile>`` of the tile and its neighbours, and ``levelling`` for local clouds.
    """
    side, config = params.side, params.semantics
    tile = tile_named(params.tile, params.size, AROUND)
    own = inputs.of(TilePoints, f"cloud/{params.tile}").xyz
    others = [
        inputs.of(TilePoints, f"cloud/{name}").xyz for name in inputs.under("cloud") if name != params.tile
    ]
    xyz = np.concatenate([own, *(part[tile.in_buffered(part[:, :2] + side.origin[:2])] for part in others)])
    turn = load_turn(inputs)
    if turn is not None:
        xyz = xyz @ turn.T
    ground = fit_ground(xyz, config.ground, find_raised(xyz, config.raised))
    height = xyz[:, 2] - ground.height(xyz[:, :2])
    moved = trail_probability(xyz, height, config.trail_shape)
    return TileTrails(moved[: len(own)].astype(np.float32))


def load_moved(inputs: Inputs, tile: str, names: Sequence[str], where: Sequence[Ints]) -> Floats | None:
    """Put together what :func:`find_trails` left of a tile and of places of its neighbours, if anything."""
    if not inputs.under("trails"):
        return None
    parts = [inputs.of(TileTrails, f"trails/{tile}").moved]
    parts += [
        inputs.of(TileTrails, f"trails/{name}").moved[index] for name, index in zip(names, where, strict=True)
    ]
    return np.concatenate(parts).astype(np.float64)
