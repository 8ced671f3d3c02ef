"""Map directories: what is written is read back, whole or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import PointCloud, from_world, voxel_keys
from subiaco_geo.errors import InputError
from subiaco_geo.frames import exp_se3
from subiaco_geo.maps import load_epoch, plain, read_map, write_map
from subiaco_geo.survey_map import PoseUncertainty, SurveyMap
from subiaco_geo.trajectories import Trajectory, write_tum
from subiaco_geo.visibility import VisibilityGrid

PERTH = np.array([389_000.0, 6_463_000.0, 10.0])


def some_trajectory(rng: np.random.Generator, n: int, where: np.ndarray) -> Trajectory:
    poses = exp_se3(rng.normal(size=(n, 6)))
    poses[:, :3, 3] += where
    steps = rng.integers(1, 10**9, n)
    return Trajectory(1_763_000_000_000_000_000 + np.cumsum(steps), poses)


def some_cloud(rng: np.random.Generator, n: int, crs: str | None) -> PointCloud:
    where = PERTH if crs else np.zeros(3)
    fields = {"n": rng.integers(1, 9, n).astype(np.int32), "normals": rng.normal(size=(n, 3))}
    return from_world(where + rng.uniform(-50, 50, (n, 3)), crs, **fields)


def some_survey(seed: int = 0, n: int = 50, crs: str | None = "EPSG:7850", parts: bool = True) -> SurveyMap:
    """A map with everything in it, or with the cloud alone."""
    rng = np.random.default_rng(seed)
    cloud = some_cloud(rng, n, crs)
    if not parts:
        return SurveyMap(cloud)
    trajectory = some_trajectory(rng, n, cloud.origin)
    root = rng.normal(size=(n, 6, 6))
    keys = np.unique(voxel_keys(rng.integers(-50, 50, (n, 3))))
    beams = rng.integers(0, 99, (2, len(keys))).astype(np.uint32)
    names = [f"drive, {i % 2}" for i in range(n)]
    return SurveyMap(
        cloud,
        trajectory,
        VisibilityGrid(cloud.origin, 0.5, keys, beams[0], beams[1]),
        PoseUncertainty(trajectory.times_ns, names, root @ np.swapaxes(root, 1, 2) * 1e-4),
        {"epoch": "before", "leaf": np.float64(0.25), "bags": [{"path": Path("a"), "hash": "12"}]},
        some_cloud(rng, n, crs),
        {"a": some_trajectory(rng, 5, np.zeros(3)), "b.c": some_trajectory(rng, 7, np.zeros(3))},
        {"flags": [{"start_ns": 5, "why": "no fix"}]},
        np.round(rng.uniform(0, 99, (4, 5)), 3) * [1, 1, 1, 0, 0.01],
        {"odometry": {"voxel": 1.0}},
    )


@settings(max_examples=15)
@given(st.integers(0, 10_000), st.integers(1, 60), st.sampled_from([None, "EPSG:7850"]), st.booleans())
def test_a_map_read_back_is_the_map_that_was_written(
    tmp_path_factory: pytest.TempPathFactory, seed: int, n: int, crs: str | None, parts: bool
) -> None:
    survey = some_survey(seed, n, crs, parts)
    directory = tmp_path_factory.mktemp("map") / "before"
    write_map(directory, survey)
    back = read_map(directory)
    assert back.crs == crs
    np.testing.assert_array_equal(back.cloud.origin, survey.cloud.origin)
    np.testing.assert_allclose(back.cloud.xyz, survey.cloud.xyz, atol=2e-9)
    for name, values in survey.cloud.fields.items():
        np.testing.assert_array_equal(back.cloud.fields[name], values)
    assert back.config == survey.config
    assert back.manifest == survey.manifest
    assert plain(survey.info).items() <= back.info.items()
    assert back.odometry.keys() == survey.odometry.keys()
    for name, odometry in survey.odometry.items():
        np.testing.assert_array_equal(back.odometry[name].times_ns, odometry.times_ns)
        np.testing.assert_allclose(back.odometry[name].poses, odometry.poses, atol=1e-9)
    if parts:
        assert_same_parts(survey, back)
    else:
        assert (back.trajectory, back.visibility, back.uncertainty, back.last) == (None,) * 4


def assert_same_parts(survey: SurveyMap, back: SurveyMap) -> None:
    np.testing.assert_array_equal(back.trajectory.times_ns, survey.trajectory.times_ns)
    np.testing.assert_allclose(back.trajectory.poses, survey.trajectory.poses, atol=5.1e-5)
    for name in ("origin", "voxel", "keys", "hits", "passes"):
        np.testing.assert_array_equal(getattr(back.visibility, name), getattr(survey.visibility, name))
    assert list(back.uncertainty.sequences) == list(survey.uncertainty.sequences)
    np.testing.assert_allclose(back.uncertainty.covariances, survey.uncertainty.covariances, rtol=1e-8)
    np.testing.assert_allclose(back.last.world(), survey.last.world(), atol=0.000501)
    np.testing.assert_allclose(back.heights, survey.heights, atol=1e-6)


def test_the_directory_holds_what_the_contract_names(tmp_path: Path) -> None:
    write_map(tmp_path / "m", some_survey())
    names = {str(p.relative_to(tmp_path / "m")) for p in (tmp_path / "m").rglob("*") if p.is_file()}
    assert names == {
        "map.laz", "map.ply", "map.yaml", "trajectory.tum", "odometry/a.txt", "odometry/a.times.txt",
        "odometry/b.c.txt", "odometry/b.c.times.txt", "visibility.npz", "uncertainty.csv", "heights.csv",
        "tile_uncertainty.csv", "manifest.yaml", "last.laz", "config.yaml",
    }  # fmt: skip
    info = yaml.safe_load((tmp_path / "m" / "map.yaml").read_text())
    assert info["crs"] == "EPSG:7850"
    assert info["heights"] == "ellipsoidal"
    assert info["points"] == 50
    assert info["end_ns"] > info["start_ns"]
    assert info["bags"] == [{"path": "a", "hash": "12"}]


def test_a_local_map_says_that_it_has_no_crs(tmp_path: Path) -> None:
    write_map(tmp_path / "m", some_survey(crs=None))
    info = read_map(tmp_path / "m").info
    assert info["crs"] is None
    assert info["heights"] is None


def test_sigmas_are_the_roots_of_the_diagonal() -> None:
    covariance = np.diag([1.0, 4, 9, 16, 25, 36])[None]
    np.testing.assert_allclose(PoseUncertainty(np.array([1]), ["a"], covariance).sigmas, [[1, 2, 3, 4, 5, 6]])
    with pytest.raises(InputError, match="covariances"):
        PoseUncertainty(np.array([1, 2]), ["a"], covariance)


def test_an_existing_map_needs_overwrite_and_is_then_replaced(tmp_path: Path) -> None:
    write_map(tmp_path / "m", some_survey())
    with pytest.raises(InputError, match="exists already"):
        write_map(tmp_path / "m", some_survey(1))
    write_map(tmp_path / "m", some_survey(1, parts=False), overwrite=True)
    assert read_map(tmp_path / "m").trajectory is None
    assert [p.name for p in tmp_path.iterdir()] == ["m"]


def test_overwrite_does_not_replace_a_folder_of_other_things(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="holds other things"):
        write_map(tmp_path / "home", some_survey(), overwrite=True)
    assert (tmp_path / "home" / "thesis.tex").exists()


def test_a_map_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="empty"):
        write_map(tmp_path / "m", SurveyMap(PointCloud(np.zeros((0, 3)))))
    with pytest.raises(InputError, match="sequence"):
        write_map(
            tmp_path / "m", SurveyMap(PointCloud(np.eye(3)), odometry={"a/b": some_survey().trajectory})
        )
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_a_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"not a map directory \(no map.yaml\)"):
        read_map(tmp_path)
    with pytest.raises(InputError, match="holds no map"):
        load_epoch(tmp_path)
    with pytest.raises(InputError, match="no such map or cloud"):
        load_epoch(tmp_path / "gone")


@pytest.mark.parametrize(
    ("name", "match"),
    [
        ("map.yaml", "map.yaml"),
        ("heights.csv", "heights.csv: unexpected columns"),
        ("uncertainty.csv", "uncertainty.csv: unexpected columns"),
        ("visibility.npz", "not a visibility layer"),
        ("trajectory.tum", "trajectory.tum:1"),
        ("config.yaml", "config.yaml"),
    ],
)
def test_a_damaged_part_is_named(tmp_path: Path, name: str, match: str) -> None:
    write_map(tmp_path / "m", some_survey())
    (tmp_path / "m" / name).write_text("[: broken")
    with pytest.raises(InputError, match=match) as caught:
        read_map(tmp_path / "m")
    assert "\n" not in str(caught.value)


def test_a_cloud_exchanged_for_one_of_another_crs_is_noticed(tmp_path: Path) -> None:
    write_map(tmp_path / "m", some_survey())
    write_cloud(tmp_path / "m" / "map.ply", some_survey(crs="EPSG:28350").cloud)
    with pytest.raises(InputError, match=r"map\.yaml says CRS EPSG:7850, the cloud says EPSG:28350"):
        read_map(tmp_path / "m")


def test_an_epoch_is_a_map_a_bare_cloud_or_a_folder_with_one(tmp_path: Path) -> None:
    survey = some_survey()
    write_map(tmp_path / "m", survey)
    (tmp_path / "sim").mkdir()
    write_cloud(tmp_path / "sim" / "map.ply", survey.cloud)
    mapped = load_epoch(tmp_path / "m")
    assert mapped.visibility is not None
    assert mapped.last is None
    for path in (tmp_path / "sim", tmp_path / "sim" / "map.ply", tmp_path / "m" / "map.laz"):
        bare = load_epoch(path)
        np.testing.assert_allclose(bare.cloud.world(), survey.cloud.world(), atol=0.000501)
        assert bare.trajectory is None
        assert bare.visibility is None


def test_what_lies_beside_a_bare_map_in_its_folder_is_taken_up(tmp_path: Path) -> None:
    survey = some_survey()
    write_map(tmp_path / "m", survey)
    (tmp_path / "sim").mkdir()
    for name in ("map.ply", "visibility.npz", "trajectory.tum"):
        (tmp_path / "m" / name).rename(tmp_path / "sim" / name)
    bare = load_epoch(tmp_path / "sim")
    np.testing.assert_array_equal(bare.visibility.keys, survey.visibility.keys)
    assert len(bare.trajectory) == len(survey.trajectory)


def test_a_trajectory_given_beside_replaces_the_maps_own(tmp_path: Path) -> None:
    write_map(tmp_path / "m", some_survey())
    other = some_trajectory(np.random.default_rng(9), 3, PERTH)
    write_tum(tmp_path / "t.tum", other)
    for path in (tmp_path / "m", tmp_path / "m" / "map.ply"):
        assert len(load_epoch(path, tmp_path / "t.tum").trajectory) == 3
