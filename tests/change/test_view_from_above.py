"""Clouds measured from above and from a street: which is which, and what each shows to be free."""

from __future__ import annotations

import numpy as np
import pytest

from subiaco_change.view_from_above import ColumnCounts, count_columns, seen_from_above
from subiaco_change.visibility_evidence import EvidenceConfig, make_observer
from subiaco_geo.clouds import PointCloud
from subiaco_geo.frames import Floats
from subiaco_geo.survey_map import SurveyMap

ORIGIN = np.array([391_000.0, 6_464_000.0, 10.0])
EDGE = 80.0


def surface(x: Floats, y: Floats) -> Floats:
    """Height of a town of houses, 8 m high, on a grid of 20 m, and round crowns between them [m]."""
    inside = (np.abs(np.mod(x, 20.0) - 6.0) < 4.0) & (np.abs(np.mod(y, 20.0) - 8.0) < 5.0)
    crown = 7.0 - 0.4 * ((np.mod(x, 20.0) - 15.0) ** 2 + (np.mod(y, 20.0) - 16.0) ** 2)
    return np.where(inside, 8.0, np.maximum(crown, 0.0))


def from_above(spacing: float, seed: int) -> Floats:
    """What an aircraft meets: tops everywhere, and through crowns the ground as well."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0.0, EDGE, (round((EDGE / spacing) ** 2), 2))
    z = surface(*xy.T)
    through = (z > 0) & (z < 8.0) & (rng.random(len(xy)) < 0.3)
    return np.column_stack([xy, np.where(through, z * rng.random(len(xy)), z) + rng.normal(0, 0.02, len(xy))])


def from_a_street(spacing: float, seed: int) -> Floats:
    """What a vehicle between two rows of houses meets: ground before the walls, walls, stems and crowns."""
    rng = np.random.default_rng(seed)
    ground = rng.uniform((0.0, 0.0), (EDGE, 23.0), (round(EDGE * 23.0 / spacing**2), 2))
    ground = np.column_stack([ground, np.zeros(len(ground))])
    ground = ground[(surface(*ground.T[:2]) == 0) & (ground[:, 1] > 13.0)]
    walls = []
    for west in np.arange(2.0, EDGE, 20.0):
        n = round(8.0 * 8.0 / spacing**2)
        walls += [
            np.column_stack([rng.uniform(west, west + 8.0, n), np.full(n, y), rng.uniform(0, 8, n)])
            for y in (13.0, 23.0)
        ]
    crown = rng.uniform((0.0, 13.0, 0.0), (EDGE, 23.0, 7.0), (round(EDGE * 70.0 / spacing**2), 3))
    high = surface(crown[:, 0], crown[:, 1])
    return np.concatenate([ground, *walls, crown[(high > 0) & (high < 8) & (crown[:, 2] < high)]])


@pytest.mark.parametrize("spacing", [0.3, 0.6, 1.0])
def test_a_view_from_above_is_told_from_that_of_a_street_at_every_spacing(spacing: float) -> None:
    assert seen_from_above([count_columns(from_above(spacing, 1), spacing)])
    assert not seen_from_above([count_columns(from_a_street(spacing, 1), spacing)])


def test_pieces_of_a_cloud_are_judged_together_and_flat_ground_tells_nothing() -> None:
    cloud = from_above(0.5, 2)
    west = cloud[:, 0] < 40.0
    flat = np.column_stack([np.random.default_rng(2).uniform(0, EDGE, (20_000, 2)), np.zeros(20_000)])
    assert seen_from_above(count_columns(part, 0.5) for part in (cloud[west], cloud[~west]))
    assert seen_from_above(count_columns(part, 0.5) for part in (cloud, flat))
    assert not seen_from_above([count_columns(flat, 0.5)])
    assert count_columns(flat[:0], float("inf")) == ColumnCounts(0, 0, 0, 0, 0)


def test_a_tower_that_was_taken_away_is_seen_free_from_above_to_its_top_and_not_from_a_street() -> None:
    """30 m over open ground an aircraft has passed; from a street the view ends somewhere unknown."""
    cloud = PointCloud(from_above(0.5, 3), ORIGIN, "EPSG:7850")
    place = np.column_stack([np.full(30, 12.5), np.full(30, 3.0), np.arange(30.0) + 0.7]) + ORIGIN
    config = EvidenceConfig()
    above = make_observer(SurveyMap(cloud), config, from_above=True)
    unknown = make_observer(SurveyMap(cloud), config)
    assert above.empty(place[2:]).all()
    assert (above.free_probability(place[2:]) == config.shadow_trust).all()
    assert above.below_view(place).all()
    low = place[:, 2] - ORIGIN[2] < config.shadow_height
    assert np.array_equal(unknown.observed(place), low)
    assert not unknown.below_view(place[10:]).any()
    beside = np.array([[-9.0, 3.0, 5.0]]) + ORIGIN  # outside the cloud nothing is known
    assert not above.observed(beside).any()
