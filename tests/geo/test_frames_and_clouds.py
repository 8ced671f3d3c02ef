"""Frames, clouds, visibility, configuration and whole outputs: invariants and known answers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pydantic import Field

from subiaco_geo.atomic import whole_directory, whole_file
from subiaco_geo.clouds import (
    PointCloud,
    from_world,
    packable,
    sort_spatially,
    unpack_voxel_keys,
    voxel_average,
    voxel_downsample,
    voxel_indices,
    voxel_keys,
)
from subiaco_geo.config import (
    StrictModel,
    config_hash,
    load_config,
    merge,
    parse_setting,
    read_parameters,
    write_config,
)
from subiaco_geo.errors import InputError, RegistrationError, SubiacoError
from subiaco_geo.frames import (
    exp_se3,
    interpolate_poses,
    invert_pose,
    make_pose,
    pose_from_quaternion,
    quaternion_from_pose,
    rotation_angle,
    transform_points,
)
from subiaco_geo.visibility import VisibilityGrid, load_visibility, save_visibility

twists = hnp.arrays(np.float64, (3, 6), elements=st.floats(-3, 3))

# --- frames ----------------------------------------------------------------------------------------


@given(twists)
def test_a_pose_and_its_inverse_cancel(twist: np.ndarray) -> None:
    poses = exp_se3(twist)
    np.testing.assert_allclose(poses @ invert_pose(poses), np.tile(np.eye(4), (3, 1, 1)), atol=1e-12)
    points = np.arange(12.0).reshape(4, 3)
    back = transform_points(invert_pose(poses[0]), transform_points(poses[0], points))
    np.testing.assert_allclose(back, points, atol=1e-11)


@given(twists)
def test_quaternions_give_the_pose_back(twist: np.ndarray) -> None:
    poses = exp_se3(twist)
    np.testing.assert_allclose(
        pose_from_quaternion(poses[:, :3, 3], quaternion_from_pose(poses)), poses, atol=1e-12
    )


def test_a_quarter_turn_about_up_takes_east_to_north() -> None:
    pose = exp_se3([0, 0, np.pi / 2, 10, 0, 0])
    assert pose.shape == (4, 4)
    np.testing.assert_allclose(transform_points(pose, [[1.0, 0, 0]]), [[10, 1, 0]], atol=1e-12)
    assert rotation_angle(pose) == pytest.approx(np.pi / 2)


def test_interpolation_is_linear_with_slerp_and_holds_the_ends() -> None:
    poses = np.stack([np.eye(4), exp_se3([0, 0, 1.0, 2, 0, 0])])
    at = interpolate_poses(np.array([0, 10]), poses, np.array([-5, 5, 99]))
    np.testing.assert_allclose(at, [poses[0], exp_se3([0, 0, 0.5, 1, 0, 0]), poses[1]], atol=1e-12)
    with pytest.raises(InputError, match="increasing"):
        interpolate_poses(np.array([0, 0]), poses, np.array([0]))


def test_points_of_the_wrong_shape_are_refused() -> None:
    with pytest.raises(InputError, match=r"\(N, 3\)"):
        transform_points(np.eye(4), np.zeros(3))


def test_poses_stack() -> None:
    assert make_pose(np.tile(np.eye(3), (2, 5, 1, 1)), np.zeros(3)).shape == (2, 5, 4, 4)


# --- clouds ----------------------------------------------------------------------------------------

indices = hnp.arrays(np.int64, (20, 3), elements=st.integers(-(2**20), 2**20 - 1))


@given(indices)
def test_voxel_keys_unpack_to_the_indices_packed(index: np.ndarray) -> None:
    keys = voxel_keys(index)
    np.testing.assert_array_equal(unpack_voxel_keys(keys), index)
    assert len(np.unique(keys)) == len(np.unique(index, axis=0))


@pytest.mark.parametrize("value", [2**20, -(2**20) - 1])
def test_voxels_out_of_reach_are_refused_before_two_share_a_key(value: int) -> None:
    index = np.array([[0, value, 0]])
    assert not packable(index).any()
    with pytest.raises(InputError, match="local coordinates"):
        voxel_keys(index)


def test_world_coordinates_are_kept_about_a_round_origin() -> None:
    world = np.array([[389_012.345, 6_463_078.901, 12.0], [389_013.0, 6_463_079.0, 13.0]])
    cloud = from_world(world, "EPSG:7850")
    np.testing.assert_array_equal(cloud.origin % 100, 0)
    assert np.abs(cloud.xyz).max() < 150
    np.testing.assert_allclose(cloud.world(), world, atol=1e-9)
    np.testing.assert_allclose(cloud.rebased([389_000, 6_463_000, 0]).world(), world, atol=1e-9)
    np.testing.assert_array_equal(from_world(world - world[0]).origin, 0)


def test_fields_follow_a_selection() -> None:
    cloud = PointCloud(np.eye(3), fields={"a": np.arange(3)}).with_fields(b=np.arange(3) * 2)
    chosen = cloud.select(np.array([True, False, True]))
    assert chosen.fields["b"].tolist() == [0, 4]
    assert len(chosen) == 2


def test_a_cloud_checks_its_shapes() -> None:
    with pytest.raises(InputError, match="field a has 2 values for 3 points"):
        PointCloud(np.eye(3), fields={"a": np.zeros(2)})
    with pytest.raises(InputError, match="xyz"):
        PointCloud(np.zeros((3, 2)))
    with pytest.raises(InputError, match="origin"):
        PointCloud(np.eye(3), origin=np.zeros(2))


def test_single_precision_input_becomes_double() -> None:
    assert PointCloud(np.eye(3, dtype=np.float32)).xyz.dtype == np.float64  # type: ignore[arg-type]


def test_downsampling_averages_each_voxel() -> None:
    xyz = np.array([[0.1, 0.1, 0.1], [0.2, 0.1, 0.1], [0.6, 0.1, 0.1]])
    normals = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    fields = {"spread": np.array([1, 2, 5], np.float32), "n": np.array([7, 8, 9]), "normals": normals}
    small = voxel_downsample(PointCloud(xyz, fields=fields), 0.5)
    np.testing.assert_allclose(small.xyz, [[0.15, 0.1, 0.1], [0.6, 0.1, 0.1]])
    np.testing.assert_allclose(small.fields["spread"], [1.5, 5])
    assert small.fields["spread"].dtype == np.float32
    assert small.fields["n"].tolist() == [7, 9]
    np.testing.assert_allclose(np.linalg.norm(small.fields["normals"], axis=1), 1)


@given(hnp.arrays(np.float64, (50, 3), elements=st.floats(-20, 20)), st.floats(0.1, 5.0))
def test_downsampling_leaves_one_point_a_voxel_and_keeps_the_centroid(xyz: np.ndarray, leaf: float) -> None:
    cloud = PointCloud(xyz, fields={"weight": np.ones(50)})
    keys, counts = np.unique(voxel_keys(voxel_indices(xyz, leaf)), return_counts=True)
    small = voxel_downsample(cloud, leaf)
    assert len(small) == len(keys)
    np.testing.assert_allclose((small.xyz * counts[:, None]).sum(axis=0) / 50, xyz.mean(axis=0), atol=1e-9)


def test_an_empty_cloud_downsamples_to_itself() -> None:
    assert len(voxel_downsample(PointCloud(np.zeros((0, 3))), 0.5)) == 0


@given(st.integers(0, 2**32 - 1), st.integers(1, 300), st.floats(0.1, 5.0))
def test_every_point_is_in_the_voxel_of_the_mean_that_it_went_into(seed, count, leaf):
    xyz = np.random.default_rng(seed).uniform(-10, 10, (count, 3))
    small, voxel = voxel_average(PointCloud(xyz), leaf)
    assert np.array_equal(np.unique(voxel), np.arange(len(small)))
    sums = [np.bincount(voxel, xyz[:, axis]) / np.bincount(voxel) for axis in range(3)]
    np.testing.assert_allclose(small.xyz, np.column_stack(sums), atol=1e-9)
    assert np.array_equal(np.floor(xyz / leaf), np.floor(small.xyz / leaf)[voxel])


@pytest.mark.parametrize("offset", [0.0, 6_463_000.0])
def test_spatial_sorting_groups_cells_anywhere_in_the_world(offset: float) -> None:
    xyz = np.random.default_rng(6).uniform(0, 20, (500, 3)) + offset
    order = sort_spatially(xyz)
    assert sorted(order) == list(range(500))
    cells = np.floor(xyz[order] / 2.0)
    changes = np.any(np.diff(cells, axis=0) != 0, axis=1).sum()
    assert changes == len(np.unique(cells, axis=0)) - 1
    assert len(sort_spatially(np.zeros((0, 3)))) == 0


# --- visibility ------------------------------------------------------------------------------------


def grid() -> VisibilityGrid:
    index = np.array([[0, 0, 0], [1, 0, 0], [-3, 2, 1]])
    order = np.argsort(voxel_keys(index))
    hits, passes = np.array([[1, 0, 4], [0, 5, 6]], np.uint32)[:, order]
    return VisibilityGrid(np.array([100.0, 200, 0]), 0.5, voxel_keys(index)[order], hits, passes)


def test_beams_are_looked_up_where_they_went() -> None:
    points = np.array([[100.1, 200.1, 0.1], [100.6, 200.1, 0.1], [98.6, 201.1, 0.6], [100.1, 200.1, 0.6]])
    hits, passes = grid().lookup(points)
    assert hits.tolist() == [1, 0, 4, 0]
    assert passes.tolist() == [0, 5, 6, 0]
    assert grid().observed(points).tolist() == [True, True, True, False]
    assert grid().observed(points, min_beams=5).tolist() == [False, True, True, False]


def test_a_point_beyond_the_reach_of_the_keys_was_never_seen() -> None:
    near = np.array([[100.1, 200.1, 0.1]])
    alias = near + np.array([0.0, 0.0, 0.5 * 2**21])  # the same packed key, were it not refused
    assert grid().observed(np.vstack([near, alias, [[1e9, 0, 0]]])).tolist() == [True, False, False]


def test_an_empty_grid_saw_nothing() -> None:
    none = np.zeros(0, np.uint32)
    empty = VisibilityGrid(np.zeros(3), 0.5, np.zeros(0, np.int64), none, none)
    assert not empty.observed(np.eye(3)).any()


def test_visibility_is_read_as_written(tmp_path: Path) -> None:
    save_visibility(tmp_path / "v.npz", grid())
    back = load_visibility(tmp_path / "v.npz")
    assert back.voxel == 0.5
    for name in ("origin", "keys", "hits", "passes"):
        np.testing.assert_array_equal(getattr(back, name), getattr(grid(), name))


@pytest.mark.parametrize("keep", [0, 30, 200])
def test_a_damaged_visibility_layer_is_refused(tmp_path: Path, keep: int) -> None:
    save_visibility(tmp_path / "v.npz", grid())
    (tmp_path / "v.npz").write_bytes((tmp_path / "v.npz").read_bytes()[:keep])
    with pytest.raises(InputError, match="not a visibility layer"):
        load_visibility(tmp_path / "v.npz")


# --- configuration ---------------------------------------------------------------------------------


class Slice(StrictModel):
    FORMER_NAMES: ClassVar[Mapping[str, str]] = {"edge": "voxel"}
    voxel: float = Field(1.0, gt=0)
    name: str = "a"


class Whole(StrictModel):
    odometry: Slice = Slice()
    seed: int = 0


def test_later_files_and_settings_win(tmp_path: Path) -> None:
    for name, voxel in (("a", 2.0), ("b", 3.0)):
        text = f"/**:\n  ros__parameters:\n    odometry:\n      voxel: {voxel}\n      name: {name}\n"
        (tmp_path / f"{name}.yaml").write_text(text)
    config = load_config(Whole, [tmp_path / "a.yaml", tmp_path / "b.yaml"], ["odometry.voxel=0.5", "seed=7"])
    assert (config.odometry.voxel, config.odometry.name, config.seed) == (0.5, "b", 7)


def test_a_written_configuration_loads_to_the_same_object_and_hash(tmp_path: Path) -> None:
    config = Whole(odometry=Slice(voxel=0.25))
    write_config(tmp_path / "c.yaml", config)
    assert load_config(Whole, [tmp_path / "c.yaml"]) == config
    assert (
        config_hash(load_config(Whole, [tmp_path / "c.yaml"])) == config_hash(config) != config_hash(Whole())
    )


@pytest.mark.parametrize(
    ("setting", "match"),
    [
        ("voxel", "expected key=value"),
        ("=3", "expected key=value"),
        ("a..b=3", "expected key=value"),
        ("seed=[1", "not valid YAML"),
        ("odometry.voxel=-1", "odometry.voxel: Input should be greater than 0"),
        ("odometry.vocsel=1", "odometry.vocsel: no such setting; did you mean voxel"),
        ("odometry.edge=1", "odometry.edge: no such setting; it is called voxel now"),
    ],
)
def test_bad_settings_are_refused_in_one_line(setting: str, match: str) -> None:
    with pytest.raises(InputError, match=match) as caught:
        load_config(Whole, settings=[setting])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (b"a: [", "not valid YAML"),
        (b"\xff\xfe\x00", "not a text file"),
        (b"odometry: {}", "ros__parameters"),
        (b"/**:\n  ros__parameters: [1]\n", "names and values"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, text: bytes, match: str) -> None:
    (tmp_path / "c.yaml").write_bytes(text)
    with pytest.raises(InputError, match=match) as caught:
        load_config(Whole, [tmp_path / "c.yaml"])
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def test_a_missing_configuration_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_parameters(tmp_path / "none.yaml")


def test_no_parameters_at_all_are_defaults(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("/**:\n  ros__parameters:\n")
    assert load_config(Whole, [tmp_path / "c.yaml"]) == Whole()


def test_merging_leaves_its_arguments_alone() -> None:
    base = {"a": {"b": 1, "c": 2}}
    assert merge(base, {"a": {"b": 3}, "d": 4}) == {"a": {"b": 3, "c": 2}, "d": 4}
    assert base == {"a": {"b": 1, "c": 2}}
    assert parse_setting("a.b.c=1.5") == {"a": {"b": {"c": 1.5}}}


# --- whole outputs and errors ----------------------------------------------------------------------


def fail_half_way(target: Path, overwrite: bool = False) -> None:
    with whole_directory(target, overwrite=overwrite) as partial:
        (partial / "a").write_text("half")
        raise RuntimeError("power cut")


def test_a_directory_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "out" / "map"
    with pytest.raises(RuntimeError, match="power cut"):
        fail_half_way(target)
    assert list((tmp_path / "out").iterdir()) == []
    with whole_directory(target) as partial:
        (partial / "a").write_text("whole")
        assert not target.exists()
    assert (target / "a").read_text() == "whole"


def test_the_old_directory_stays_until_the_new_one_is_whole(tmp_path: Path) -> None:
    target = tmp_path / "map"
    with whole_directory(target) as partial:
        (partial / "a").write_text("old")
    with pytest.raises(RuntimeError, match="power cut"):
        fail_half_way(target, overwrite=True)
    assert (target / "a").read_text() == "old"
    with whole_directory(target, overwrite=True, marker="a") as partial:
        (partial / "b").write_text("new")
    assert [p.name for p in target.iterdir()] == ["b"]
    assert [p.name for p in tmp_path.iterdir()] == ["map"]


def test_a_file_is_not_replaced_by_a_directory(tmp_path: Path) -> None:
    (tmp_path / "map").write_text("I am a file")
    with pytest.raises(InputError, match="is a file"), whole_directory(tmp_path / "map", overwrite=True):
        pass
    assert (tmp_path / "map").read_text() == "I am a file"


def fill_the_disk(path: Path) -> None:
    with whole_file(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError("disk full")


def test_a_file_keeps_its_old_content_when_writing_fails(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError, match="disk full"):
        fill_the_disk(path)
    assert path.read_text() == "old"
    with whole_file(path) as temporary:
        assert temporary.suffix == ".txt"
        temporary.write_text("new")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_errors_carry_their_exit_codes() -> None:
    assert (SubiacoError.exit_code, InputError.exit_code, RegistrationError.exit_code) == (1, 2, 3)
    assert issubclass(InputError, SubiacoError)
    assert issubclass(RegistrationError, SubiacoError)
