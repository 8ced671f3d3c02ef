"""Files of the health monitor: the manifest of flags and the quality of the streets."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from subiaco_geo.atomic import whole_file
from subiaco_geo.bag_files import find_storage, sequence_name
from subiaco_geo.config import load_yaml
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.survey_map import SurveyMap
from subiaco_mapping.health_monitor.monitor import Monitor, merged_flags
from subiaco_mapping.health_monitor.routes import route_enu
from subiaco_mapping.health_monitor.street_quality import UNDRIVEN, write_geojson

LOGGER = logging.getLogger(__name__)

MANIFEST = "manifest.yaml"
STREETS = "quality.geojson"


def read_manifest(path: Path) -> dict[str, Any]:
    """Return a manifest, empty where there is none.

    Raises
    ------
    InputError
        The file is there but is no manifest.
    """
    if not path.is_file():
        return {}
    try:
        document = load_yaml(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        first = str(error).splitlines()[0]
        raise InputError(f"{path}: cannot be read ({first}); move it away") from error
    if not isinstance(document, dict) or not isinstance(document.get("sequences"), dict):
        raise InputError(f"{path}: not a manifest (no sequences); move it away")
    return document


def write_manifest(path: Path, manifest: dict[str, Any]) -> None:
    """Write a manifest, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(yaml.safe_dump(manifest, sort_keys=False), encoding="utf-8")


class SurveyFiles:
    """Manifest and street lights of one drive; an earlier run of the watch is gone on with.

    Parameters
    ----------
    directory : Path
    sequence : str
        Name of the drive in the manifest.
    routes : sequence of (N, 2) float64
        Planned lines: latitude, longitude [deg].

    Attributes
    ----------
    remaining : float
        What of the route was undriven when last written [m]; NaN without a route.
    """

    def __init__(self, directory: Path, sequence: str, routes: list[Floats]) -> None:
        self._directory = directory
        self._sequence = sequence
        self._routes = routes
        self._earlier = read_manifest(directory / MANIFEST).get("sequences", {}).get(sequence, {})
        self._earlier_features = _features(directory / STREETS)
        self._complained = False
        self.remaining = float("nan")

    def write(self, monitor: Monitor) -> None:
        """Write both; a disk that refuses is said once, and does not end the watch."""
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
            write_manifest(self._directory / MANIFEST, self.manifest(monitor))
            if monitor.positions.frame is not None:
                write_geojson(self._directory / STREETS, self.geojson(monitor))
            self._complained = False
        except OSError as error:
            if not self._complained:
                LOGGER.error("%s: %s; the watch goes on without files", self._directory, error.strerror)
            self._complained = True

    def manifest(self, monitor: Monitor) -> dict[str, Any]:
        """Return the manifest, stretches of an earlier run of the watch included."""
        manifest = monitor.manifest(self._sequence)
        sequence, earlier = manifest["sequences"][self._sequence], self._earlier
        if earlier:
            sequence["start_s"] = min(earlier.get("start_s", sequence["start_s"]), sequence["start_s"])
            flagged = {name: list(found) for name, found in earlier.get("flagged", {}).items()}
            for name, found in sequence["flagged"].items():
                flagged.setdefault(name, []).extend(found)
            sequence["flagged"] = flagged
        return manifest

    def geojson(self, monitor: Monitor) -> dict[str, Any]:
        """Return the street lights and what of the route is undriven."""
        frame = monitor.positions.frame
        assert frame is not None
        collection = monitor.streets.geojson(frame, route_enu(self._routes, frame))
        if self._routes:
            planned = [
                f["properties"] for f in collection["features"] if f["properties"]["kind"] == "planned"
            ]
            self.remaining = sum(p["length_m"] for p in planned if p["light"] == UNDRIVEN)
        return {**collection, "features": self._earlier_features + collection["features"]}


def _features(path: Path) -> list[dict[str, Any]]:
    try:
        features = json.loads(path.read_text(encoding="utf-8"))["features"]
        return [f for f in features if f["properties"]["kind"] == "driven"]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def add_stretches(path: Path, sequence: str, name: str, stretches: list[dict[str, Any]]) -> None:
    """Add stretches to a manifest on disk, e.g. deaths of processes that only their supervisor saw."""
    manifest = read_manifest(path)
    if not manifest or not stretches:
        return
    found = manifest["sequences"].setdefault(sequence, {}).setdefault("flagged", {})
    found[name] = [*found.get(name, []), *stretches]
    write_manifest(path, manifest)


def extended(mapped: Mapping[str, Any], watched: Mapping[str, Any]) -> dict[str, Any]:
    """Extend a watch's manifest by the mapping's: flags of both, everything else the mapping's.

    The watch names its one drive by itself, so its flags go to the mapping's sequence of that name,
    or to the only one.
    """
    sequences = dict(mapped.get("sequences", {}))
    for name, before in watched.get("sequences", {}).items():
        target = name if name in sequences else next(iter(sequences)) if len(sequences) == 1 else None
        if target is None:
            continue
        after = sequences[target]
        extra = {key: before[key] for key in ("streams", "street_segments") if key in before}
        flags = merged_flags(before.get("flagged", {}), after.get("flagged", {}))
        sequences[target] = {**after, **extra, "flagged": flags}
    legend = {**watched.get("legend", {}), **mapped.get("legend", {})}
    return {**mapped, "sequences": sequences, "legend": legend}


def with_watched(survey: SurveyMap, bags: Iterable[Path | str]) -> SurveyMap:
    """Extend what the watch wrote beside the bags of a map by the map's own manifest."""
    manifest: Mapping[str, Any] = survey.manifest
    for bag in map(Path, bags):
        watched = _beside(bag)
        drives = list(watched.get("sequences", {}).values())
        if len(drives) == 1:
            manifest = extended(manifest, {**watched, "sequences": {sequence_name(bag): drives[0]}})
    return survey if manifest is survey.manifest else replace(survey, manifest=manifest)


def _beside(bag: Path) -> dict[str, Any]:
    """Return the watch's manifest in a bag's folder or in the drive's folder around ``bag/``."""
    storage = find_storage(bag).resolve()
    folder = storage if storage.is_dir() else storage.parent
    for place in (folder, folder.parent) if folder.name == "bag" else (folder,):
        manifest = read_manifest(place / MANIFEST)
        if manifest.get("watched") is True:
            return manifest
    return {}
