"""Beams through voxels: the kernel against its plain numpy twin, and known answers."""

from __future__ import annotations

import numpy as np
import pytest

from subiaco_geo.clouds import unpack_voxel_keys, voxel_indices, voxel_keys
from subiaco_geo.errors import InputError
from subiaco_geo.visibility import VisibilityGrid
from subiaco_geo.voxel_traversal import VisibilityAccumulator

ORIGIN = np.array([391_000.0, 6_464_000.0, -20.0])


def accumulate_visibility(starts, ends, origin, voxel, returned=None) -> VisibilityGrid:
    """Count beams (N, 3) -> (N, 3) [m, world] in one batch."""
    accumulator = VisibilityAccumulator(origin, voxel)
    accumulator.add(starts, ends, returned)
    return accumulator.grid()


def twin(starts, ends, voxel):
    """Voxels between sorted plane crossings, one beam at a time."""
    hits: dict[int, int] = {}
    passes: dict[int, int] = {}
    for start, end in zip(starts / voxel, ends / voxel, strict=True):
        cuts = [0.0, 1.0]
        for axis in range(3):
            low, high = sorted((start[axis], end[axis]))
            planes = np.arange(np.floor(low) + 1, np.floor(high) + 1)
            cuts.extend((planes - start[axis]) / (end[axis] - start[axis]))
        cuts = np.sort(cuts)
        middles = start + 0.5 * (cuts[:-1] + cuts[1:])[:, None] * (end - start)
        keys = voxel_keys(np.floor(middles).astype(np.int64))
        for key in keys[:-1]:
            passes[int(key)] = passes.get(int(key), 0) + 1
        hits[int(keys[-1])] = hits.get(int(keys[-1]), 0) + 1
    return hits, passes


def test_kernel_counts_the_same_voxels_as_its_numpy_twin():
    rng = np.random.default_rng(5)
    starts = rng.uniform(-3, 3, (400, 3))
    ends = starts + rng.normal(0, 8, (400, 3))
    grid = accumulate_visibility(starts + ORIGIN, ends + ORIGIN, ORIGIN, 0.5)
    hits, passes = twin(starts, ends, 0.5)
    assert {int(k): int(h) for k, h in zip(grid.keys, grid.hits, strict=True) if h} == hits
    assert {int(k): int(p) for k, p in zip(grid.keys, grid.passes, strict=True) if p} == passes
    assert np.all(np.diff(grid.keys) > 0)


def test_a_beam_along_an_axis_passes_every_voxel_before_its_hit():
    grid = accumulate_visibility(
        np.array([[0.25, 0.25, 0.25]]), np.array([[4.75, 0.25, 0.25]]), np.zeros(3), 0.5
    )
    cells = unpack_voxel_keys(grid.keys)
    assert cells[:, 0].tolist() == list(range(10))
    assert grid.passes.tolist() == [1] * 9 + [0]
    assert grid.hits.tolist() == [0] * 9 + [1]


def test_a_beam_without_return_hits_nothing():
    start, end = np.array([[0.25, 0.25, 0.25]]), np.array([[2.25, 0.25, 0.25]])
    grid = accumulate_visibility(start, end, np.zeros(3), 0.5, np.array([False]))
    assert grid.hits.sum() == 0
    assert grid.passes.sum() == 5


def test_a_beam_inside_one_voxel_is_a_hit_only():
    grid = accumulate_visibility(np.full((1, 3), 0.1), np.full((1, 3), 0.4), np.zeros(3), 0.5)
    assert grid.hits.tolist() == [1]
    assert grid.passes.tolist() == [0]


def test_batches_count_like_one_batch_while_the_table_grows():
    rng = np.random.default_rng(6)
    starts = np.zeros((3000, 3))
    ends = rng.normal(0, 30, (3000, 3))
    whole = accumulate_visibility(starts, ends, np.zeros(3), 0.5)
    growing = VisibilityAccumulator(np.zeros(3), 0.5, capacity=1024)
    growing.add(starts[:1000], ends[:1000])
    growing.add(starts[1000:], ends[1000:])
    found = growing.grid()
    assert np.array_equal(found.keys, whole.keys)
    assert np.array_equal(found.hits, whole.hits)
    assert np.array_equal(found.passes, whole.passes)
    assert whole.hits.sum() == 3000


def test_every_hit_lies_in_the_voxel_of_its_end():
    rng = np.random.default_rng(7)
    ends = rng.uniform(-10, 10, (500, 3))
    grid = accumulate_visibility(np.zeros((500, 3)), ends, np.zeros(3), 0.5)
    assert set(grid.keys[grid.hits > 0]) == set(voxel_keys(voxel_indices(ends, 0.5)))


def test_beams_that_are_not_finite_or_too_far_are_refused():
    good = np.zeros((1, 3))
    with pytest.raises(InputError, match="NaN"):
        accumulate_visibility(good, np.full((1, 3), np.nan), np.zeros(3), 0.5)
    with pytest.raises(InputError, match="nearer origin"):
        accumulate_visibility(good, np.full((1, 3), 1e7), np.zeros(3), 0.5)


def test_more_beams_than_one_batch_holds_are_all_counted():
    count = (1 << 16) + 7
    starts, ends = np.full((count, 3), -0.25), np.tile([1.25, -0.25, -0.25], (count, 1))
    grid = accumulate_visibility(starts, ends, np.zeros(3), 0.5)
    assert grid.passes.tolist() == [count, count, count, 0]
    assert grid.hits.tolist() == [0, 0, 0, count]


def test_the_number_of_voxels_is_known_while_beams_and_returns_are_counted():
    rng = np.random.default_rng(8)
    store = VisibilityAccumulator(np.zeros(3), 0.5, capacity=1024, least_beams=2)
    for window in range(1, 5):
        ends = rng.normal(0, 9, (400, 3))
        store.touch(ends + 1.0, window)
        store.add(np.zeros((400, 3)), ends, rng.random(400) < 0.7, window)
        grid, looks = store.grid_and_looks()
        assert len(store) == len(grid.keys) == len(np.unique(grid.keys)) <= store.cells
        assert np.array_equal(looks.hits > 0, looks.first > 0)


def test_an_accumulator_is_told_windows_only_if_it_keeps_time():
    beam = np.zeros((1, 3)), np.ones((1, 3))
    with pytest.raises(InputError, match="keeps no time"):
        VisibilityAccumulator(np.zeros(3), 0.5).add(*beam, window=1)
    with pytest.raises(InputError, match="keeps no time"):
        VisibilityAccumulator(np.zeros(3), 0.5).touch(beam[1], window=1)
    with pytest.raises(InputError, match="give the window"):
        VisibilityAccumulator(np.zeros(3), 0.5, least_beams=2).add(*beam)
