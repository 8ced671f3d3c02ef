"""Where a registration starts, and when it is refused: features, planes, ambiguity, file formats."""

from __future__ import annotations

import sys
from pathlib import Path

import laspy
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from subiaco_change.config import ChangeConfig
from subiaco_change.geometry import build_pyramid
from subiaco_change.registration.config import KeypointConfig, RegistrationConfig
from subiaco_change.registration.icp import Pairs, solve
from subiaco_change.registration.keypoints import propose_by_features, ransac
from subiaco_change.registration.planes import PlanePairs, extract_planes, match_planes, normal_equations
from subiaco_change.registration.register import given_registration, register
from subiaco_change.tiling.alignment import ChangedPoints
from subiaco_change.tiling.epoch_tiles import Coordinates, EpochContext
from subiaco_change.tiling.registration_stage import RegistrationParams, RegistrationSlice, register_again
from subiaco_change.tiling.stage_inputs import PairRegistration, slice_of
from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.errors import RegistrationError
from subiaco_geo.frames import exp_se3, transform_points
from subiaco_geo.maps import load_epoch
from subiaco_geo.work.results import pack
from subiaco_geo.work.store import MemoryStore
from subiaco_geo.work.tasks import Inputs

sys.path.insert(0, str(Path(__file__).parent))
from registration_scene import Street, errors, pose, rectangle

CONFIG = RegistrationConfig()
#: 12 degrees of tilt, any yaw, 200 m away
FAR = pose((0.0, 0.0, -127.0), (160.0, -120.0, 15.0)) @ pose((7.2, 9.6, 0.0), (0.0, 0.0, 0.0))


def cloud(points, crs=None):
    return voxel_downsample(PointCloud(points, crs=crs), 0.25)


def moved(points, T_after_before):
    return transform_points(np.linalg.inv(T_after_before), points)


@pytest.fixture(scope="module")
def bare_street():
    """Two samplings of a street without trees, *before* moved by ``FAR``."""
    street = Street(seed=7, length=120.0, width=56.0)
    street.trees = []
    return moved(street.sample(1, density=16.0), FAR), street.sample(2, density=16.0)


def test_ransac_finds_the_motion_that_a_tenth_of_the_pairs_agree_on_and_finds_it_again():
    rng = np.random.default_rng(1)
    source = rng.uniform(-50, 50, (500, 3))
    target = rng.uniform(-50, 50, (500, 3))
    target[:50] = transform_points(FAR, source[:50]) + rng.normal(0, 0.1, (50, 3))
    found, agree = ransac(source, target, 0.6, 20_000, seed=3)
    shift, angle = errors(found, FAR, FAR[:3, 3])
    assert shift < 0.1
    assert angle < 0.2
    assert 48 <= agree <= 52
    again, _ = ransac(source, target, 0.6, 20_000, seed=3)
    assert np.array_equal(found, again)


@pytest.mark.parametrize("count", [0, 2, 30])
def test_ransac_finds_nothing_where_no_three_pairs_agree(count):
    rng = np.random.default_rng(2)
    assert ransac(*rng.uniform(-500, 500, (2, count, 3)), 0.6, 2000, seed=0) is None


def test_the_paper_s_chain_registers_clouds_without_a_frame_given_samples_enough(bare_street):
    """One pair in 28 is right, so that 20 000 samples hold one good triple at best."""
    config = RegistrationConfig(
        coarse="always", coarse_method="features", features=KeypointConfig(iterations=2_000_000)
    )
    before, after = (cloud(points) for points in bare_street)
    result = register(before, after, config)
    shift, angle = errors(result.T_after_before, FAR, result.origin)
    assert shift < 0.01
    assert angle < 0.02


def test_feature_starts_are_the_same_for_the_same_seed(bare_street):
    levels = [build_pyramid(points - np.median(points, axis=0), (1.0,))[0] for points in bare_street]
    first, second = (propose_by_features(*levels, KeypointConfig(), seed=5) for _ in range(2))
    assert np.array_equal(first[0].pose, second[0].pose)
    nothing = build_pyramid(np.zeros((9, 3)), (1.0,))[0]
    assert propose_by_features(levels[0], nothing, KeypointConfig(), 5) == []


@pytest.mark.parametrize(("one", "other"), [("a.ply", "b.las"), ("a.laz", "b.pcd"), ("a.copc.laz", "b.ply")])
def test_bare_clouds_of_every_format_are_registered_from_any_frame(tmp_path, one, other):
    street = Street(seed=9, length=54.0, width=46.0)
    for name, points in ((one, moved(street.sample(1), FAR)), (other, street.sample(2))):
        write_bare(tmp_path / name, cloud(points).xyz)
    before, after = (load_epoch(tmp_path / name).cloud for name in (one, other))
    assert before.crs is None
    result = register(before, after, CONFIG)
    shift, angle = errors(result.T_after_before, FAR, result.origin)
    assert shift < 0.015
    assert angle < 0.03


def write_bare(path, points):
    """Write points (N, 3) as other programs do: ASCII PLY and PCD, LAS without a CRS."""
    if path.name.endswith(".copc.laz"):
        write_cloud(path, PointCloud(points))
    elif path.suffix in (".las", ".laz"):
        las = laspy.create(point_format=0, file_version="1.2")
        las.header.scales, las.header.offsets = np.full(3, 0.001), points.min(axis=0)
        las.xyz = points
        las.write(path)
    else:
        n = len(points)
        heads = {
            ".ply": f"ply\nformat ascii 1.0\nelement vertex {n}\n"
            "property double x\nproperty double y\nproperty double z\nend_header",
            ".pcd": f"VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\n"
            f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA ascii",
        }
        np.savetxt(path, points, "%.4f", header=heads[path.suffix], comments="")


def test_a_place_that_looks_the_same_turned_round_is_refused():
    street = Street(seed=9, length=60.0, width=50.0)

    def both_ways(seed):
        points = street.sample(seed)
        points = points[points[:, 0] > 0]
        return cloud(np.vstack([points, points * (-1, -1, 1)]))

    with pytest.raises(RegistrationError, match="ambiguous"):
        register(both_ways(1), both_ways(2), RegistrationConfig(coarse="always"))


def test_a_corridor_without_a_prior_is_refused_and_the_free_direction_named():
    def corridor(seed):
        rng = np.random.default_rng(seed)
        walls = [rectangle(rng, (-30, y, 0), (60, 0, 0), (0, 0, 5), 25) for y in (-5, 5)]
        points = np.vstack([rectangle(rng, (-30, -5, 0), (60, 0, 0), (0, 10, 0), 25), *walls])
        return cloud(points + rng.normal(0, 0.01, points.shape))

    with pytest.raises(RegistrationError, match="nothing fixes x and there is no prior"):
        register(corridor(1), corridor(2), CONFIG)


def test_an_earlier_fit_is_refined_without_the_points_left_out(bare_street):
    before, after = (cloud(points) for points in bare_street)
    near = given_registration(pose((0, 0, 0.1), (0.1, -0.1, 0.05)) @ FAR, before, after, CONFIG)
    lifted = after.xyz.copy()
    patch = (np.abs(lifted[:, 1]) < 12) & (lifted[:, 0] < 10)
    lifted[patch, 2] += 0.05
    changed = PointCloud(lifted, after.origin)
    pulled = register(before, changed, CONFIG, start=near)
    freed = register(before, changed, CONFIG, exclude_after=patch, start=near)
    off = [errors(r.T_after_before, FAR, near.origin)[0] for r in (pulled, freed)]
    assert freed.method.startswith("earlier fit")
    assert off[1] < 0.008 < off[0]


def test_a_second_estimate_that_fails_keeps_the_first_and_warns(bare_street):
    clouds = [cloud(points) for points in bare_street]
    first = given_registration(FAR, *clouds, CONFIG)
    pieces = {"registration": PairRegistration(first, 0.0, None)}
    for epoch, points in zip(("before", "after"), clouds, strict=True):
        pieces[f"cloud/{epoch}/0_0"] = Coordinates(points.xyz)
        pieces[f"changed/{epoch}/0_0"] = ChangedPoints(np.ones(len(points), dtype=bool))
    sides = tuple(
        EpochContext(epoch, points.origin, None, "shadow", None, points.origin, 0.5)
        for epoch, points in zip(("before", "after"), clouds, strict=True)
    )
    inputs = Inputs(
        MemoryStore({name: pack(piece) for name, piece in pieces.items()}), {name: name for name in pieces}
    )
    params = RegistrationParams(sides, slice_of(RegistrationSlice, ChangeConfig()), None)
    found = register_again(inputs, params)
    assert np.array_equal(found.registration.T_local, first.T_local)
    assert "the first is kept" in found.failed
    assert found.shift == 0.0


def box_level():
    rng = np.random.default_rng(4)
    walls = [
        rectangle(rng, (2, 2, 0), (16, 0, 0), (0, 0, 6), 40),
        rectangle(rng, (2, 2, 0), (0, 16, 0), (0, 0, 6), 40),
    ]
    points = np.vstack([rectangle(rng, (0, 0, 0), (19, 0, 0), (0, 19, 0), 40), *walls])
    return build_pyramid(points + rng.normal(0, 0.005, points.shape), (0.25,))[0]


def test_planes_of_ground_and_walls_are_found_and_paired_after_a_small_motion():
    level = box_level()
    planes = extract_planes(level, seed=0)
    axes = np.abs(planes.normals) > 0.999
    assert sorted(axes.argmax(axis=1).tolist()) == [0, 1, 2]
    small = pose((0.5, -0.4, 1.0), (0.05, 0.05, 0.05))
    turned = type(planes)(
        planes.normals @ small[:3, :3], transform_points(np.linalg.inv(small), planes.centres)
    )
    pairs = match_planes(turned, planes, small, 0.1)
    assert len(pairs.before) == 3
    assert np.allclose(pairs.before @ small[:3, :3].T, pairs.after, atol=1e-9)
    assert len(match_planes(turned, planes, pose((0, 0, 40), (0, 0, 0)), 0.1).before) <= 1


def test_the_plane_term_has_the_derivative_that_differences_give():
    rng = np.random.default_rng(6)
    normals = rng.normal(size=(2, 5, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    pairs = PlanePairs(normals[0], normals[1], 0.1)
    rotation = Rotation.from_euler("xyz", (0.3, -0.2, 0.5)).as_matrix()

    def value(twist):
        turned = exp_se3(np.append(twist, np.zeros(3)))[:3, :3] @ rotation
        return 0.5 * pairs.weight * np.sum((pairs.before @ turned.T - pairs.after) ** 2)

    _, gradient = normal_equations(pairs, rotation)
    steps = 1e-5 * np.eye(3)
    assert np.allclose(gradient, [(value(s) - value(-s)) / 2e-5 for s in steps], atol=1e-8)


def test_a_heavy_plane_term_turns_the_step_that_points_alone_leave_at_zero():
    rng = np.random.default_rng(8)
    normals = rng.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = Pairs(rng.uniform(-9, 9, (300, 3)), normals, np.zeros(300), np.zeros(300), np.arange(300), 1.0)
    turn = exp_se3(np.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0]))[:3, :3]
    planes = PlanePairs(normals[:20], normals[:20] @ turn.T, 1e9)
    still = solve(points, np.ones(300), np.zeros(3), 1e-3)
    step = solve(points, np.ones(300), np.zeros(3), 1e-3, normal_equations(planes, np.eye(3)))
    assert np.allclose(still.twist, 0)
    assert np.allclose(step.twist[:3], (0, 0, 0.01), atol=1e-4)
