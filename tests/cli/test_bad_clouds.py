"""Epochs that cannot be compared: exit 2 or 3, one line, the remedy, nothing left."""

from __future__ import annotations

import html
import json
import re
import shutil

import laspy
import numpy as np
import pytest
from small_clouds import ORIGIN, street, write_ply, write_street

from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.maps import write_map
from subiaco_geo.survey_map import SurveyMap


@pytest.fixture
def good(tmp_path):
    return write_street(tmp_path / "good.ply")


def pair(before, after, tmp_path, *options):
    return ["change", before, after, "-o", tmp_path / "out", *options]


def test_a_missing_cloud(refused, tmp_path, good):
    refused(pair(good, tmp_path / "none.ply", tmp_path), "none.ply: no such map or cloud", "give a map")


def test_a_missing_third_epoch_is_refused_before_the_first_comparison(refused, tmp_path, good, monkeypatch):
    monkeypatch.setattr("subiaco_change.history.run_change", lambda *_, **__: pytest.fail("compared"))
    other = write_street(tmp_path / "other.ply", seed=2)
    refused(
        ["change", good, other, tmp_path / "none.laz", "-o", tmp_path / "out"], "none.laz: no such map or"
    )


def test_a_folder_without_a_map(refused, tmp_path, good):
    (tmp_path / "photos").mkdir()
    refused(pair(tmp_path / "photos", good, tmp_path), "photos: holds no map", "subiaco map")


def test_an_unknown_ending(refused, tmp_path, good):
    (tmp_path / "cloud.e57").write_bytes(b"ASTM-E57")
    refused(pair(tmp_path / "cloud.e57", good, tmp_path), "cloud.e57", "'.e57'", ".laz")


@pytest.mark.parametrize("ending", [".ply", ".las", ".laz", ".pcd"])
def test_text_under_the_name_of_a_cloud(refused, tmp_path, good, ending):
    bad = tmp_path / f"letter{ending}"
    bad.write_text("Dear surveyor,\nplease find enclosed no points at all.\n" * 20)
    refused(pair(bad, good, tmp_path), bad.name, "export")


@pytest.mark.parametrize("ending", [".ply", ".las", ".laz"])
def test_a_cut_cloud(refused, tmp_path, good, ending):
    bad = write_street(tmp_path / f"cut{ending}")
    data = bad.read_bytes()
    bad.write_bytes(data[: len(data) // 2])
    refused(pair(good, bad, tmp_path), bad.name, "cut", "copy or export it again")


def test_a_cloud_file_without_bytes(refused, tmp_path, good):
    (tmp_path / "blank.laz").touch()
    refused(pair(good, tmp_path / "blank.laz", tmp_path), "blank.laz", "no bytes", "again")


def test_a_cloud_without_points(refused, tmp_path, good):
    bad = write_ply(tmp_path / "hollow.ply", np.zeros((0, 3)))
    refused(pair(bad, good, tmp_path), "hollow.ply: the cloud is empty", "give a cloud with points")


def test_nan_coordinates(refused, tmp_path, good):
    xyz = street()
    xyz[:7, 1] = np.nan
    bad = write_ply(tmp_path / "gaps.ply", xyz)
    refused(pair(bad, good, tmp_path), "gaps.ply: 7 of", "NaN", "remove them")


def test_projected_coordinates_in_single_precision(refused, tmp_path, good):
    bad = write_ply(tmp_path / "coarse.ply", street() + ORIGIN, "float")
    refused(pair(bad, good, tmp_path), "coarse.ply", "float32", "export again with double")


def test_a_cloud_comment_with_an_unknown_crs(refused, tmp_path, good):
    bad = write_ply(tmp_path / "lost.ply", street() + ORIGIN, comment="comment crs EPSG:999999")
    refused(pair(bad, good, tmp_path), "lost.ply", "EPSG:999999", "give an EPSG code")


def test_epochs_in_different_places_though_both_carry_a_crs(refused, tmp_path, good):
    far = write_street(tmp_path / "far.ply", shift=(2000.0, 0.0, 0.0))
    refused(pair(good, far, tmp_path), "different places", "E 391200 to", "E 393200 to", "CRS are right")


def test_two_crs_with_only_a_ballpark_operation_between_them(refused, tmp_path, good):
    old = write_street(tmp_path / "agd66.ply", crs="EPSG:20250")
    refused(pair(old, good, tmp_path), "EPSG:20250", "EPSG:7850", "ballpark", "reproject")


def test_local_epochs_that_do_not_overlap_after_registration(refused, tmp_path):
    first = write_ply(tmp_path / "street.ply", street())
    rng = np.random.default_rng(5)
    flat = np.column_stack([rng.uniform(500, 506, (4000, 2)), rng.normal(0, 2.0, 4000)])
    other = write_ply(tmp_path / "bush.ply", flat)
    line = refused(pair(first, other, tmp_path), code=3)
    assert "could not be registered" in line
    assert "give the transform (--transform F)" in line


def test_a_given_transform_that_cannot_be_read(refused, tmp_path, good):
    refused(pair(good, good, tmp_path, "--transform", tmp_path / "none.txt"), "none.txt", "four rows")
    (tmp_path / "short.txt").write_text("1 0 0\n0 1 0\n")
    refused(pair(good, good, tmp_path, "--transform", tmp_path / "short.txt"), "short.txt", "4x4")
    (tmp_path / "odd.json").write_text("{}")
    refused(pair(good, good, tmp_path, "--transform", tmp_path / "odd.json"), "odd.json", "T_after_before")


def test_a_given_transform_under_which_nothing_overlaps(refused, tmp_path):
    cloud = write_ply(tmp_path / "street.ply", street())
    T = np.eye(4)
    T[0, 3] = 500.0
    np.savetxt(tmp_path / "T.txt", T)
    arguments = pair(cloud, cloud, tmp_path, "--transform", tmp_path / "T.txt")
    refused(arguments, "do not overlap", "check the transform", code=3)


def test_degrees_without_a_crs_are_named_as_such(refused, tmp_path, good):
    degrees = street() / [95_000.0, 111_000.0, 1.0] + [115.8, -31.9, 0.0]
    bad = write_ply(tmp_path / "degrees.ply", degrees)
    said = refused(pair(bad, good, tmp_path), "degrees.ply", "look like degrees", "no CRS", "reproject")
    assert "x 115.8" in said


def test_a_registration_that_fails_says_where_extents_differ_as_metres_and_feet_do(refused, tmp_path):
    metres = write_ply(tmp_path / "metres.ply", street())
    feet = write_ply(tmp_path / "feet.ply", street(2) * 3.2808)
    refused(pair(feet, metres, tmp_path), "the extent of before is 3.28 times as large", "in feet", code=3)


def test_a_stray_point_is_counted_without_a_warning_of_numpy(refused, command, tmp_path, good, recwarn):
    stray = write_ply(tmp_path / "stray.ply", np.concatenate([street(), [[1e30, 0.0, 0.0]]]))
    refused(
        pair(good, stray, tmp_path),
        "stray.ply: points farther than 100 km from the median of the cloud: 1",
        "remove",
    )
    assert not [w for w in recwarn if issubclass(w.category, RuntimeWarning)]


def test_points_that_are_all_at_one_place_are_named(refused, tmp_path, good):
    one = write_ply(tmp_path / "one.ply", np.tile([3.0, 4.0, 5.0], (2000, 1)))
    refused(pair(good, one, tmp_path), "one.ply: all 2000 points are at one place", "check the cloud")
    write_cloud(tmp_path / "placed.ply", PointCloud(np.zeros((2000, 3)), ORIGIN, "EPSG:7850"))
    refused(pair(tmp_path / "placed.ply", good, tmp_path), "placed.ply: all 2000 points are at one place")


def test_nan_points_are_counted_among_the_points_that_were_read(refused, tmp_path, good):
    xyz = street()
    xyz[::50] = np.nan
    bad = write_ply(tmp_path / "nan.ply", xyz)
    refused(pair(bad, good, tmp_path), "nan.ply: 20 of the points 1 to 1000 have NaN", "remove them")


def test_a_trajectory_that_cannot_have_seen_the_cloud(refused, tmp_path):
    good = write_street(tmp_path / "local.ply", crs=None)
    options = ["--registration", "identity", "--trajectory-before", tmp_path / "far.tum"]
    rows = [f"{t} {ORIGIN[0] + 540 + t} {ORIGIN[1]} {ORIGIN[2] + 2} 0 0 0 1" for t in range(5)]
    (tmp_path / "far.tum").write_text("\n".join(rows))
    said = refused(
        pair(good, good, tmp_path, *options), "far.tum: no pose of the trajectory lies within 80 m"
    )
    assert "500 m away" in said
    (tmp_path / "far.tum").write_text(rows[0])
    refused(pair(good, good, tmp_path, *options), "far.tum: holds fewer than 2 poses", "whole trajectory")


def test_a_given_transform_that_is_not_rigid(refused, tmp_path, good):
    np.savetxt(tmp_path / "skewed.txt", np.diag([2.0, 1.0, 1.0, 1.0]))
    refused(
        pair(good, good, tmp_path, "--transform", tmp_path / "skewed.txt"),
        "transform: not rigid",
        "without scale",
    )


def test_a_registration_that_is_not_known(refused, tmp_path, good):
    refused(pair(good, good, tmp_path, "--registration", "magic"), "magic", "'identity'")


def test_transform_and_identity_at_once(refused, tmp_path, good):
    np.savetxt(tmp_path / "T.txt", np.eye(4))
    options = ["--transform", tmp_path / "T.txt", "--registration", "identity"]
    refused(pair(good, good, tmp_path, *options), "--transform", "--registration", "one of")


def test_a_trajectory_that_cannot_be_read(refused, tmp_path, good):
    refused(pair(good, good, tmp_path, "--trajectory-before", tmp_path / "none.tum"), "none.tum", ";")
    (tmp_path / "odd.tum").write_text("here and there\n")
    refused(pair(good, good, tmp_path, "--trajectory-after", tmp_path / "odd.tum"), "odd.tum", ";")


def test_files_of_another_kind_are_named_without_words_of_python(refused, tmp_path, good):
    (tmp_path / "cloud.laz").write_bytes(bytes(range(128, 256)))
    (tmp_path / "words.txt").write_text("a,b,c\n")
    for option, name, reason in (
        ("--trajectory-before", "cloud.laz", "not a text file"),
        ("--transform", "words.txt", "four rows of four numbers"),
        ("--transform", "a,b,c", "no such file"),
    ):
        said = refused(
            pair(good, good, tmp_path, option, tmp_path / name), f"{name}: ", reason, "give a text file"
        )
        assert "codec" not in said
        assert "convert" not in said


@pytest.fixture(scope="session")
def gda94_change(tmp_path_factory):
    """Return the change directory of a street in GDA94 against the same in GDA2020, and how it ended."""
    from subiaco_bringup.cli import main

    folder = tmp_path_factory.mktemp("gda")
    before = write_street(folder / "gda94.ply", crs="EPSG:28350")
    after = write_street(folder / "gda2020.ply", shift=(0.6, 1.5, 0.0), seed=2)
    options = ["--registration", "identity", "-q", "--set", "leaf=0.5"]
    code = main.run(["change", str(before), str(after), "-o", str(folder / "out"), *options])
    assert code == 0
    return folder / "out"


def test_gda94_is_brought_to_gda2020_and_its_accuracy_recorded(gda94_change):
    registration = json.loads((gda94_change / "registration.json").read_text())
    run = json.loads((gda94_change / "run.json").read_text())
    accuracy = registration["details"]["crs_operation_accuracy_m"]
    assert 0.0 < accuracy <= 0.05  # GDA94 to GDA2020 is stated to a centimetre
    assert run["crs"] == "EPSG:7850"
    (note,) = [text for text in run["warnings"] if "EPSG:28350" in text]
    assert "EPSG:7850" in note
    assert str(accuracy) in note
    assert "GDA94 to GDA2020" in note


def test_foreign_clouds_are_told_that_confidence_was_never_calibrated_for_them(gda94_change):
    run = json.loads((gda94_change / "run.json").read_text())
    assert run["confidence_calibrated"] is False
    assert run["confidence_calibrated_for"]["clouds"] == "simulated"
    assert any("not calibrated for this kind of cloud" in line for line in run["confidence_not_calibrated"])
    assert "not calibrated for this kind of cloud" in (gda94_change / "summary.html").read_text()
    assert "not calibrated for this kind of cloud" in (gda94_change / "report.html").read_text()


def test_heights_of_bare_clouds_are_not_claimed_to_be_ellipsoidal(gda94_change):
    with laspy.open(gda94_change / "after_labelled.laz") as reader:
        text = "".join(vlr.string for vlr in reader.header.vlrs if hasattr(vlr, "string"))
    assert "GDA2020" in text
    assert "llipsoid" not in text.replace("SPHEROID", ""), "no vertical datum is known"
    assert "VERT_CS" not in text


def test_heights_of_our_own_maps_are_stated_as_ellipsoidal(command, tmp_path):
    for epoch, seed in (("before", 1), ("after", 2)):
        write_map(tmp_path / epoch, SurveyMap(PointCloud(street(seed), ORIGIN, "EPSG:7850")))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "run.json").write_text("of an earlier run")
    options = ["--registration", "identity", "--set", "leaf=0.5", "--overwrite"]
    ran = command("change", tmp_path / "before", tmp_path / "after", "-o", tmp_path / "out", *options)
    assert ran.code == 0, ran.err
    assert "of an earlier run" not in (tmp_path / "out" / "run.json").read_text()
    with laspy.open(tmp_path / "out" / "after_labelled.laz") as reader:
        text = "".join(vlr.string for vlr in reader.header.vlrs if hasattr(vlr, "string"))
    assert "VERT_CS" in text
    assert "ellipsoidal height" in text


def test_a_serious_finding_stands_in_command_line_run_report_and_summary(command, tmp_path):
    cloud = write_street(tmp_path / "street.ply")
    (tmp_path / "copy.ply").write_bytes(cloud.read_bytes())
    options = ["--registration", "identity", "-q", "--set", "leaf=0.5"]
    ran = command("change", cloud, tmp_path / "copy.ply", "-o", tmp_path / "out", *options)
    assert ran.code == 0, ran.err
    (found,) = [f for f in json.loads((tmp_path / "out/run.json").read_text())["findings"]
                if f["severity"] == "serious"]  # fmt: skip
    assert found["code"] == "same_survey"
    assert found["sentence"] in ran.err
    assert found["remedy"] in ran.err
    for page in ("report.html", "summary.html"):
        text = html.unescape((tmp_path / "out" / page).read_text())
        (box,) = re.findall(r'<p class="alarm"[^>]*>(.*?)</p>', text, re.DOTALL)
        assert found["sentence"] in box
        assert found["remedy"] in box


def test_every_finding_is_printed_once_with_and_without_a_line_of_the_log(command, tmp_path, caplog):
    cloud = write_street(tmp_path / "street.ply")
    (tmp_path / "copy.ply").write_bytes(cloud.read_bytes())
    bare = write_street(tmp_path / "bare.ply", crs=None, seed=2)
    for name, before in (("same_survey", tmp_path / "copy.ply"), ("crs_missing", bare)):
        out = tmp_path / name
        ran = command("change", before, cloud, "-o", out, "--registration", "identity", "--set", "leaf=0.5")
        assert ran.code == 0, ran.err
        known = {f["code"]: f["sentence"] for f in json.loads((out / "run.json").read_text())["findings"]}
        assert (ran.err + caplog.text).count(known[name]) == 1, ran.err


def test_ahd_against_ellipsoidal_heights_is_refused_before_the_registration(refused, tmp_path, good):
    high = write_street(tmp_path / "ahd.ply", shift=(0.0, 0.0, 32.7), seed=2)
    refused(pair(good, high, tmp_path), "32.7 m lower", "ellipsoid", "AHD", "--transform")


def test_a_zone_label_that_is_wrong_is_refused_with_the_distance(refused, tmp_path, good):
    wrong = write_street(tmp_path / "zone51.ply", crs="EPSG:7851", seed=2)
    refused(pair(wrong, good, tmp_path), "km apart", "EPSG:7851", "coordinates agree as they are")


def test_a_survey_in_gda94_labelled_gda2020_is_named_in_the_result(command, tmp_path, good):
    shifted = write_street(tmp_path / "gda94.ply", shift=(-0.996, -1.495, 0.078), seed=2)
    ran = command("change", shifted, good, "-o", tmp_path / "out", "-q", "--set", "leaf=0.5")
    assert ran.code == 0, ran.err
    codes = {f["code"]: f for f in json.loads((tmp_path / "out/run.json").read_text())["findings"]}
    assert "GDA94 (BEFORE) and GDA2020 (AFTER), 1.80 m" in codes["datum_mismatch"]["sentence"]
    assert "GDA94 (BEFORE)" in ran.err


def test_an_earlier_change_directory_is_replaced_only_when_asked(refused, gda94_change, tmp_path):
    good = write_street(tmp_path / "good.ply")
    refused(["change", good, good, "-o", gda94_change], "out: exists already", "--overwrite")


def test_a_folder_of_other_things_is_not_replaced_even_when_asked(refused, tmp_path, good):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years of work")
    arguments = ["change", good, good, "-o", tmp_path / "home", "--overwrite"]
    refused(arguments, "home: holds other things", "choose another place")


@pytest.mark.parametrize("verb", ["report", "evaluate"])
def test_what_is_no_change_directory(refused, tmp_path, verb):
    (tmp_path / "photos").mkdir()
    more = [tmp_path / "truth"] if verb == "evaluate" else []
    refused([verb, tmp_path / "photos", *more], "missing" if more else "photos", "subiaco")
    refused([verb, tmp_path / "none", *more], "truth" if more else "none", "subiaco")


def test_evaluate_with_a_truth_but_no_change_directory(refused, tmp_path, survey_of_both):
    (tmp_path / "photos").mkdir()
    refused(["evaluate", tmp_path / "photos", survey_of_both], "photos", "expected")
    refused(["evaluate", tmp_path / "none", survey_of_both], "none: no such directory", "give")


def test_evaluate_with_half_a_pair(refused, tmp_path):
    refused(["evaluate", tmp_path / "change"], "CHANGE_DIR and TRUTH in pairs")


def test_a_report_of_a_directory_with_a_damaged_file(refused, tmp_path, gda94_change):
    shutil.copytree(gda94_change, tmp_path / "change")
    (tmp_path / "change" / "run.json").write_text("{ half")
    refused(["report", tmp_path / "change"], "run.json", "subiaco change")
