"""What people accepted or rejected reaches every output, and the next run."""

import json
import shutil
import sqlite3

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
from result_scene import SceneConfig
from shapely.geometry import box

from subiaco_bringup.cli.main import run
from subiaco_change.outputs import directory as outputs
from subiaco_change.outputs.change_directory_reading import read_change_directory
from subiaco_change.outputs.directory import take_up_reviews
from subiaco_change.outputs.exports import export_changes
from subiaco_change.outputs.parcels import OUTSIDE
from subiaco_change.outputs.reviews import read_review_file, review_counts, review_states, selected_by_review
from subiaco_change.outputs.table import TEXT_COLUMNS, read_csv
from subiaco_geo.cloud_io import read_cloud
from subiaco_geo.codes import Change
from subiaco_geo.errors import InputError
from subiaco_report.facts import summary


@pytest.fixture(scope="module")
def with_lots(tmp_path_factory, result):
    """A change directory with one lot around object 2 (a house that was removed), which has an owner."""
    target = tmp_path_factory.mktemp("reviewed") / "out"
    house = next(r for r in result.records if r.object_id == 2)
    frame = gpd.GeoDataFrame(
        {"lot": ["12"], "owner": ["Ng"], "valued": [7]},
        geometry=[house.footprint.buffer(3.0, join_style="mitre")],
        crs="EPSG:7850",
    )
    outputs.write_change_directory(target, result, SceneConfig(), outputs.ChangeInputs(lots=frame))
    return target


@pytest.fixture
def directory(with_lots, tmp_path):
    target = tmp_path / "changes"
    shutil.copytree(with_lots, target)
    return target


def uid(directory, number):
    table = pd.read_csv(directory / "changes.csv").set_index("object_id")
    return table.loc[number, "object_uid"]


def save_reviews(path, rows, separator=","):
    lines = [separator.join(("object_uid", "review", "reviewer", "note"))]
    path.write_text("\n".join([*lines, *(separator.join(row) for row in rows)]) + "\n", encoding="utf-8")
    return path


def test_words_of_a_review_are_a_yes_a_no_or_a_remark():
    table = pd.DataFrame(
        {"label": "Added", "review": ["Accepted", " ok ", "REJECTED", "no", "ask Jo", "", None]}
    )
    states = review_states(table).tolist()
    assert states == ["accepted", "accepted", "rejected", "rejected", "other", "", ""]
    counts = {"changed": 7, "reviewed": 5, "accepted": 2, "rejected": 2, "other": 1}
    assert review_counts(table) == counts
    assert selected_by_review(table, "accepted").sum() == 2
    assert selected_by_review(table, "not-rejected").sum() == 5
    with pytest.raises(InputError, match="give all, accepted, not-rejected"):
        selected_by_review(table, "some")


@pytest.mark.parametrize("separator", [",", ";"])
def test_a_review_file_is_read_with_commas_and_with_semicolons(tmp_path, separator):
    path = save_reviews(tmp_path / "r.csv", [("aa", "accepted", "Jo", "seen")], separator)
    assert read_review_file(path).loc["aa"].tolist() == ["accepted", "Jo", "seen"]


def test_a_file_that_is_no_review_is_refused_by_its_column(tmp_path):
    (tmp_path / "r.csv").write_text("id,review\n1,ok\n")
    with pytest.raises(InputError, match="column object_uid is missing"):
        read_review_file(tmp_path / "r.csv")
    with pytest.raises(InputError, match="no reviews could be read"):
        read_review_file(tmp_path / "none.csv")


def test_a_rejected_row_leaves_every_count_and_is_kept_in_the_table(directory):
    rows = [(uid(directory, 2), "rejected", "Jo", "still there"), (uid(directory, 4), "accepted", "Jo", "")]
    path = save_reviews(directory.parent / "reviews.csv", rows)
    before = gpd.read_file(directory / "changes.gpkg", layer="parcels").set_index("lot")
    assert before.loc["12", "removed"] == 1
    table, unknown = take_up_reviews(directory, [path])
    assert unknown == []
    assert review_counts(table) | {"other": 0} == {
        "changed": 6, "reviewed": 2, "accepted": 1, "rejected": 1, "other": 0,
    }  # fmt: skip
    csv = pd.read_csv(directory / "changes.csv", keep_default_na=False).set_index("object_id")
    parquet = gpd.read_parquet(directory / "changes.parquet").set_index("object_id")
    package = gpd.read_file(directory / "changes.gpkg", layer="objects").set_index("object_id")
    for read in (csv, parquet, package, read_change_directory(directory).table.set_index("object_id")):
        assert read.loc[2, ["review", "reviewer", "note"]].tolist() == ["rejected", "Jo", "still there"]
        assert read.loc[4, "review"] == "accepted"
        assert read.loc[2, "label"] == "Removed"
    lots = gpd.read_file(directory / "changes.gpkg", layer="parcels").set_index("lot")
    assert lots.loc["12", ["removed", "rejected"]].tolist() == [0, 1]
    assert lots.loc["12", "net_m3"] == 0.0
    assert lots.loc["12", ["owner", "valued"]].tolist() == ["Ng", 7]
    assert lots.loc[OUTSIDE, "added"] == before.loc[OUTSIDE, "added"]
    assert pd.read_csv(directory / "parcels.csv").set_index("lot").loc["12", "rejected"] == 1
    with sqlite3.connect(directory / "changes.gpkg") as connection:
        styled = connection.execute("select f_table_name from layer_styles").fetchall()
    assert sorted(name for (name,) in styled) == ["coverage", "ground", "objects", "parcels"]
    assert summary(table)[-1]["total"] == len(table) - 1


def test_the_pages_strike_rejected_rows_through_and_say_how_many_were_reviewed(directory, capsys):
    save_reviews(directory / "reviews.csv", [(uid(directory, 2), "rejected", "Jo", "")])
    assert run(["review", str(directory), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rejected"] == 1
    text = (directory / "summary.html").read_text(encoding="utf-8")
    assert "1 of 6 claimed changes were reviewed by a person: 0 accepted, 1 rejected" in text
    assert "object 2<" not in text
    report = (directory / "report.html").read_text(encoding="utf-8")
    assert "1 changes were rejected by a reviewer" in report
    assert not (directory / "reviews.csv").exists()
    assert (directory / "reviews_applied.csv").is_file()


def test_an_edit_in_qgis_after_a_review_holds_and_may_take_it_back(directory):
    take_up_reviews(
        directory, [save_reviews(directory.parent / "a.csv", [(uid(directory, 2), "rejected", "Jo", "x")])]
    )
    layer = gpd.read_file(directory / "changes.gpkg", layer="objects")
    layer.loc[layer["object_id"] == 2, ["review", "note"]] = ["accepted", ""]
    layer.to_file(directory / "changes.gpkg", layer="objects", driver="GPKG")
    row = read_change_directory(directory).table.set_index("object_id").loc[2]
    assert row[["review", "reviewer", "note"]].tolist() == ["accepted", "Jo", ""]


def test_the_next_run_reads_the_file_that_the_report_saved(directory, result):
    save_reviews(directory / "reviews.csv", [(uid(directory, 5), "accepted", "Jo", "")])
    outputs.write_change_directory(directory, result, SceneConfig(), outputs.ChangeInputs(), overwrite=True)
    table = read_change_directory(directory).table.set_index("object_id")
    assert table.loc[5, ["review", "reviewer"]].tolist() == ["accepted", "Jo"]
    assert not (directory / "reviews.csv").exists()


def test_reviews_of_objects_that_are_not_there_are_named(directory, capsys):
    path = save_reviews(directory.parent / "b.csv", [("nobody", "accepted", "", "")])
    assert run(["review", str(directory), str(path)]) == 0
    assert "1 reviews have no object in this table, first nobody" in capsys.readouterr().err


def test_exports_can_hold_what_was_accepted_alone(directory, tmp_path):
    rows = [(uid(directory, 2), "rejected", "", ""), (uid(directory, 4), "accepted", "", "")]
    take_up_reviews(directory, [save_reviews(tmp_path / "c.csv", rows)])
    (file,) = export_changes(directory, tmp_path / "accepted", "geojson", review="accepted")
    assert gpd.read_file(file)["object_id"].tolist() == [4]
    (file,) = export_changes(directory, tmp_path / "rest", "gpkg", review="not-rejected")
    objects = gpd.read_file(file, layer="objects")
    assert 2 not in set(objects["object_id"])
    assert len(objects) == 8
    for which, codes in (("accepted", {4: Change.ADDED, 6: 254}), ("not-rejected", {4: 0, 6: 0, 2: 254})):
        export_changes(directory, tmp_path / f"ply_{which}", "ply", review=which)
        clouds = [read_cloud(tmp_path / f"ply_{which}" / f"{e}_labelled.ply") for e in ("before", "after")]
        instance, change = (np.concatenate([c.fields[n] for c in clouds]) for n in ("instance", "change"))
        for number, code in codes.items():
            assert set(change[instance == number].tolist()) == {int(code)}


def test_a_map_has_no_reviews_to_choose_by(tmp_path, capsys):
    (tmp_path / "map.yaml").write_text("crs: EPSG:7850\n")
    assert (
        run(["export", str(tmp_path), "--to", "laz", "--review", "accepted", "-o", str(tmp_path / "o")]) == 2
    )
    assert "is a map, which has no reviews" in capsys.readouterr().err


def test_a_box_of_lots_keeps_the_attributes_of_its_file(tmp_path):
    from subiaco_change.outputs.parcels import read_lots

    frame = gpd.GeoDataFrame(
        {"lot_id": ["a"], "Removed": [3], "zone": ["R20"]},
        geometry=[box(391_000, 6_464_000, 391_010, 6_464_010)],
        crs="EPSG:7850",
    )
    frame.to_file(tmp_path / "lots.gpkg")
    lots = read_lots(tmp_path / "lots.gpkg", "EPSG:7850")
    assert list(lots.columns) == ["lot", "lot_id", "Removed_lot", "zone", "geometry"]


def test_a_table_saved_by_a_spreadsheet_with_semicolons_and_decimal_commas_is_read(
    change_directory, tmp_path
):
    plain = read_csv(change_directory / "changes.csv")
    typed = pd.read_csv(change_directory / "changes.csv", dtype=str, keep_default_na=False)
    numbers = [name for name in typed.columns if name not in TEXT_COLUMNS]
    typed[numbers] = typed[numbers].map(lambda text: text.replace(".", ","))
    typed.to_csv(tmp_path / "changes.csv", sep=";", index=False, encoding="utf-8-sig")
    pd.testing.assert_frame_equal(read_csv(tmp_path / "changes.csv"), plain)
