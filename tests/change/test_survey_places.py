"""Where the sensor of a bare cloud was: the ground along its way has the most points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from subiaco_change.method_numbers import NUMBERS
from subiaco_change.survey_places import GroundDensity, ground_density, survey_places
from subiaco_geo.frames import Floats

ORIGIN = np.array([391_000.0, 6_464_000.0])
CELL = NUMBERS.survey_places.cell
SENSOR = NUMBERS.survey_places.sensor_height


def bent_street(length: float, turn: float, heading: float) -> Floats:
    """Places (K, 2) of a drive every metre, with a bend half way [m, local]."""
    way = np.arange(0.0, length)
    angle = heading + turn / (1.0 + np.exp(-(way - length / 2.0) / 10.0))
    return np.column_stack([np.cumsum(np.cos(angle)), np.cumsum(np.sin(angle))])


def ground_around(drive: Floats, seed: int, *, slope: float = 0.03, thinned: float = np.inf) -> GroundDensity:
    """Ground of a drive by cells, as dense as flat beams leave it, with houses that hide parts of it.

    ``thinned``: points that a cell has at most.
    """
    rng = np.random.default_rng(seed)
    low, high = drive.min(axis=0) - 45.0, drive.max(axis=0) + 45.0
    axes = [np.arange(np.floor(a / CELL), np.ceil(b / CELL)) for a, b in zip(low, high, strict=True)]
    cell = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    centre = (cell + 0.5) * CELL
    distance = cKDTree(drive).query(centre)[0]
    points = rng.poisson(3000.0 / (1.0 + (distance / 8.0) ** 2)).astype(np.int64)
    houses = (np.mod(centre[:, 0], 18.0) < 10.0) & (distance > 12.0)
    kept = ~houses & (distance < 40.0) & (rng.random(len(cell)) < 0.9)
    shift = np.round(ORIGIN / CELL)
    points = np.minimum(points, thinned).astype(np.int64)
    left = np.minimum(points, 64)
    level = slope * centre + 10.0
    return GroundDensity((cell + shift)[kept].astype(np.int64), points[kept], left[kept], level[kept, 0])


@given(
    seed=st.integers(0, 2**16),
    length=st.floats(120.0, 240.0),
    turn=st.floats(-1.2, 1.2),
    heading=st.floats(-np.pi, np.pi),
)
@settings(max_examples=25, deadline=None)
def test_places_lie_on_the_drive_and_along_most_of_it_at_the_height_of_a_sensor(
    seed: int, length: float, turn: float, heading: float
) -> None:
    drive = bent_street(length, turn, heading)
    places = survey_places([ground_around(drive, seed)])
    plan = places[:, :2] - np.round(ORIGIN / CELL) * CELL
    assert np.max(cKDTree(drive).query(plan)[0]) < 6.0
    away = cKDTree(plan).query(drive[15:-15])[0]  # gaps of more than 30 m, one in fifty drives, stay open
    assert np.mean(away < 12.0) > 0.7
    assert np.max(away) < 35.0
    np.testing.assert_allclose(places[:, 2], 10.0 + 0.03 * plan[:, 0] + SENSOR, atol=0.3)


def test_a_vehicle_that_waited_does_not_hide_the_rest_of_its_way() -> None:
    drive = bent_street(200.0, 0.5, 0.3)
    ground = ground_around(drive, 1)
    centre = (ground.cell + 0.5) * CELL - np.round(ORIGIN / CELL) * CELL
    waited = np.hypot(*(centre - drive[60]).T) < 8.0
    crowded = replace(ground, points=np.where(waited, 40 * ground.points, ground.points))
    places = survey_places([crowded])[:, :2] - np.round(ORIGIN / CELL) * CELL
    assert np.max(cKDTree(places).query(drive[15:-15])[0]) < 12.0


def test_tiles_together_give_the_places_of_the_whole() -> None:
    ground = ground_around(bent_street(160.0, 0.0, 0.2), 2)
    west = ground.cell[:, 0] < np.median(ground.cell[:, 0])
    halves = [
        GroundDensity(ground.cell[p], ground.points[p], ground.thinned[p], ground.level[p])
        for p in (west, ~west)
    ]
    np.testing.assert_array_equal(survey_places(halves), survey_places([ground]))


@pytest.mark.parametrize("points", [16, 64, 200])
def test_a_cloud_that_was_thinned_to_one_density_does_not_tell(points: int) -> None:
    ground = ground_around(bent_street(200.0, 0.4, 0.0), 3, thinned=points)
    assert len(survey_places([ground])) == 0


def test_a_site_that_was_scanned_from_one_spot_shows_no_way() -> None:
    ground = ground_around(bent_street(6.0, 0.0, 0.0), 4)
    assert len(survey_places([ground])) == 0


def test_no_ground_gives_no_places() -> None:
    none = ground_density(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64))
    assert survey_places([none]).shape == (0, 3)
    assert survey_places([]).shape == (0, 3)


def test_points_on_the_ground_are_counted_as_often_as_the_cloud_had_them() -> None:
    xyz = np.array([[1.0, 1.0, 5.0], [1.5, 0.5, 5.2], [1.2, 1.1, 7.0], [3.0, 1.0, 5.1]])
    found = ground_density(xyz, np.array([0.0, 0.1, 1.9, -0.1]), np.array([4, 2, 9, 1]))
    np.testing.assert_array_equal(found.cell, [[0, 0], [1, 0]])
    np.testing.assert_array_equal(found.points, [6, 1])
    np.testing.assert_array_equal(found.thinned, [2, 1])
    np.testing.assert_allclose(found.level, [5.1, 5.1])
