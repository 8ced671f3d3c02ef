"""Classes of vehicles, and of what has their size, as a passing sensor sees them: from one side."""

import numpy as np
import pytest
from street_side_scene import box, car, drive_past, hedge, van

from subiaco_change.segmentation.classes import SemanticsConfig, label_points
from subiaco_change.segmentation.config import VehicleConfig
from subiaco_change.segmentation.vehicles import ground_boxes
from subiaco_geo.codes import Semantic


def shares(distance, beams, **thing):
    """Fraction of the points of a thing in every class, seen so far away [m] with so many beams."""
    cloud, own = drive_past(distance, beams, np.random.default_rng(1), **thing)
    found = label_points(cloud, SemanticsConfig()).semantic[own]
    return np.bincount(found, minlength=len(Semantic)) / len(found)


@pytest.mark.parametrize(("distance", "beams"), [(2, 16), (6, 32), (12, 16), (12, 64), (25, 32), (25, 64)])
def test_a_car_seen_from_one_side_is_a_vehicle(distance, beams):
    assert shares(float(distance), beams, triangles=car())[Semantic.MOBILE] > 0.85


@pytest.mark.parametrize(("distance", "beams"), [(2, 16), (6, 16), (12, 32), (25, 64)])
def test_a_van_seen_from_one_side_is_a_vehicle_and_no_set_of_fences(distance, beams):
    assert shares(float(distance), beams, triangles=van())[Semantic.MOBILE] > 0.85


def test_a_box_hedge_of_the_size_of_a_car_is_a_plant_where_its_surface_is_sampled_densely():
    leaves = hedge(np.random.default_rng(1), np.array([4.5, 1.6, 1.5]))
    assert shares(6.0, 64, leaves=leaves)[Semantic.VEGETATION] > 0.9


@pytest.mark.parametrize(("distance", "beams"), [(2, 64), (12, 16), (25, 32)])
def test_a_low_wall_is_no_vehicle(distance, beams):
    assert shares(float(distance), beams, triangles=box(8.0, 0.3, 0.9))[Semantic.MOBILE] == 0.0


def test_a_container_is_no_plant():
    assert shares(6.0, 32, triangles=box(6.0, 2.4, 2.6))[Semantic.VEGETATION] < 0.05


def panel(lean, length=4.2, top=1.45, bottom=0.25):
    """Points (N, 3) each 0.2 m of the side of a car whose windows lean inwards, thinned at its ends."""
    u, z = (a.ravel() for a in np.meshgrid(np.arange(0, length, 0.2), np.arange(bottom, top, 0.2)))
    cabin = (z < 0.9) | ((u > 0.8) & (u < length - 0.8))
    aside = np.where(z > 0.9, lean * (z - 0.9) / (top - 0.9), 0.0)
    return np.column_stack([u, aside + np.random.default_rng(2).normal(0, 0.01, len(u)), z])[cabin]


def kinds_of(xyz, foliage=False):
    """Classes that the boxes on the ground get, of points that are all upright."""
    count = len(xyz)
    leafy = np.full(count, foliage)
    found = ground_boxes(xyz, xyz[:, 2], leafy, np.ones(count, bool), np.arange(count), VehicleConfig())
    return [kind for _, kind in found]


def test_the_side_of_a_car_alone_is_a_vehicle_because_its_windows_lean_inwards():
    assert kinds_of(panel(0.4)) == [Semantic.MOBILE]
    assert kinds_of(panel(-0.4) @ np.diag([-1.0, 1.0, 1.0])) == [Semantic.MOBILE]


def test_a_piece_of_fence_or_hedge_as_long_and_high_as_a_car_is_no_vehicle():
    assert kinds_of(panel(0.0)) == []
    assert Semantic.MOBILE not in kinds_of(panel(0.4), foliage=True)


@pytest.mark.parametrize("length", [2.4, 7.0])
def test_a_leaning_panel_that_is_shorter_or_longer_than_a_car_is_no_vehicle(length):
    assert kinds_of(panel(0.4, length)) == []
