"""What people are handed: run by the command, added up by lot, reviewed, and run again."""

from __future__ import annotations

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
from scenes import Scene
from shapely.geometry import box

from subiaco_bringup.cli.main import run
from subiaco_change.outputs.directory import read_change_directory
from subiaco_change.outputs.parcels import OUTSIDE
from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import CHANGED

CRS = "EPSG:7850"
ORIGIN = np.array([391_000.0, 6_464_000.0, 20.0])
BEFORE = Scene(houses=[(-15, 12), (5, 12)], trees=[(-20, -8), (-5, -12)], cars=[(-10, 0)], poles=[])
AFTER = Scene(
    houses=[(-15, 12), (5, 12, 10, 8, 8.0)],
    trees=[(-20, -8), (10, -10)],
    cars=[(15, 1)],
    poles=[],
    lift=lambda x, y: 0.3 * np.sign(x) * ((abs(y + 3) < 1.5) & (abs(x) < 18)),
)


def lots() -> gpd.GeoDataFrame:
    """Six lots of 10 m by 40 m; the footpath in the east belongs to none."""
    west = ORIGIN[0] - 30.0
    shapes = [box(west + 10 * i, ORIGIN[1] - 20, west + 10 * i + 10, ORIGIN[1] + 20) for i in range(5)]
    return gpd.GeoDataFrame({"lot_id": list("ABCDE")}, geometry=shapes, crs=CRS)


@pytest.fixture(scope="module")
def words(tmp_path_factory):
    """The words of a command on two clouds and lots; the folder is the last of them."""
    folder = tmp_path_factory.mktemp("hand_over")
    for name, scene, seed in (("before", BEFORE, 1), ("after", AFTER, 2)):
        cloud = scene.survey(seed).cloud
        write_cloud(folder / f"{name}.ply", PointCloud(cloud.xyz, ORIGIN, CRS))
    lots().to_file(folder / "lots.gpkg", driver="GPKG", engine="pyogrio")
    epochs = [str(folder / "before.ply"), str(folder / "after.ply")]
    given = ["--registration", "identity", "--parcels", str(folder / "lots.gpkg"), "-q"]
    return ["change", *epochs, *given, "-o", str(folder / "out")], folder / "out"


@pytest.fixture(scope="module")
def handed_over(words):
    """The change directory of the first run."""
    command, out = words
    assert run(command) == 0
    return out


def test_lots_add_up_to_the_objects_of_the_run(handed_over):
    table = read_change_directory(handed_over).table
    changed = table[table["label"].isin([c.label for c in CHANGED])]
    assert set(changed["label"]) == {c.label for c in CHANGED}
    for rows in (
        pd.read_csv(handed_over / "parcels.csv"),
        gpd.read_file(handed_over / "changes.gpkg", layer="parcels"),
    ):
        assert rows["lot"].tolist() == [*"ABCDE", OUTSIDE]
        for label in table["label"].unique():
            if label.lower() in rows:
                assert rows[label.lower()].sum() == (table["label"] == label).sum()
        assert rows["net_m3"].sum() == pytest.approx(changed["delta_v_m3"].sum(), abs=0.01)
        assert rows["changed_m2"].sum() == pytest.approx(changed.geometry.area.sum(), abs=0.01)
        assert rows["changed_m2"].iloc[-1] < rows["changed_m2"].sum() / 2


def test_reviews_typed_into_the_table_survive_a_run_with_other_parameters(handed_over, words):
    table = pd.read_csv(handed_over / "changes.csv", dtype=str, keep_default_na=False)
    changed = table["label"].isin([c.label for c in CHANGED])
    said = {uid: f"seen {uid}" for uid in table.loc[changed, "object_uid"]}
    table.loc[changed, "review"] = "confirmed"
    table.loc[changed, "note"] = [said[uid] for uid in table.loc[changed, "object_uid"]]
    table.to_csv(handed_over / "changes.csv", index=False)
    command, out = words
    other = ["--set", "decisions.lod_floor=0.15", "--set", "ground.threshold=0.2"]
    assert run([*command, *other, "--set", "instances.vegetation_gap=1.0", "--overwrite"]) == 0
    again = pd.read_csv(out / "changes.csv", dtype=str, keep_default_na=False).set_index("object_uid")
    lost = out / "reviews_without_object.csv"
    gone = pd.read_csv(lost)["object_uid"].tolist() if lost.is_file() else []
    kept = again.loc[[uid for uid in said if uid not in gone]]
    assert len(kept) >= len(said) - 1
    assert kept["note"].tolist() == [said[uid] for uid in kept.index]
    assert set(kept["review"]) == {"confirmed"}
    assert not again.drop(index=kept.index)["review"].any()


def test_the_report_is_built_again_and_a_project_that_is_missing_too(handed_over):
    project, page = handed_over / "changes.qgs", handed_over / "report.html"
    project.write_text("with a layer of my own")
    page.unlink()
    assert run(["report", str(handed_over), "-q"]) == 0
    assert page.is_file()
    assert project.read_text() == "with a layer of my own"
    project.unlink()
    assert run(["report", str(handed_over), "-q"]) == 0
    assert "layername=objects" in project.read_text()
