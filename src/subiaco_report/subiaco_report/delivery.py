"""A delivery folder: what a client is handed, with manifest, checksums, metadata and accuracy statement."""

from __future__ import annotations

import csv
import hashlib
import shutil
from dataclasses import dataclass
from datetime import UTC, date, datetime
from importlib.metadata import version
from pathlib import Path

import geopandas as gpd
from pyproj import CRS

from subiaco_change.outputs.change_directory_reading import ChangeDirectory, read_change_directory
from subiaco_change.outputs.difference_rasters import cut_and_fill, write_difference_rasters
from subiaco_change.outputs.exports import export_changes
from subiaco_change.outputs.geopackage import layers_of, write_layer
from subiaco_change.outputs.parcels import OUTSIDE, read_lots
from subiaco_change.outputs.reviews import review_counts
from subiaco_change.outputs.table import write_csv
from subiaco_geo.atomic import whole_directory
from subiaco_geo.errors import InputError
from subiaco_report.accuracy import accuracy_facts, read_check
from subiaco_report.facts import findings, is_simulated
from subiaco_report.iso_metadata import DeliveryFacts, iso_metadata
from subiaco_report.page import environment
from subiaco_report.project_facts import project_facts
from subiaco_report.row_data import FOLDER as REPORT_FILES
from subiaco_report.summary import epoch_facts
from subiaco_report.viewer.build import FOLDER as VIEWER

MANIFEST, CHECKSUMS = "manifest.csv", "SHA256SUMS"
_TABLES = ("gpkg", "csv", "shp", "dxf", "geojson", "kml")
_GEOGRAPHIC = ("geojson", "kml")  # which need a CRS
_COPIED = ("coverage.tif", "lod95.tif", "ground_change.tif", "registration.json", "run.json", "config.yaml")
_PAGES = ("report.html", "summary.html", "overview.png")
_ABOUT = {
    "report": "pages for people: report.html (every change), summary.html (two pages), viewer (3D)",
    "changes": "the change table in the forms of GIS and CAD programs",
    "rasters": "heights of both surveys and their difference, coverage, level of detection (GeoTIFF)",
    "clouds": "labelled points of both surveys (COPC, LAS 1.4)",
    "volumes": "cut and fill of the ground by polygon",
    "processing": "settings, registration and versions of the run",
    "accuracy.html": "accuracy statement, to be signed",
    "metadata.xml": "metadata (ISO 19115, XML of ISO 19139)",
}


@dataclass(frozen=True)
class Delivery:
    """What a delivery holds beside the change directory.

    ``review``: rows by their review, see :func:`~subiaco_change.outputs.reviews.selected_by_review`;
    ``polygons``: areas for cut and fill, None takes the lots of the change directory; ``check``: output of
    ``subiaco check --json``; ``cell``: edge of the cells of the difference rasters [m]; ``clouds``: with
    point clouds; ``created``: day of the metadata, None takes today (UTC).
    """

    review: str = "all"
    polygons: Path | None = None
    check: Path | None = None
    cell: float = 0.5
    clouds: bool = True
    created: date | None = None


def deliver(directory: Path, output: Path, delivery: Delivery) -> list[Path]:
    """Write the delivery of a change directory.

    Parameters
    ----------
    directory : Path
        Change directory.
    output : Path
        New folder.
    delivery : Delivery

    Returns
    -------
    list of Path
        Every file, relative to the folder.

    Raises
    ------
    InputError
        Not a change directory, polygons or a check that cannot be read, or a folder that exists, or cells
        without an area.
    """
    change = read_change_directory(directory)
    if not delivery.cell > 0.0:
        raise InputError(f"--cell {delivery.cell}: must be larger than 0; give the edge of a cell in metres")
    check = None if delivery.check is None else read_check(delivery.check)
    layers_of(directory / "changes.gpkg")  # a missing one is refused before the work
    polygons = _polygons(change, delivery.polygons)
    with whole_directory(output) as target:
        _copy(directory, target)
        for kind in _TABLES:
            if change.table.crs is not None or kind not in _GEOGRAPHIC:
                _export(directory, target / "changes", kind, delivery.review)
        write_difference_rasters(directory, target / "rasters", delivery.cell)
        if polygons is not None:
            _write_volumes(target, change, polygons)
        if delivery.clouds:
            _export(directory, target / "clouds", "copc", delivery.review)
        (target / "accuracy.html").write_text(
            environment().get_template("accuracy.html.j2").render(_statement(change, check, delivery.review)),
            encoding="utf-8",
        )
        metadata = iso_metadata(_metadata(change, delivery.created or datetime.now(UTC).date()))
        (target / "metadata.xml").write_text(metadata, encoding="utf-8")
        (target / "README.txt").write_text(_readme(target, delivery.review), encoding="utf-8")
        files = sorted(path.relative_to(target) for path in target.rglob("*") if path.is_file())
        _write_manifest(target, files)
    return [*files, Path(CHECKSUMS), Path(MANIFEST)]


def _copy(directory: Path, target: Path) -> None:
    """Copy pages, rasters and the record of the run."""
    for name in ("report", "rasters", "processing", "changes"):
        (target / name).mkdir()
    for name in (*_PAGES, *_COPIED):
        if (directory / name).is_file():
            folder = "report" if name in _PAGES else "rasters" if name.endswith(".tif") else "processing"
            shutil.copyfile(directory / name, target / folder / name)
    for name in (REPORT_FILES, VIEWER):
        if (directory / name).is_dir():
            shutil.copytree(directory / name, target / "report" / name)


def _export(directory: Path, target: Path, kind: str, review: str) -> None:
    """Export into a folder that several exports share."""
    scratch = target.with_name(f".{target.name}.{kind}")
    files = export_changes(directory, scratch, kind, review=review)
    target.mkdir(exist_ok=True)
    for file in files:
        file.replace(target / file.name)
    scratch.rmdir()


def _polygons(change: ChangeDirectory, path: Path | None) -> gpd.GeoDataFrame | None:
    """Polygons of a file, else the lots of the change directory, else None."""
    if path is not None:
        return read_lots(path, change.run.get("crs"))
    package = change.path / "changes.gpkg"
    if "parcels" not in layers_of(package):
        return None
    lots = gpd.read_file(package, layer="parcels", engine="pyogrio")
    return lots.loc[lots["lot"] != OUTSIDE, ["lot", "geometry"]].reset_index(drop=True)


def _write_volumes(target: Path, change: ChangeDirectory, polygons: gpd.GeoDataFrame) -> None:
    sigma = float(change.registration["sigma_reg_m"] or 0.0)
    volumes = cut_and_fill(target / "rasters" / "ground_difference.tif", polygons, sigma)
    (target / "volumes").mkdir()
    write_layer(target / "volumes" / "volumes.gpkg", "volumes", volumes)
    write_csv(target / "volumes" / "volumes.csv", volumes)


def _statement(change: ChangeDirectory, check: dict[str, object] | None, review: str) -> dict[str, object]:
    """Return what the template of the accuracy statement needs."""
    crs = change.run.get("crs")
    known = None if crs is None else CRS.from_user_input(crs)
    said = {
        "all": "The delivery holds all of them.",
        "accepted": "The tables of the delivery hold accepted rows only.",
        "not-rejected": "Rejected rows are left out of the tables of the delivery.",
    }
    return {
        "project": project_facts(change.path),
        "simulated": is_simulated(change.run),
        "epochs": epoch_facts(change.run),
        "crs_name": "local coordinates, without a datum" if known is None else f"{known.name} ({crs})",
        "heights": "as in the maps; local"
        if known is None
        else "as in the maps; ellipsoidal where Subiaco made them",
        "facts": accuracy_facts(change.run, change.registration, check),
        "reviews": review_counts(change.table),
        "rows_said": said[review],
        "calibrated": bool(change.run.get("confidence_calibrated", False)),
        "findings": findings(change.run, change.registration),
        "version": change.run.get("versions", {}).get("subiaco-change", version("subiaco-change")),
        "table_hash": change.run.get("table_hash", ""),
    }


def _metadata(change: ChangeDirectory, created: date) -> DeliveryFacts:
    project = project_facts(change.path)
    clouds = change.open("before"), change.open("after")
    low = [min(c.low[axis] for c in clouds) for axis in (0, 1)]
    high = [max(c.high[axis] for c in clouds) for axis in (0, 1)]
    simulated = "Simulated data. " if is_simulated(change.run) else ""
    days = tuple(str(epoch["days"] or "") for epoch in epoch_facts(change.run))
    return DeliveryFacts(
        identifier=f"subiaco-{change.run.get('table_hash', '')}",
        title=project["project"] or "Changes between two mobile laser scanning surveys",
        abstract=f"{simulated}{len(change.table)} objects compared between two surveys: labels, heights, "
        "volumes, confidence, footprints, rasters of height difference and labelled point clouds.",
        organisation=project["client"],
        created=created.isoformat(),
        crs=change.run.get("crs"),
        bounds=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
        days=days,
        lineage=f"{simulated}Aligned by {change.registration['method']}, then compared object by object.",
        accuracy_m=change.run.get("level_of_detection", {}).get("median_where_known_m"),
    )


def _readme(target: Path, review: str) -> str:
    held = [f"{name}: {text}" for name, text in _ABOUT.items() if (target / name).exists()]
    held.append(
        f"{MANIFEST}: every file with its size and SHA-256; {CHECKSUMS}: for 'sha256sum -c {CHECKSUMS}'"
    )
    return f"Delivery of changes between two surveys. Rows: {review}.\n\n" + "\n".join(held) + "\n"


def _write_manifest(target: Path, files: list[Path]) -> None:
    """Write size and SHA-256 of every file, for people and for ``sha256sum -c``."""
    sums = []
    for file in files:
        with (target / file).open("rb") as stream:
            sums.append(hashlib.file_digest(stream, "sha256").hexdigest())
    with (target / MANIFEST).open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(("file", "bytes", "sha256"))
        for file, digest in zip(files, sums, strict=True):
            writer.writerow((file.as_posix(), (target / file).stat().st_size, digest))
    lines = [f"{digest}  {file.as_posix()}\n" for file, digest in zip(files, sums, strict=True)]
    (target / CHECKSUMS).write_text("".join(lines), encoding="utf-8")
