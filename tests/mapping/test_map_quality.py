"""Quality report: figures known by hand, fixes that were truly held out, words that follow the figures."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import TwoDrives
from hypothesis import given
from hypothesis import strategies as st
from mapping_scenes import SECOND, START_NS, relative, turning_pose

from subiaco_geo.clouds import PointCloud
from subiaco_geo.crs import EnuFrame
from subiaco_geo.frames import interpolate_poses
from subiaco_geo.maps import write_map
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import Trajectory
from subiaco_mapping.backend import MappingBackend
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.map_quality import wall_thickness as walls
from subiaco_mapping.map_quality.config import MapQualityConfig
from subiaco_mapping.map_quality.figures import assess
from subiaco_mapping.map_quality.gnss_holdout import FixErrors, holdout_check, holdout_rows
from subiaco_mapping.map_quality.page import with_quality
from subiaco_mapping.map_quality.verdict import amount
from subiaco_mapping.map_quality.wall_thickness import coverage, wall_thickness
from subiaco_mapping.measurements import DeskewedScan, Extrinsics, GnssFix, OdometryPose
from subiaco_mapping.pose_graph.config import GnssConfig, GraphConfig
from subiaco_mapping.survey_graph.solution import GraphSolution

FRAME = EnuFrame(-31.948, 115.825, 12.0)
LEVER = np.array([-0.4, 0.3, 0.9])
STEP = SECOND // 10
SIGMA = 0.02
# errors here are white, and stated as they are
CONFIG = MappingConfig(
    gnss=GnssConfig(correlated_share=0.0, sigma_fixed=1e-4), graph=GraphConfig(drift_share=1.0)
)


def wall(height: float = 4.0, offsets=(0.0,), spread: float = 0.02, origin=(0.0, 0.0, 0.0)) -> PointCloud:
    """A wall 20 m long that looks west, one point a voxel of 0.25 m, voxel rows at ``offsets`` in turn."""
    y, z = (v.ravel() for v in np.meshgrid(np.arange(0.125, 20, 0.25), np.arange(0.125, height, 0.25)))
    x = 5.5 + np.resize(offsets, len(y))
    normals = np.tile([-1.0, 0.0, 0.0], (len(y), 1))
    fields = {"normals": normals, "n": np.full(len(y), 6, np.uint32), "spread": np.full(len(y), spread)}
    return PointCloud(np.column_stack([x, y, z]), np.array(origin), None, fields)


def test_a_wall_is_as_thick_as_its_points_scatter():
    found = wall_thickness(wall(spread=0.02))
    assert len(found.thickness) == 20 * 4
    np.testing.assert_allclose(found.thickness, 0.02, atol=1e-9)


def test_a_wall_that_two_drives_put_in_two_places_is_thick():
    found = wall_thickness(wall(offsets=(-0.05, 0.05, 0.05, -0.05), spread=0.02))
    np.testing.assert_allclose(found.thickness, np.hypot(0.05, 0.02), rtol=1e-6)


def test_what_is_lower_than_two_patches_is_no_facade():
    assert len(wall_thickness(wall(height=1.0)).thickness) == 0


def test_ground_is_no_wall_and_a_cloud_without_statistics_has_none():
    cloud = wall()
    level = cloud.with_fields(normals=np.tile([0.0, 0.0, 1.0], (len(cloud), 1)))
    assert len(wall_thickness(level).thickness) == 0
    assert len(wall_thickness(PointCloud(cloud.xyz)).thickness) == 0


def test_a_hedge_is_no_wall():
    cloud = wall()
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(len(cloud), 3)) * [1.0, 1.0, 0.05]
    ragged = cloud.with_fields(normals=normals / np.linalg.norm(normals, axis=1, keepdims=True))
    assert len(wall_thickness(ragged).thickness) == 0


def test_a_large_map_is_sampled_by_whole_columns(monkeypatch):
    monkeypatch.setattr(walls, "_MOST", len(wall()) // 3)
    found = wall_thickness(wall())
    assert 0 < len(found.thickness) < 80
    assert len(found.thickness) % 4 == 0, "all patches above each other, or none"


@given(st.integers(1, 200), st.integers(0, 99), st.sampled_from([7, 50, 1000]))
def test_every_point_is_counted_in_its_square_metre(count, seed, chunk):
    rng = np.random.default_rng(seed)
    xyz, n = rng.uniform(-3, 3, (count, 3)), rng.integers(1, 9, count)
    cloud = PointCloud(xyz, np.array([388_000.4, 6_464_000.7, 0.0]), None, {"n": n})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(walls, "_CHUNK", chunk)
        found = coverage(cloud)
    cells = np.floor(cloud.world()[:, :2]).astype(int)
    expected, of = np.unique(cells, axis=0, return_inverse=True)
    by_cell = {tuple(c): (p, r) for c, p, r in zip(found.cell, found.points, found.returns, strict=True)}
    assert by_cell == {
        tuple(c): ((of.ravel() == k).sum(), n[of.ravel() == k].sum()) for k, c in enumerate(expected)
    }


def test_one_block_of_ten_is_withheld_and_nothing_of_a_short_drive():
    times = np.arange(0, 100 * SECOND, SECOND // 5)
    held = holdout_rows(times, MapQualityConfig())
    assert sorted(set((times[held] // (5 * SECOND)).tolist())) == [5, 15]
    assert held.sum() == 2 * 25
    assert not holdout_rows(times[: 9 * 5], MapQualityConfig()).any()
    assert holdout_rows(times[: 20 * 5], MapQualityConfig()).sum() == 25
    assert len(holdout_rows(times[:0], MapQualityConfig())) == 0


def driven(folder: Path, count: int = 600, fixes: bool = True, seed: int = 3) -> MappingBackend:
    """A back end fed with a minute on a circle: exact odometry, fixes with white errors of SIGMA."""
    rng = np.random.default_rng(seed)
    stamps = START_NS + np.arange(count) * STEP
    truth = turning_pose(stamps, speed=6.0, rate=0.2)
    backend = MappingBackend(CONFIG, Extrinsics(np.eye(4), None, LEVER), folder)
    backend.start_sequence("drive")
    covariance = np.diag(np.repeat([4e-4**2, 0.002**2], 3))
    for stamp, pose in zip(stamps.tolist(), relative(truth), strict=True):
        scan = DeskewedScan(stamp, rng.uniform(-9, 9, (20, 3)), np.zeros(20, np.float32), "gyro")
        backend.on_odometry(OdometryPose(stamp, pose, covariance, 100, 0.02, False, 0), scan)
    for time in range(int(stamps[0]) + STEP // 3, int(stamps[-1]) * fixes, SECOND // 5):
        at = interpolate_poses(stamps, truth, np.array([time]))[0]
        enu = at[:3, :3] @ LEVER + at[:3, 3] + rng.normal(0, SIGMA, 3)
        place = FRAME.to_geodetic(enu[None])[0]
        backend.on_fix(GnssFix(time, *place.tolist(), np.eye(3) * SIGMA**2, 2))
    return backend


@pytest.fixture(scope="module")
def solution(tmp_path_factory: pytest.TempPathFactory) -> GraphSolution:
    return driven(tmp_path_factory.mktemp("spool")).optimize()


def test_withheld_errors_are_of_the_size_that_is_stated(solution):
    found = holdout_check(solution, CONFIG)
    assert isinstance(found, FixErrors)
    assert len(found) == 25
    told = found.described()
    assert told["horizontal_rmse_m"] == pytest.approx(SIGMA * np.sqrt(2), rel=0.3)
    assert told["vertical_rmse_m"] == pytest.approx(SIGMA, rel=0.4)
    assert 0.75 < told["error_over_sigma"] < 1.25
    assert told["share_within_95"] > 0.8


def test_withheld_fixes_have_no_say_in_the_solution_that_they_are_compared_with(solution):
    chain = solution.graph.chains[0]
    held = holdout_rows(chain.gnss.times_ns, CONFIG.quality)
    shift = np.array([3.0, -4.0, 5.0])
    moved = replace(chain, gnss=replace(chain.gnss, enu=chain.gnss.enu + held[:, None] * shift))
    wrong = replace(solution, graph=replace(solution.graph, chains={0: moved}))
    before, after = holdout_check(solution, CONFIG), holdout_check(wrong, CONFIG)
    np.testing.assert_allclose(before.offset - after.offset, np.tile(shift, (25, 1)), atol=1e-9)
    assert after.described()["error_over_sigma"] > 50
    assert after.described()["contradicting"] == 25


def test_a_fix_of_multipath_is_counted_and_does_not_hide_the_others(solution):
    found = holdout_check(solution, CONFIG)
    offset = found.offset.copy()
    offset[3] += [1.5, 0.0, 0.0]
    before, after = found.described(), replace(found, offset=offset).described()
    assert (before["contradicting"], after["contradicting"]) == (0, 1)
    assert after["horizontal_rmse_m"] == pytest.approx(before["horizontal_rmse_m"], rel=0.2)
    assert after["error_over_sigma"] == pytest.approx(before["error_over_sigma"], rel=0.2)


@pytest.mark.parametrize(
    ("quality", "reason"),
    [
        (MapQualityConfig(holdout=False), "quality.holdout"),
        (MapQualityConfig(holdout_block_ns=10**12), "short"),
    ],
)
def test_where_nothing_is_withheld_the_reason_is_told(solution, quality, reason):
    assert reason in holdout_check(solution, CONFIG.model_copy(update={"quality": quality}))


def surveyed(flagged: float = 0.0) -> SurveyMap:
    stretch = {"start_s": 1.0, "end_s": 2.0, "scans": 10, "length_m": flagged}
    flags = {"without_rtk_fixed": [stretch]} if flagged else {}
    return SurveyMap(wall(), manifest={"sequences": {"drive": {"flagged": flags}}})


def reported(survey, solution, **limits):
    config = CONFIG.model_copy(update={"quality": MapQualityConfig(**limits)})
    found = with_quality(survey, solution, config)
    return found, json.loads(found.pages["quality.json"]), found.pages["quality.html"]


@pytest.fixture(scope="module")
def good(solution):
    return reported(surveyed(), solution)


def test_a_good_map_is_called_good_in_one_sentence_with_its_numbers(good):
    _, facts, page = good
    assert facts["verdict"]["grade"] == "good"
    assert facts["verdict"]["wrong"] == []
    sentence = facts["verdict"]["sentence"]
    assert sentence in page
    assert sentence.startswith("Good: 25 of 25 RTK fixes")
    assert amount(facts["withheld"]["horizontal_rmse_m"]) in sentence
    assert "walls are 20 mm thick" in sentence


def test_the_page_lies_beside_the_map_and_needs_no_other_file(good, tmp_path):
    found, _, page = good
    write_map(tmp_path / "map", found)
    assert (tmp_path / "map/quality.html").read_text() == page
    assert "http:" not in page
    assert "https:" not in page
    assert page.count('src="') == page.count('src="data:image/png;base64,') == 6


@pytest.mark.parametrize(
    ("limits", "flagged", "named"),
    [
        ({"max_horizontal": 0.001}, 0.0, "Withheld fixes, horizontal"),
        ({"max_wall": 0.01}, 0.0, "Wall thickness"),
        ({"max_ratio": 0.1}, 0.0, "stated sigma"),
        ({}, 100.0, "flags"),
    ],
)
def test_what_misses_its_limit_is_named_and_the_map_is_not_called_good(solution, limits, flagged, named):
    config = CONFIG.model_copy(update={"quality": MapQualityConfig(**limits)})
    found = assess(surveyed(flagged), solution, config).facts["verdict"]
    assert found["grade"] == "check"
    assert found["sentence"].startswith("Look before you sign")
    assert len(found["wrong"]) == 1
    assert named in found["wrong"][0]


@pytest.mark.parametrize(("days", "grade"), [(0.4, "good"), (1.9, "good"), (3.0, "check"), (728.0, "check")])
def test_drives_of_different_days_in_one_map_are_told_in_its_first_clause(solution, days, grade):
    pause = np.array([0, 0, 1, 1]) * int(days * 86_400e9)
    times = 1_700_000_000 * 10**9 + np.arange(4) * 10**9 + pause
    survey = replace(surveyed(), trajectory=Trajectory(times, np.tile(np.eye(4), (4, 1, 1))))
    found = assess(survey, solution, CONFIG).facts["verdict"]
    assert found["grade"] == grade
    clause = f"its drives lie {days:.0f} days apart"
    assert (clause in found["sentence"]) == (grade == "check")
    assert ("map the drives of each survey by themselves" in found["sentence"]) == (grade == "check")


def test_a_map_without_fixes_is_called_local_and_says_what_it_could_not_check(tmp_path):
    local = driven(tmp_path, count=40, fixes=False).optimize()
    _, facts, page = reported(surveyed(), local)
    assert facts["verdict"]["grade"] == "local"
    assert facts["withheld"] == "no GNSS places this map"
    assert facts["sequences"]["drive"]["states"] == {"no fix": 1.0}
    assert facts["verdict"]["sentence"] in page


def test_the_report_can_be_switched_off(solution):
    assert (
        with_quality(
            surveyed(), solution, CONFIG.model_copy(update={"quality": MapQualityConfig(enabled=False)})
        ).pages
        == {}
    )


@pytest.mark.slow
def test_mapping_writes_the_report_of_both_drives(two_drives: TwoDrives):
    facts = json.loads(two_drives.survey.pages["quality.json"])
    assert sorted(facts["sequences"]) == ["back", "there"]
    assert facts["simulated"] == bool(two_drives.survey.info.get("simulations"))
    assert facts["fixes_used"]["RTK fixed"]["horizontal_rmse_m"] < 0.05
    assert facts["walls"]["thickness_median_m"] < 0.05
