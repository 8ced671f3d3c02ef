"""Neighbourhoods against plain numpy and scipy twins."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from subiaco_change.geometry import (
    build_index,
    build_pyramid,
    estimate_normals,
    fit_planes,
    lies_near,
    nearest,
    outlier_mask,
    outline_of_cells,
)
from subiaco_change.segmentation.clustering import connect, group_reduce
from subiaco_geo.errors import InputError


@pytest.fixture(scope="module")
def points():
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(-10, 10, (4000, 2)), rng.normal(0, 0.02, 4000)])
    return np.vstack([ground, rng.uniform(-10, 10, (2000, 3)) * (1, 1, 0.3)])


def test_nearest_points_are_those_of_a_kd_tree(points):
    queries = points + np.random.default_rng(4).normal(0, 0.3, points.shape)
    found, distance = nearest(build_index(points, 0.8), queries, 0.6)
    expected, index = cKDTree(points).query(queries, distance_upper_bound=0.6)
    assert np.allclose(distance, expected)
    near = np.isfinite(expected)
    assert 0 < near.sum() < len(near)
    assert np.array_equal(found[near], index[near])
    assert np.all(found[~near] == -1)


def test_places_lie_near_points_up_to_the_reach_and_no_farther():
    places = np.array([[0.0, 0.0], [1.5, 0.0], [1.5 + 1e-9, 0.0], [40.0, 0.0]])
    assert lies_near(places, np.zeros((1, 2)), 1.5).tolist() == [True, True, False, False]
    assert not lies_near(places, np.full((3, 2), 90.0), 1.5).any()
    assert not lies_near(places, np.zeros((0, 2)), 1.5).any()
    assert lies_near(places[:0], places, 1.5).shape == (0,)


def test_planes_are_those_of_numpy_eigenvectors(points):
    planes = fit_planes(points, 0.8)
    tree = cKDTree(points)
    for i in range(0, len(points), 97):
        ball = points[tree.query_ball_point(points[i], 0.8)]
        assert planes.count[i] == len(ball)
        if len(ball) < 5:
            assert np.all(planes.normals[i] == 0)
            continue
        values, vectors = np.linalg.eigh(np.cov(ball.T, bias=True))
        assert planes.curvature[i] == pytest.approx(values[0] / values.sum(), abs=1e-9)
        assert abs(planes.normals[i] @ vectors[:, 0]) == pytest.approx(1.0, abs=1e-6)
        assert planes.normals[i, 2] >= 0


def test_planes_around_the_first_points_are_those_of_all_points(points):
    mixed = points[np.random.default_rng(9).permutation(len(points))]
    some, every = fit_planes(mixed, 0.8, first=1500), fit_planes(mixed, 0.8)
    assert np.array_equal(some.normals, every.normals[:1500])
    assert np.array_equal(some.curvature, every.curvature[:1500])
    assert np.array_equal(some.count, every.count[:1500])


def test_normals_of_a_tilted_plane_are_its_normal_whatever_the_order_of_the_points():
    rng = np.random.default_rng(5)
    xy = rng.uniform(-5, 5, (2000, 2))
    plane = np.column_stack([xy, 0.3 * xy[:, 0] - 0.1 * xy[:, 1]])
    expected = np.array([-0.3, 0.1, 1.0]) / np.linalg.norm([-0.3, 0.1, 1.0])
    normals = estimate_normals(plane, 0.8)
    assert np.abs(normals - expected).max() < 1e-9
    shuffle = rng.permutation(len(plane))
    assert np.allclose(estimate_normals(plane[shuffle], 0.8), normals[shuffle], atol=1e-12)


def test_only_lonely_points_are_outliers():
    rng = np.random.default_rng(6)
    cloud = np.vstack([rng.uniform(0, 10, (5000, 3)) * (1, 1, 0.01), [[5.0, 5.0, 8.0], [-9.0, 0.0, 3.0]]])
    mask = outlier_mask(cloud)
    assert mask[-2:].all()
    assert mask[:-2].mean() < 0.02


def test_the_pyramid_gets_coarser_and_keeps_the_plane():
    rng = np.random.default_rng(7)
    flat = np.column_stack([rng.uniform(0, 20, (20_000, 2)), np.zeros(20_000)])
    levels = build_pyramid(flat, (1.0, 0.5, 0.25))
    assert [len(level.xyz) for level in levels][:2] == [400, 1600]
    for level in levels:
        assert np.allclose(level.planes.normals, [0, 0, 1])


def test_points_that_are_not_finite_cannot_be_indexed():
    with pytest.raises(InputError, match="finite"):
        build_index(np.full((3, 3), np.nan), 1.0)


@pytest.mark.parametrize("cell", [0.4, 5.0])
def test_an_index_sorts_by_column_and_height_and_keeps_equal_heights_in_order(cell):
    xyz = np.round(np.random.default_rng(5).uniform(0, 12, (6000, 3)), 1)  # many equal heights
    index = build_index(xyz, cell)
    steps = np.minimum(((xyz[:, :2] - index.corner) / index.cell).astype(np.int64), index.shape - 1)
    assert np.array_equal(index.order, np.lexsort((xyz[:, 2], steps @ [index.shape[1], 1])))


def test_the_outline_of_cells_is_the_union_of_their_squares():
    cells = np.unique(np.random.default_rng(6).integers(0, 12, (90, 2)), axis=0)
    corner, edge = np.array([3.1, -7.7]), 0.3
    low = corner + cells * edge
    squares = shapely.box(low[:, 0], low[:, 1], low[:, 0] + edge, low[:, 1] + edge)
    outline = outline_of_cells(cells, corner, edge)
    assert outline.is_valid
    assert outline.area == pytest.approx(len(cells) * edge**2)
    assert outline.symmetric_difference(shapely.union_all(squares, grid_size=1e-9)).area < 1e-6


def test_components_are_numbered_as_scipy_numbers_them():
    rng, count = np.random.default_rng(7), 400
    pairs = rng.integers(0, count, (250, 2))
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(count, count)).tocsr()
    assert np.array_equal(connect(count, pairs), connected_components(graph, directed=False)[1])
    assert np.array_equal(connect(3, np.zeros((0, 2), dtype=np.int64)), [0, 1, 2])


@pytest.mark.parametrize("how", ["mean", "minimum", "maximum", "median"])
def test_values_are_reduced_by_label_as_scipy_reduces_them(how):
    rng = np.random.default_rng(8)
    labels, values = rng.integers(0, 50, 300), rng.normal(size=300)
    held = np.unique(labels)
    reduced = group_reduce(labels, values, 60, how)
    assert np.allclose(reduced[held], getattr(ndimage, how)(values, labels, held))
    assert np.isnan(np.delete(reduced, held)).all()
