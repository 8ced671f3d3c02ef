"""What was seen through windows is a part of the building, and no plant."""

import numpy as np
import pytest

from subiaco_change.decisions.point_labels import label_rest, unlabelled
from subiaco_change.method_rules.switches import rules_switched_off
from subiaco_change.objects.voxel_objects import EpochView
from subiaco_change.segmentation.building_interiors import inside_facades
from subiaco_change.segmentation.classes import SemanticsConfig, label_points
from subiaco_change.visibility_evidence import EvidenceConfig
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change, Semantic

#: A street along x, driven at y = 0; the house stands from y = 8 to 16.
SENSOR = np.column_stack([np.arange(-30.0, 45.0, 3.0), np.zeros(25), np.full(25, 1.9)])


def facade(top: float = 6.0, window: bool = True) -> np.ndarray:
    """Front (N, 3) of 12 m at y = 8, with a row of windows from 1 to 2.2 m, and both sides of 8 m."""
    x, z = np.meshgrid(np.arange(0.0, 12.0, 0.15), np.arange(0.1, top, 0.15))
    wall = np.column_stack([x.ravel(), np.full(x.size, 8.0), z.ravel()])
    glass = (np.abs(wall[:, 2] - 1.6) < 0.6) & (wall[:, 0] % 3.0 < 1.5)
    front = wall[~glass] if window else wall
    y, z = np.meshgrid(np.arange(8.0, 16.0, 0.15), np.arange(0.1, top, 0.15))
    sides = [np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()]) for x in (0.0, 12.0)]
    return np.concatenate([front, *sides])


def scatter(low: tuple[float, float, float], high: tuple[float, float, float], count: int, seed: int):
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


def decide(free: np.ndarray, walls: np.ndarray, sensor: np.ndarray = SENSOR, upon: int = 0) -> np.ndarray:
    """Decide about free points; the last ``upon`` points of the walls are a roof."""
    xyz = np.concatenate([walls, free])
    wall = np.arange(len(xyz)) < len(walls)
    upright = wall & (np.arange(len(xyz)) < len(walls) - upon)
    return inside_facades(xyz, xyz[:, 2], wall, upright, ~wall, sensor)[len(walls) :]


def test_furniture_behind_windows_is_inside() -> None:
    assert decide(scatter((2, 9.5, 0.3), (10, 14, 2.4), 400, 1), facade()).mean() > 0.95


@pytest.mark.parametrize(
    ("width", "roofed", "inside"), [(3.0, True, True), (5.5, True, False), (3.0, False, False)]
)
def test_a_gap_between_walls_is_an_opening_if_it_is_below_a_roof_and_no_wider_than_a_door(
    width, roofed, inside
):
    """A front with glass from the floor to the eaves; without eaves two houses stand beside a gap."""
    walls = facade(top=2.8, window=False)
    glass = (walls[:, 1] == 8.0) & (np.abs(walls[:, 0] - 6.0) < width / 2)
    x, y = np.meshgrid(np.arange(0.0, 12.0, 0.2), np.arange(7.6, 9.0, 0.2))
    eaves = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 2.9)])[: None if roofed else 0]
    room = scatter((4.8, 9.5, 0.3), (7.2, 12.0, 2.3), 300, 7)
    assert (decide(room, np.concatenate([walls[~glass], eaves]), upon=len(eaves)).mean() > 0.9) == inside


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ((2, 5, 0.3), (10, 7, 2.4)),  # a shrub in the front garden
        ((14, 9, 0.3), (17, 14, 4.0)),  # a tree beside the house
        ((2, 17, 14.0), (10, 20, 19.0)),  # a crown behind the house, seen above its roof
        ((3, 19, 2.0), (9, 22, 6.0)),  # a tree in the garden behind the house, hidden by it
    ],
)
def test_plants_before_beside_and_above_a_house_are_outside(low, high) -> None:
    assert not decide(scatter(low, high, 400, 2), facade()).any()


def test_a_low_garden_wall_hides_no_interior() -> None:
    assert not decide(scatter((2, 9.5, 0.3), (10, 14, 1.5), 400, 3), facade(top=1.8, window=False)).any()


def test_without_a_survey_path_nothing_is_decided() -> None:
    inside = scatter((2, 9.5, 0.3), (10, 14, 2.4), 400, 1)
    assert not decide(inside, facade(), np.zeros((0, 3))).any()
    far = SENSOR + np.array([500.0, 0.0, 0.0])
    assert not decide(inside, facade(), far).any()


def test_points_behind_windows_are_building_and_of_no_object() -> None:
    rng = np.random.default_rng(4)
    ground = np.column_stack(
        [rng.uniform(-10, 22, 6000), rng.uniform(-6, 7.9, 6000), rng.normal(0, 0.01, 6000)]
    )
    walls = facade() + rng.normal(0, 0.005, facade().shape)
    inside = scatter((1, 9.2, 0.4), (11, 14, 2.5), 2500, 5)
    cloud = PointCloud(np.concatenate([ground, walls, inside]), np.zeros(3))
    room = np.arange(len(cloud)) >= len(ground) + len(walls)
    found = label_points(cloud, SemanticsConfig(), sensor=SENSOR)
    assert np.mean(found.semantic[room] == Semantic.BUILDING) > 0.9
    assert np.mean(found.interior[room]) > 0.8
    assert not found.interior[~room].any()
    with rules_switched_off(("building_interiors",)):
        without = label_points(cloud, SemanticsConfig(), sensor=SENSOR)
    assert np.mean(without.semantic[room] == Semantic.BUILDING) < 0.5


def test_the_label_of_an_interior_is_that_of_its_house() -> None:
    walls, inside = facade(), scatter((2, 9.5, 0.3), (10, 13, 2.4), 50, 6)
    xyz = np.concatenate([walls, inside, [[60.0, 9.0, 1.0]]])
    count, house = len(xyz), len(walls)
    instance = np.where(np.arange(count) < house, 7, -1).astype(np.int32)
    view = EpochView(
        xyz, np.tile([0.0, 1.0, 0.0], (count, 1)), np.full(count, Semantic.BUILDING, np.uint8), instance,
        xyz[:, 2], np.full(count, 0.05), np.ones(count),
    )  # fmt: skip
    labels = unlabelled(view)
    labels.instance[:house], labels.change[:house] = 7, Change.REMOVED

    def nothing(places: np.ndarray) -> np.ndarray:
        return np.zeros(len(places), dtype=bool)

    joined = label_rest(view, labels, None, (), nothing, EvidenceConfig(), np.zeros((0, 3)), nothing, 0.5)
    assert np.all(labels.change[house:-1] == Change.REMOVED)
    assert np.all(labels.instance[house:-1] == 7)
    assert labels.instance[-1] == -1  # 48 m from the house
    assert set(joined) == set(range(house, count - 1))
