"""The ground model follows slopes and kerbs, runs under houses, and never holds NaN."""

import gzip

import numpy as np
import pytest
from scenes import Scene, ground_z

from subiaco_change.segmentation.ground_model import GroundConfig, fill_gaps, fit_ground
from subiaco_geo.errors import InputError


def plane(slope, kerb=0.0, seed=0):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-25, 25, (40_000, 2))
    z = slope * xy[:, 0] + kerb * (xy[:, 1] > 0) + rng.normal(0, 0.015, len(xy))
    return np.column_stack([xy, z])


@pytest.mark.parametrize("slope", [0.0, 0.05, 0.12])
def test_heights_of_a_slope_are_unbiased(slope):
    xyz = plane(slope)
    inner = (abs(xyz[:, :2]) < 23).all(axis=1)
    residual = xyz[inner, 2] - fit_ground(xyz, GroundConfig()).height(xyz[inner, :2])
    assert abs(residual.mean()) < 0.01
    assert residual.std() < 0.03


def test_a_kerb_stays_a_step():
    model = fit_ground(plane(0.02, kerb=0.15), GroundConfig())
    step = model.height(np.array([[0.0, 1.0]])) - model.height(np.array([[0.0, -1.0]]))
    assert step[0] == pytest.approx(0.15, abs=0.03)


def test_the_ground_runs_on_under_houses_and_trees():
    model = fit_ground(Scene().survey(1).cloud.xyz, GroundConfig())
    xy = np.array([[-15.0, 12.0], [20.0, -13.0], [-20.0, -8.0], [-10.0, 0.0]])
    assert model.height(xy) == pytest.approx(ground_z(xy[:, 0], xy[:, 1]), abs=0.15)


def test_normals_tilt_with_the_slope():
    normal = fit_ground(plane(0.1), GroundConfig()).normal(np.array([[0.0, 0.0]]))[0]
    assert normal == pytest.approx(np.array([-0.1, 0, 1]) / np.sqrt(1.01), abs=0.01)


def test_places_far_from_ground_are_marked_unsupported_but_have_a_height():
    xyz = plane(0.0)
    xyz = xyz[(abs(xyz[:, 0]) > 10) | (abs(xyz[:, 1]) > 10)]
    model = fit_ground(xyz, GroundConfig())
    places = np.array([[0.0, 0.0], [20.0, 20.0], [500.0, 0.0]])
    assert model.supported(places[:2]).tolist() == [False, True]
    assert np.isfinite(model.height(places)).all()


def test_gaps_are_filled_within_the_bounds_of_what_is_known():
    rng = np.random.default_rng(0)
    raster = np.where(rng.random((37, 52)) < 0.05, rng.random((37, 52)), np.nan)
    filled = fill_gaps(raster)
    known = np.isfinite(raster)
    assert np.array_equal(filled[known], raster[known])
    assert raster[known].min() <= filled.min() <= filled.max() <= raster[known].max()


def test_an_empty_cloud_is_refused():
    with pytest.raises(InputError, match="no points"):
        fit_ground(np.zeros((0, 3)), GroundConfig())


def test_real_reference_samples_are_filtered_with_little_error(shared_data):
    """ISPRS sample 12 (town): total error of |height| < 0.5 m as ground."""
    import open3d as o3d

    clouds = []
    for name in ("samp12-utm", "samp12-utm-ground"):
        data = gzip.decompress((shared_data / "isprs_filter" / f"{name}.pcd.gz").read_bytes())
        import tempfile
        from pathlib import Path

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "x.pcd"
            path.write_bytes(data)
            clouds.append(
                np.asarray(o3d.t.io.read_point_cloud(str(path)).point.positions.numpy(), dtype=float)
            )
    xyz, truth = clouds
    is_ground = np.isin(
        xyz.round(2).view([("", float)] * 3).ravel(), truth.round(2).view([("", float)] * 3).ravel()
    )
    local = xyz - xyz.mean(axis=0)
    model = fit_ground(local, GroundConfig())
    found = abs(local[:, 2] - model.height(local[:, :2])) < 0.5
    assert (found != is_ground).mean() < 0.08


def test_a_house_at_the_end_of_what_was_seen_is_no_ground():
    rng = np.random.default_rng(4)
    street = np.column_stack([rng.uniform([-30, -8], [30, 0], (30_000, 2)), rng.normal(0, 0.015, 30_000)])
    roof = np.column_stack([rng.uniform([-30, 2], [-8, 12], (12_000, 2)), rng.normal(3, 0.015, 12_000)])
    model = fit_ground(np.concatenate([street, roof]), GroundConfig())
    assert abs(model.height(roof[:, :2])).max() < 0.3


@pytest.mark.parametrize("slope", [0.2, 0.35])
def test_houses_fall_off_a_steep_hill_and_the_hill_stays(slope):
    xyz = plane(slope, seed=5)
    house = (abs(xyz[:, 0]) < 5) & (abs(xyz[:, 1]) < 5)
    xyz[house, 2] = 5 * slope + 4
    model = fit_ground(xyz, GroundConfig())
    residual = xyz[:, 2] - model.height(xyz[:, :2])
    inner = (abs(xyz[:, :2]) < 23).all(axis=1) & ~house
    assert (abs(residual[inner]) < 0.15).mean() > 0.99
    assert residual[house].min() > 2


def test_a_garden_behind_a_retaining_wall_is_ground_and_a_flat_roof_as_high_is_not():
    rng = np.random.default_rng(8)
    xy = rng.uniform(-25, 25, (40_000, 2))
    bank = np.clip((xy[:, 1] - 5) * 0.2, 0, 2.4)  # a lane rises beside the garden to its level
    garden = (abs(xy[:, 0]) < 9) & (xy[:, 1] > -4)
    roof = (abs(xy[:, 0]) < 5) & (abs(xy[:, 1] + 15) < 4)
    z = np.where(garden, 2.4, np.where(roof, 2.4, bank)) + rng.normal(0, 0.015, len(xy))
    model = fit_ground(np.column_stack([xy, z]), GroundConfig())
    above = z - model.height(xy)
    assert abs(above[garden & (abs(xy[:, 0]) < 8) & (xy[:, 1] > -3)]).max() < 0.2
    assert above[roof].min() > 2


def test_ground_seen_through_gaps_in_leaves_is_kept_and_a_lone_ghost_below_is_not():
    rng = np.random.default_rng(6)
    xyz = plane(0.02, seed=6)
    xyz[rng.random(len(xyz)) < 0.995, 2] += 5
    ghost = np.array([[3.0, 3.0, -4.0]])
    model = fit_ground(np.concatenate([xyz, ghost]), GroundConfig())
    places = rng.uniform(-20, 20, (200, 2))
    assert model.height(places) == pytest.approx(0.02 * places[:, 0], abs=0.25)


def test_a_sliver_with_no_flat_ground_in_it_keeps_its_lowest_points_as_ground():
    rng = np.random.default_rng(5)
    xyz = rng.uniform([0.0, 0.0, 1.0], [0.4, 20.0, 4.0], (400, 3))
    ground = fit_ground(xyz, GroundConfig())
    assert np.isfinite(ground.heights).all()
    assert xyz[:, 2].min() <= ground.heights.min() <= ground.heights.max() <= xyz[:, 2].max()
