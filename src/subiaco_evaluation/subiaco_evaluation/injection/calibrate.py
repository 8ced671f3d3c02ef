"""Detectability and confidence on one's own city, from known changes injected into its map."""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from numpy.typing import NDArray
from pydantic import Field

from subiaco_change.config import ChangeConfig
from subiaco_change.outputs.json_text import write_json
from subiaco_change.outputs.rasters import LodRaster, build_lod_raster, write_bands
from subiaco_change.pipeline import detect_changes
from subiaco_evaluation.confidence_fit import fit_confidence, held_out_error, judged_rows, pair_points
from subiaco_evaluation.injection.config import InjectionConfig, RepeatConfig
from subiaco_evaluation.injection.detectability import (
    PROBABILITY,
    Curve,
    fit_curves,
    outcomes,
    smallest_table,
    statement,
)
from subiaco_evaluation.injection.drawing import draw_curves, draw_ground
from subiaco_evaluation.injection.edits import Donor
from subiaco_evaluation.injection.inject import inject
from subiaco_evaluation.injection.repeat import measured_repeat
from subiaco_evaluation.injection.source_objects import label_scene
from subiaco_geo.atomic import whole_directory
from subiaco_geo.clouds import PointCloud
from subiaco_geo.config import StrictModel, write_config
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.survey_map import SurveyMap

#: What tells a calibration from another folder.
MARKER = "calibration.json"


class MapCalibrationConfig(StrictModel):
    """How many copies, and what is done to them."""

    copies: int = Field(
        4, ge=2, description="Number of injected copies of the survey on which the confidence is fitted"
    )
    fresh: int = Field(
        1, ge=0, description="Number of further injected copies on which the fitted confidence is tested"
    )
    injection: InjectionConfig = InjectionConfig()


@dataclass(frozen=True)
class MapCalibration:
    """Rows and changes of all copies; ``fresh_changes`` are those of copies that nothing was fitted on.

    ``repeat`` tells how the second pass differed, and ``repeat_measured`` whether that was measured.
    """

    rows: pd.DataFrame
    changes: pd.DataFrame
    fresh_changes: pd.DataFrame
    lod: LodRaster
    crs: str | None
    left_out: dict[str, int]
    repeat: RepeatConfig = field(default_factory=RepeatConfig)
    repeat_measured: bool = False

    def curves(self) -> dict[tuple[str, str], Curve]:
        """Return the fitted curves by class and kind."""
        return fit_curves(self.changes)


def calibrate(
    survey: SurveyMap,
    change: ChangeConfig,
    config: MapCalibrationConfig,
    donors: tuple[Donor, ...] = (),
    progress: Callable[[str, float], None] | None = None,
    transform: Floats | None = None,
    other: PointCloud | None = None,
) -> MapCalibration:
    """Run change detection on injected copies of a map.

    Parameters
    ----------
    survey : SurveyMap
        With a trajectory.
    change : ChangeConfig
    config : MapCalibrationConfig
    donors : tuple of Donor
        Objects to put; those of the map itself where there are none.
    progress : callable, optional
    transform : (4, 4) float64, optional
        Identity skips the registration, and leaves its error out of the statement.
    other : PointCloud, optional
        Map of other sequences of the same days, from which the noise of a second pass is measured.

    Raises
    ------
    InputError
        The map has no trajectory, or no change fitted anywhere.
    RegistrationError
    """
    rows, changes, left_out = [], [], dict[str, int]()
    lod, crs = None, None
    total = config.copies + config.fresh
    scene = label_scene(survey, config.injection)
    injection = config.injection
    if other is not None:
        injection = injection.model_copy(update={"repeat": measured_repeat(scene, other, injection)})
    for copy in range(total):
        if progress is not None:
            progress(f"copy {copy + 1} of {total}", copy / total)
        settings = injection.model_copy(update={"seed": injection.seed + copy})
        injected = inject(survey, settings, donors, scene=scene)
        if copy % 2:
            injected = injected.turned_round()
        result = detect_changes(injected.before, injected.after, change, transform=transform)
        points = pair_points(result, injected.before.cloud, injected.after.cloud)
        if copy < config.copies:
            rows.append(judged_rows(result, points, f"copy {copy}"))
        changes.append(outcomes(pd.DataFrame(injected.rows), points, result, copy))
        for name, count in injected.left_out.items():
            left_out[name] = left_out.get(name, 0) + count
        lod = lod or build_lod_raster(result.before, result.after)
        crs = result.after.crs
    every = pd.concat(changes, ignore_index=True)
    if len(every) == 0 or lod is None:
        raise InputError("calibrate: no change fitted anywhere in this map; is it large enough?")
    fresh = every["copy"] >= config.copies
    return MapCalibration(
        pd.concat(rows), every[~fresh], every[fresh], lod, crs, left_out, injection.repeat, other is not None
    )


def write_calibration(
    directory: Path,
    result: MapCalibration,
    config: MapCalibrationConfig,
    source: Path,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Write ``confidence.yaml``, ``detectable*``, ``fresh.csv``, ``changes.csv`` and ``calibration.json``.

    Returns
    -------
    dict
        Content of ``calibration.json``.
    """
    curves = result.curves()
    today = dt.datetime.now(dt.UTC).date()
    fitted_on = f"{config.copies} injected copies of {source.name}; {today}"
    tried = statement(result.fresh_changes, curves)
    document: dict[str, Any] = {
        "source": str(source),
        "copies": config.copies,
        "fresh_copies": config.fresh,
        "injected_changes": len(result.changes),
        "found": int(result.changes["found"].sum()),
        "probability": PROBABILITY,
        "held_out_ece": held_out_error(result.rows),
        "fresh_changes": _plain(tried.iloc[-1]),
        "fitted_nowhere": result.left_out,
        "second_pass": {
            "measured": result.repeat_measured,
            **result.repeat.model_dump(),
        },
    }
    with whole_directory(directory, overwrite=overwrite, marker=MARKER) as target:
        slice_ = {"confidence": fit_confidence(result.rows, fitted_on, "own")}
        (target / "confidence.yaml").write_text(
            yaml.safe_dump({"/**": {"ros__parameters": slice_}}, sort_keys=False)
        )
        every = pd.concat([result.changes, result.fresh_changes], ignore_index=True)
        every.round(4).to_csv(target / "changes.csv", index=False)
        smallest_table(result.changes, curves).to_csv(target / "detectable.csv", index=False)
        tried.to_csv(target / "fresh.csv", index=False)
        draw_curves(target / "detectable.png", result.changes, curves)
        ground = curves.get(("ground", "shift"))
        if ground is not None:
            band = {"smallest_95": detectable_ground(result.lod, ground)}
            write_bands(target / "detectable_ground.tif", band, result.lod, result.crs)
            draw_ground(target / "detectable_ground.png", band["smallest_95"], result.lod)
        write_config(target / "config.yaml", config)
        write_json(target / MARKER, document)
    return document


def _plain(row: pd.Series) -> dict[str, float | None]:
    """Return numbers of :func:`statement` for JSON."""
    known = row.drop(["class", "kind"]).astype(float)
    return {name: None if np.isnan(value) else float(value) for name, value in known.items()}


def detectable_ground(lod: LodRaster, curve: Curve) -> NDArray[np.float32]:
    """Return the smallest rise or fall of the ground that is found, cell by cell [m]."""
    with np.errstate(divide="ignore", invalid="ignore"):
        smallest = np.where(lod.lod95 > 0, curve.smallest(lod.lod95.astype(np.float64)), np.nan)
    return np.asarray(smallest, dtype=np.float32)
