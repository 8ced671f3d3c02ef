"""The field of view that the points of a whole epoch need of its sensor, tile by tile."""

import numpy as np
import pytest

from subiaco_change.tiling.epoch_preparation import NeedsParams, RenderParams, find_needs, render_tile
from subiaco_change.tiling.epoch_tiles import EpochContext, TilePoints
from subiaco_geo.frames import make_pose
from subiaco_geo.free_space.expected_visibility import ExpectedVisibilityConfig
from subiaco_geo.free_space.view_estimation import estimate_view
from subiaco_geo.tiles import split_by_tile
from subiaco_geo.work.results import pack
from subiaco_geo.work.store import MemoryStore
from subiaco_geo.work.tasks import Inputs

CONFIG = ExpectedVisibilityConfig()
SIZE = 100.0
TRUE_DEG = 4.0


def street():
    """Points (N, 3) of a road along x and of a wall beside it as far up as 4 deg reach; poses to x = 110 m.

    The drive ends 10 m behind the border of two tiles, beside the wall of the second tile.
    """
    road = np.stack(np.meshgrid(np.arange(50, 125, 0.3), np.arange(-8, 12, 0.3)), -1).reshape(-1, 2)
    wall = np.stack(np.meshgrid(np.arange(101, 112, 0.25), np.arange(0, 8, 0.1)), -1).reshape(-1, 2)
    wall = np.column_stack([wall[:, 0], np.full(len(wall), 12.0), wall[:, 1]])
    x = np.arange(60.0, 111.0, 2.0)
    eyes = np.column_stack([x, np.zeros(len(x)), np.full(len(x), 2.0)])
    way = wall[:, None] - eyes[None]
    rise = np.degrees(np.arcsin(way[..., 2] / np.linalg.norm(way, axis=2)))
    seen = wall[(rise <= TRUE_DEG).any(axis=1)]
    return np.vstack([np.column_stack([road, np.zeros(len(road))]), seen]), make_pose(
        np.tile(np.eye(3), (len(x), 1, 1)), eyes
    )


def test_points_at_the_border_of_a_tile_are_seen_by_the_poses_of_the_next_tile():
    """The poses beside the wall would need 14 deg; those in the other tile show that 4 deg suffice."""
    points, poses = street()
    side = EpochContext("before", np.zeros(3), None, "trajectory", None, np.full(3, -10.0), 0.5, 0.25)
    store, keys = MemoryStore(), {}
    for name, index in split_by_tile(points, SIZE).items():
        keys[f"cloud/{name}"] = f"cloud-{name}"
        store.save(f"cloud-{name}", pack(TilePoints(points[index])))
    clouds = dict(keys)
    for name, index in split_by_tile(poses[:, :3, 3], SIZE).items():
        params = RenderParams(name, SIZE, side, CONFIG, poses[index], np.zeros(len(index)), 0.9)
        store.save(f"views-{name}", pack(render_tile(Inputs(store, clouds), params)))
        keys[f"views/{name}"] = f"views-{name}"
    tile = max(split_by_tile(points, SIZE))
    cloud, views = (
        {k: v for k, v in keys.items() if k.startswith(start)} for start in (f"cloud/{tile}", "views/")
    )
    whole, alone = cloud | views, cloud | {f"views/{tile}": views[f"views/{tile}"]}
    params = NeedsParams(tile, side, CONFIG, 0.9)
    found, own = (
        np.degrees(estimate_view([find_needs(Inputs(store, chosen), params)], CONFIG).elevation_max)
        for chosen in (whole, alone)
    )
    assert found == pytest.approx(TRUE_DEG, abs=1.1)
    assert own > 10.0
