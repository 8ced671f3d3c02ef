"""Halls wider than a ground filter's window, and terraces that are none."""

import numpy as np
import pytest

from subiaco_change.segmentation.classes import SemanticsConfig, label_points
from subiaco_change.segmentation.ground_model import GroundConfig, fit_ground
from subiaco_change.segmentation.raised_surfaces import RaisedConfig, find_raised
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Semantic


def plain(size, height, seed=0, spacing=0.7, slope=0.01):
    """Airborne points (N, 3) of a plain of ``size`` [m] about the origin with heights of a function."""
    rng = np.random.default_rng(seed)
    count = int((size / spacing) ** 2)
    xy = rng.uniform(-size / 2, size / 2, (count, 2))
    z = slope * xy[:, 0] + height(xy[:, 0], xy[:, 1]) + rng.normal(0, 0.02, count)
    return np.column_stack([xy, z])


def hall(length, width, top):
    return lambda x, y: np.where((abs(x) < length / 2) & (abs(y) < width / 2), top, 0.0)


@pytest.mark.parametrize(("length", "width"), [(147.0, 100.0), (50.0, 34.0)])
def test_a_hall_wider_than_the_window_is_no_ground(length, width):
    xyz = plain(220.0, hall(length, width, 9.0))
    surfaces = find_raised(xyz, RaisedConfig())
    roof = xyz[:, 2] > 5
    assert surfaces.holds(xyz)[roof].mean() > 0.97
    assert surfaces.holds(xyz)[~roof].mean() < 0.02
    model = fit_ground(xyz, GroundConfig(), surfaces)
    places = np.array([[0.0, 0.0], [length / 4, width / 4], [-length / 4, 0.0]])
    assert model.height(places) == pytest.approx(0.01 * places[:, 0], abs=0.4)
    assert not model.supported(places).any()


def test_a_roof_that_fills_a_tile_lies_above_the_ground_around_it():
    wide = plain(220.0, hall(147.0, 100.0, 9.0))
    surfaces = find_raised(wide, RaisedConfig())
    tile = wide[(abs(wide[:, 0]) < 40) & (abs(wide[:, 1]) < 40)]
    found = label_points(PointCloud(tile), SemanticsConfig(), None, surfaces)
    assert (found.semantic == Semantic.GROUND).mean() < 0.02
    assert np.median(found.height_above_ground) == pytest.approx(9.0, abs=1.0)


def test_two_levels_of_one_hall_are_both_raised():
    def levels(x, y):
        low = hall(60.0, 40.0, 6.0)(x, y)
        return np.where((x > 0) & (low > 0), 11.0, low)

    xyz = plain(150.0, levels)
    assert find_raised(xyz, RaisedConfig()).holds(xyz)[xyz[:, 2] > 4].mean() > 0.95


@pytest.mark.parametrize(
    "height",
    [
        lambda x, y: np.where(y > 0, 4.0, 0.0),  # a terrace that goes on to the end of the map
        lambda x, y: np.where(abs(x) < 40, 4.0 * np.clip(1.5 - abs(y) / 30, 0, 1), 0.0),  # a dam with ramps
        hall(60.0, 60.0, -5.0),  # a pit
        lambda x, y: 0.1 * x,  # a hillside
    ],
    ids=["terrace", "ramps", "pit", "hillside"],
)
def test_ground_that_goes_on_somewhere_is_not_raised(height):
    assert not np.isfinite(find_raised(plain(160.0, height), RaisedConfig()).lowest).any()


def test_a_terrace_of_which_the_street_sees_the_front_is_not_raised():
    """A garden 2.5 m above the road, seen 12 m deep: its other three sides end where sight ends."""
    road = plain(80.0, lambda x, y: 0.0 * x, seed=1, spacing=0.3)
    garden = plain(80.0, lambda x, y: 2.5 + 0.0 * x, seed=2, spacing=0.3)
    road, garden = road[abs(road[:, 1]) < 5], garden[(garden[:, 1] > 5) & (garden[:, 1] < 17)]
    xyz = np.concatenate([road, garden])
    assert not np.isfinite(find_raised(xyz, RaisedConfig()).lowest).any()
