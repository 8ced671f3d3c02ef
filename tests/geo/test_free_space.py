"""Expected visibility: what a survey must have seen of a street with a wall, a crown and a yard."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.free_space.depth_images import SKY, UNKNOWN, ImageGrid, Surfaces, render
from subiaco_geo.free_space.expected_visibility import (
    ExpectedVisibility,
    ExpectedVisibilityConfig,
    OccupiedVoxels,
    occupied_corner,
    render_views,
    sample_poses,
)
from subiaco_geo.free_space.sensor_view import SensorView, described_view, spin_axes
from subiaco_geo.free_space.view_estimation import edge_of_view, estimate_view, view_histogram

ORIGIN = np.array([391_000.0, 6_464_000.0, 10.0])
VIEW = SensorView(np.radians(-25.0), np.radians(22.5), 50.0)
CONFIG = ExpectedVisibilityConfig()


def sheet(first: tuple[float, float], second: tuple[float, float], leaf: float = 0.25) -> Floats:
    """Grid (N, 2) of points over two spans, one a leaf."""
    axes = [np.arange(low, high, leaf) + 0.5 * leaf for low, high in (first, second)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


def scene() -> Floats:
    """Street along x; on its left a wall of 4 m at y = 10, before x = 20 m; beyond it a lawn up to y = 20."""
    road = sheet((-30, 60), (-8, 10))
    lawn = sheet((25, 60), (10, 20))
    ground = np.vstack([road, lawn])
    wall = sheet((-30, 20), (0, 4))
    return np.vstack(
        [
            np.column_stack([ground, np.zeros(len(ground))]),
            np.column_stack([wall[:, 0], np.full(len(wall), 10.0), wall[:, 1]]),
        ]
    )


def lane(step: float = 2.0) -> Floats:
    x = np.arange(-25.0, 55.0, step)
    return np.column_stack([x, np.zeros_like(x), np.full_like(x, 2.0)])


def expected(
    points: Floats, eyes: Floats, view: SensorView = VIEW, axes: Floats | None = None
) -> ExpectedVisibility:
    world, eyes = points + ORIGIN, eyes + ORIGIN
    up = np.tile([0.0, 0.0, 1.0], (len(eyes), 1)) if axes is None else axes
    corner = occupied_corner(world.min(axis=0), CONFIG)
    return ExpectedVisibility(
        render_views(world, eyes, up, CONFIG),
        OccupiedVoxels.of(world, corner, CONFIG.occupied),
        view,
        CONFIG,
    )


@pytest.fixture(scope="module")
def street() -> ExpectedVisibility:
    return expected(scene(), lane())


def at(*places: tuple[float, float, float]) -> Floats:
    return np.array(places) + ORIGIN


def test_space_over_the_street_and_before_the_wall_is_free(street: ExpectedVisibility) -> None:
    places = at((0, 5, 1.0), (0, 8.5, 3.0), (10, -4, 1.5), (40, 15, 1.0))
    assert street.passed(places).all()
    assert street.observed(places).all()
    assert (street.free_probability(places) > 0.8).all()


def test_space_above_a_wall_is_free_although_only_the_sky_is_behind_it(street: ExpectedVisibility) -> None:
    places = at((0, 10, 5.2), (0, 12, 6.5), (-5, 10, 7.0))
    assert street.passed(places).all()


def test_nothing_behind_a_closed_wall_is_seen(street: ExpectedVisibility) -> None:
    yard = np.stack(np.meshgrid([-10.0, 0.0, 5.0], [11.0, 13.0, 16.0], [0.3, 1.0, 2.0]), axis=-1).reshape(
        -1, 3
    )
    assert not street.observed(yard + ORIGIN).any()
    assert not street.passed(yard + ORIGIN).any()
    assert np.allclose(street.free_probability(yard + ORIGIN), 0.5)


def test_what_holds_points_is_seen_and_is_not_free(street: ExpectedVisibility) -> None:
    places = at((0, 10, 2.0), (3, 10, 1.0), (3, 2, 0.05))
    assert street.observed(places).all()
    assert not street.passed(places).any()
    assert (street.free_probability(places) < 0.5).all()


def test_a_place_without_points_just_behind_the_front_of_a_wall_is_unknown(
    street: ExpectedVisibility,
) -> None:
    """Images are coarser than the cloud: that poses meet the wall near a place does not occupy the place."""
    places = at((0, 9.9, 2.0), (3, 9.9, 1.0))
    assert not street.occupied.holds(places).any()
    assert (street.images.looks(places, street._limits()).surface > 0).all()
    assert np.all(street.free_probability(places) >= 0.5)


def test_beyond_the_useful_range_and_above_the_field_of_view_nothing_is_known() -> None:
    one = expected(scene(), lane()[:3])  # from x = -25 to -21 m
    far, high = at((40, 0, 1.5)), at((-24, 6, 9.0))
    assert not one.observed(far).any()
    assert not one.observed(high).any()
    tall = SensorView(VIEW.elevation_min, np.radians(60.0), VIEW.useful_range)
    assert expected(scene(), lane()[:3], tall).passed(high).all()


def test_a_road_that_swallows_beams_does_not_make_the_space_below_the_horizon_free() -> None:
    """Nothing returned at all: the sky is free, what lies below the sensor stays unknown."""
    far_off = np.array([[0.0, 100.0, 0.0]])
    nothing = expected(far_off, lane())
    assert nothing.passed(at((0, 20, 6.0))).all()
    assert not nothing.observed(at((0, 20, 1.0), (0, 10, 0.5))).any()


def test_space_behind_a_thin_crown_is_free_where_several_poses_look_through() -> None:
    rng = np.random.default_rng(3)
    leaves = rng.normal(0.0, 1.0, (40, 3)) * 1.0 + (0.0, 8.0, 5.0)
    trunkless = np.vstack([scene()[:, :3], leaves])
    street = expected(trunkless[trunkless[:, 1] < 9.9], lane())
    behind = np.column_stack([np.linspace(-1, 1, 9), np.full(9, 13.0), np.full(9, 6.0)]) + ORIGIN
    assert street.passed(behind).mean() > 0.5
    within = leaves[:5] + ORIGIN
    assert not street.passed(within).any()


def test_more_poses_never_make_free_space_unknown() -> None:
    points, rng = scene(), np.random.default_rng(0)
    places = rng.uniform((-20, -8, 0.2), (50, 25, 9), (3000, 3)) + ORIGIN
    few, many = (expected(points, lane()[::step]) for step in (3, 1))
    assert few.passed(places).sum() > 500
    assert not (few.passed(places) & ~many.passed(places)).any()
    assert not (few.observed(places) & ~many.observed(places)).any()


@settings(max_examples=8, deadline=None)
@given(
    st.floats(-np.pi, np.pi),
    st.tuples(st.floats(-500, 500), st.floats(-500, 500), st.floats(-20, 20)),
)
def test_the_answer_moves_with_the_survey(turn: float, shift: tuple[float, float, float]) -> None:
    """A rotation about the vertical and a shift change verdicts on the borders of cells alone."""
    points, eyes = scene()[::2], lane(4.0)
    places = np.random.default_rng(1).uniform((-20, -8, 0.2), (50, 25, 9), (1500, 3))
    here = expected(points, eyes)
    rotation = Rotation.from_euler("z", turn).as_matrix()
    there = expected(points @ rotation.T + shift, eyes @ rotation.T + shift)
    first = here.passed(places + ORIGIN)
    second = there.passed(places @ rotation.T + shift + ORIGIN)
    assert (first != second).mean() < 0.05


def test_a_yawed_and_a_tilted_sensor_see_by_their_own_axes() -> None:
    """A sensor that looks up by 15 deg on its left sees higher there."""
    tilt = Rotation.from_euler("x", 15.0, degrees=True).as_matrix()
    eyes = lane()
    axes = spin_axes(np.tile(tilt, (len(eyes), 1, 1)))
    assert np.allclose(axes, tilt[:, 2])
    left_high = at((0, 8.0, 5.5))
    narrow = SensorView(VIEW.elevation_min, np.radians(12.0), 9.0)
    points = scene()
    assert not expected(points, eyes, narrow).observed(left_high).any()
    assert expected(points, eyes, narrow, axes).passed(left_high).all()


def test_the_spin_axis_is_the_body_axis_that_is_upright() -> None:
    camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # z forward, y down
    assert np.allclose(spin_axes(camera[None]), [[0.0, 0.0, 1.0]])
    assert np.allclose(spin_axes(np.eye(3)[None]), [[0.0, 0.0, 1.0]])
    lying = Rotation.from_euler("xyz", [45.0, 35.0, 0.0], degrees=True).as_matrix()
    assert np.allclose(spin_axes(lying[None]), [[0.0, 0.0, 1.0]])


def test_poses_of_a_second_pass_are_not_kept_again() -> None:
    way = lane(0.5)
    there_and_back = np.vstack([way, way[::-1]])
    kept = sample_poses(there_and_back, 2.0)
    assert len(kept) == pytest.approx(len(sample_poses(way, 2.0)), abs=1)
    assert len(sample_poses(way, 2.0)) == 40


def test_depths_are_ranges_and_empty_directions_sky_or_unknown() -> None:
    grid = ImageGrid.covering(1.0, -45.0, 60.0)
    wall = np.column_stack([np.full(400, 10.0), sheet((-2.5, 2.5), (-2.5, 2.5))])
    image = render(wall, np.zeros((1, 3)), grid, Surfaces(0.2, 1.5, 60.0, np.radians(3.0)))[0]
    assert image[45, 180] == pytest.approx(1000, abs=10)
    assert image[60, 0] == SKY
    assert image[30, 0] == UNKNOWN


def test_the_estimated_field_of_view_lies_near_the_true_one() -> None:
    """Towers end where 20 deg reach at 30 m; a lower view that reaches farther explains them too."""
    true = SensorView(np.radians(-25.0), np.radians(20.0), 30.0)
    facade = sheet((-30, 60), (0, 25), 0.5)
    points = np.column_stack([facade[:, 0], np.full(len(facade), 12.0), facade[:, 1]])
    eyes = lane()
    way = points[:, None] - eyes[None]
    distance = np.linalg.norm(way, axis=2)
    seen = ((distance < true.useful_range) & (way[..., 2] < np.sin(true.elevation_max) * distance)).any(
        axis=1
    )
    road = np.column_stack([sheet((-30, 60), (-8, 12), 0.5), np.zeros(180 * 40)])
    world = np.vstack([points[seen], road])
    images = render_views(world, eyes, np.tile([0.0, 0.0, 1.0], (len(eyes), 1)), CONFIG)
    found = estimate_view([view_histogram(world, images, CONFIG)], CONFIG)
    assert 8.0 < np.degrees(found.elevation_max) < 23.0
    assert 20.0 < found.useful_range < 60.0
    reached = np.sin(found.elevation_max) * found.useful_range
    assert reached == pytest.approx(np.sin(true.elevation_max) * true.useful_range, rel=0.3)


def test_a_facade_that_is_met_from_seventy_metres_shows_that_the_space_before_it_is_free() -> None:
    road = np.column_stack([sheet((-60, 80), (-20, 20)), np.zeros(560 * 160)])
    front = sheet((-2, 4), (0, 3))
    facade = np.column_stack([front[:, 0], np.full(len(front), 70.0), front[:, 1]])
    assert len(facade) < 0.01 * len(road)
    points = np.vstack([road, facade])
    bare = expected(points, lane())
    view = estimate_view([view_histogram(points + ORIGIN, bare.images, CONFIG)], CONFIG)
    assert replace(bare, view=view).passed(at((0, 64, 1.5))).all()
    assert not replace(bare, view=view).observed(at((0, 74, 1.5))).any()


def test_a_map_that_describes_its_sensor_is_believed() -> None:
    info = {"sensor": VIEW.description()}
    found = described_view(info)
    assert found is not None
    assert found.elevation_max == pytest.approx(VIEW.elevation_max)
    assert found.useful_range == 50.0
    assert found.blind is None
    assert described_view({}) is None
    for stated in ((), ((np.radians(90.0), np.pi),)):
        told = described_view({"sensor": replace(VIEW, blind=stated).description()})
        assert told is not None
        assert told.blind is not None
        assert np.allclose(np.reshape(told.blind, (-1, 2)), np.reshape(stated, (-1, 2)))
    for bad in (
        {**VIEW.description(), "azimuth_blind_deg": 90.0},
        {**VIEW.description(), "azimuth_blind_deg": [[90.0, 0.0]]},
        {"elevation_min_deg": 10.0},
        {**VIEW.description(), "elevation_max_deg": -30.0},
        3,
    ):
        with pytest.raises(InputError, match="sensor"):
            described_view({"sensor": bad})


@pytest.mark.parametrize("beyond", [0, 3])
def test_the_view_ends_where_points_become_few_from_one_step_to_the_next(beyond):
    steps = np.concatenate([np.linspace(200, 60, 50), np.full(30, beyond)]).astype(np.int64)
    assert abs(edge_of_view(steps) - 49) <= 1


def test_the_view_does_not_end_where_high_objects_become_rare_over_many_steps_or_points_are_few():
    rare = (2000 * np.exp(-np.arange(80) / 8.0)).astype(np.int64)
    few = np.concatenate([np.full(50, 5), np.zeros(30)]).astype(np.int64)
    for steps in (rare, few, rare[:4], np.zeros(1, dtype=np.int64)):
        assert edge_of_view(steps) == len(steps) - 1
