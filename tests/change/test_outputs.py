"""The change directory is read back with the libraries that others use."""

import csv
import dataclasses
import hashlib
import json
import sqlite3
import xml.etree.ElementTree as ET

import geopandas as gpd
import laspy
import numpy as np
import pandas as pd
import pytest
import rasterio
import yaml
from result_scene import OBJECTS, ORIGIN, SceneConfig, ground_raster

from subiaco_change.outputs import directory as outputs
from subiaco_change.outputs import table as outputs_table
from subiaco_change.outputs.clouds import POINT_FIELDS, labelled_cloud
from subiaco_change.outputs.geopackage import layer_qml
from subiaco_change.outputs.rasters import build_coverage, build_lod_raster, write_lod
from subiaco_change.outputs.table import (
    ALL_COLUMNS,
    COLUMNS,
    build_table,
    object_uids,
    read_csv,
    table_hash,
    write_csv,
)
from subiaco_change.records import CHANGE_COLOURS
from subiaco_geo.cloud_io import read_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import ASPRS_CODES, Change, Semantic
from subiaco_geo.errors import InputError

CONTRACT = """
object_id class label id_before id_after match_kind delta_h_m delta_v_m3 delta_v_surface_m3 delta_c_m iou_3d
d_perp_m lod95_m observed_fraction evidence score_paper confidence n_before n_after x y z
delta_h_low_m delta_h_high_m delta_v_low_m3 delta_v_high_m3 height_before_m height_after_m area_m2 date_before
date_after
""".split()  # noqa: SIM905


def check_rows(frame, records):
    rows = frame.set_index("object_id").sort_index()
    assert list(rows.index) == sorted(r.object_id for r in records)
    for record in records:
        row = rows.loc[record.object_id]
        assert row["label"] == record.change.label
        assert row["class"] == record.semantic.label
        assert row["id_before"] == ";".join(map(str, record.id_before))
        assert row["reason"] == record.reason
        for name in ("delta_h_m", "delta_v_m3", "iou_3d", "lod95_m", "score_paper", "confidence", "x", "z"):
            value = getattr(record, name)
            if np.isfinite(value):
                assert row[name] == pytest.approx(value, abs=1e-3)
            else:
                assert pd.isna(row[name])


def test_csv_has_the_columns_of_the_contract_in_its_order_and_equals_the_records(change_directory, result):
    text = pd.read_csv(change_directory / "changes.csv", dtype=str, keep_default_na=False)
    assert list(text.columns) == list(ALL_COLUMNS)
    assert list(text.columns[: len(CONTRACT)]) == CONTRACT == list(COLUMNS)
    assert text.set_index("object_id").loc["1", "id_before"] == "1;101"
    assert text.set_index("object_id").loc["2", "delta_h_m"] == ""
    check_rows(outputs.read_change_directory(change_directory).table, result.records)


def test_geopackage_layers_hold_objects_and_ground_with_crs_and_footprints(change_directory, result):
    layers = {n: gpd.read_file(change_directory / "changes.gpkg", layer=n) for n in ("objects", "ground")}
    assert layers["ground"]["object_id"].tolist() == [10]
    assert all(layer.crs.to_epsg() == 7850 for layer in layers.values())
    together = pd.concat(layers.values()).fillna({"id_before": "", "reason": ""})
    check_rows(together, result.records)
    house = layers["objects"].set_index("object_id").loc[1]
    assert house.geometry.area == pytest.approx(12.0 * 9.0)
    assert house.geometry.bounds[:2] == pytest.approx((391_210.0, 6_464_545.0))


def test_geoparquet_equals_the_records(change_directory, result):
    table = gpd.read_parquet(change_directory / "changes.parquet")
    assert table.crs.to_epsg() == 7850
    assert list(table.columns[:-1]) == list(ALL_COLUMNS)
    check_rows(table, result.records)


def test_geopackage_carries_a_default_style_with_the_colour_of_every_label(change_directory):
    with sqlite3.connect(change_directory / "changes.gpkg") as connection:
        rows = connection.execute("select f_table_name, styleQML, useAsDefault from layer_styles").fetchall()
    assert sorted(row[0] for row in rows) == ["coverage", "ground", "objects"]
    assert all(row[2] for row in rows)
    (objects,) = (row[1] for row in rows if row[0] == "objects")
    for change in Change:
        assert f'value="{change.label}"' in objects
        assert ",".join(map(str, CHANGE_COLOURS[change])) in objects


@pytest.mark.parametrize(
    ("layer", "entry", "count"),
    [("objects", "category", len(Change) + 1), ("coverage", "category", 4), ("parcels", "range", 5)],
)
def test_a_style_is_well_formed_and_every_entry_has_its_symbol(layer, entry, count):
    root = ET.fromstring(layer_qml(layer).split("\n", 1)[1])
    used = [e.get("symbol") for e in root.findall(f".//{entry}")]
    assert used == [s.get("name") for s in root.findall(".//symbol")]
    assert len(used) == count


@pytest.mark.parametrize("epoch", ["before", "after"])
def test_ply_keeps_points_fields_and_colours(change_directory, result, epoch):
    cloud = read_cloud(change_directory / f"{epoch}_labelled.ply")
    source = getattr(result, epoch)
    np.testing.assert_allclose(cloud.world(), source.world(), atol=1e-6)
    for name, kind in POINT_FIELDS.items():
        assert cloud.fields[name].dtype == kind
        np.testing.assert_array_equal(cloud.fields[name], source.fields[name])
    red = [CHANGE_COLOURS[Change(code)][0] for code in source.fields["change"]]
    np.testing.assert_array_equal(cloud.fields["red"], red)
    assert cloud.crs is not None
    assert "7850" in cloud.crs


@pytest.mark.parametrize("epoch", ["before", "after"])
def test_laz_holds_asprs_codes_and_ours_as_extra_bytes(change_directory, result, epoch):
    las = laspy.read(change_directory / f"{epoch}_labelled.laz")
    source = getattr(result, epoch)
    assert las.header.point_format.id == 7
    assert las.header.parse_crs() is not None
    codes = [ASPRS_CODES[Semantic(code)] for code in source.fields["semantic"]]
    np.testing.assert_array_equal(np.asarray(las.classification), codes)
    assert set(POINT_FIELDS) <= set(las.point_format.extra_dimension_names)
    np.testing.assert_array_equal(np.asarray(las["change"]), source.fields["change"])
    np.testing.assert_array_equal(np.asarray(las["instance"]), source.fields["instance"])
    np.testing.assert_allclose(np.asarray(las.xyz), source.world(), atol=1e-3)


def test_ground_raster_puts_the_changed_patch_where_it_is(change_directory):
    with rasterio.open(change_directory / "ground_change.tif") as dataset:
        assert dataset.crs.to_epsg() == 7850
        assert dataset.descriptions == ("dz", "confidence")
        inside = (ORIGIN[0] + 77.0, ORIGIN[1] + 15.0)
        outside = (ORIGIN[0] + 77.0, ORIGIN[1] + 17.0)
        assert [v[0] for v in dataset.sample([inside, outside], indexes=1)] == [0.25, 0.0]
        assert dataset.index(*inside) == (27, 38)
        np.testing.assert_array_equal(dataset.read(1), ground_raster().dz)


def test_coverage_says_who_saw_each_cell():
    def cloud(x, change):
        fields = {"change": np.array(change, np.uint8), "lod95": np.array([0.04] * len(x), np.float32)}
        xyz = np.column_stack([x, np.ones(len(x)), np.zeros(len(x))])
        return PointCloud(xyz, fields=fields)

    coverage = build_coverage(cloud([1.0, 3.0], [4, 255]), cloud([1.0, 5.0, 9.0], [0, 255, 4]))
    assert coverage.code.tolist() == [[1, 2, 3, 0, 1]]
    assert coverage.area(2) == 4.0
    assert np.isnan(coverage.lod95[0, 3])
    assert coverage.lod95[0, 0] == np.float32(0.04)


def test_registration_json_holds_the_world_transform_and_no_nan(change_directory, result):
    document = json.loads((change_directory / "registration.json").read_text())
    np.testing.assert_allclose(document["T_after_before"], result.registration.T_after_before)
    assert document["rmse_m"] == 0.021
    assert document["crs"] == "EPSG:7850"


def test_run_json_names_versions_and_inputs_and_the_table_hash(tmp_path, result):
    source = tmp_path / "before.ply"
    source.write_bytes(b"points")
    target = tmp_path / "out"
    outputs.write_change_directory(target, result, SceneConfig(), outputs.ChangeInputs(before=source))
    run = json.loads((target / "run.json").read_text())
    assert run["inputs"]["before"]["sha256"] == hashlib.sha256(b"points").hexdigest()
    assert run["inputs"]["after"] is None
    assert run["table_hash"] == table_hash(build_table(result.records, "EPSG:7850"))
    assert run["seconds"] == {"register": 1.5, "decide": 0.25}
    assert run["peak_memory_mib"] > 10
    assert run["versions"]["numpy"] == np.__version__
    assert yaml.safe_load((target / "config.yaml").read_text())["/**"]["ros__parameters"]["leaf"] == 0.25


def test_table_hash_sees_a_label_but_neither_order_nor_review(result):
    table = build_table(result.records, None)
    assert table_hash(build_table(result.records[::-1], None)) == table_hash(table)
    assert table_hash(table.assign(note="seen")) == table_hash(table)
    other = dataclasses.replace(result.records[0], change=Change.UNCHANGED)
    assert table_hash(build_table((other, *result.records[1:]), None)) != table_hash(table)


def test_uids_do_not_depend_on_ids_and_differ_between_neighbours(result):
    renumbered = [dataclasses.replace(r, object_id=r.object_id + 50) for r in result.records]
    assert object_uids(renumbered) == object_uids(result.records)
    assert len(set(object_uids([*result.records, *result.records]))) == 2 * len(result.records)


def test_nothing_is_left_under_the_final_name_when_writing_fails(tmp_path, result, monkeypatch):
    def fail(*_):
        raise RuntimeError("disk full")

    monkeypatch.setattr(outputs, "write_coverage", fail)
    with pytest.raises(RuntimeError, match="disk full"):
        outputs.write_change_directory(tmp_path / "out", result, SceneConfig(), outputs.ChangeInputs())
    assert list(tmp_path.iterdir()) == []


def test_an_existing_directory_is_refused_and_kept(change_directory, result):
    with pytest.raises(InputError, match="--overwrite"):
        outputs.write_change_directory(change_directory, result, SceneConfig(), outputs.ChangeInputs())
    assert (change_directory / "run.json").is_file()


def test_reviews_survive_a_rerun_and_changed_evidence_is_flagged(tmp_path, result):
    target = tmp_path / "out"
    outputs.write_change_directory(target, result, SceneConfig(), outputs.ChangeInputs())
    frame = pd.read_csv(target / "changes.csv", dtype=str, keep_default_na=False).set_index("object_id")
    frame.loc["2", ["review", "reviewer"]] = ["confirmed", "Jo"]
    frame.reset_index()[list(ALL_COLUMNS)].to_csv(target / "changes.csv", index=False)
    layer = gpd.read_file(target / "changes.gpkg", layer="objects")
    layer.loc[layer["object_id"] == 4, ["review", "note"]] = ["rejected", "a fence"]
    layer.to_file(target / "changes.gpkg", layer="objects", driver="GPKG")
    records = [
        dataclasses.replace(r, change=Change.UNCHANGED) if r.object_id == 4 else r for r in result.records
    ]
    again = dataclasses.replace(result, records=tuple(records))
    outputs.write_change_directory(target, again, SceneConfig(), outputs.ChangeInputs(), overwrite=True)
    rows = outputs.read_change_directory(target).table.set_index("object_id")
    assert rows.loc[2, ["review", "reviewer", "evidence_changed"]].tolist() == ["confirmed", "Jo", ""]
    assert rows.loc[4, ["review", "note"]].tolist() == ["rejected", "a fence"]
    assert rows.loc[4, "evidence_changed"] == "label was Added"
    assert rows.loc[1, "review"] == ""


def test_a_note_that_looks_like_a_formula_is_no_formula_in_the_csv_and_comes_back(tmp_path, result):
    table = build_table(result.records, "EPSG:7850")
    note = '=HYPERLINK("http://example.org")'
    table.loc[0, "note"] = note
    write_csv(tmp_path / "changes.csv", table)
    cells = [row["note"] for row in csv.DictReader((tmp_path / "changes.csv").open(newline=""))]
    assert cells[0] == f"'{note}"
    assert read_csv(tmp_path / "changes.csv").loc[0, "note"] == note


def test_a_review_survives_other_parameters_that_move_the_object_and_its_label(tmp_path, result):
    target = tmp_path / "out"
    outputs.write_change_directory(target, result, SceneConfig(), outputs.ChangeInputs())
    frame = pd.read_csv(target / "changes.csv", dtype=str, keep_default_na=False).set_index("object_id")
    frame.loc["1", "review"], frame.loc["2", "review"] = "confirmed", "rejected"
    uid = frame.loc["1", "object_uid"]
    frame.reset_index()[list(ALL_COLUMNS)].to_csv(target / "changes.csv", index=False)
    moved = dataclasses.replace(
        next(r for r in result.records if r.object_id == 1), object_id=77, x=result.records[0].x + 1.4
    )
    again = dataclasses.replace(result, records=(moved,))
    outputs.write_change_directory(target, again, SceneConfig(), outputs.ChangeInputs(), overwrite=True)
    rows = outputs.read_change_directory(target).table.set_index("object_id")
    assert rows.loc[77, ["object_uid", "review"]].tolist() == [uid, "confirmed"]
    lost = pd.read_csv(target / "reviews_without_object.csv")
    assert lost[["object_id", "review"]].to_numpy().tolist() == [[2, "rejected"]]


def test_missing_and_foreign_directories_are_refused_with_the_remedy(tmp_path):
    with pytest.raises(InputError, match="no such directory"):
        outputs.read_change_directory(tmp_path / "nowhere")
    (tmp_path / "map.ply").write_text("ply")
    with pytest.raises(InputError, match=r"changes\.csv is missing.*subiaco change"):
        outputs.read_change_directory(tmp_path)


def test_a_directory_without_a_cloud_is_refused(tmp_path, result):
    target = tmp_path / "out"
    outputs.write_change_directory(target, result, SceneConfig(), outputs.ChangeInputs())
    (target / "after_labelled.ply").unlink()
    assert len(outputs.read_change_directory(target).after) == len(result.after)  # the LAZ serves
    (target / "after_labelled.laz").unlink()
    with pytest.raises(InputError, match="after_labelled"):
        outputs.read_change_directory(target)


def test_clouds_without_a_field_or_with_a_strange_code_are_refused(result):
    fields = dict(result.after.fields)
    with pytest.raises(InputError, match="code 7"):
        labelled_cloud(result.after.with_fields(change=np.full(len(result.after), 7, np.uint8)))
    fields.pop("lod95")
    with pytest.raises(InputError, match="lod95 is missing"):
        labelled_cloud(dataclasses.replace(result.after, fields=fields))


def test_a_result_without_crs_ground_or_records_is_written(tmp_path, result):
    bare = dataclasses.replace(
        result,
        records=(),
        ground=None,
        before=dataclasses.replace(result.before, crs=None),
        after=dataclasses.replace(result.after, crs=None),
    )
    outputs.write_change_directory(tmp_path / "out", bare, SceneConfig(), outputs.ChangeInputs())
    back = outputs.read_change_directory(tmp_path / "out")
    assert len(back.table) == 0
    assert back.table.crs is None
    assert not (tmp_path / "out" / "ground_change.tif").exists()


def test_duplicate_object_ids_are_refused(result):
    with pytest.raises(InputError, match="not unique"):
        build_table([result.records[0], result.records[0]], None)


def test_every_label_is_in_the_scene():
    assert {spec[2] for spec in OBJECTS} == set(Change)


def test_the_lod_raster_holds_medians_of_both_epochs_north_up_and_says_where_nothing_is_claimed(tmp_path):
    rng = np.random.default_rng(3)
    xyz = np.column_stack([rng.uniform(0, 20, (4000, 2)), np.zeros(4000)])
    lod = np.where(xyz[:, 0] < 10, 0.02, np.inf).astype(np.float32)
    lod[(xyz[:, 1] > 15) & (xyz[:, 0] < 5)] = 0.08
    clouds = [
        PointCloud(xyz[part], np.array([391_000.0, 6_464_000.0, 0.0]), "EPSG:7850", {"lod95": lod[part]})
        for part in (slice(0, None, 2), slice(1, None, 2))
    ]
    write_lod(tmp_path / "lod95.tif", build_lod_raster(*clouds), "EPSG:7850")
    with rasterio.open(tmp_path / "lod95.tif") as dataset:
        assert dataset.descriptions == ("lod95", "claimed")
        assert dataset.res == (5.0, 5.0)
        assert dataset.bounds[:] == (391_000.0, 6_464_000.0, 391_020.0, 6_464_020.0)
        lod95, claimed = dataset.read()
    assert lod95[0, 0] == pytest.approx(0.08)
    assert np.allclose(lod95[1:, :2], 0.02)
    assert np.isnan(lod95[:, 2:]).all()
    assert np.array_equal(claimed, np.tile([1.0, 1.0, 0.0, 0.0], (4, 1)))


def test_registration_is_reported_block_by_block(tmp_path, result):
    blocks = pd.DataFrame({"east": [391_010.0], "north": [6_464_010.0], "sigma_standing_m": [0.0123]})
    outputs.write_change_directory(
        tmp_path / "out",
        dataclasses.replace(result, blocks=blocks),
        SceneConfig(),
        outputs.ChangeInputs(),
    )
    assert (tmp_path / "out" / "lod95.tif").is_file()
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "out" / "registration_blocks.csv"), blocks)


def test_heights_areas_and_days_stand_in_the_table(result):
    table = build_table(result.records, "EPSG:7850", ("2023-03-01", "2025-04-02"))
    assert set(table["date_before"]) == {"2023-03-01"}
    assert set(table["date_after"]) == {"2025-04-02"}
    assert table["area_m2"].to_numpy() == pytest.approx([r.footprint.area for r in result.records], abs=1e-3)


def test_a_table_of_version_one_is_read_with_the_later_columns_missing(change_directory, tmp_path):
    old = pd.read_csv(change_directory / "changes.csv", dtype=str, keep_default_na=False)
    later = list(COLUMNS[COLUMNS.index("delta_h_low_m") :])
    old.drop(columns=later).to_csv(tmp_path / "changes.csv", index=False)
    read = outputs_table.read_csv(tmp_path / "changes.csv")
    assert read["area_m2"].isna().all()
    assert (read["date_before"] == "").all()
