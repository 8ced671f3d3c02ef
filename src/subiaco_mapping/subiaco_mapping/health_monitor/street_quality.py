"""Quality of every street segment (green, amber, red) with its reason, and segments not yet driven."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from subiaco_geo.atomic import whole_file
from subiaco_geo.crs import EnuFrame
from subiaco_geo.frames import Floats
from subiaco_mapping.health_monitor.config import StreetQualityConfig
from subiaco_mapping.health_monitor.positions import TimedPosition
from subiaco_mapping.health_monitor.routes import cut_line, densified, middle

GREEN, AMBER, RED, UNDRIVEN = "green", "amber", "red", "undriven"
_ORDER = {GREEN: 0, AMBER: 1, RED: 2, UNDRIVEN: 3}
_COLOURS = {GREEN: "#2e9e41", AMBER: "#f0a202", RED: "#d7263d", UNDRIVEN: "#7a7a7a"}


@dataclass
class Segment:
    """A piece of the way driven and what was wrong on it."""

    start_ns: int
    end_ns: int
    way: list[tuple[float, float]]
    length: float = 0.0
    faults: dict[str, int] = field(default_factory=dict)

    def reasons(self, config: StreetQualityConfig) -> list[str]:
        """Return the flags that lasted long enough to count, worst first."""
        span = max(self.end_ns - self.start_ns, 1)
        lasting = [name for name, time_ns in self.faults.items() if time_ns >= config.min_share * span]
        return sorted(lasting, key=lambda name: (name not in config.red, name))

    def light(self, config: StreetQualityConfig) -> str:
        """Return the colour."""
        reasons = self.reasons(config)
        if any(name in config.red for name in reasons):
            return RED
        return AMBER if any(name in config.amber for name in reasons) else GREEN


class StreetQuality:
    """Cut the way driven into segments and colour them.

    Parameters
    ----------
    config : StreetQualityConfig
    """

    def __init__(self, config: StreetQualityConfig) -> None:
        self._config = config
        self._last: TimedPosition | None = None
        self.segments: list[Segment] = []

    def take(self, place: TimedPosition, raised: Collection[str], events: Collection[str] = ()) -> None:
        """Go on to a place; the flags raised meanwhile stain the way there.

        ``events`` are flags of one moment: they stain the whole segment.
        """
        last, self._last = self._last, place
        if last is None:
            self.segments.append(Segment(place.time_ns, place.time_ns, [(place.east, place.north)]))
            return
        step = float(np.hypot(place.east - last.east, place.north - last.north))
        segment = self.segments[-1]
        passed_ns = max(place.time_ns - last.time_ns, 0)
        for name in raised:
            segment.faults[name] = segment.faults.get(name, 0) + passed_ns
        for name in events:
            segment.faults[name] = 2**62
        segment.end_ns = place.time_ns
        segment.length += step
        if np.hypot(place.east - segment.way[-1][0], place.north - segment.way[-1][1]) >= 1.0:
            segment.way.append((place.east, place.north))
        if segment.length >= self._config.segment_length:
            begin = [segment.way[-1]]
            self.segments.append(Segment(place.time_ns, place.time_ns, begin))

    def driven(self) -> list[Segment]:
        """Return the segments that have a length."""
        return [segment for segment in self.segments if len(segment.way) > 1]

    def _samples(self, segments: Sequence[Segment]) -> tuple[Floats, Floats]:
        """Return points (N, 2) along segments and each one's light as a number (N,)."""
        points = [densified(np.array(s.way), 0.5 * self._config.same_street) for s in segments]
        rank = [_ORDER[s.light(self._config)] for s in segments]
        counts = [len(p) for p in points]
        return np.concatenate([*points, np.zeros((0, 2))]), np.repeat(np.array(rank, float), counts)

    def best_statuses(self, places: Floats) -> list[str]:
        """Return the best light with which any drive passed places (M, 2), undriven where none did."""
        points, rank = self._samples(self.driven())
        names = {value: name for name, value in _ORDER.items()}
        found = []
        for place in places:
            near = np.hypot(*(points - place).T) <= self._config.same_street
            found.append(names[int(rank[near].min())] if near.any() else UNDRIVEN)
        return found

    def again(self) -> list[Segment]:
        """Return red segments that no later or earlier drive of the same street made good."""
        red = [s for s in self.driven() if s.light(self._config) == RED]
        middles = np.array([s.way[len(s.way) // 2] for s in red]).reshape(-1, 2)
        return [s for s, best in zip(red, self.best_statuses(middles), strict=True) if best == RED]

    def counts(self) -> dict[str, int]:
        """Return how many segments have which light."""
        lights = [segment.light(self._config) for segment in self.driven()]
        return {name: lights.count(name) for name in (GREEN, AMBER, RED)}

    def geojson(self, frame: EnuFrame, routes: Sequence[Floats] = ()) -> dict[str, Any]:
        """Return everything as a feature collection: driven segments, then pieces of the route.

        Parameters
        ----------
        frame : EnuFrame
            Of the places.
        routes : sequence of (N, 2) float64
            Planned lines, east and north in the same frame [m].
        """
        again = {id(segment) for segment in self.again()}
        features = [self._feature(s, frame, id(s) in again) for s in self.driven()]
        for route in routes:
            features += self._route_features(route, frame)
        return {"type": "FeatureCollection", "features": features}

    def _feature(self, segment: Segment, frame: EnuFrame, again: bool) -> dict[str, Any]:
        light = segment.light(self._config)
        properties = {
            "kind": "driven",
            "light": light,
            "reasons": segment.reasons(self._config),
            "drive_again": again,
            "start_s": round(segment.start_ns * 1e-9, 3),
            "end_s": round(segment.end_ns * 1e-9, 3),
            "length_m": round(segment.length, 1),
        }
        return _line(np.array(segment.way), frame, light, properties)

    def route_pieces(self, route: Floats) -> list[tuple[Floats, str]]:
        """Return the pieces of a planned line with the best light that each was driven with."""
        pieces = cut_line(route, self._config.route_step)
        middles = np.array([middle(piece) for piece in pieces]).reshape(-1, 2)
        return list(zip(pieces, self.best_statuses(middles), strict=True))

    def _route_features(self, route: Floats, frame: EnuFrame) -> list[dict[str, Any]]:
        features = []
        for piece, light in self.route_pieces(route):
            length = float(np.linalg.norm(np.diff(piece, axis=0), axis=1).sum())
            properties = {"kind": "planned", "light": light, "length_m": round(length, 1)}
            features.append(_line(piece, frame, light, properties))
        return features


def _line(way: Floats, frame: EnuFrame, light: str, properties: dict[str, Any]) -> dict[str, Any]:
    geodetic = frame.to_geodetic(np.column_stack([way, np.zeros(len(way))]))
    coordinates = [[round(lon, 8), round(lat, 8)] for lat, lon in geodetic[:, :2].tolist()]
    style = {"stroke": _COLOURS[light], "stroke-width": 4, "style": {"color": _COLOURS[light], "weight": 4}}
    return {
        "type": "Feature",
        "geometry": {"type": "LineString", "coordinates": coordinates},
        "properties": {**properties, **style},
    }


def write_geojson(path: Path, collection: dict[str, Any]) -> None:
    """Write a feature collection, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(collection), encoding="utf-8")
