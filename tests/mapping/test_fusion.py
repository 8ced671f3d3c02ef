"""The fused map says what was there, how often and how evenly it was seen."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from plain_fusion import fused_cloud

from subiaco_geo.clouds import PointCloud, voxel_indices, voxel_keys
from subiaco_geo.errors import InputError
from subiaco_mapping.fusion.config import FusionConfig
from subiaco_mapping.fusion.ground_heights import height_table
from subiaco_mapping.fusion.voxel_fusion import VoxelAccumulator
from subiaco_mapping.measurements import DeskewedScan
from subiaco_mapping.preprocessing.scan_spool import Spool

SENSOR = np.array([0.0, 0.0, 2.0])


def twin(xyz: np.ndarray, leaf: float) -> dict[int, np.ndarray]:
    """Plain numpy: points by voxel key."""
    keys = voxel_keys(voxel_indices(xyz, leaf))
    return {int(key): xyz[keys == key] for key in np.unique(keys)}


def test_voxel_sums_equal_plain_numpy_whatever_the_batches() -> None:
    rng = np.random.default_rng(7)
    xyz = rng.normal(0, 2.0, (5000, 3))
    intensity = rng.uniform(0, 255, 5000).astype(np.float32)
    accumulator = VoxelAccumulator(0.5, capacity=1024)
    for part in np.array_split(np.arange(5000), 7):
        accumulator.add(xyz[part], intensity[part], SENSOR)
    found, expected = accumulator.statistics(), twin(xyz, 0.5)
    assert found.keys.tolist() == sorted(expected)
    for key, n, mean, covariance in zip(found.keys, found.n, found.mean, found.covariance, strict=True):
        points = expected[int(key)]
        assert n == len(points)
        np.testing.assert_allclose(mean, points.mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(
            covariance, np.cov(points.T, bias=True) if n > 1 else np.zeros((3, 3)), atol=1e-9
        )


def test_the_table_grows_without_losing_a_point() -> None:
    xyz = np.stack(np.meshgrid(*[np.arange(60) + 0.5] * 3), axis=-1).reshape(-1, 3)
    accumulator = VoxelAccumulator(1.0, capacity=1024)
    accumulator.add(xyz, np.ones(len(xyz), np.float32), SENSOR)
    found = accumulator.statistics()
    assert len(found.n) == 60**3
    assert found.n.sum() == 60**3


def floor_map(noise: float) -> PointCloud:
    rng = np.random.default_rng(8)
    xyz = rng.uniform(-5, 5, (200_000, 3)) * [1, 1, 0] + [0, 0, 0.125]
    xyz[:, 2] += noise * rng.standard_normal(len(xyz))
    accumulator = VoxelAccumulator(0.25)
    accumulator.add(xyz, np.ones(len(xyz), np.float32), SENSOR)
    config = FusionConfig(min_points=5)
    return fused_cloud(accumulator, config, 1, lambda p: p, lambda _p, v: v, None)


def test_n_spread_and_normals_of_a_noisy_floor_are_right() -> None:
    cloud = floor_map(0.02)
    assert np.median(cloud.fields["n"]) == pytest.approx(200_000 / 1600, rel=0.05)
    assert np.median(cloud.fields["spread"]) == pytest.approx(0.02, rel=0.1)
    assert np.median(cloud.fields["normals"][:, 2]) > 0.999
    np.testing.assert_allclose(np.linalg.norm(cloud.fields["normals"], axis=1), 1.0, atol=1e-9)


def test_normals_look_towards_the_sensor() -> None:
    rng = np.random.default_rng(9)
    wall = np.column_stack([np.full(50_000, 4.1), rng.uniform(-4, 4, 50_000), rng.uniform(0, 4, 50_000)])
    accumulator = VoxelAccumulator(0.25)
    accumulator.add(wall, np.ones(len(wall), np.float32), SENSOR)
    cloud = fused_cloud(accumulator, FusionConfig(), 1, lambda p: p, lambda _p, v: v, None)
    assert (cloud.fields["normals"][:, 0] < -0.99).mean() > 0.95


def test_points_that_are_not_finite_are_refused() -> None:
    with pytest.raises(InputError, match="not finite"):
        VoxelAccumulator(0.25).add(np.array([[np.nan, 0, 0]]), np.ones(1, np.float32), SENSOR)


def test_the_spool_gives_scans_back_to_a_millimetre(tmp_path: Path) -> None:
    rng = np.random.default_rng(10)
    xyz, last = rng.uniform(-50, 50, (1000, 3)), rng.uniform(-30, 30, (20, 3))
    spool = Spool(tmp_path / "s", 70.0)
    spool.append(
        DeskewedScan(
            1, xyz, np.arange(1000, dtype=np.float32), "gyro", None, last, np.ones(20, np.float32), last[:7]
        )
    )
    scan = spool.read(0)
    kept = np.linalg.norm(xyz, axis=1) <= 70.0
    assert np.abs(scan.xyz - xyz[kept]).max() < 0.0011
    np.testing.assert_array_equal(scan.intensity, np.arange(1000)[kept])
    assert np.abs(scan.last_xyz - last).max() < 0.0011
    assert np.abs(scan.sky_xyz - last[:7]).max() < 0.0011


def test_ground_heights_of_a_slope_with_houses_are_those_of_the_slope() -> None:
    rng = np.random.default_rng(11)
    ground = rng.uniform(0, 60, (40_000, 2))
    slope = np.column_stack([ground, 5.0 + 0.03 * ground[:, 0]])
    house = np.column_stack([rng.uniform(4, 12, (4000, 2)), rng.uniform(5, 12, 4000)])
    table = height_table(
        PointCloud(np.vstack([slope, house]), origin=np.array([388000.0, 6464000.0, 0.0])), 20.0
    )
    assert len(table) == 9
    np.testing.assert_allclose(table[:, 2], 5.0 + 0.03 * (table[:, 0] - 388000.0), atol=0.06)
    np.testing.assert_allclose(table[:, 4], np.arctan(0.03), atol=0.005)


def test_a_tile_without_enough_ground_has_neither_height_nor_tilt() -> None:
    rng = np.random.default_rng(12)
    street = np.column_stack([rng.uniform(0, 20, (4000, 2)), np.full(4000, 3.0)])
    roof = np.column_stack([rng.uniform(20, 40, 4000), rng.uniform(0, 20, 4000), np.zeros(4000)])
    roof[:, 2] = 6.0 + 0.6 * (roof[:, 0] - 20.0)
    few = np.column_stack([rng.uniform(40, 43, (300, 2)) - [0, 40], rng.uniform(2, 9, 300)])
    table = height_table(PointCloud(np.vstack([street, roof, few]), origin=np.zeros(3)), 20.0)
    np.testing.assert_allclose(table[:, 0], [10.0, 30.0, 50.0])
    assert table[0, 2] == pytest.approx(3.0)
    assert table[0, 4] == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(table[1:, [2, 4]]).all()


def test_a_strip_of_ground_gives_a_height_but_no_tilt() -> None:
    rng = np.random.default_rng(13)
    strip = np.column_stack([rng.uniform(0, 20, 4000), rng.uniform(0, 5, 4000), rng.normal(2.0, 0.01, 4000)])
    (row,) = height_table(PointCloud(strip, origin=np.zeros(3)), 20.0)
    assert row[2] == pytest.approx(2.0, abs=0.03)
    assert np.isnan(row[4])


def test_a_spool_whose_disk_is_full_keeps_what_it_has_and_counts_what_it_leaves_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = [10**9]
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=free[0]))
    spool = Spool(tmp_path / "s", 70.0, reserve_bytes=10**8)
    xyz = np.random.default_rng(11).uniform(-50, 50, (100, 3))
    for count in range(60):
        free[0] = 10**9 if count < 20 else 10**7
        spool.append(DeskewedScan(count, xyz, np.ones(100, np.float32), "gyro"))
    assert (len(spool), spool.left_out) == (60, 40)
    kept = int((np.linalg.norm(xyz, axis=1) <= 70.0).sum())
    assert [len(spool.read(k).xyz) for k in (0, 19, 20, 59)] == [kept, kept, 0, 0]
