"""Stage: the vertical direction of an epoch without CRS, from the ground of all its tiles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_change.level_of_detection.common_frame import upright_turn
from subiaco_change.tiling.epoch_tiles import Side, TilePoints
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.frames import Floats
from subiaco_geo.work.tasks import Inputs


@dataclass(frozen=True)
class LevellingParams:
    """The epoch whose ``cloud/<tile>`` are levelled."""

    side: Side


@dataclass(frozen=True)
class Levelling:
    """Rotation (3, 3) that makes the streets of an epoch lie level, None where they do."""

    turn: Floats | None


def find_upright(inputs: Inputs, params: LevellingParams) -> Levelling:
    """Find the rotation that makes the streets of an epoch lie level."""
    thin = [
        voxel_downsample(PointCloud(inputs.of(TilePoints, f"cloud/{name}").xyz), 1.0).xyz
        for name in inputs.under("cloud")
    ]
    return Levelling(upright_turn(PointCloud(np.concatenate(thin), params.side.origin)))


def load_turn(inputs: Inputs) -> Floats | None:
    """Return the rotation of ``levelling``, None where the task rests on none or nothing is turned."""
    found = inputs.find(Levelling, "levelling")
    return None if found is None else found.turn
