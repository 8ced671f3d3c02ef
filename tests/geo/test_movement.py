"""Moving or static, from times: known sequences of hits and looks through voxels."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from subiaco_geo.clouds import voxel_keys
from subiaco_geo.movement import MovementConfig, stood, verdicts
from subiaco_geo.observation_times import PENDING, VoxelObservations, joined_looks
from subiaco_geo.visibility import (
    NO_VERDICT,
    SURELY_MOVED,
    TimeRecord,
    VisibilityGrid,
    load_visibility,
    save_visibility,
    visibility_parts,
)
from subiaco_geo.voxel_traversal import VisibilityAccumulator

CONFIG = MovementConfig()
LENGTH = 12.0  # of the street that is looked at [m]
Present = Callable[[np.ndarray, float], np.ndarray]


def looked_at(cells: np.ndarray, seconds: float, present: Present, start: float = 0.0) -> VoxelObservations:
    """Look at voxels (M, 3) in every window: hit where something is present, looked through elsewhere."""
    count = round(seconds / CONFIG.window)
    hit = np.stack([present(cells, start + k * CONFIG.window) for k in range(count)], axis=1)
    rises = np.diff(hit.astype(int), axis=1, prepend=0) > 0
    window = np.arange(1, count + 1)
    first = np.where(hit.any(axis=1), hit.argmax(axis=1) + 1, 0)
    last = (hit * window).max(axis=1)
    sums = (hit.sum(axis=1), (~hit).sum(axis=1), rises.sum(axis=1))
    edges = (hit[:, 0] + 2 * hit[:, -1]).astype(np.uint8)
    hits, through, runs = (column.astype(np.uint16) for column in sums)
    return VoxelObservations(hits, through, runs, first.astype(np.uint32), last.astype(np.uint32), edges)


def block(length: float, height: int = 3, width: int = 1) -> np.ndarray:
    """Voxels (M, 3) of something along x, in the order of their keys."""
    shape = np.meshgrid(np.arange(round(length / 0.5)), np.arange(width), np.arange(height), indexing="ij")
    return np.stack([axis.ravel() for axis in shape], axis=1)


def probability(cells: np.ndarray, looks: VoxelObservations) -> np.ndarray:
    """Probability (M,) that what was hit moved; NaN where nothing was."""
    code = verdicts(voxel_keys(cells), looks, CONFIG)
    return np.where(code == NO_VERDICT, np.nan, code / SURELY_MOVED)


def car(speed: float, length: float = 4.5, wait: tuple[float, float] = (0.0, 0.0)) -> Present:
    """A car that comes from x = -10 m; it waits ``wait`` = (begin, length) seconds on its way."""

    def present(cells: np.ndarray, seconds: float) -> np.ndarray:
        driven = seconds if seconds < wait[0] else max(wait[0], seconds - wait[1])
        front = -10.0 + speed * driven
        x = 0.5 * cells[:, 0]
        return np.asarray((x < front) & (x + 0.5 > front - length))

    return present


@pytest.mark.parametrize("speed", [3.0, 5.0, 8.0, 11.0, 15.0])
def test_a_car_that_crosses_at_any_speed_moved(speed: float) -> None:
    cells = block(LENGTH)
    found = probability(cells, looked_at(cells, 10.0, car(speed)))
    assert np.nanmin(found) >= CONFIG.sure


def test_a_car_that_stops_at_a_light_for_five_seconds_and_leaves_moved() -> None:
    cells = block(LENGTH)
    looks = looked_at(cells, 14.0, car(5.0, wait=(3.0, 5.0)))
    assert looks.hits.max() * CONFIG.window > 5.0
    assert np.nanmin(probability(cells, looks)) >= CONFIG.sure


def test_a_crawling_queue_moved_although_each_place_was_hit_for_most_of_the_time() -> None:
    def queue(cells: np.ndarray, seconds: float) -> np.ndarray:
        phase = (0.5 * cells[:, 0] - 1.2 * seconds) % 7.0  # a car of 4.5 m every 7 m at 1.2 m/s
        return np.asarray(phase < 4.5)

    cells = block(LENGTH)
    looks = looked_at(cells, 20.0, queue)
    assert np.mean(looks.hits / (looks.hits + looks.through)) > 0.6
    assert np.nanmedian(probability(cells, looks)) >= CONFIG.sure


def test_a_parked_car_stood_and_one_that_waited_and_left_did_not() -> None:
    cells = block(LENGTH)
    parked = stood(looked_at(cells, 10.0, lambda xyz, _: np.ones(len(xyz), dtype=bool)), CONFIG)
    assert parked.all()
    for speed, wait in ((3.0, (0.0, 0.0)), (5.0, (3.0, 5.0))):
        assert not stood(looked_at(cells, 14.0, car(speed, wait=wait)), CONFIG).any()
    seconds = 1.0  # too short a time to tell
    assert not stood(looked_at(cells, seconds, lambda xyz, _: np.ones(len(xyz), dtype=bool)), CONFIG).any()


@pytest.mark.parametrize(("share", "width"), [(1.0, 1), (0.7, 2), (0.35, 2), (0.2, 2), (0.1, 2)])
def test_hedges_fences_and_trees_stand_however_porous(share: float, width: int) -> None:
    rng = np.random.default_rng(5)

    def porous(cells: np.ndarray, _: float) -> np.ndarray:
        return np.asarray(rng.random(len(cells)) < share)

    cells = block(6.0, width=width)
    found = probability(cells, looked_at(cells, 8.0, porous))
    assert np.nanmean(found) < 0.25
    assert np.nanmax(found) < CONFIG.sure


@pytest.mark.parametrize("sides", [True, False])
def test_the_roof_of_a_parked_van_that_beams_skim_from_afar_stands(sides: bool) -> None:
    """Its sides are hit all the time, the roof from near alone; without sides it crossed the road."""
    cells = block(5.0, height=5, width=5)
    rim = (np.isin(cells[:, 0], (0, 9)) | np.isin(cells[:, 1], (0, 4))) & (cells[:, 2] < 4)
    roof = cells[:, 2] == 4
    cells = cells[(rim & sides) | roof]

    def van(found: np.ndarray, seconds: float) -> np.ndarray:
        return np.asarray((found[:, 2] < 4) | (4.0 <= seconds < 4.5))

    looks = looked_at(cells, 10.0, van)
    moved = probability(cells, looks) >= CONFIG.sure
    assert not moved[cells[:, 2] < 4].any()
    assert moved[cells[:, 2] == 4].mean() == pytest.approx(0.0 if sides else 1.0)


def test_a_pole_stands_although_beams_pass_beside_it_in_half_of_the_windows() -> None:
    rng = np.random.default_rng(6)
    cells = block(0.5, height=8)
    looks = looked_at(cells, 8.0, lambda c, _: np.asarray(rng.random(len(c)) < 0.5))
    assert np.nanmax(probability(cells, looks)) < 0.1


@pytest.mark.parametrize("way", [0.3, 0.5, 0.7])
def test_a_pole_that_drifting_poses_shift_over_some_voxels_stands(way: float) -> None:
    """Columns beside one another hold it in turns; one of them holds it at every look."""

    def pole(cells: np.ndarray, seconds: float) -> np.ndarray:
        return np.asarray(np.abs(0.5 * cells[:, 0] - 2.0 - way * seconds / 4.0) < 0.26)

    cells = block(6.0, height=5)
    looks = looked_at(cells, 4.0, pole)
    assert (looks.through[looks.hits > 0] > 0).any()
    assert np.nanmax(probability(cells, looks)) < 0.5


def test_a_pedestrian_as_thin_as_that_pole_moved() -> None:
    cells = block(6.0, height=4)
    looks = looked_at(cells, 4.0, lambda c, t: np.asarray(np.abs(0.5 * c[:, 0] - 1.4 * t) < 0.3))
    assert np.nanmedian(probability(cells, looks)) >= CONFIG.sure


def test_a_shrub_seen_briefly_on_two_passes_stands() -> None:
    cells = block(1.0, height=2, width=2)
    looks = looked_at(cells, 1.0, lambda c, _: np.ones(len(c), dtype=bool))
    alone = probability(cells, looks)
    assert alone == pytest.approx(np.full(len(cells), 0.5))
    starts = np.arange(len(cells)) * 2
    both = [np.stack([a, b], axis=1).ravel() for a, b in zip(looks.columns(), later(looks, 200), strict=True)]
    assert np.nanmax(probability(cells, joined_looks(starts, VoxelObservations(*both)))) < 0.1


def later(looks: VoxelObservations, windows: int) -> list[np.ndarray]:
    return looks.later(windows).columns()


def test_a_thing_seen_for_a_third_of_a_second_alone_is_uncertain() -> None:
    cells = block(2.0)
    found = probability(cells, looked_at(cells, 0.4, lambda c, _: np.ones(len(c), dtype=bool)))
    assert found == pytest.approx(np.full(len(cells), 0.5))


def test_nothing_is_said_of_voxels_that_returned_nothing() -> None:
    cells = block(2.0)
    looks = looked_at(cells, 4.0, lambda c, _: np.zeros(len(c), dtype=bool))
    assert (verdicts(voxel_keys(cells), looks, CONFIG) == NO_VERDICT).all()
    assert verdicts(np.zeros(0, np.int64), looks.select(slice(0, 0)), CONFIG).shape == (0,)


@given(st.integers(0, 2**32 - 1), st.integers(1, 200))
@settings(deadline=None, max_examples=25)
def test_verdicts_do_not_depend_on_how_many_voxels_are_taken_at_a_time(seed: int, most: int) -> None:
    rng = np.random.default_rng(seed)
    cells = np.unique(rng.integers(-6, 6, (300, 3)), axis=0)
    keys = np.sort(voxel_keys(cells))
    looks = looked_at(cells, 6.0, lambda c, t: np.asarray((c[:, 0] == int(2 * t) - 6) | (c[:, 1] > 4)))
    np.testing.assert_array_equal(verdicts(keys, looks, CONFIG, most), verdicts(keys, looks, CONFIG))


def windows_of(beams: list[tuple[int, bool]], least: int, cut: int | None = None) -> tuple[list[int], int]:
    """Hits, looks through, runs, first and last window of a voxel, and its edges, from the accumulator."""
    parts, start, end = [], np.array([[0.25, 0.25, 0.25]]), np.array([[2.25, 0.25, 0.25]])
    groups = [beams] if cut is None else [beams[:cut], beams[cut:]]
    store, shift = VisibilityAccumulator(np.zeros(3), 0.5, 1024, least_beams=least), 0
    for group in groups:
        if parts:
            later = max(group[0][0] - 1 - PENDING, 0)
            store, shift = store.pending(group[0][0], later), later
        store.add(start + 5, end + 5, window=1)  # another place
        for window, hit in group:
            if hit:
                store.touch(np.array([[1.25, 0.25, 0.25]]), window - shift)
            else:
                store.add(start, end, window=window - shift)
        slot = np.flatnonzero(store.grid().keys == voxel_keys(np.array([[2, 0, 0]])))
        parts.append(store.looks().select(slot).later(shift))
    columns = [np.concatenate(column) for column in zip(*(p.columns() for p in parts), strict=True)]
    looks = joined_looks(np.zeros(1, np.int64), VoxelObservations(*columns))
    *counts, edges = (int(column[0]) for column in looks.columns())
    return counts, edges


def test_a_window_is_a_look_through_only_with_enough_beams_and_no_return() -> None:
    assert windows_of([(1, False), (2, False), (2, False), (3, False), (3, False), (3, True)], 2) == (
        [1, 1, 1, 3, 3],
        2,
    )
    assert windows_of([(4, True), (4, False), (4, False)], 2) == ([1, 0, 1, 4, 4], 3)


def plain_looks(beams: list[tuple[int, bool]], least: int) -> list[tuple[int, bool]]:
    """Looks (window, hit) of a plain count."""
    told, pending, last = [], 0, 0
    for w in sorted({w for w, _ in beams}):
        pending = (pending if w - last <= PENDING else 0) + sum(v == w for v, _ in beams)
        last, hit = w, any(hit for v, hit in beams if v == w)
        if hit or pending >= least:
            told.append((w, hit))
            pending = 0
    return told


@given(
    st.lists(
        st.tuples(st.sampled_from([0, 1, 2, PENDING, PENDING + 1]), st.booleans()), min_size=1, max_size=30
    ),
    st.integers(1, 3),
)
@settings(deadline=None, max_examples=60)
def test_looks_are_those_of_a_plain_count_and_do_not_depend_on_when_memory_went_to_disk(
    steps: list[tuple[int, bool]], least: int
) -> None:
    window, beams = 1, []
    for step, hit in steps:
        window += step
        beams.append((window, hit))
    told = plain_looks(beams, least)
    hits = [w for w, hit in told if hit]
    runs = sum(hit and (k == 0 or not told[k - 1][1]) for k, (_, hit) in enumerate(told))
    expected = [len(hits), len(told) - len(hits), runs, min(hits, default=0), max(hits, default=0)]
    assert windows_of(beams, least)[0] == expected
    for cut in range(1, len(beams)):
        if beams[cut - 1][0] != beams[cut][0]:
            assert windows_of(beams, least, cut)[0] == expected


def test_beams_too_few_for_a_look_in_one_window_add_up_and_a_return_discards_them() -> None:
    thin = [(w, False) for w in range(1, 8)]
    assert windows_of(thin, 3)[0] == [0, 2, 0, 0, 0]
    assert windows_of([*thin[:2], (3, True), *thin[3:]], 3)[0] == [1, 1, 1, 3, 3]


def test_a_layer_with_times_is_read_back_whole_and_in_parts_and_one_without_still_loads(
    tmp_path: Path,
) -> None:
    cells = block(6.0)
    keys, looks = voxel_keys(cells), looked_at(cells, 10.0, car(8.0))
    counts = np.arange(len(keys), dtype=np.uint32)
    times = TimeRecord(CONFIG.window, 123, looks)
    grid = VisibilityGrid(np.zeros(3), 0.5, keys, counts, counts, verdicts(keys, looks, CONFIG), times)
    save_visibility(tmp_path / "timed.npz", grid)
    save_visibility(tmp_path / "plain.npz", VisibilityGrid(np.zeros(3), 0.5, keys, counts, counts))
    whole, parts = load_visibility(tmp_path / "timed.npz"), list(visibility_parts(tmp_path / "timed.npz", 10))
    assert whole.times is not None
    assert (whole.times.window, whole.times.start_ns) == (CONFIG.window, 123)
    for name, column in zip(vars(looks), looks.columns(), strict=True):
        np.testing.assert_array_equal(getattr(whole.times.looks, name), column)
        joined = np.concatenate([getattr(p.times.looks, name) for p in parts if p.times is not None])
        np.testing.assert_array_equal(joined, column)
    np.testing.assert_array_equal(whole.moving, grid.moving)
    centres = (cells + 0.5) * 0.5
    found = whole.moved(np.vstack([centres, [[900.0, 0.0, 0.0]]]))
    assert found is not None
    assert found[:-1].min() >= CONFIG.sure
    assert np.isnan(found[-1])
    plain = load_visibility(tmp_path / "plain.npz")
    assert plain.times is None
    assert plain.moved(centres) is None
