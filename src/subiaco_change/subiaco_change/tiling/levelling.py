"""Stage: the vertical direction of an epoch without CRS, from the ground of all its tiles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from subiaco_change.level_of_detection.common_frame import upright_turn
from subiaco_change.tiling.epoch_tiles import Side
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.work.store import Arrays
from subiaco_geo.work.tasks import Inputs


def find_upright(inputs: Inputs, params: Mapping[str, Any]) -> Arrays:
    """Find the rotation that makes the streets of an epoch lie level: ``turn`` (3, 3), if any."""
    side: Side = params["side"]
    thin = [
        voxel_downsample(PointCloud(np.asarray(inputs[f"cloud/{name}"]["xyz"])), 1.0).xyz
        for name in inputs.under("cloud")
    ]
    turn = upright_turn(PointCloud(np.concatenate(thin), side.origin))
    return {} if turn is None else {"turn": turn}
