"""Azimuths into which a sensor never looked, estimated from ground that a sensor of known sector met."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from subiaco_geo.frames import Floats, make_pose
from subiaco_geo.free_space.azimuth_sector import Arcs, estimate_blind_arcs, in_arcs, path_poses
from subiaco_geo.free_space.depth_images import UNKNOWN, DepthImages, ImageGrid
from subiaco_geo.free_space.expected_visibility import (
    ExpectedVisibility,
    ExpectedVisibilityConfig,
    OccupiedVoxels,
    occupied_columns,
    occupied_corner,
    render_views,
)
from subiaco_geo.free_space.sensor_view import SensorView, spin_headings
from subiaco_geo.free_space.view_estimation import blind_arcs, with_blind_arcs

CORNER = np.array([391_000.0, 6_464_000.0])
REACH = 25.0
AHEAD: Arcs = ((np.radians(90.0), np.radians(180.0)),)
BEHIND: Arcs = ((np.radians(270.0), np.radians(180.0)),)


def straight(length: float = 60.0) -> tuple[Floats, Floats]:
    """Positions (K, 2) and headings (K,) of a drive to the east."""
    x = np.arange(0.0, length, 0.5)
    return np.column_stack([x, np.zeros_like(x)]), np.zeros(len(x))


def bend() -> tuple[Floats, Floats]:
    """Drive to the east, then to the north."""
    eyes, headings = straight(40.0)
    turned = np.column_stack([np.full(len(eyes), 40.0), eyes[:, 0]])
    return np.vstack([eyes, turned]), np.concatenate([headings, np.full(len(eyes), 0.5 * np.pi)])


def ground(eyes: Floats, headings: Floats, blind: Arcs, reach: float = REACH) -> Floats:
    """Ground (M, 2) that a sensor with blind arcs meets: points 0.5 m apart, one in ten lost."""
    low, high = eyes.min(axis=0) - reach, eyes.max(axis=0) + reach
    spans = [np.arange(a, b, 0.5) + 0.25 for a, b in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*spans, indexing="ij"), axis=-1).reshape(-1, 2)
    met = np.zeros(len(places), dtype=bool)
    for eye, heading in zip(eyes, headings, strict=True):
        way = places - eye
        azimuth = np.arctan2(way[:, 1], way[:, 0]) - heading
        met |= (np.hypot(way[:, 0], way[:, 1]) < reach) & ~in_arcs(azimuth, blind)
    return places[met & (np.random.default_rng(0).random(len(places)) < 0.9)]


def found(eyes: Floats, headings: Floats, cloud: Floats) -> Arcs:
    return estimate_blind_arcs(eyes + CORNER, headings, cloud + CORNER, REACH)


def blind_degrees(arcs: Arcs) -> set[int]:
    """Whole degrees that lie in arcs."""
    angles = np.arange(360)
    return set(angles[in_arcs(np.radians(angles + 0.5), arcs)].tolist())


@pytest.mark.parametrize("drive", [straight, bend])
def test_a_sensor_that_looks_all_around_has_no_blind_azimuth(drive: object) -> None:
    eyes, headings = drive()  # type: ignore[operator]
    assert found(eyes, headings, ground(eyes, headings, ())) == ()


@pytest.mark.parametrize("drive", [straight, bend])
@pytest.mark.parametrize(
    "blind",
    [
        pytest.param(AHEAD, id="looks ahead"),
        pytest.param(BEHIND, id="looks behind"),
        pytest.param(((np.radians(135.0), np.radians(90.0)),), id="270 degrees"),
        pytest.param(((np.radians(180.0), np.radians(180.0)),), id="looks to the left"),
        pytest.param(((np.radians(160.0), np.radians(40.0)),), id="mast behind"),
    ],
)
def test_blind_azimuths_of_a_known_sector_are_found_to_15_degrees(drive: object, blind: Arcs) -> None:
    eyes, headings = drive()  # type: ignore[operator]
    arcs = found(eyes, headings, ground(eyes, headings, blind))
    first, extent = np.degrees(blind[0])
    known = blind_degrees(arcs)
    surely = {round(first + a) % 360 for a in range(10, round(extent) - 10)}
    assert surely <= known
    perhaps = {round(first + a) % 360 for a in range(-15, round(extent) + 15)}
    assert known <= perhaps


def test_two_blind_arcs_are_found_apart() -> None:
    eyes, headings = bend()
    blind = ((np.radians(-40.0), np.radians(80.0)), (np.radians(140.0), np.radians(80.0)))
    known = blind_degrees(found(eyes, headings, ground(eyes, headings, blind)))
    assert {0, 20, 340, 160, 180, 200} <= known
    assert not {70, 90, 110, 250, 270, 290} & known


def test_a_sector_turns_with_the_vehicle() -> None:
    """Where the headings say nothing of a bend, no fixed azimuth is blind."""
    eyes, headings = bend()
    cloud = ground(eyes, headings, AHEAD)
    assert found(eyes, headings, cloud) != ()
    wrong = blind_degrees(found(eyes, np.zeros(len(eyes)), cloud))
    assert 180 not in wrong or 90 not in wrong


def test_a_cloud_that_ends_at_both_ends_of_its_drive_shows_no_sector() -> None:
    eyes, headings = straight()
    cloud = ground(eyes, headings, ())
    cut = cloud[(cloud[:, 0] > 0.0) & (cloud[:, 0] < 59.5)]
    assert found(eyes, headings, cut) == ()


@pytest.mark.parametrize("beyond", [0.0, 2.0, 4.0])
def test_a_short_street_cut_a_little_beyond_both_ends_and_sides_shows_no_sector(beyond: float) -> None:
    eyes, headings = straight(36.0)
    cloud = ground(eyes, headings, ())
    inside = (cloud[:, 0] > -beyond) & (cloud[:, 0] < 35.5 + beyond) & (np.abs(cloud[:, 1]) < 16.0)
    assert found(eyes, headings, cloud[inside]) == ()


def test_a_cloud_that_was_cut_beside_its_drive_shows_no_sector() -> None:
    """The cloud holds one side of the road up to the middle of it, over the length of the drive."""
    eyes, headings = straight()
    cloud = ground(eyes, headings, ())
    cut = cloud[(cloud[:, 1] > -2.0) & (cloud[:, 0] > 0.0) & (cloud[:, 0] < 59.5)]
    assert found(eyes, headings, cut) == ()


def test_a_drive_far_beyond_its_cloud_shows_no_sector() -> None:
    eyes, headings = straight(200.0)
    cloud = ground(eyes, headings, ())
    cut = cloud[(cloud[:, 0] > 80.0) & (cloud[:, 0] < 130.0)]
    assert found(eyes, headings, cut) == ()


def test_stray_points_do_not_open_a_blind_sector() -> None:
    eyes, headings = straight()
    cloud = ground(eyes, headings, AHEAD)
    stray = np.random.default_rng(1).uniform([-25.0, -25.0], [0.0, 25.0], (60, 2))
    assert 180 in blind_degrees(found(eyes, headings, np.vstack([cloud, stray])))


@settings(max_examples=10, deadline=None)
@given(turn=st.floats(-np.pi, np.pi), mounted=st.sampled_from([0.0, 0.5 * np.pi, np.pi]))
def test_the_sector_does_not_depend_on_the_course(turn: float, mounted: float) -> None:
    """Rotated as a whole, a drive shows the same sector; a sensor mounted askew shows it in its own axes."""
    eyes, headings = straight(30.0)
    cloud = ground(eyes, headings, AHEAD)
    c, s = np.cos(turn), np.sin(turn)
    turned = np.array([[c, s], [-s, c]])
    known = blind_degrees(found(eyes @ turned, headings + turn - mounted, cloud @ turned))
    shift = round(np.degrees(mounted))
    assert {(a + shift) % 360 for a in range(110, 250)} <= known
    assert not {(a + shift) % 360 for a in (*range(75), *range(286, 360))} & known


def test_every_pass_of_a_drive_counts_and_its_end() -> None:
    x = np.concatenate([np.arange(0.0, 10.0, 0.1), np.arange(10.0, 3.0, -0.1)])
    chosen = path_poses(np.column_stack([x, np.zeros_like(x), np.zeros_like(x)]))
    assert chosen[0] == 0
    assert chosen[-1] == len(x) - 1
    assert np.abs(np.diff(x[chosen])).max() < 0.71
    assert len(chosen) > 30
    assert len(path_poses(np.zeros((0, 3)))) == 0


def test_headings_follow_the_body_whatever_axis_is_upright() -> None:
    yaw = np.radians([0.0, 40.0, 200.0])
    c, s, z = np.cos(yaw), np.sin(yaw), np.zeros(3)
    vehicle = np.stack([np.stack([c, s, z], 1), np.stack([-s, c, z], 1), np.tile([0.0, 0.0, 1.0], (3, 1))], 2)
    camera = vehicle @ np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    for rotations in (vehicle, camera):
        assert np.allclose(np.exp(1j * spin_headings(rotations)), np.exp(1j * yaw))
    assert len(spin_headings(vehicle[:0])) == 0


def test_images_know_nothing_of_blind_azimuths() -> None:
    grid = ImageGrid.covering(10.0, -40.0, 50.0)
    images = DepthImages(
        np.zeros((2, 3)), np.tile([0.0, 0.0, 1.0], (2, 1)), np.full((2, grid.rows, 36), 7, np.uint16), grid
    )
    closed = images.blinded(np.array([0.0, 0.5 * np.pi]), AHEAD).images == UNKNOWN
    azimuth = np.arange(36) * 10.0 - 175.0
    assert np.array_equal(closed[0, 0], np.abs(azimuth) > 90.0)
    assert np.array_equal(closed[1, 0], azimuth < 0.0)
    assert images.blinded(np.zeros(2), ()) is images


def test_space_behind_the_first_pose_of_a_view_ahead_is_not_seen() -> None:
    """A place that would count as free for a view all around is unknown to one that looks ahead."""
    config = ExpectedVisibilityConfig()
    eyes, headings = straight()
    cloud = ground(eyes, headings, AHEAD)
    world = np.column_stack([cloud + CORNER, np.zeros(len(cloud))])
    positions = np.column_stack([eyes + CORNER, np.full(len(eyes), 2.0)])
    poses = make_pose(np.tile(np.eye(3), (len(eyes), 1, 1)), positions)
    images = render_views(world, positions, np.tile([0.0, 0.0, 1.0], (len(eyes), 1)), config)
    corner = occupied_corner(world.min(axis=0), config)
    occupied = OccupiedVoxels.of(world, corner, config.occupied)
    view = SensorView(np.radians(-25.0), np.radians(15.0), REACH)
    arcs = blind_arcs(poses, occupied_columns(occupied.keys, corner, config.occupied), REACH)
    around = ExpectedVisibility(images, occupied, view, config)
    ahead = replace(around, images=images.blinded(headings, arcs), view=replace(view, blind=arcs))
    behind = np.array([[-12.0, 0.0, 3.5], [-8.0, 3.0, 3.5]]) + np.append(CORNER, 0.0)
    before = np.array([[20.0, 5.0, 3.5], [72.0, 3.0, 3.5]]) + np.append(CORNER, 0.0)
    assert around.passed(behind).all()
    assert not ahead.observed(behind).any()
    assert np.allclose(ahead.free_probability(behind), 0.5)
    assert ahead.passed(before).all()


def test_azimuths_that_a_map_states_are_not_estimated() -> None:
    """A cloud that ends at its first pose looks like that of a view ahead; its map tells that it is none."""
    config = ExpectedVisibilityConfig()
    eyes, headings = straight()
    columns = ground(eyes, headings, AHEAD) + CORNER
    positions = np.column_stack([eyes + CORNER, np.full(len(eyes), 2.0)])
    poses = make_pose(np.tile(np.eye(3), (len(eyes), 1, 1)), positions)
    unknown = SensorView(np.radians(-25.0), np.radians(15.0), REACH)
    assert with_blind_arcs(unknown, poses, columns, config).blind
    around = replace(unknown, blind=())
    assert with_blind_arcs(around, poses, columns, config) is around
