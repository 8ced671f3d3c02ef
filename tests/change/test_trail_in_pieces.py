"""Pieces of ghost trails, distinguished from plants and parked cars by the row that they lie in."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from test_one_epoch_parts import obj

from subiaco_change.decisions.config import DecisionConfig
from subiaco_change.decisions.dynamic_objects import OwnEpochEvidence
from subiaco_change.decisions.trail_in_pieces import (
    Surroundings,
    _on_arcs,
    decide_piece_of_trail,
    surroundings,
)
from subiaco_geo.codes import Change, Semantic

RULES = DecisionConfig()
NOWHERE = cKDTree(np.zeros((0, 3)))
#: Ground points a quarter of a metre apart.
ROAD = np.stack(np.meshgrid(np.arange(-30, 30, 0.25), np.arange(-10, 10, 0.25)), axis=-1).reshape(-1, 2)
EMPTY = np.zeros((0, 3))
BEND = 0.01  # of the street [1/m]


def nowhere(xyz):
    return np.zeros(len(xyz), dtype=bool)


def plate(x, width=2.0, top=1.6, y=0.0):
    """Points of the front of a vehicle that a sweep met at ``x`` along a street, ``y`` aside of the lane."""
    across, up = np.meshgrid(np.arange(-width / 2, width / 2 + 0.1, 0.25), np.arange(0.35, top, 0.25))
    return np.column_stack([np.full(across.size, x), across.ravel() + y + 0.5 * BEND * x**2, up.ravel()])


def row(first, last, **sizes):
    """Return the fronts of a vehicle that drove from ``first`` to ``last``, 1.8 m from sweep to sweep."""
    return np.concatenate([plate(x, **sizes) for x in np.arange(first, last, 1.8)])


PIECE = np.concatenate([plate(0.0), plate(1.8)])
BEFORE_AND_BEHIND = np.concatenate([row(-18.0, -1.0), row(3.6, 18.0)])


def holding(pieces, ground=ROAD):
    return Surroundings(ground, EMPTY, pieces, pieces[:, 2])


def decided(piece, own, other=None, semantic=Semantic.VEGETATION, counted=False):
    evidence = OwnEpochEvidence(nowhere, NOWHERE, ground=None if counted else cKDTree(ROAD))
    other = holding(EMPTY) if other is None else other
    return decide_piece_of_trail([obj([(piece, False)])], semantic, evidence, own, other, RULES)


@pytest.mark.parametrize("semantic", [Semantic.VEGETATION, Semantic.MOBILE, Semantic.OTHER])
@pytest.mark.parametrize("reach", [18.0, 11.0])
def test_a_piece_in_a_row_of_pieces_on_a_bend_is_not_claimed(semantic, reach):
    own = holding(np.concatenate([PIECE, row(-reach, -1.0), row(3.6, 18.0)]))
    decision = decided(PIECE, own, semantic=semantic)
    assert decision is not None
    assert decision.change is Change.UNOBSERVED
    assert "2.0 m wide that the other survey does not hold" in decision.reason


def test_the_trail_of_a_bus_is_as_wide_as_a_bus_with_its_mirrors():
    piece = np.concatenate([plate(0.0, width=2.75), plate(1.8, width=2.75)])
    own = holding(np.concatenate([piece, row(-18.0, -1.0, width=2.75), row(3.6, 18.0, width=2.75)]))
    assert decided(piece, own) is not None


def fronts_on_a_circle(radius, places):
    """Fronts of a vehicle that drove on a circle through the origin, at lengths along it [m]."""
    fronts = []
    for turn in np.asarray(places) / radius:
        front = plate(0.0)
        out = radius + front[:, 1]
        fronts.append(np.column_stack([out * np.sin(turn), radius - out * np.cos(turn), front[:, 2]]))
    return np.concatenate(fronts)


@pytest.mark.parametrize("radius", [10.0, -13.0, 20.0])
def test_a_vehicle_that_turns_at_a_junction_leaves_shapeless_pieces_on_a_circle(radius):
    piece = fronts_on_a_circle(radius, [0.0])
    rest = fronts_on_a_circle(radius, np.arange(1.8, 9.0, 1.8))
    pieces = np.concatenate([piece, rest, fronts_on_a_circle(radius, np.arange(-9.0, -1.0, 1.8))])
    decision = decided(piece, holding(pieces))
    assert decision is not None
    assert float(decision.reason.split(" m long")[0].split()[-1]) >= 16.0
    assert decided(piece, holding(np.concatenate([piece, rest]))) is None


@given(
    bend=st.floats(-0.1, 0.1),
    heading=st.floats(-np.pi, np.pi),
    along=st.floats(-12, 12),
    aside=st.floats(-3, 3),
)
def test_a_place_on_a_circle_is_told_by_its_length_along_it_and_its_distance_from_it(
    bend, heading, along, aside
):
    turned = heading + bend * along
    steps = np.linspace(0.0, along, 2001)
    middle = heading + bend * 0.5 * (steps[1:] + steps[:-1])
    on_circle = np.array([np.cos(middle).sum(), np.sin(middle).sum()]) * along / 2000
    place = on_circle + aside * np.array([-np.sin(turned), np.cos(turned)])
    arc = place[None], np.array([[np.cos(heading), np.sin(heading)]]), np.array([bend])
    assert _on_arcs(*arc, lengthwise=True)[0, 0] == pytest.approx(along, abs=1e-4)
    assert _on_arcs(*arc, lengthwise=False)[0, 0] == pytest.approx(aside, abs=1e-4)


def test_a_parked_car_is_no_piece_of_a_trail_on_a_narrow_bend():
    car = fronts_on_a_circle(10.0, [-0.9, 0.9])
    around = np.concatenate([fronts_on_a_circle(10.0, s * np.arange(3.0, 9.1, 1.5)) for s in (-1.0, 1.0)])
    own = holding(np.concatenate([car, around]))
    assert decided(car, own, semantic=Semantic.MOBILE) is None
    assert decided(car, own) is not None


def test_the_last_piece_of_a_row_is_a_piece_too():
    assert decided(PIECE, holding(np.concatenate([PIECE, row(3.6, 18.0)]))) is not None


@pytest.mark.parametrize(
    ("piece", "pieces"),
    [
        (plate(0.0, y=2.2), np.concatenate([PIECE, BEFORE_AND_BEHIND])),
        (PIECE, row(5.4, 18.0)),
        (PIECE, row(3.6, 9.0)),
        (PIECE, np.concatenate([row(-18.0, -1.0, width=0.5), row(3.6, 18.0, width=0.5)])),
        (plate(0.0, top=3.0), BEFORE_AND_BEHIND),
        (plate(0.0, top=8.0), np.concatenate([row(-18.0, -1.0, top=3.5), row(3.6, 18.0, top=3.5)])),
        (PIECE, np.concatenate([row(-18.0, -1.0, width=6.0), row(3.6, 18.0, width=6.0)])),
    ],
    ids=[
        "a car parked beside a trail",
        "a car with a gap to the trail before it",
        "two bushes",
        "a row of posts",
        "a van at the end of a row of low pieces",
        "a tree",
        "a plot of shrubs",
    ],
)
def test_what_does_not_lie_in_a_row_as_long_as_a_trail_and_as_wide_as_a_vehicle_is_claimed(piece, pieces):
    assert decided(piece, holding(np.concatenate([piece, pieces]))) is None


@pytest.mark.parametrize("length", [8.0, 4.0])
def test_an_object_of_pieces_of_two_lanes_is_not_claimed_where_it_is_longer_than_a_car(length):
    object_ = np.concatenate([row(0.0, length), row(0.0, length, y=3.3)])
    rows = [
        row(-18.0, -1.0),
        row(length + 1.0, 20.0),
        row(-18.0, -1.0, y=3.3),
        row(length + 1.0, 20.0, y=3.3),
    ]
    decision = decided(object_, holding(np.concatenate([object_, *rows])))
    assert (decision is not None) == (length > 6.0)
    assert decided(object_, holding(object_)) is None


def test_a_planted_row_that_hides_the_ground_is_claimed():
    pieces = np.concatenate([PIECE, BEFORE_AND_BEHIND])
    hidden = cKDTree(pieces[:, :2]).query(ROAD)[0] < 0.6
    assert decided(PIECE, holding(pieces, ROAD[~hidden])) is None


def test_a_row_that_stands_in_both_surveys_is_no_trail():
    own = holding(np.concatenate([PIECE, BEFORE_AND_BEHIND]))
    other = Surroundings(ROAD, BEFORE_AND_BEHIND + 0.1, EMPTY, np.zeros(0))
    assert decided(PIECE, own) is not None
    assert decided(PIECE, own, other) is None


def test_a_wall_and_an_object_of_a_map_with_counts_of_beams_are_claimed():
    own = holding(np.concatenate([PIECE, BEFORE_AND_BEHIND]))
    assert decided(PIECE, own, semantic=Semantic.BUILDING) is None
    assert decided(PIECE, own, counted=True) is None


def test_parked_vehicles_and_buildings_are_no_pieces_and_ghost_trails_do_not_stand():
    xyz = np.column_stack([np.arange(6.0), np.zeros(6), np.full(6, 1.0)])
    semantic = np.array(
        [
            Semantic.GROUND,
            Semantic.BUILDING,
            Semantic.VEGETATION,
            Semantic.MOBILE,
            Semantic.MOBILE,
            Semantic.OTHER,
        ]
    )
    instance = np.array([-1, 0, 1, 2, -1, -1])
    height = np.array([0.0, 1.0, 1.0, 1.0, 1.0, 5.0])
    found = surroundings(xyz, semantic, instance, height)
    assert found.ground[:, 0].tolist() == [0]
    assert found.standing[:, 0].tolist() == [1, 2, 3, 5]
    assert found.pieces[:, 0].tolist() == [2, 4]
