from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from subiaco_geo.clouds import voxel_keys
from subiaco_geo.voxel_components import connected_voxels


@given(st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=25)
def test_connected_voxels_are_those_that_touch_one_another(seed: int) -> None:
    cells = np.unique(np.random.default_rng(seed).integers(0, 9, (60, 3)), axis=0)
    part = connected_voxels(voxel_keys(cells))
    apart = np.abs(cells[:, None] - cells[None]).max(axis=2)
    touching = np.linalg.matrix_power((apart <= 1).astype(float), 8) > 0
    for _ in range(4):
        touching = touching.astype(float) @ touching.astype(float) > 0
    np.testing.assert_array_equal(part[:, None] == part[None], touching)


def test_a_component_is_named_by_its_lowest_row() -> None:
    cells = np.array([[0, 0, 0], [0, 5, 0], [1, 1, 1], [1, 6, -1], [9, 0, 0]])
    assert connected_voxels(voxel_keys(cells)).tolist() == [0, 1, 0, 1, 4]


def test_no_voxels_have_no_components() -> None:
    assert len(connected_voxels(np.zeros(0, dtype=np.int64))) == 0
