"""An airborne park against itself: other points, thinner, moved, trees felled and planted."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from bench_airborne import Outcome, compare

from subiaco_geo.codes import Change
from subiaco_geo.maps import load_epoch

pytestmark = pytest.mark.slow
EDGE = 110.0  # of the piece [m]
FOUND = 1 / 3  # share of the points of an object with its label; the lowest points of a crown are ground too


def piece(shared_data: Path, west: float, south: float) -> np.ndarray:
    """Points (N, 3) of a square of the park, by the distance of its corner from that of the crop [m]."""
    xyz = load_epoch(shared_data / "autzen" / "autzen_crop_650x300m_rgb.laz").cloud.world()
    x, y = (xyz[:, k] - xyz[:, k].min() for k in (0, 1))
    return xyz[(x >= west) & (x < west + EDGE) & (y >= south) & (y < south + EDGE)]


def missed(outcome: Outcome) -> list[str]:
    """Every felled or planted object that was not found, with its labels and the rows that touch it."""
    return [
        f"{'roof' if roof else 'tree'} {change.label}, {len(xyz)} points, {np.ptp(xyz, axis=0).round(1)} m:"
        f" found {share:.2f}; {rows}"
        for roof, change, xyz, share, rows in outcome.objects()
        if share < FOUND
    ]


@pytest.mark.parametrize(("west", "south"), [(30.0, 40.0), (260.0, 30.0)])
def test_felled_and_new_trees_of_a_park_are_found_and_little_else(
    shared_data: Path, west: float, south: float
) -> None:
    outcome = compare(piece(shared_data, west, south), 1)
    objects = outcome.objects()
    assert outcome.shift < 0.02, "registered at its defaults from 0.7 m and half a degree away"
    assert len(objects) >= 5
    assert {change for _, change, *_ in objects} == {Change.ADDED, Change.REMOVED}
    lost = missed(outcome)
    assert len(lost) <= 0.25 * len(objects), "\n".join(lost)
    false = outcome.false_claims()
    assert 1000.0 * len(false) / outcome.area() <= 0.5, "\n".join(false)
    assert max(false.values(), default=0.0) <= 0.9


def test_at_a_quarter_of_the_points_what_is_missed_is_unobserved_and_nothing_is_false(
    shared_data: Path,
) -> None:
    outcome = compare(piece(shared_data, 60.0, 150.0), 1, 0.5)
    assert outcome.shift < 0.04
    objects, lost = outcome.objects(), missed(outcome)
    assert len(lost) <= 0.5 * len(objects), "\n".join(lost)
    assert all("Unobserved" in text for text in lost), "\n".join(lost)
    assert not outcome.false_claims()
