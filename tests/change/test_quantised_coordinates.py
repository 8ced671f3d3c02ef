"""Coordinates that lie exactly on the rims of tiles and cells, as those of LAS files do."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from subiaco_change.decisions.ground_cells import GroundChangeConfig, difference_cells
from subiaco_change.objects.voxel_objects import EpochView
from subiaco_change.segmentation.ground_model import GroundConfig, fit_ground
from subiaco_change.tiling.ground_stage import _RIM, _window
from subiaco_change.tiling.retiling import near_tile
from subiaco_evaluation.baselines.cells import common_grid
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Semantic
from subiaco_geo.tiles import tile_named

ORIGINS = st.tuples(
    st.floats(-1e6, 1e6),
    st.floats(-1e7, 1e7),
    st.floats(-100, 1000),
    st.sampled_from([1e-3, 1e-2, 0.1, 0.25]),
)


def ground_view(xyz):
    """An epoch that is all ground."""
    n = len(xyz)
    return EpochView(
        xyz, np.tile([0.0, 0.0, 1.0], (n, 1)), np.full(n, Semantic.GROUND, dtype=np.uint8),
        np.full(n, -1, dtype=np.int32), np.zeros(n), np.full(n, 0.03), np.ones(n),
    )  # fmt: skip


def on_the_rim(tile, step, rise):
    """World coordinates (N, 3), whole steps, along the rim and the middle of a buffered tile."""
    low, high = np.array(tile.buffered[:2]), np.array(tile.buffered[2:])
    side = np.unique(np.round(np.concatenate([low, high, np.linspace(low, high, 41).ravel()]) / step)) * step
    x, y = np.meshgrid(side, side)
    xy = np.column_stack([x.ravel(), y.ravel()])
    return np.column_stack([xy, np.full(len(xy), rise)])


@settings(max_examples=25, deadline=None)
@given(drawn=ORIGINS, local=st.floats(-500.0, 500.0), seed=st.integers(0, 10**6))
def test_ground_on_the_rim_of_a_tile_is_compared_wherever_the_origin_lies(drawn, local, seed):
    """The same flat ground, whole steps apart, 0.3 m higher in *after*.

    A transformation to the common frame leaves the local coordinates wrong in digits that world
    coordinates do not have.
    """
    rng = np.random.default_rng(seed)
    east, north, _, step = drawn
    name = f"{int(east // 80)}_{int(north // 80)}"
    tile = tile_named(name, 80.0, _RIM)
    origin = np.array([tile.core[0] + local, tile.core[1] - local, 0.0])
    near = near_tile(name, _RIM, 80.0, origin)
    views = []
    for rise in (0.0, 0.3):
        world = on_the_rim(tile, step, rise)
        digit = np.spacing(np.abs(world)) * rng.uniform(-0.5, 0.5, world.shape)
        xyz = (world - origin) + digit * [1.0, 1.0, 0.0]
        views.append(ground_view(xyz[near(xyz)]))
    corner, shape, _ = _window(tile, origin, GroundChangeConfig())
    cells = difference_cells(*views, corner, shape, GroundChangeConfig())
    assert cells.dz.shape == shape
    known = np.isfinite(cells.dz)
    assert known.any()
    assert cells.dz[known] == pytest.approx(0.3, abs=1e-9)


@settings(max_examples=20, deadline=None)
@given(drawn=ORIGINS)
def test_whole_steps_on_the_rim_of_a_grid_fall_into_its_cells(drawn):
    east, north, height, step = drawn
    index = np.arange(-20, 21)
    xy = (
        np.stack(np.meshgrid(index, index), axis=-1).reshape(-1, 2) * step
        + np.round(np.array([east, north]) / step) * step
    )
    world = np.column_stack([xy, np.full(len(xy), height)])
    origin = np.array([east, north, height])
    cloud = PointCloud(world - origin, origin)
    grid = common_grid(cloud, cloud, 0.5)
    flat = grid.flat(cloud.xyz)
    assert flat.min() >= 0
    assert flat.max() < grid.shape[0] * grid.shape[1]
    model = fit_ground(world - origin, GroundConfig(cell=0.3))
    assert np.abs(model.height(cloud.xyz[:, :2]) - cloud.xyz[:, 2]).max() < 0.1
