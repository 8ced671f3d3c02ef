"""The summary says what was compared, how sure, and what could not be seen, and calls simulated data so."""

import json
import re
import shutil

import numpy as np
import pytest

from subiaco_change.job import drive_facts
from subiaco_change.outputs.change_directory_reading import read_change_directory
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import Trajectory
from subiaco_report import evidence_pictures as evidence
from subiaco_report import page
from subiaco_report.cloud_windows import gather
from subiaco_report.facts import changed_rows
from subiaco_report.page import build_report
from subiaco_report.summary import build_summary, day_of, epoch_facts, largest_rows

HOUR_NS = 3_600_000_000_000
DAY_2024_NS = int(np.datetime64("2024-05-06T07:00:00", "ns").astype(np.int64))


@pytest.fixture(scope="module")
def change(change_directory):
    return read_change_directory(change_directory)


@pytest.fixture(scope="module")
def facts(change):
    changed = changed_rows(change.table)
    return build_summary(change, gather(change), dict.fromkeys(changed["object_id"]))


def survey(cloud, start_ns, x):
    poses = np.repeat(np.eye(4)[None], len(x), axis=0)
    poses[:, 0, 3] = x
    return SurveyMap(cloud, Trajectory(start_ns + HOUR_NS * np.arange(len(x)), poses))


def test_counts_add_up_to_the_changes(facts, result):
    assert facts["changed"] == sum(r.change.label in facts["labels"] for r in result.records)
    assert facts["counts"][-1]["class"] == "all"
    assert facts["counts"][-1]["total"] == facts["changed"] == sum(b["count"] for b in facts["bands"])
    assert sum(row["total"] for row in facts["counts"][:-1]) == facts["changed"]


def test_bands_of_confidence_are_called_by_what_was_measured_or_said_to_be_unmeasured(
    change_directory, tmp_path
):
    target = tmp_path / "copy"
    shutil.copytree(change_directory, target)
    run = json.loads((target / "run.json").read_text())
    assert run["confidence_bands"] == []
    assert (target / "summary.html").read_text().count('<td class="soft">not measured</td>') == 3
    run |= {"confidence_calibrated": True}
    run["confidence_bands"] = [{"low": 0.9, "high": 1.01, "right": 106, "claims": 118}]
    (target / "run.json").write_text(json.dumps(run))
    build_report(target)
    text = (target / "summary.html").read_text()
    assert "106 of 118 were right" in text
    assert text.count("not measured") == 2
    assert "sure (" not in text


def test_the_largest_come_by_volume_whatever_its_sign(change):
    changed = changed_rows(change.table)
    volumes = largest_rows(changed)["delta_v_m3"].abs().tolist()
    assert volumes == sorted(changed["delta_v_m3"].abs().tolist(), reverse=True)[:10]
    assert len(volumes) > 3


def test_areas_of_the_coverage_are_those_of_the_raster(facts, change_directory):
    rasterio = pytest.importorskip("rasterio")
    with rasterio.open(change_directory / "coverage.tif") as dataset:
        codes, cell = dataset.read(1), dataset.res[0]
    for code, entry in enumerate(facts["coverage"]["entries"], start=1):
        assert entry["area_m2"] == pytest.approx(np.count_nonzero(codes == code) * cell**2)


def test_days_and_kilometres_come_from_the_trajectory_and_jumps_between_recordings_do_not_count(result):
    known = drive_facts(survey(result.after, DAY_2024_NS, [0.0, 10.0, 20.0, 5020.0, 5030.0]))
    assert known == {"first": "2024-05-06T07:00:00", "last": "2024-05-06T11:00:00", "km": 0.03}
    assert day_of(known["first"]) == "6 May 2024"
    assert drive_facts(survey(result.after, 0, [0.0, 10.0])) == {"km": 0.01}
    assert drive_facts(SurveyMap(result.after)) == {}


def test_what_is_not_known_is_said_to_be_not_known(change):
    before, after = epoch_facts(change.run)
    assert before["days"] is before["km"] is after["name"] is None


def test_simulated_surveys_are_called_so_in_both_pages_and_real_ones_are_not(
    change_directory, tmp_path, monkeypatch
):
    monkeypatch.setattr(page.pictures, "overview", lambda *_: b"")
    monkeypatch.setattr(page, "_MOST_BLOCKS", 0)
    target = tmp_path / "copy"
    shutil.copytree(change_directory, target)
    run = json.loads((target / "run.json").read_text())
    assert "simulated" not in (change_directory / "summary.html").read_text()
    run["notes"] = {
        "simulations": [{"preset": "easy"}],
        "epochs": {"before": {"first": "2023-05-02T08:00:00", "last": "2023-05-03T08:00:00", "km": 1.5}},
    }
    (target / "run.json").write_text(json.dumps(run))
    build_report(target)
    text = (target / "summary.html").read_text()
    assert "simulated data" in text
    assert "2 May 2023 to 3 May 2023" in text
    assert "1.50 km" in text
    assert "simulated surveys" in (target / "report.html").read_text()


def test_it_shows_the_same_pictures_as_the_report_and_nothing_from_outside(change_directory):
    text = (change_directory / "summary.html").read_text()
    report = (change_directory / "report.html").read_text()
    shown = re.findall(r'<figure><div class="proof"><img src="([^"]+)"', text)
    assert len(shown) == 6
    assert all(uri.partition(",")[2] in report for uri in shown)
    assert not re.search(r"https?://", text)
    assert all(len(uri) < evidence.MAX_BYTES * 1.4 for uri in shown)
