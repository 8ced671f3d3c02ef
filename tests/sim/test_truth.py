"""What counts as changed, and what counts as seen."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from subiaco_geo.codes import Change
from subiaco_geo.frames import make_pose
from subiaco_sim.buildings import House, Shed
from subiaco_sim.collect import FirstPoints, MeanPoints
from subiaco_sim.config import TruthConfig
from subiaco_sim.ground import Patch, Road, Terrain
from subiaco_sim.labels import decide, ground_change, true_change
from subiaco_sim.primitives import Material, box, sample_surface
from subiaco_sim.scene import BUILDING, MOBILE, VEGETATION, GroundItem, Item, Placed, Scene, compile_meshes
from subiaco_sim.seeing import OtherDrive, seen_from

NO_IDS = np.zeros(0, dtype=np.int64)


def flat_scene() -> Scene:
    far_road = Road(np.array([[0.0, 500.0]]))
    terrain = Terrain(far_road, (-50, -50, 50, 50), (0.0, 0.0), 1.0)
    return Scene(terrain, (), (), np.zeros((0, 2)))


def pair(before: Shed | House | None, after: Shed | House | None, shift: float = 0.0) -> Item:
    first = Placed(before, 0.0, 0.0) if before else None
    second = Placed(after, shift, 0.0) if after else None
    return Item(1, "shed", BUILDING, first, second)


def test_a_body_that_gains_height_has_known_statistics_and_is_increased() -> None:
    found = true_change(pair(Shed(7.8, 5.8, 3.0), Shed(7.8, 5.8, 4.0)), flat_scene())
    assert found.change == Change.INCREASED
    assert found.delta_h == pytest.approx(1.0, abs=0.01)
    assert found.delta_v == pytest.approx(48.0, rel=0.01)  # 16 x 12 columns of 0.5 m are touched
    assert found.iou == pytest.approx(0.75, abs=0.01)


def test_one_epoch_only_is_added_or_removed() -> None:
    assert true_change(pair(None, Shed(4, 4)), flat_scene()).change == Change.ADDED
    assert true_change(pair(Shed(4, 4), None), flat_scene()).change == Change.REMOVED


def test_a_new_chimney_is_no_change() -> None:
    house = House(10, 11, "gable")
    other = House(10, 11, "gable", chimney=True)
    assert true_change(pair(house, other), flat_scene()).change == Change.UNCHANGED


@pytest.mark.parametrize(
    ("semantic", "dh", "dv", "relative", "iou", "expected"),
    [
        (BUILDING, 0.51, 1.0, 0.0, 0.5, Change.INCREASED),
        (BUILDING, 0.49, 1.0, 0.09, 0.5, Change.UNCHANGED),
        (BUILDING, 0.0, -9.0, -0.11, 0.5, Change.DECREASED),
        (BUILDING, 0.8, -9.0, -0.11, 0.5, Change.DECREASED),
        (VEGETATION, 0.31, 1.0, 0.0, 0.5, Change.INCREASED),
        (VEGETATION, 0.29, 1.0, 0.14, 0.5, Change.UNCHANGED),
        (VEGETATION, 0.0, -1.0, -0.16, 0.1, Change.DECREASED),
        (MOBILE, 0.9, 9.0, 0.5, 0.5, Change.UNCHANGED),
        (MOBILE, 0.0, 0.0, 0.0, 0.1, Change.NOT_REPORTED),
    ],
)
def test_the_published_thresholds_decide(
    semantic: int, dh: float, dv: float, relative: float, iou: float, expected: Change
) -> None:
    assert decide(semantic, dh, dv, relative, 0.5, iou) == expected


@pytest.mark.parametrize(
    ("length", "rise", "expected"),
    [
        (10, 0.25, Change.INCREASED),
        (10, -0.3, Change.DECREASED),
        (10, 0.1, Change.UNCHANGED),
        (8, 0.3, Change.UNCHANGED),
    ],
)
def test_ground_changes_count_from_their_rise_and_area(length: float, rise: float, expected: Change) -> None:
    assert ground_change(GroundItem(1, Patch(0, 0, length, 3.0, 0.3, rise), "")) == expected


def blind_drive() -> OtherDrive:
    """A drive along x at y = 0, a wall at y = 5 from x = -5 to 5, ground all around."""
    wall = box(10.0, 0.2, 3.0, Material.BRICK).placed(0, 5.0, 0)
    ground = box(200, 200, 1.0, Material.ASPHALT).placed(0, 0, -1.0)
    positions = np.column_stack([np.linspace(-1, 1, 5), np.zeros(5), np.full(5, 2.0)])
    return OtherDrive(
        compile_meshes([(0, ground), (1, wall)]), make_pose(np.tile(np.eye(3), (5, 1, 1)), positions), 60.0
    )


def test_a_place_is_unseen_exactly_where_the_wall_hides_it() -> None:
    places = np.array(
        [
            [0.0, 4.9, 1.0],  # the face of the wall
            [0.0, 8.0, 0.5],  # behind it
            [0.0, 8.0, 4.5],  # behind it, above the sight line
            [20.0, 8.0, 0.5],  # beside it
            [0.0, 3.0, 1.0],  # empty space in front
            [0.0, 70.0, 9.0],  # out of range
            [0.3, 0.3, 9.0],  # over the roof, outside the field of view
        ]
    )
    seen = seen_from(blind_drive(), places, np.full(len(places), 7), NO_IDS, TruthConfig())
    assert seen.tolist() == [True, False, True, True, True, False, False]


def test_the_inside_of_a_reshaped_body_counts_as_seen_up_to_its_limit_and_only_for_itself() -> None:
    places = np.array([[0.0, 6.5, 1.0], [0.0, 9.0, 1.0]])
    drive, config = blind_drive(), TruthConfig(own_body=2.0)
    own = seen_from(drive, places, np.array([1, 1]), np.array([1]), config)
    other = seen_from(drive, places, np.array([2, 2]), np.array([2]), config)
    assert own.tolist() == [True, False]
    assert other.tolist() == [False, False]


@given(x=st.floats(-90, 90), y=st.floats(-90, 90), yaw=st.floats(-7, 7))
def test_placing_a_mesh_keeps_its_area(x: float, y: float, yaw: float) -> None:
    mesh = box(4.0, 3.0, 2.0, Material.BRICK)
    assert mesh.areas().sum() == pytest.approx(52.0)
    assert mesh.placed(x, y, 1.0, yaw).areas().sum() == pytest.approx(52.0)


def test_samples_of_a_surface_lie_on_it() -> None:
    mesh = box(4.0, 3.0, 2.0, Material.BRICK)
    points = sample_surface(mesh, 0.1, np.random.default_rng(6))
    assert len(points) == pytest.approx(5200, rel=0.1)
    assert compile_meshes([(0, mesh)]).distance_to_surface(points).max() < 1e-5


def test_points_kept_by_voxel_do_not_depend_on_how_they_came() -> None:
    rng = np.random.default_rng(7)
    xyz, ids = rng.uniform(0, 3, (5000, 3)), rng.integers(0, 9, 5000)
    whole, parts, mean = FirstPoints(0.5), FirstPoints(0.5), MeanPoints(0.5)
    whole.add(xyz, ids)
    for k in range(0, 5000, 1000):
        parts.add(xyz[k : k + 1000], ids[k : k + 1000])
        mean.add(xyz[k : k + 1000], xyz[k : k + 1000, 0], ids[k : k + 1000])
    for one, other in zip(whole.result(), parts.result(), strict=True):
        np.testing.assert_array_equal(one, other)
    points, attribute, _, count = mean.result()
    assert count.sum() == 5000
    np.testing.assert_allclose(points[:, 0], attribute)
    np.testing.assert_allclose((points * count[:, None]).sum(axis=0), xyz.sum(axis=0))
