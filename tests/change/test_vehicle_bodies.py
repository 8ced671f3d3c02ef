"""A place inside a vehicle of one epoch is occupied in that epoch, whatever its beams crossed."""

import numpy as np
import pytest
from test_occupancy import REACH, car, epoch, everywhere

from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_change.objects.vehicle_bodies import inside_vehicles
from subiaco_change.objects.voxel_objects import build_voxels
from subiaco_geo.codes import Semantic


def turned(xyz, degrees):
    angle = np.radians(degrees)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.column_stack([xyz[:, :2] @ rotation.T, xyz[:, 2]])


def seats(rng, count=400):
    """Points in the middle of the car: what beams met through its windows."""
    return rng.uniform([1.3, 0.7, 0.6], [2.9, 1.1, 0.8], (count, 3))


@pytest.mark.parametrize("degrees", [0.0, 37.0, 90.0])
def test_what_lies_inside_a_car_is_occupied_though_every_beam_crossed_it(degrees):
    rng = np.random.default_rng(1)
    inside = epoch(turned(seats(rng), degrees), Semantic.MOBILE)
    other = epoch(turned(car(rng), degrees), Semantic.MOBILE)
    with rules_switched_off(["closed_vehicles"]):
        plain = build_voxels(inside, other, everywhere, 0.25, REACH)
    known = build_voxels(inside, other, everywhere, 0.25, REACH)
    assert plain.observed_unoccupied.any()
    assert known.occupied_in_other.all()
    assert not known.free_space_confirmed.any()


def test_what_lies_beside_or_above_a_car_is_as_it_was():
    rng = np.random.default_rng(2)
    other = epoch(car(rng), Semantic.MOBILE)
    beside, above = seats(rng) + np.array([0.0, 2.2, 0.0]), seats(rng) + np.array([0.0, 0.0, 1.2])
    assert not inside_vehicles(np.concatenate([beside, above]), other).any()


@pytest.mark.parametrize(
    ("stretch", "semantic"),
    [([1, 3.0, 1], Semantic.MOBILE), ([0.3, 0.5, 1], Semantic.MOBILE), ([1, 1, 1], Semantic.BUILDING)],
    ids=["two cars in one instance", "a bin", "a kiosk"],
)
def test_what_is_no_single_vehicle_encloses_nothing(stretch, semantic):
    rng = np.random.default_rng(3)
    other = epoch(car(rng) * stretch, semantic)
    assert not inside_vehicles(seats(rng) * stretch, other).any()
