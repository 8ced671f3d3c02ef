"""Mistakes in the two surveys become findings with a value, a limit and a remedy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from subiaco_change.input_checks import (
    InputCheckConfig,
    SurveyFacts,
    check_shift,
    check_surveys,
    unstated_findings,
)
from subiaco_change.records import Registration
from subiaco_geo.crs import transformer
from subiaco_geo.survey_map import PoseUncertainty
from subiaco_geo.trajectories import Trajectory

PLACE = np.array([391_200.0, 6_464_300.0, 12.0])
CONFIG = InputCheckConfig()


def drive(*days: str, scans: int = 50) -> Trajectory:
    """Return a trajectory with a drive of five seconds on each day."""
    steps = np.arange(scans) * 100_000_000
    times = np.concatenate([np.datetime64(day, "ns").astype(np.int64) + steps for day in days])
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, 3] = PLACE
    return Trajectory(times, poses)


def facts(
    *days: str, crs: str | None = "EPSG:7850", place: np.ndarray = PLACE, sigma: float = 0.0
) -> SurveyFacts:
    way = drive(*days) if days else None
    stated = None
    if sigma:
        covariances = np.tile(np.eye(6) * sigma**2, (10, 1, 1))
        stated = PoseUncertainty(np.arange(10), ["a"] * 10, covariances)
    return SurveyFacts(crs, place, way, stated)


@pytest.fixture
def two(tmp_path: Path) -> tuple[Path, Path]:
    """Two clouds with different content."""
    paths = tmp_path / "2023.ply", tmp_path / "2025.ply"
    for path in paths:
        path.write_text(path.name)
    return paths


def codes(paths: tuple[Path, Path], before: SurveyFacts, after: SurveyFacts) -> dict[str, str]:
    return {f.code: f.severity for f in check_surveys(paths, (before, after), CONFIG)}


def test_two_surveys_in_order_have_no_finding(two):
    assert codes(two, facts("2023-10-15"), facts("2025-10-12")) == {}
    assert codes(two, facts(), facts("2025-10-12")) == {}


def test_swapped_epochs_are_serious_and_the_remedy_is_named(two):
    (found,) = check_surveys(two, (facts("2025-10-12"), facts("2023-10-15")), CONFIG)
    assert (found.code, found.severity) == ("epochs_swapped", "serious")
    assert "2025-10-12" in found.sentence
    assert "2023-10-15" in found.sentence
    assert found.remedy == "Exchange BEFORE and AFTER."


def test_surveys_that_overlap_in_time_are_a_warning(two):
    before = facts("2025-10-11", "2025-10-12")
    assert codes(two, before, facts("2025-10-12"))["epochs_overlap_in_time"] == "warning"


def test_times_since_the_start_of_a_recording_say_nothing(two):
    way = drive("1970-01-01")
    undated = SurveyFacts("EPSG:7850", PLACE, way, None)
    assert codes(two, facts("2025-10-12"), undated) == {}


@pytest.mark.parametrize("copy", ["the same path", "a copy"])
def test_one_cloud_given_twice_is_serious(tmp_path, copy):
    first, second = tmp_path / "a.ply", tmp_path / "b.ply"
    first.write_text("points")
    second.write_text("points")
    paths = (first, first) if copy == "the same path" else (first, second)
    assert codes(paths, facts(), facts()) == {"same_survey": "serious"}


@pytest.mark.parametrize(
    ("days", "severity"),
    [(("2025-10-12", "2025-10-13"), None), (("2025-10-12", "2025-10-20"), "warning"),
     (("2023-10-15", "2025-10-12"), "serious")],
)  # fmt: skip
def test_drives_of_different_epochs_in_one_map(two, days, severity):
    found = codes(two, facts("2020-01-01"), facts(*days))
    assert found.get("epochs_mixed") == severity


def test_perth_in_zone_51_is_outside_the_area_of_the_crs(two):
    place = transformer("EPSG:7850", "EPSG:7851").apply(PLACE[None])[0]
    (found,) = check_surveys(two, (facts(), facts(crs="EPSG:7851", place=place)), CONFIG)
    assert (found.code, found.severity) == ("crs_area", "serious")
    assert "E -17" in found.sentence
    assert "area of use" in found.sentence


def moved(vector: tuple[float, float, float]) -> Registration:
    T = np.eye(4)
    T[:3, 3] = vector
    return Registration(T, PLACE, 0.005, 0.02, 0.9, np.full(6, 0.002), "test")


def test_a_shift_of_gda94_against_gda2020_is_named():
    surveys = facts("2023-10-15", sigma=0.012), facts("2025-10-12", sigma=0.012)
    vector = transformer("EPSG:28350", "EPSG:7850").apply(PLACE[None])[0] - PLACE
    (found,) = check_shift(moved(tuple(vector)), surveys, 0.04, CONFIG)
    assert (found.code, found.severity) == ("datum_mismatch", "serious")
    assert "moved BEFORE by 1.80 m" in found.sentence
    assert "GDA94 (BEFORE) and GDA2020 (AFTER)" in found.sentence
    assert "limit 3 times" in found.sentence


def test_plate_motion_between_two_surveys_is_named():
    surveys = facts("2015-07-01", sigma=0.012), facts("2026-07-01", sigma=0.012)
    (found,) = check_shift(moved((0.43, 0.64, 0.0)), surveys, 0.04, CONFIG)
    assert "ITRF2014 (BEFORE) and ITRF2014 (AFTER)" in found.sentence


@pytest.mark.parametrize(
    ("sigma", "size", "code"),
    [(0.012, 0.05, None), (0.012, 0.3, "registration_shift"), (0.2, 0.3, None), (0.0, 0.3, None),
     (0.0, 0.7, "registration_shift")],
)  # fmt: skip
def test_a_shift_is_compared_with_what_the_surveys_state(sigma, size, code):
    surveys = facts(sigma=sigma), facts(sigma=sigma)
    found = check_shift(moved((size, 0.0, 0.0)), surveys, 0.04, CONFIG)
    assert [f.code for f in found] == ([code] if code else [])
    assert all(f.severity == "serious" and f"{size:.2f} m" in f.sentence for f in found)


def test_local_surveys_have_no_shift():
    local = replace(facts(), crs=None)
    assert check_shift(moved((50.0, 0.0, 0.0)), (local, facts()), 0.04, CONFIG) == ()


def test_what_was_assumed_of_poses_is_said():
    (both,) = unstated_findings((facts(), facts()), 0.04, used=True)
    assert "4 cm" in both.sentence
    assert "Neither survey" in both.sentence
    (one,) = unstated_findings((facts(sigma=0.01), facts()), 0.04, used=True)
    assert "The survey after" in one.sentence
    assert unstated_findings((facts(sigma=0.01), facts(sigma=0.01)), 0.04, used=True) == ()
    assert unstated_findings((facts(), facts()), 0.04, used=False) == ()
