"""The change directory: every file of a change run, written whole or not at all, reviews taken up."""

from __future__ import annotations

import logging
import platform
import shutil
import sqlite3
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import geopandas as gpd
import pandas as pd

from subiaco_change.decisions.confidence import ConfidenceCalibration
from subiaco_change.input_checks import hash_path
from subiaco_change.method_numbers import NUMBERS
from subiaco_change.outputs import table as outputs_table
from subiaco_change.outputs.change_directory_reading import ChangeDirectory, read_change_directory
from subiaco_change.outputs.clouds import write_labelled
from subiaco_change.outputs.geopackage import embed_styles, layers_of, write_geopackage, write_layer
from subiaco_change.outputs.json_text import write_json
from subiaco_change.outputs.parcels import build_parcels, coverage_polygons, rebuild_parcels
from subiaco_change.outputs.rasters import (
    Coverage,
    LodRaster,
    build_coverage,
    build_lod_raster,
    join_coverage,
    join_lod,
    lod_statement,
    read_coverage,
    write_coverage,
    write_ground_change,
    write_lod,
)
from subiaco_change.outputs.reviews import (
    REVIEW_FILE,
    apply_reviews,
    carry_reviews,
    read_review_file,
    read_reviewed,
)
from subiaco_change.outputs.table import schema_faults
from subiaco_change.records import ChangeResult, Registration, TiledResult
from subiaco_geo.atomic import refuse_existing, refuse_foreign, whole_directory, whole_file
from subiaco_geo.config import StrictModel, config_hash, write_config
from subiaco_geo.findings import SEVERITIES, Finding
from subiaco_geo.settings import method_statement, setting_values
from subiaco_geo.work.executors import Executor, InProcess, Start, work_beside
from subiaco_geo.work.tasks import peak_mib

_LOG = logging.getLogger(__name__)

__all__ = ["ChangeDirectory", "ChangeInputs", "PageWriter", "read_change_directory", "write_change_directory"]


#: What tells a change directory from another folder.
MARKER = "run.json"
#: Facts that a user gave for the pages; a directory that is replaced hands the file on.
PROJECT_FACTS = "project.json"
#: Writes the pages and the QGIS project into a change directory that holds everything else. The caller
#: gives it, because the report is built on this package and not the other way round.
PageWriter = Callable[[Path, Start], object]
_PACKAGES = (
    "subiaco-geo",
    "subiaco-mapping",
    "subiaco-change",
    "numpy",
    "scipy",
    "open3d-cpu",
    "open3d",
    "small-gicp",
    "geopandas",
    "laspy",
    "rasterio",
)


@dataclass(frozen=True)
class ChangeInputs:
    """Where the two epochs came from; ``notes`` are further facts for ``run.json``.

    ``calibration`` tells what the confidences were fitted on; the report
    says where they were not calibrated. ``ellipsoidal`` tells that heights are known to
    be ellipsoidal, so that the LAZ files may say so. ``lots`` are
    those of :func:`~subiaco_change.outputs.parcels.read_lots`, for the layer ``parcels``. ``findings`` are
    those of the surveys and their registration (:mod:`subiaco_change.input_checks`).
    """

    before: Path | None = None
    after: Path | None = None
    notes: Mapping[str, Any] = field(default_factory=dict)
    calibration: ConfidenceCalibration = field(default_factory=ConfidenceCalibration)
    ellipsoidal: bool = False
    lots: gpd.GeoDataFrame | None = None
    findings: tuple[Finding, ...] = ()


def registration_document(registration: Registration, crs: str | None) -> dict[str, Any]:
    """Return the content of ``registration.json``."""
    return {
        "T_after_before": registration.T_after_before,
        "crs": crs,
        "origin": registration.origin,
        "T_local_about_origin": registration.T_local,
        "rmse_m": registration.rmse_m,
        "inlier_ratio": registration.inlier_ratio,
        "pose_std": registration.pose_std,
        "pose_std_order": ["rx_rad", "ry_rad", "rz_rad", "tx_m", "ty_m", "tz_m"],
        "sigma_reg_m": registration.sigma_reg_m,
        "degenerate": list(registration.degenerate),
        "method": registration.method,
        "warnings": list(registration.warnings),
        "details": dict(registration.details),
    }


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def findings_of(result: ChangeResult | TiledResult, inputs: ChangeInputs) -> tuple[Finding, ...]:
    """Return all that speaks against a result, what is serious first."""
    warned = tuple(Finding("registration", "warning", text) for text in result.registration.warnings)
    found = (*inputs.findings, *result.findings, *warned)
    return tuple(sorted(found, key=lambda finding: SEVERITIES.index(finding.severity)))


def run_document(
    result: ChangeResult | TiledResult,
    config: StrictModel,
    inputs: ChangeInputs,
    table_hash: str,
    points: Mapping[str, int],
    coverage: Coverage,
    lod: LodRaster,
) -> dict[str, Any]:
    """Return the content of ``run.json``; ``points`` by epoch, areas from ``coverage`` and ``lod``."""
    sources = {"before": inputs.before, "after": inputs.after}
    findings = findings_of(result, inputs)
    return {
        "table_hash": table_hash,
        "config_hash": config_hash(config),
        "method": method_statement(config, setting_values(NUMBERS)),
        "versions": _versions(),
        "inputs": {
            name: {"path": str(path), "sha256": hash_path(path)} if path else None
            for name, path in sources.items()
        },
        "notes": dict(inputs.notes),
        "crs": result.crs,
        "points": dict(points),
        "compared_area_m2": coverage.area(1),
        "undecided_area_m2": coverage.area(4),
        "level_of_detection": lod_statement(lod),
        "confidence_calibrated": not inputs.calibration.lacking,
        "confidence_calibrated_for": dict(inputs.calibration.calibrated_for),
        "confidence_not_calibrated": list(inputs.calibration.lacking),
        "confidence_bands": [band.model_dump() for band in inputs.calibration.bands],
        "seconds": dict(result.seconds),
        "stages": dict(result.costs) if isinstance(result, TiledResult) else {},
        "peak_memory_mib": peak_mib(),
        "findings": [f.document() for f in findings],
        "warnings": [f.text for f in findings],
    }


def write_change_directory(
    directory: Path,
    result: ChangeResult | TiledResult,
    config: StrictModel,
    inputs: ChangeInputs,
    overwrite: bool = False,
    write_pages: PageWriter | None = None,
    executor: Executor | None = None,
) -> None:
    """Write every product of a change run.

    Parameters
    ----------
    directory : Path
        Appears whole at the end, or not at all.
    result : ChangeResult
    config : StrictModel
        As resolved; written to ``config.yaml``.
    inputs : ChangeInputs
    overwrite : bool
        Replace an earlier directory; its reviews are carried over.
    write_pages : callable, optional
        Called last, with the directory before it gets its name, so that it appears with its pages.
    executor : Executor, optional
        Its workers write clouds and draw while this process writes tables.

    Raises
    ------
    InputError
        The directory exists and ``overwrite`` is false, or a cloud lacks a field.
    """
    refuse_existing(directory, overwrite)
    refuse_foreign(directory, MARKER)
    crs = result.crs
    found = outputs_table.build_table(result.records, crs, _survey_days(inputs))
    digest, table = outputs_table.table_hash(found), outputs_table.with_regular_outlines(found)
    previous = read_reviewed(directory)
    lost = table.iloc[:0]
    if previous is not None:
        table, lost = carry_reviews(table, previous)
    with (
        whole_directory(directory, overwrite=overwrite, marker=MARKER) as target,
        work_beside(executor or InProcess()) as start,
    ):
        writing = {
            epoch: start(write_labelled, target, epoch, result.reading(epoch), inputs.ellipsoidal)
            for epoch in ("before", "after")
        }
        rasters = [(build_coverage(*pair), build_lod_raster(*pair)) for pair in result.parts()]
        coverage = join_coverage(seen for seen, _ in rasters)
        lod = join_lod(raster for _, raster in rasters)
        _write_table(target, table)
        if len(lost):
            outputs_table.write_csv(target / "reviews_without_object.csv", lost)
            _LOG.warning(
                "%s: %d reviewed rows have no object now; see reviews_without_object.csv",
                directory,
                len(lost),
            )
        _write_areas(target, table, inputs.lots, coverage)
        if result.ground is not None:
            write_ground_change(target / "ground_change.tif", result.ground, crs)
        write_coverage(target / "coverage.tif", coverage, crs)
        write_lod(target / "lod95.tif", lod, crs)
        if result.blocks is not None:
            result.blocks.to_csv(target / "registration_blocks.csv", index=False, float_format="%.4f")
        write_json(target / "registration.json", registration_document(result.registration, crs))
        write_config(target / "config.yaml", config)
        points = {epoch: written() for epoch, written in writing.items()}
        write_json(target / "run.json", run_document(result, config, inputs, digest, points, coverage, lod))
        if (directory / PROJECT_FACTS).is_file():
            shutil.copyfile(directory / PROJECT_FACTS, target / PROJECT_FACTS)
        if write_pages is not None:
            write_pages(target, start)


def _survey_days(inputs: ChangeInputs) -> tuple[str, str]:
    """Day of the first scan of *before* and of *after*, ISO 8601; empty where the map has no times."""
    epochs = inputs.notes.get("epochs", {})
    before, after = (str(epochs.get(name, {}).get("first", ""))[:10] for name in ("before", "after"))
    return before, after


def _write_table(target: Path, table: gpd.GeoDataFrame) -> None:
    for fault in schema_faults(table):
        _LOG.warning("changes.csv: %s, against the data dictionary; please report it with run.json", fault)
    outputs_table.write_csv(target / "changes.csv", table)
    write_geopackage(target / "changes.gpkg", table)
    outputs_table.write_parquet(target / "changes.parquet", table)


def _write_areas(
    target: Path, table: gpd.GeoDataFrame, lots: gpd.GeoDataFrame | None, coverage: Coverage
) -> None:
    """Write the layers ``coverage`` and, with lots, ``parcels``, with their styles."""
    package = target / "changes.gpkg"
    write_layer(package, "coverage", coverage_polygons(coverage, table.crs))
    if lots is not None:
        parcels = build_parcels(table, lots, coverage)
        write_layer(package, "parcels", parcels)
        outputs_table.write_csv(target / "parcels.csv", parcels)
    embed_styles(package, ("coverage",) if lots is None else ("coverage", "parcels"))


#: Name of a review file of which every row is in the table now.
APPLIED = "reviews_applied.csv"
_SPATIAL = ("ST_IsEmpty", "ST_MinX", "ST_MaxX", "ST_MinY", "ST_MaxY")  # which triggers of GeoPackages name


def take_up_reviews(directory: Path, files: list[Path]) -> tuple[gpd.GeoDataFrame, list[str]]:
    """Store reviews in every file of a change directory that holds or counts rows, but the pages.

    Parameters
    ----------
    directory : Path
        Change directory; its own ``reviews.csv`` and what was typed into its CSV or GeoPackage count too.
    files : list of Path
        Review files of :func:`read_review_file`; a later one wins.

    Returns
    -------
    table : GeoDataFrame
        With its reviews.
    unknown : list of str
        ``object_uid`` that the table does not have.

    Raises
    ------
    InputError
        Not a change directory, or not a review file.
    """
    read_change_directory(directory)  # refuses what is none
    layers_of(directory / "changes.gpkg")
    table = read_reviewed(directory)
    assert table is not None
    unknown: list[str] = []
    for path in files:
        reviews = read_review_file(path)
        table = apply_reviews(table, reviews)
        unknown += sorted(set(reviews.index) - set(table["object_uid"]))
    with whole_file(directory / "changes.gpkg") as temporary:
        shutil.copyfile(directory / "changes.gpkg", temporary)
        _update_package(temporary, table)
        if (directory / "parcels.csv").is_file():
            parcels = rebuild_parcels(temporary, table, read_coverage(directory / "coverage.tif"))
            with whole_file(directory / "parcels.csv") as target:
                outputs_table.write_csv(target, parcels)
    with whole_file(directory / "changes.csv") as temporary:
        outputs_table.write_csv(temporary, table)
    with whole_file(directory / "changes.parquet") as temporary:
        outputs_table.write_parquet(temporary, table)
    if (directory / REVIEW_FILE).is_file():
        (directory / REVIEW_FILE).replace(directory / APPLIED)
    return table, unknown


def _update_package(path: Path, table: pd.DataFrame) -> None:
    """Write the reviews into the layers ``objects`` and ``ground``; everything else stays as it is."""
    rows = table[["review", "reviewer", "note", "object_uid"]].to_numpy().tolist()
    with closing(sqlite3.connect(path)) as connection, connection:
        for name in _SPATIAL:
            connection.create_function(name, 1, lambda _: 0)
        for layer in ("objects", "ground"):
            query = f"update {layer} set review = ?, reviewer = ?, note = ? where object_uid = ?"  # noqa: S608
            connection.executemany(query, rows)
