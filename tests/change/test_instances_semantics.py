"""Classes, superpoints and instances of a small street with known answers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import Scene, car, ground_z, house, pole, tree
from scipy.spatial import cKDTree

from subiaco_change.segmentation.classes import SemanticsConfig, label_points
from subiaco_change.segmentation.clustering import voxel_clusters
from subiaco_change.segmentation.features import EigenFeatureConfig, compute_features, neighbour_eigen
from subiaco_change.segmentation.instances import InstanceConfig, segment
from subiaco_change.segmentation.superpoints import (
    SuperpointConfig,
    edge_weights,
    graph_edges,
    partition,
    potts_energy,
)
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.codes import Semantic

SCENE = Scene()


@pytest.fixture(scope="module")
def labelled():
    cloud = SCENE.survey(1).cloud
    result = label_points(cloud, SemanticsConfig())
    return cloud, result, segment(cloud, result, InstanceConfig())[1]


def near(cloud, things, maker):
    """Points within 0.15 m of a dense sampling of things."""

    dense = np.concatenate([maker(np.random.default_rng(9), *values) for values in things])
    return cKDTree(dense).query(cloud.xyz)[0] < 0.15


@pytest.mark.parametrize(
    ("maker", "things", "semantic", "share"),
    [
        (house, SCENE.houses, Semantic.BUILDING, 0.93),
        (tree, SCENE.trees, Semantic.VEGETATION, 0.93),
        (car, SCENE.cars, Semantic.MOBILE, 0.9),
        (pole, SCENE.poles, Semantic.OTHER, 0.85),
    ],
)
def test_most_points_of_every_thing_get_its_class(labelled, maker, things, semantic, share):
    cloud, result, _ = labelled
    mask = near(cloud, things, maker) & (result.height_above_ground > 0.2)
    assert (result.semantic[mask] == semantic).mean() > share


def test_open_ground_is_ground(labelled):
    cloud, result, _ = labelled
    mask = (cloud.xyz[:, 1] < -18) & (abs(result.height_above_ground) < 0.06)
    assert (result.semantic[mask] == Semantic.GROUND).mean() > 0.99


def test_every_thing_is_one_instance(labelled):
    _, result, instance = labelled
    counts = [len(np.unique(instance[(result.semantic == s) & (instance >= 0)])) for s in Semantic]
    assert counts == [0, 3, 3, 2, 1]


def test_scores_are_shares_of_the_classes(labelled):
    _, result, _ = labelled
    assert result.scores.sum(axis=1) == pytest.approx(1.0, abs=1e-5)


def test_labels_do_not_depend_on_the_order_of_the_points():
    cloud = SCENE.survey(2).cloud
    shuffle = np.random.default_rng(0).permutation(len(cloud))
    first = label_points(cloud, SemanticsConfig()).semantic
    second = label_points(cloud.select(shuffle), SemanticsConfig()).semantic
    assert (first[shuffle] == second).mean() > 0.999


def test_cars_bumper_to_bumper_stay_apart():
    scene = Scene(houses=[], trees=[], poles=[], cars=[(0, 0), (5.4, 0), (10.8, 0)])
    cloud = scene.survey(3).cloud
    result = label_points(cloud, SemanticsConfig())
    _, instance = segment(cloud, result, InstanceConfig())
    assert len(np.unique(instance[(result.semantic == Semantic.MOBILE) & (instance >= 0)])) == 3


@pytest.mark.parametrize("seed", [3, 4, 5])
@pytest.mark.parametrize("step", [(4.7, 0.0), (0.0, 2.1)])
def test_parked_cars_a_hand_apart_are_one_object_each(step, seed):
    cars = [(k * step[0], k * step[1]) for k in range(3)]
    cloud = Scene(houses=[], trees=[], poles=[], cars=cars).survey(seed).cloud
    result = label_points(cloud, SemanticsConfig())
    _, instance = segment(cloud, result, InstanceConfig())
    assert len(np.unique(instance[(result.semantic == Semantic.MOBILE) & (instance >= 0)])) == 3


def test_two_touching_crowns_are_two_trees():
    scene = Scene(houses=[], cars=[], poles=[], trees=[(0, 0, 8, 2.3), (5, 0, 8, 2.3)])
    cloud = scene.survey(3).cloud
    result = label_points(cloud, SemanticsConfig())
    _, instance = segment(cloud, result, InstanceConfig())
    ids = instance[result.semantic == Semantic.VEGETATION]
    assert len(np.unique(ids[ids >= 0])) == 2


@given(st.integers(0, 10_000), st.integers(30, 120), st.floats(0.05, 3.0))
def test_the_energy_is_never_above_the_trivial_partitions(seed, count, strength):
    rng = np.random.default_rng(seed)
    xyz = rng.random((count, 3))
    features = rng.random((count, 4)) + (xyz[:, :1] > 0.5)
    neighbours = compute_features(xyz, EigenFeatureConfig(neighbours=8)).neighbours
    config = SuperpointConfig(strength=strength)
    found = partition(features, neighbours, config)
    edges = graph_edges(neighbours)
    weights = edge_weights(features, edges, config.sigma)
    single, one = (
        potts_energy(features, labels, edges, weights, strength)
        for labels in (np.arange(count), np.zeros(count, dtype=np.int64))
    )
    assert found.energy <= min(single, one) + 1e-9
    assert found.energy == pytest.approx(potts_energy(features, found.labels, edges, weights, strength))


def test_two_flat_features_give_two_superpoints():
    xyz = np.stack(np.meshgrid(np.arange(20.0), np.arange(10.0), [0.0]), axis=-1).reshape(-1, 3)
    features = np.repeat((xyz[:, :1] > 9.5).astype(float), 2, axis=1) * 5
    found = partition(features, compute_features(xyz, EigenFeatureConfig()).neighbours, SuperpointConfig())
    assert len(np.unique(found.labels)) == 2


def test_the_eigen_kernel_agrees_with_plain_numpy():
    rng = np.random.default_rng(1)
    xyz = rng.random((200, 3))
    squared = ((xyz[:, None] - xyz) ** 2).sum(axis=2)
    neighbours = np.argsort(squared, axis=1)[:, :16].astype(np.int32)
    near_squared = np.take_along_axis(squared, neighbours.astype(int), axis=1).astype(np.float32)
    values, normals = neighbour_eigen(xyz, neighbours, near_squared, 0.09, 8)
    assert (normals[:, 2] >= 0).all()
    for i in range(0, 200, 17):
        used = max(int((near_squared[i] <= 0.09).sum()), 8)
        expected, vectors = np.linalg.eigh(np.cov(xyz[neighbours[i, :used]].T, bias=True))
        assert values[i] == pytest.approx(expected, abs=1e-9)
        assert abs(normals[i] @ vectors[:, 0]) == pytest.approx(1.0, abs=1e-9)


def test_clusters_are_connected_voxels():
    xyz = np.array([[0.1, 0, 0], [0.9, 0, 0], [5, 0, 0], [5.5, 0.4, 0.2], [20, 0, 0]])
    assert voxel_clusters(xyz, 1.0).tolist() == [0, 0, 1, 1, 2]
    assert segment_of_nothing() == 0


def segment_of_nothing():
    return len(voxel_clusters(PointCloud(np.zeros((0, 3))).xyz, 1.0))


def box(rng, x, y, length, width, height):
    """Four upright sides and a top, a hand's breadth above the ground, 400 points a square metre of plan."""
    count = 6000
    u, v, w = rng.uniform(-0.5, 0.5, (3, count))
    side = rng.integers(0, 5, count)
    u = np.where(side == 0, 0.5, np.where(side == 1, -0.5, u))
    v = np.where(side == 2, 0.5, np.where(side == 3, -0.5, v))
    w = np.where(side == 4, 0.5, w)
    z = ground_z(x, y) + 0.3 + (w + 0.5) * height
    return np.column_stack([x + u * length, y + v * width, z])


def with_things(*things):
    scene = Scene(houses=[(-15, 12)], trees=[], cars=[], poles=[])
    cloud = scene.survey(4).cloud
    xyz = np.concatenate([cloud.xyz, *things])
    return voxel_downsample(PointCloud(xyz), 0.25)


def test_a_bus_is_a_vehicle_though_its_sides_are_planes():
    bus = box(np.random.default_rng(0), 8.0, 0.0, 11.0, 2.6, 3.0)
    cloud = with_things(bus)
    found = label_points(cloud, SemanticsConfig()).semantic
    mine = cKDTree(bus).query(cloud.xyz)[0] < 0.1
    assert (found[mine] == Semantic.MOBILE).mean() > 0.9


def test_a_chimney_belongs_to_its_house():
    chimney = box(np.random.default_rng(1), -15.0, 12.0, 0.6, 0.6, 0.8) + np.array([0, 0, 5.0])
    cloud = with_things(chimney)
    found = label_points(cloud, SemanticsConfig()).semantic
    mine = cKDTree(chimney).query(cloud.xyz)[0] < 0.1
    assert (found[mine] == Semantic.BUILDING).mean() > 0.9


def test_a_bundle_of_wires_is_no_facade():
    rng = np.random.default_rng(2)
    along = rng.uniform(-20, 20, 4000)
    sag = 8 + 0.002 * along**2 + rng.integers(0, 3, 4000) * 0.3
    wires = np.column_stack([along, np.full(4000, 2.0) + rng.normal(0, 0.02, 4000), sag])
    cloud = with_things(wires)
    found = label_points(cloud, SemanticsConfig()).semantic
    mine = cKDTree(wires).query(cloud.xyz)[0] < 0.1
    assert (found[mine] == Semantic.BUILDING).mean() < 0.05


def test_a_tile_with_its_overlap_gets_the_labels_and_objects_of_the_whole(labelled):
    cloud, whole, objects = labelled
    x = cloud.xyz[:, 0]
    tile = np.flatnonzero(x < 10.0)
    part = cloud.select(tile)
    result = label_points(part, SemanticsConfig())
    _, mine = segment(part, result, InstanceConfig())
    core = x[tile] < 0.0
    assert (result.semantic == whole.semantic[tile])[core].mean() > 0.998
    assert np.abs(result.height_above_ground - whole.height_above_ground[tile])[core].max() < 0.02
    pairs = np.unique(np.stack([mine, objects[tile]])[:, core & (mine >= 0)], axis=1)
    assert len(np.unique(pairs[0])) == len(np.unique(pairs[1])) == pairs.shape[1]
