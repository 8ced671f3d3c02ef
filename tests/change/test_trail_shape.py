"""Ghost trails in clouds without counts and times of beams, recognised by their shape."""

from __future__ import annotations

import numpy as np
import pytest

from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_change.segmentation.ghost_trails import trail_probability
from subiaco_change.segmentation.trail_raster import Raster, TrailShapeConfig
from subiaco_change.segmentation.trail_swaths import with_pieces
from subiaco_geo.frames import Floats

CONFIG = TrailShapeConfig()
SURE = 0.9


def street(*, hidden: tuple[float, float, float, float] | None = None, seed: int = 0) -> Floats:
    """A level street, 80 m by 20 m, about three points a cell of 0.3 m; none within x0, x1, y0, y1."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-40, 40, 50_000), rng.uniform(-10, 10, 50_000), np.zeros(50_000)])
    if hidden is not None:
        x0, x1, y0, y1 = hidden
        inside = (ground[:, 0] > x0) & (ground[:, 0] < x1) & (ground[:, 1] > y0) & (ground[:, 1] < y1)
        ground = ground[~inside]
    return ground


def shell(x: float, y: float, seed: int, height: float = 1.5, points: int = 400) -> Floats:
    """Sides, ends and roof of a vehicle of 4.4 m by 1.8 m, 0.25 m above the road, along x."""
    rng = np.random.default_rng(seed)
    u, v, w = (rng.uniform(-1, 1, points) for _ in range(3))
    z = 0.25 + (height - 0.25) * 0.5 * (w + 1)
    face = rng.integers(0, 5, points)
    u = np.where(face == 0, -1.0, np.where(face == 1, 1.0, u))
    v = np.where(face == 2, -1.0, np.where(face == 3, 1.0, v))
    z = np.where(face == 4, height, z)
    return np.column_stack([x + 2.2 * u, y + 0.9 * v, z])


def trail(y: float, first: float = -30.0, last: float = 30.0, step: float = 1.0) -> Floats:
    """What a vehicle leaves that moved along x: some points of its shell at every step."""
    places = np.arange(first, last, step)
    return np.concatenate([shell(x, y, 100 + i, points=120) for i, x in enumerate(places)])


def chances(*parts: Floats) -> list[Floats]:
    """Probability of the points of every part, in one cloud."""
    xyz = np.concatenate(parts)
    found = trail_probability(xyz, xyz[:, 2], CONFIG)
    return np.split(found, np.cumsum([len(part) for part in parts])[:-1])


def turned(degrees: float) -> Floats:
    """Rotation (3, 3) of a street about the vertical."""
    angle = np.radians(degrees)
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


@pytest.mark.parametrize("degrees", [0.0, 17.0, 45.0, 100.0])
def test_a_trail_is_told_from_its_shape_in_every_direction(degrees: float) -> None:
    turn = turned(degrees)
    ground, moved = chances(street() @ turn.T, trail(0.0) @ turn.T)
    assert (moved > SURE).mean() > 0.9
    assert (ground > 0.5).mean() < 0.01


def test_standing_vehicles_in_a_row_are_no_trail() -> None:
    row = [shell(x, -4.0, i) for i, x in enumerate(np.arange(-25.0, 25.0, 5.4))]
    assert max(float(part.max()) for part in chances(street(), *row)[1:]) < 0.5


def test_most_of_a_standing_vehicle_beside_a_trail_stays() -> None:
    """The gap is 0.3 m, one cell: both hang together in the raster."""
    _, moved, standing = chances(street(hidden=(-1.6, 1.6, 1.5, 2.7)), trail(0.0), shell(0.0, 2.1, 7))
    assert (moved > SURE).mean() > 0.85
    assert (standing > 0.5).mean() < 0.4


@pytest.mark.parametrize("degrees", [0.0, 40.0])
def test_a_row_of_parked_vehicles_beside_a_trail_stays(degrees: float) -> None:
    """The road is seen beneath the vehicles, and the row is filled: gaps of 1.4 m alone tell it apart."""
    turn = turned(degrees)
    rng = np.random.default_rng(9)
    seats = rng.uniform((-2.0, -0.7, 0.4), (2.0, 0.7, 1.1), (300, 3))
    row = [
        np.concatenate([shell(x, 2.1, i), seats + np.array([x, 2.1, 0.0])])
        for i, x in enumerate(np.arange(-27, 28, 5.8))
    ]
    parts = [part @ turn.T for part in (street(), trail(0.0), *row)]
    _, moved, *standing = chances(*parts)
    assert (moved > SURE).mean() > 0.75
    assert (np.concatenate(standing) > 0.5).mean() < 0.1
    with rules_switched_off(["parked_beside_trails"]):
        assert (np.concatenate(chances(*parts)[2:]) > 0.5).mean() > 0.5


@pytest.mark.parametrize("degrees", [0.0, 40.0])
def test_parked_vehicles_that_hide_the_ground_stay_however_narrow_the_gaps_between_them(
    degrees: float,
) -> None:
    """The gaps are 0.7 m wide, 0.3 m beside the trail; each hides the ground beneath its middle."""
    turn = turned(degrees)
    places = np.arange(-25.5, 26, 5.1)
    ground = street()
    beneath = (np.abs(ground[:, None, 0] - places) < 1.9) & (np.abs(ground[:, None, 1] - 2.1) < 0.6)
    row = [shell(x, 2.1, i, points=2500) for i, x in enumerate(places)]
    parts = [part @ turn.T for part in (ground[~beneath.any(axis=1)], trail(0.0), *row)]

    def told() -> float:
        _, moved, *standing = chances(*parts)
        return float((moved > SURE).mean() - (np.concatenate(standing) > 0.5).mean())

    assert told() > 0.7
    with rules_switched_off(["parked_beside_trails"]):
        assert told() < 0.5


@pytest.mark.parametrize(("bottom", "is_trail"), [(0.1, False), (0.3, True)])
def test_a_hedge_that_beams_penetrate_reaches_the_ground_and_a_trail_does_not(
    bottom: float, is_trail: bool
) -> None:
    """A filled swath, 1.8 m wide and 40 m long, on ground that was seen."""
    low, high = (-20, -0.9, bottom), (20, 0.9, 1.5)
    swath = np.random.default_rng(3).uniform(low, high, (9000, 3))
    chance = chances(street(), swath)[1]
    assert (chance > SURE).mean() > 0.9 if is_trail else chance.max() < 0.5


def test_a_long_hedge_on_ground_that_it_hides_is_no_trail() -> None:
    rng = np.random.default_rng(3)
    hedge = np.column_stack(
        [rng.uniform(-20, 20, 9000), rng.uniform(-0.9, 0.9, 9000), rng.uniform(0, 1.6, 9000)]
    )
    assert chances(street(hidden=(-20, 20, -0.9, 0.9)), hedge)[1].max() < 0.5


def test_what_sprawls_over_an_open_place_is_no_trail() -> None:
    """A bed of shrubs in three connected rows has the area of a long trail, and is 10 m long."""
    rows = [trail(y, -3.0, 3.0) for y in (-3.2, 0.0, 3.2)]
    links = [shell(x, y, 50 + i) for i, (x, y) in enumerate(((-2.0, -1.6), (2.0, 1.6)))]
    assert chances(street(), np.concatenate([*rows, *links]))[1].max() < 0.6


def test_a_wall_and_a_roof_overhead_are_no_trail() -> None:
    rng = np.random.default_rng(4)
    wall = np.column_stack([rng.uniform(-20, 20, 6000), rng.normal(4, 0.02, 6000), rng.uniform(0, 1.9, 6000)])
    crown = np.column_stack([rng.uniform(-5, 5, 4000), rng.uniform(-5, 5, 4000), rng.uniform(2.6, 6, 4000)])
    _, by_wall, by_crown = chances(street(), wall, crown)
    assert by_wall.max() < 0.5
    assert by_crown.max() < 0.5


def test_a_crown_over_a_trail_is_not_part_of_it() -> None:
    rng = np.random.default_rng(5)
    crown = np.column_stack([rng.uniform(-5, 5, 4000), rng.uniform(-5, 5, 4000), rng.uniform(2.6, 6, 4000)])
    _, moved, above = chances(street(), trail(0.0), crown)
    assert (moved > SURE).mean() > 0.9
    assert above.max() < 0.5


def walk(y: float, seed: int = 8, points: int = 700) -> Floats:
    """What a person on foot leaves, 0.5 m wide and 1.7 m high, along 20 m."""
    rng = np.random.default_rng(seed)
    way = np.column_stack([rng.uniform(-10, 10, points), rng.normal(y, 0.11, points)])
    return np.column_stack([way, rng.uniform(0.2, 1.7, points)])


def fence(y: float, seed: int = 9, points: int = 700) -> Floats:
    """A fence of that length and height, a plane to 2 cm."""
    rng = np.random.default_rng(seed)
    way = np.column_stack([rng.uniform(-10, 10, points), rng.normal(y, 0.02, points)])
    return np.column_stack([way, rng.uniform(0.0, 1.7, points)])


def test_a_person_on_foot_is_told_from_a_fence_by_thickness() -> None:
    _, person, standing = chances(street(), walk(-5.0), fence(5.0))
    assert (person > SURE).mean() > 0.9
    assert standing.max() < 0.5


def test_what_hides_the_ground_behind_it_is_no_thin_trail() -> None:
    assert chances(street(hidden=(-10, 10, -8.0, -5.0)), walk(-5.0))[1].max() < 0.5


def test_nothing_above_the_ground_leaves_no_trail() -> None:
    xyz = street()
    assert not trail_probability(xyz, xyz[:, 2], CONFIG).any()
    assert len(trail_probability(np.zeros((0, 3)), np.zeros(0), CONFIG)) == 0


def test_the_order_of_the_points_does_not_matter() -> None:
    xyz = np.concatenate([street(), trail(0.0), shell(10.0, 4.0, 1)])
    order = np.random.default_rng(6).permutation(len(xyz))
    straight = trail_probability(xyz, xyz[:, 2], CONFIG)
    np.testing.assert_array_equal(trail_probability(xyz[order], xyz[order, 2], CONFIG), straight[order])


def test_a_piece_beyond_a_trail_belongs_to_it_and_one_aside_does_not() -> None:
    body = np.zeros((40, 200), dtype=np.bool_)
    body[17:23, 10:120] = True  # a trail, 1.8 m wide
    body[18:22, 124], body[30:34, 124] = True, True  # 1.2 m beyond its end; 2.4 m beside its edge
    cells = np.where(np.arange(200) < 120, 0.99, 0.0) * body
    ground = np.ones_like(body)
    raster = Raster(np.zeros((0, 2), np.int64), ground, body, body, ~body, np.where(body, 1.5, -np.inf))
    found = with_pieces(cells, raster, SURE, CONFIG)
    assert (found[18:22, 124] >= SURE).all()
    assert not found[30:34, 124].any()
    np.testing.assert_array_equal(found[:, :120], cells[:, :120])


def test_a_vehicle_that_stands_in_line_with_a_trail_is_no_piece_of_it() -> None:
    _, moved, standing = chances(
        street(hidden=(32, 36.4, -0.7, 0.7)), trail(0.0), shell(34.2, 0.0, 11, points=900)
    )
    assert (moved > SURE).mean() > 0.9
    assert (standing > 0.5).mean() < 0.4
