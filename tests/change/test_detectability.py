"""The smallest change that is found: known curves come back, and hold on fresh changes."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import rasterio
from scipy.special import expit

from subiaco_change.decisions.confidence_config import FEATURES, ConfidenceConfig
from subiaco_change.outputs.rasters import LodRaster
from subiaco_evaluation.confidence_fit import LEAST, fit_confidence, held_out_errors
from subiaco_evaluation.injection.calibrate import MapCalibration, MapCalibrationConfig, write_calibration
from subiaco_evaluation.injection.detectability import COLUMNS, Curve, fit_curve, fit_curves, statement

TRUE = Curve(a=3.0, b=5.0, c=-2.0, tested=(0.05, 1.0), count=0, found=0)


def changes(count: int, seed: int, class_name: str = "ground") -> pd.DataFrame:
    """Changes of sizes and levels of detection at random, found with the probability of the true curve."""
    rng = np.random.default_rng(seed)
    size, lod = rng.uniform(0.05, 1.0, count), rng.uniform(0.05, 0.2, count)
    found = rng.random(count) < TRUE.probability(size, lod)
    rows = [(seed, i, class_name, "shift", "raised", size[i], lod[i], 50, found[i]) for i in range(count)]
    return pd.DataFrame(rows, columns=list(COLUMNS))


def test_a_known_curve_comes_back_and_holds_on_fresh_changes():
    fitted = fit_curve(changes(1500, seed=1))
    assert fitted is not None
    for lod in (0.06, 0.15):
        assert fitted.smallest(lod) == pytest.approx(TRUE.smallest(lod), rel=0.12)
    tried = statement(changes(4000, seed=2), {("ground", "shift"): fitted})
    assert tried["class"].tolist() == ["ground", "all"]
    row = tried.iloc[0]
    assert row["about"] > 200
    assert row["about_found"] == pytest.approx(row["about_expected"], abs=0.02)
    assert 0.92 < row["about_found"] < 0.98
    assert 0.95 < row["above_found"] <= 1.0


def test_a_coarser_level_of_detection_never_makes_smaller_changes_visible():
    fitted = fit_curve(changes(300, seed=3))
    assert fitted is not None
    smallest = fitted.smallest(np.array([0.05, 0.1, 0.2]))
    assert (np.diff(smallest) >= 0).all()


def test_where_everything_is_found_the_smallest_that_was_tried_is_stated():
    every = changes(40, seed=9).assign(found=True)
    fitted = fit_curve(every)
    assert fitted is not None
    assert fitted.smallest(np.array([0.06, 0.15])) == pytest.approx(every["magnitude_m"].min())


def test_what_was_not_tested_is_not_stated():
    missed = changes(200, seed=4).assign(found=False)
    fitted = fit_curve(missed)
    assert fitted is not None
    assert np.isnan(fitted.smallest(0.1))
    assert fit_curve(missed.head(5)) is None
    assert statement(missed, {("ground", "shift"): fitted})["above"].tolist() == [0, 0]
    assert statement(missed, {})["above"].tolist() == [0]


def judged(count: int = 400, seed: int = 5) -> pd.DataFrame:
    """Rows whose label is right with a probability that follows the first feature."""
    rng = np.random.default_rng(seed)
    x = np.zeros((count, len(FEATURES)))
    x[:, :5] = rng.normal(size=(count, 5))
    return pd.DataFrame(
        {
            "kind": np.where(np.arange(count) % 2, "single", "unchanged"),
            "features": list(map(tuple, x)),
            "right": rng.random(count) < expit(0.5 + 1.5 * x[:, 0]),
            "evidence": np.where(np.arange(count) % 8 < 4, "observed", "trajectory"),
            "survey": np.where(np.arange(count) % 4 < 2, "copy 0", "copy 1"),
        }
    )


def test_confidence_is_fitted_by_kind_and_says_how_far_it_held_on_rows_left_out():
    slice_ = fit_confidence(judged(), "two copies")
    assert slice_["fitted_on"].startswith("two copies; 200 changed of 400 rows")
    assert slice_["single"]["margin"] == pytest.approx(1.5, abs=0.5)
    assert slice_["held_out_ece"] < 0.1
    assert "reshaped" not in slice_


def test_only_kinds_of_evidence_whose_confidences_held_on_other_surveys_are_called_calibrated():
    rows = judged(4000)
    wrong = (rows["evidence"] == "trajectory") & (np.arange(len(rows)) % 3 > 0)
    half = rows.assign(right=np.where(wrong & (rows["survey"] == "copy 1"), False, rows["right"]))
    errors = held_out_errors(half)
    assert errors["trajectory"] > 0.1
    assert errors["trajectory"] > 1.5 * errors["observed"]
    fitted = fit_confidence(rows, "two copies", "own")
    assert set(fitted["evidence"]) <= {"observed", "trajectory"}
    assert "trajectory" not in fit_confidence(half, "two copies")["evidence"]
    assert ConfidenceConfig(**{**fitted, "held_out_ece": 0.02}).clouds == "own"
    few = rows[rows["evidence"] == "observed"].head(LEAST - 1).assign(kind="single")
    assert list(held_out_errors(few)) == ["all"]


def test_a_calibration_is_written_with_table_curves_and_map(tmp_path):
    lod = LodRaster(np.array([[0.06, np.nan]], np.float32), np.ones((1, 2), np.float32), 1000.0, 2005.0, 5.0)
    every = pd.concat([changes(300, seed=6), changes(5, seed=7, class_name="building")])
    result = MapCalibration(judged(), every, changes(200, seed=8), lod, "EPSG:7850", {"inserted": 1})
    config = MapCalibrationConfig(copies=2)
    document = write_calibration(tmp_path / "out", result, config, tmp_path / "map")
    assert document["fresh_changes"]["above"] > 50
    assert document["second_pass"]["measured"] is False
    fresh = pd.read_csv(tmp_path / "out" / "fresh.csv")
    assert fresh.iloc[-1]["above"] == document["fresh_changes"]["above"]
    table = pd.read_csv(tmp_path / "out" / "detectable.csv")
    assert table.loc[table["class"] == "building", "smallest_95_m"].isna().all()
    with rasterio.open(tmp_path / "out" / "detectable_ground.tif") as raster:
        smallest = raster.read(1)
    curve = fit_curves(every)["ground", "shift"]
    assert smallest[0, 0] == pytest.approx(float(curve.smallest(0.06)), abs=1e-3)
    assert np.isnan(smallest[0, 1])
    assert (tmp_path / "out" / "detectable.png").stat().st_size > 5000
    assert (tmp_path / "out" / "detectable_ground.png").stat().st_size > 5000
    assert (tmp_path / "out" / "confidence.yaml").is_file()
