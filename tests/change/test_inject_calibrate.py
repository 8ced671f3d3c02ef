"""The command that calibrates on a map of one's own, run whole on a small street."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
import yaml
from scenes import Scene

from subiaco_bringup.cli.main import run
from subiaco_change.config import ChangeConfig
from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.config import load_config
from subiaco_geo.trajectories import Trajectory, write_tum

ORIGIN = np.array([391_000.0, 6_464_000.0, 20.0])
STREET = Scene(houses=[(10, 11)], trees=[(-14, -9), (-4, -11), (14, -9)], cars=[(-10, 3), (6, -4)], poles=[])


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """A cloud and the way of the drive along its middle."""
    folder = tmp_path_factory.mktemp("street")
    xyz = STREET.survey(3).cloud.xyz
    xyz = xyz[(np.abs(xyz[:, 0]) < 20) & (np.abs(xyz[:, 1]) < 16)]
    write_cloud(folder / "street.ply", PointCloud(xyz, ORIGIN, "EPSG:7850"))
    x = np.arange(-18.0, 18.0, 1.0)
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, :3, 3] = np.column_stack([x, np.zeros(len(x)), 0.03 * x + 2.0]) + ORIGIN
    write_tum(folder / "way.tum", Trajectory(np.arange(len(x), dtype=np.int64) * 10**8 + 10**18, poses))
    return folder


def test_a_map_and_its_way_give_a_statement_and_confidences_that_change_detection_takes(street):
    out = street / "calibration"
    words = ["calibrate", str(street / "street.ply"), "--trajectory", str(street / "way.tum"), "-q"]
    words += ["-o", str(out), "--copies", "2", "--registration", "identity", "--set", "fresh=0"]
    for name, count in {"inserted": 4, "removed": 2, "moved": 0, "grown": 2, "cut": 1, "patches": 3}.items():
        words += ["--set", f"injection.{name}={count}"]
    assert run([*words, "--set", "injection.min_points=60"]) == 0
    document = json.loads((out / "calibration.json").read_text())
    assert document["copies"] == 2
    assert document["injected_changes"] == len(pd.read_csv(out / "changes.csv")) > 10
    assert document["found"] > 0.6 * document["injected_changes"]
    assert document["second_pass"]["measured"] is False
    table = pd.read_csv(out / "detectable.csv")
    assert {"vegetation", "mobile", "ground"} <= set(table["class"])
    assert table["found"].sum() == 3 * document["found"]  # three levels of detection a class and kind
    fitted = load_config(ChangeConfig, (out / "confidence.yaml",), []).confidence
    assert "2 injected copies of street.ply" in fitted.fitted_on
    assert (out / "config.yaml").is_file()
    assert run(words) == 2, "it exists"


def test_a_cloud_without_its_way_is_refused_with_the_remedy(street, capsys):
    assert run(["calibrate", str(street / "street.ply"), "-o", str(street / "none"), "-q"]) == 2
    assert "give --trajectory" in capsys.readouterr().err
    assert not (street / "none").exists()


def test_an_injected_copy_is_a_map_beside_its_truth_and_says_what_was_done(street, capsys):
    out = street / "copy"
    words = ["inject", str(street / "street.ply"), "--trajectory", str(street / "way.tum"), "-o", str(out)]
    assert run([*words, "--seed", "5", "--set", "inserted=3", "--set", "min_points=60"]) == 0
    assert "changes" in capsys.readouterr().err
    rows = pd.read_csv(out / "truth" / "objects.csv")
    assert len(rows) >= 3
    assert (out / "map.yaml").is_file()
    settings = yaml.safe_load((out / "truth" / "scene.yaml").read_text())
    assert settings["config"]["inserted"] == 3
    assert settings["seed"] == 5
    for epoch in ("before", "after"):
        points = np.load(out / epoch / "truth" / "points.npz")
        assert set(np.unique(points["object"])) - {0} <= set(rows["object_id"])
