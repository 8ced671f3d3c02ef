"""Ghost trails are recognised by beams that passed through them; static objects are left alone."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import Scene, ground_z
from scipy.spatial import cKDTree

from subiaco_change.decisions.point_labels import unlabelled
from subiaco_change.objects.voxel_objects import EpochView, Reach, build_voxels
from subiaco_change.segmentation.classes import SemanticsConfig, label_points
from subiaco_change.segmentation.instances import InstanceConfig, segment
from subiaco_change.visibility_evidence import EvidenceConfig, make_observer
from subiaco_geo.clouds import PointCloud, voxel_downsample, voxel_indices, voxel_keys
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.visibility import VisibilityGrid

SCENE = Scene(cars=[(-10, 3), (12, 4)])


def trail(seed=0, count=2500):
    """What a car leaves that drives along the street: returns all through the way of its body."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform([-28, -2.7, 0.2], [28, -0.9, 1.5], (count, 3))
    xyz[:, 2] += ground_z(xyz[:, 0], xyz[:, 1])
    return xyz


@pytest.fixture(scope="module")
def labelled():
    ghosts = trail()
    cloud = voxel_downsample(PointCloud(np.concatenate([SCENE.cloud(4).xyz, ghosts])), 0.25)
    ghostly = cKDTree(ghosts).query(cloud.xyz)[0] < 0.1
    passed = np.where(ghostly, 300.0, 2.0)
    result = label_points(cloud, SemanticsConfig(), passed)
    return cloud, ghostly, result, segment(cloud, result, InstanceConfig())[1]


def test_a_trail_is_mobile_and_no_object(labelled):
    _, ghostly, result, instance = labelled
    mine = ghostly & (result.height_above_ground > 0.25)
    assert (result.semantic[mine] == Semantic.MOBILE).mean() > 0.95
    assert result.moving[mine].mean() > 0.95
    assert np.all(instance[result.moving] == -1)


def test_what_stands_beside_a_trail_keeps_its_class(labelled):
    cloud, _, result, _ = labelled
    plain = label_points(cloud, SemanticsConfig())
    apart = cKDTree(trail()).query(cloud.xyz)[0] > 0.7
    assert not result.moving[apart].any()
    assert not plain.moving.any()
    still = np.abs(cloud.xyz[:, 1] + 1.8) > 2.5
    assert (result.semantic[still] == plain.semantic[still]).mean() > 0.99


def test_the_edge_of_a_roof_that_beams_graze_stands():
    cloud = SCENE.survey(4).cloud
    height = cloud.xyz[:, 2] - ground_z(cloud.xyz[:, 0], cloud.xyz[:, 1])
    roof = (np.abs(cloud.xyz[:, :2] - SCENE.cars[0]) < 2.0).all(axis=1) & (height > 1.0)
    assert np.count_nonzero(roof) > 20
    result = label_points(cloud, SemanticsConfig(), np.where(roof, 60.0, 1.0))
    assert not result.moving.any()


def test_the_lower_leaves_of_a_crown_are_no_trail_and_a_trail_beneath_a_high_crown_is_one():
    """Most beams pass through the thin lower part of a crown; the street tree hangs over the way of a car."""
    rng = np.random.default_rng(5)
    crown = rng.uniform([-1.6, -1.6, 0.8], [1.6, 1.6, 7.0], (3000, 3))
    crown = crown[np.hypot(crown[:, 0], crown[:, 1]) < 1.6] + (2.0, -6.2, 0.0)
    high = rng.uniform([-6.0, -4.0, 4.5], [-2.0, -0.5, 8.0], (3000, 3))
    leaves = np.concatenate([crown, high])
    leaves[:, 2] += ground_z(leaves[:, 0], leaves[:, 1])
    ghosts = trail()
    street = SCENE.cloud(4).xyz
    street = street[cKDTree(leaves[:, :2]).query(street[:, :2])[0] > 0.5]
    cloud = voxel_downsample(PointCloud(np.concatenate([street, ghosts, leaves])), 0.25)
    ghostly, leafy = (cKDTree(places).query(cloud.xyz)[0] < 0.1 for places in (ghosts, leaves))
    height = cloud.xyz[:, 2] - ground_z(cloud.xyz[:, 0], cloud.xyz[:, 1])
    thin = leafy & (height < 3.5)
    result = label_points(cloud, SemanticsConfig(), np.where(ghostly, 300.0, np.where(thin, 60.0, 2.0)))
    assert not result.moving[leafy].any()
    assert result.moving[ghostly & (height > 0.25)].mean() > 0.95


def test_a_long_trail_close_to_a_fence_is_a_trail():
    along, up = np.meshgrid(np.arange(-28.0, 28.0, 0.1), np.arange(0.2, 1.5, 0.1))
    fence = np.column_stack([along.ravel(), np.full(along.size, -0.7), up.ravel()])
    fence[:, 2] += ground_z(fence[:, 0], fence[:, 1])
    ghosts = trail()
    cloud = voxel_downsample(PointCloud(np.concatenate([SCENE.cloud(4).xyz, ghosts, fence])), 0.25)
    ghostly = cKDTree(ghosts).query(cloud.xyz)[0] < 0.1
    result = label_points(cloud, SemanticsConfig(), np.where(ghostly, 300.0, 1.0))
    assert result.moving[ghostly & (result.height_above_ground > 0.25)].mean() > 0.9


def test_few_passes_are_no_movement():
    cloud = SCENE.survey(4).cloud
    assert not label_points(cloud, SemanticsConfig(), np.full(len(cloud), 5.0)).moving.any()


def test_an_observer_counts_the_beams_of_its_visibility_layer():
    world = np.array([[0.2, 0.2, 0.2], [5.2, 0.2, 0.2], [9.2, 0.2, 0.2]])
    keys = voxel_keys(voxel_indices(world[:2], 0.5))
    order = np.argsort(keys)
    hits, passes = np.array([4, 0], np.uint32)[order], np.array([8, 60], np.uint32)[order]
    grid = VisibilityGrid(np.zeros(3), 0.5, keys[order], hits, passes)
    survey = SurveyMap(PointCloud(world), visibility=grid)
    assert make_observer(survey, EvidenceConfig()).passes(world) == pytest.approx([2.0, 60.0, 0.0])
    assert make_observer(survey, EvidenceConfig(source="shadow")).passes(world) is None


def test_a_trail_occupies_no_place_and_nothing_is_said_of_it():
    rng = np.random.default_rng(3)
    place = rng.uniform((0, 0, 0.3), (4, 2, 1.5), (400, 3))
    count = len(place)
    semantic = np.full(count, Semantic.MOBILE, dtype=np.uint8)
    rest = (
        np.zeros((count, 3)),
        semantic,
        np.zeros(count, np.int32),
        place[:, 2],
        np.ones(count),
        np.ones(count),
    )
    parked = EpochView(place, *rest)
    few = replace(parked, instance=np.full(count, -1, dtype=np.int32), passed=np.ones(count))
    trail = replace(few, passed=np.full(count, 9.0))
    everywhere = lambda xyz: np.ones(len(xyz), dtype=bool)  # noqa: E731
    reach = Reach(0.35, 1.0, 1.25)
    assert build_voxels(parked, parked, everywhere, 0.5, reach).occupied_in_other.all()
    assert build_voxels(
        parked, few, everywhere, 0.5, reach
    ).occupied_in_other.all()  # too few points for an object
    assert not build_voxels(parked, trail, everywhere, 0.5, reach).occupied_in_other.any()
    assert set(unlabelled(trail).change.tolist()) == {Change.NOT_REPORTED}
    assert set(unlabelled(parked).change.tolist()) == {Change.UNCHANGED}
