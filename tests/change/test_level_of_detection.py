"""Level of detection: known planes, coverage, and an oracle made by PDAL."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from scipy.spatial import cKDTree

from subiaco_change.geometry import estimate_normals
from subiaco_change.level_of_detection.displacement_lod import (
    LodConfig,
    combine,
    compare_epochs,
    cylinder_stats,
    make_surface,
)
from subiaco_geo.clouds import PointCloud
from subiaco_geo.errors import InputError

UP = np.array([0.0, 0.0, 1.0])


def flat(seed, noise=0.03, density=16.0, size=30.0, z=0.0, origin=(0.0, 0.0, 0.0)):
    rng = np.random.default_rng(seed)
    n = int(size * size * density)
    xyz = np.column_stack([rng.uniform(0, size, (n, 2)), z + rng.normal(0, noise, n)])
    normals = np.tile(UP, (n, 1))
    return PointCloud(xyz, np.array(origin), fields={"normals": normals})


def test_a_flat_plane_of_known_noise_has_the_lod_of_the_formula():
    config = LodConfig(noise=0.0)
    result = compare_epochs(flat(1), flat(2), 0.0, config)
    inner = np.all(np.abs(flat(1).xyz[:, :2] - 15) < 13, axis=1)
    n = 16.0 * np.pi
    expected = 1.96 * np.sqrt(2 * 0.03**2 / n)
    assert np.median(result.lod95[inner]) == pytest.approx(expected, rel=0.05)
    assert np.median(result.n_self[inner]) == pytest.approx(n, rel=0.05)
    assert np.median(result.s_self[inner]) == pytest.approx(0.03, rel=0.05)


def test_sigma_reg_enters_in_quadrature_or_linearly_as_configured():
    variance = np.array([0.01**2])
    assert combine(variance, 0.02, "quadrature")[0] == pytest.approx(1.96 * np.hypot(0.01, 0.02))
    assert combine(variance, 0.02, "linear")[0] == pytest.approx(1.96 * 0.03)
    cloud = flat(1)
    sigma = np.linspace(0.0, 0.1, len(cloud))
    lod = compare_epochs(cloud, flat(2), sigma, LodConfig()).lod95
    assert np.all(lod >= 1.96 * sigma - 1e-6)


def test_about_95_percent_of_unchanged_cylinder_means_stay_under_the_lod_without_floors():
    inside, total = 0, 0
    for seed in range(6):
        cloud = flat(100 + seed, size=60.0)
        result = compare_epochs(cloud, flat(200 + seed, size=60.0), 0.0, LodConfig(noise=0.0))
        # one point every 2.5 m, so that the cylinders do not share points
        cell = np.floor(cloud.xyz[:, :2] / 2.5).astype(int)
        _, first = np.unique(cell, axis=0, return_index=True)
        inside += int((np.abs(result.distance[first]) <= result.lod95[first]).sum())
        total += len(first)
    assert total > 3000
    assert 0.935 <= inside / total <= 0.965


def test_a_raised_plane_shows_its_displacement_and_its_sign():
    result = compare_epochs(flat(1), flat(2, z=0.2), 0.0, LodConfig())
    assert np.median(result.distance) == pytest.approx(0.2, abs=0.005)
    assert np.mean(result.distance > result.lod95) > 0.99
    back = compare_epochs(flat(2, z=0.2), flat(1), 0.0, LodConfig())
    assert np.median(back.distance) == pytest.approx(-0.2, abs=0.005)


def test_nothing_is_claimed_where_the_other_epoch_is_empty():
    other = flat(2)
    other = other.select(other.xyz[:, 0] < 15)
    result = compare_epochs(flat(1), other, 0.01, LodConfig())
    x = flat(1).xyz[:, 0]
    assert np.isinf(result.lod95[x > 16.1]).all()
    assert np.isnan(result.distance[x > 16.1]).all()
    assert np.isfinite(result.lod95[(x > 1) & (x < 14)]).all()
    assert result.lod95[np.isfinite(result.lod95)].min() >= 1.96 * 0.01


@pytest.mark.parametrize("beyond", [(-9.0, -9.0), (39.0, 39.0), (-9.0, 39.0), (15.0, 39.0), (-4e4, 4e4)])
def test_cylinders_beside_all_points_of_a_surface_hold_nothing(beyond):
    """Diagonally beside a tile both ranges of columns are empty: their counts must not multiply to some."""
    surface = make_surface(flat(3), LodConfig())
    queries = np.array([[*beyond, 0.0], [15.0, 15.0, 0.0]])
    whole, shorter = cylinder_stats(queries, np.tile([0.0, 0.0, 1.0], (2, 1)), surface, LodConfig(), 5.5, 1.0)
    assert whole.count[0] == shorter.count[0] == 0
    assert whole.count[1] > 3


def test_a_wall_beside_the_ground_does_not_raise_the_lod_of_either():
    def corner(seed):
        rng = np.random.default_rng(seed)
        ground = flat(seed, noise=0.01)
        n = 30 * 6 * 16
        wall = np.column_stack([15 + rng.normal(0, 0.01, n), rng.uniform(0, 30, n), rng.uniform(0, 6, n)])
        xyz = np.vstack([ground.xyz, wall])
        normals = np.vstack([ground.fields["normals"], np.tile([1.0, 0, 0], (n, 1))])
        return PointCloud(xyz, fields={"normals": normals})

    lod = compare_epochs(corner(1), corner(2), 0.0, LodConfig(noise=0.0)).lod95
    assert np.quantile(lod[np.isfinite(lod)], 0.99) < 0.02


def test_the_kernel_agrees_with_its_numpy_twin():
    rng = np.random.default_rng(9)
    points, queries = rng.uniform(-3, 3, (3000, 3)), rng.uniform(-2, 2, (60, 3))
    axes = rng.normal(size=(60, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    normals = rng.normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    config = LodConfig(radius=0.8, normal_agreement=0.5)
    surface = make_surface(PointCloud(points, fields={"normals": normals}), config)
    found = cylinder_stats(queries, axes, surface, config, 1.3, 0.7)
    for i in range(60):
        offset = points - queries[i]
        along = offset @ axes[i]
        across = np.linalg.norm(offset - along[:, None] * axes[i], axis=1)
        for stats, half_length in zip(found, (1.3, 0.7), strict=True):
            keep = (np.abs(along) <= half_length) & (across <= 0.8) & (np.abs(normals @ axes[i]) >= 0.5)
            assert stats.count[i] == keep.sum()
            assert stats.mean[i] == pytest.approx(along[keep].mean(), abs=1e-9)
            assert stats.std[i] == pytest.approx(along[keep].std(), abs=1e-9)


def test_the_same_cylinder_in_both_epochs_keeps_what_stands_beside_the_surface_out():
    def with_shelf(seed):
        ground = flat(seed)
        rng = np.random.default_rng(seed + 50)
        n = 30 * 30 * 8
        shelf = np.column_stack([rng.uniform(0, 30, (n, 2)), 0.75 + rng.normal(0, 0.01, n)])
        xyz = np.vstack([ground.xyz, shelf])
        return PointCloud(xyz, fields={"normals": np.tile(UP, (len(xyz), 1))})

    result = compare_epochs(with_shelf(1), with_shelf(2), 0.0, LodConfig(noise=0.0))
    assert np.quantile(np.abs(result.distance[np.isfinite(result.distance)]), 0.999) < 0.05


def test_a_surface_beyond_the_short_cylinder_is_found_by_the_long_one():
    result = compare_epochs(flat(1), flat(2, z=0.8), 0.0, LodConfig())
    assert np.median(result.distance) == pytest.approx(0.8, abs=0.01)


def test_clouds_about_different_origins_are_refused():
    with pytest.raises(InputError, match="origin"):
        compare_epochs(flat(1), flat(2, origin=(100.0, 0.0, 0.0)), 0.0, LodConfig())


def test_distances_and_uncertainties_are_those_of_the_m3c2_oracle(shared_data):
    """PDAL's filters.m3c2: normal radius 1.390432, cylinder 2.890432 x 5.5 (feet), reg_error 0, linear."""
    laspy = pytest.importorskip("laspy")
    folder = shared_data / "m3c2_oracle"
    if not folder.is_dir():
        pytest.skip("no m3c2_oracle")
    with (folder / "autzen-bmx-m3c2.txt").open() as file:
        rows = list(csv.DictReader(file))

    def column(name):
        return np.array([float(row[name]) for row in rows])

    core = np.stack([column(axis) for axis in "XYZ"], axis=1)
    origin = core.mean(axis=0)
    first, second = (
        np.asarray(laspy.read(folder / f"autzen-bmx-{year}.las").xyz) - origin for year in (2010, 2023)
    )
    core -= origin
    normals = np.zeros_like(core)
    tree = cKDTree(first)
    for i, point in enumerate(core):
        ball = first[tree.query_ball_point(point, 1.390432)]
        if len(ball) < 3:
            continue
        normals[i] = np.linalg.eigh(np.cov(ball.T))[1][:, 0]
    normals[normals[:, 2] < 0] *= -1
    config = LodConfig(radius=2.890432, normal_agreement=0.0)
    sides = [
        make_surface(PointCloud(p, fields={"normals": np.zeros_like(p)}), config) for p in (first, second)
    ]
    ours = [cylinder_stats(core, normals, side, config, 5.5, 5.5)[0] for side in sides]
    variance = sum(s.std**2 / np.maximum(s.count, 1) for s in ours)
    # a core point that PDAL drops from its own cylinder, or one on the rim, changes a count by one
    same = (ours[0].count == column("m3c2_count1")) & (ours[1].count == column("m3c2_count2"))
    assert same.sum() >= 95
    assert np.abs(ours[1].mean - ours[0].mean - column("m3c2_distance"))[same].max() < 0.001
    assert np.abs(combine(variance, 0.0, "linear") - column("m3c2_uncertainty"))[same].max() < 0.001
    assert np.median(np.abs(ours[1].mean - ours[0].mean - column("m3c2_distance"))) < 0.001


def test_normals_are_estimated_where_the_field_is_missing():
    bare = [PointCloud(flat(seed).xyz) for seed in (1, 2)]
    assert np.abs(estimate_normals(bare[0].xyz, 0.8)[:, 2]).mean() > 0.99
    lod = compare_epochs(*bare, 0.0, LodConfig()).lod95
    assert np.isfinite(lod).mean() > 0.95
