"""The light of every street segment, and what of a planned route is still to be driven."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import HOME, START_NS, Drive, watched

from subiaco_geo.errors import InputError
from subiaco_mapping.health_monitor.config import StreetQualityConfig
from subiaco_mapping.health_monitor.positions import Positions, TimedPosition, planar_turn
from subiaco_mapping.health_monitor.routes import cut_line, read_route, route_enu
from subiaco_mapping.health_monitor.street_quality import (
    AMBER,
    GREEN,
    RED,
    UNDRIVEN,
    StreetQuality,
    write_geojson,
)

SECOND = 10**9


def drive(
    book: StreetQuality, way: np.ndarray, start: float, raised: dict[int, set[str]] | None = None
) -> None:
    """Drive a line (N, 2), a point a second; ``raised`` holds the flags of some seconds."""
    for k, (east, north) in enumerate(way.tolist()):
        time_ns = START_NS + int((start + k) * SECOND)
        book.take(TimedPosition(time_ns, east, north), (raised or {}).get(k, set()))


def street(east: float = 0.0, length: int = 100) -> np.ndarray:
    return np.array([[east, north] for north in range(0, length + 1, 5)], dtype=float)


def test_segments_are_cut_by_way_and_coloured_by_the_worst_that_lasted() -> None:
    book = StreetQuality(StreetQualityConfig())
    drive(
        book,
        street(),
        0.0,
        {2: {"packet_loss"}, 3: {"packet_loss"}, 7: {"without_rtk_fixed"}, 12: {"disk_low"}},
    )
    lights = [segment.light(StreetQualityConfig()) for segment in book.driven()]
    assert lights == [RED, AMBER, GREEN, GREEN]
    assert [segment.length for segment in book.driven()] == [25.0] * 4
    assert book.driven()[0].reasons(StreetQualityConfig()) == ["packet_loss"]
    assert book.counts() == {GREEN: 2, AMBER: 1, RED: 1}


def test_a_fault_of_a_moment_stains_its_segment_and_a_short_one_does_not() -> None:
    book = StreetQuality(StreetQualityConfig(min_share=0.5))
    drive(book, street(length=20), 0.0, {1: {"packet_loss"}})
    assert book.driven()[0].light(StreetQualityConfig(min_share=0.5)) == GREEN
    book.take(TimedPosition(START_NS + 5 * SECOND, 0.0, 22.0), set(), {"clock_step"})
    assert book.driven()[0].light(StreetQualityConfig()) == RED


def test_a_red_street_is_to_be_driven_again_until_it_was() -> None:
    book = StreetQuality(StreetQualityConfig())
    drive(book, street(), 0.0, {k: {"lidar_silent"} for k in range(6, 10)})
    assert len(book.again()) == 1
    drive(book, np.column_stack([np.linspace(0, 60, 13), np.full(13, 100.0)]), 30.0)
    drive(book, street(east=60.0)[::-1], 50.0)
    assert len(book.again()) == 1  # the next street does not count
    drive(book, street(east=3.0), 90.0)
    assert book.again() == []


def test_what_of_a_route_is_undriven_and_what_was_driven_badly() -> None:
    book = StreetQuality(StreetQualityConfig())
    drive(book, street(), 0.0, {k: {"without_rtk_fixed"} for k in range(11, 22)})
    route = np.array([[2.0, 0.0], [2.0, 100.0], [200.0, 100.0]])
    pieces = book.route_pieces(route)
    lights = [light for _, light in pieces]
    assert lights[:4] == [GREEN, GREEN, AMBER, AMBER]
    assert set(lights[4:]) == {UNDRIVEN}
    length = sum(np.linalg.norm(np.diff(piece, axis=0), axis=1).sum() for piece, _ in pieces)
    assert length == pytest.approx(298.0)


def test_geojson_holds_lines_in_degrees_with_light_and_reasons(tmp_path: Path) -> None:
    monitor, _ = watched(Drive(duration=20.0, muted={"lidar": [(5.0, 12.0)]}))
    frame = monitor.positions.frame
    assert frame is not None
    route = HOME.to_geodetic([[0, 0, 0], [0, 400, 0]])[:, :2]
    write_geojson(tmp_path / "q.geojson", monitor.streets.geojson(frame, route_enu([route], frame)))
    features = json.loads((tmp_path / "q.geojson").read_text())["features"]
    driven = [f for f in features if f["properties"]["kind"] == "driven"]
    assert {f["geometry"]["type"] for f in features} == {"LineString"}
    red = [f for f in driven if f["properties"]["light"] == RED]
    assert 2 <= len(red) <= 4  # 56 of 160 m
    assert all(f["properties"]["reasons"] == ["lidar_silent"] and f["properties"]["drive_again"] for f in red)
    longitude, latitude = driven[0]["geometry"]["coordinates"][0]
    assert (latitude, longitude) == pytest.approx((-31.95, 115.83), abs=1e-6)
    undriven = [f for f in features if f["properties"]["light"] == UNDRIVEN]
    assert sum(f["properties"]["length_m"] for f in undriven) == pytest.approx(400 - 160, abs=30)
    assert [p.name for p in tmp_path.iterdir()] == ["q.geojson"]


def test_odometry_carries_on_where_fixes_end() -> None:
    """The odometry runs along its own x axis; the street runs north."""
    monitor, _ = watched(Drive(duration=30.0, muted={"gnss": [(10.0, 30.0)]}))
    last = monitor.streets.segments[-1].way[-1]
    assert last == pytest.approx((0.0, 8.0 * 29.9), abs=2.0)
    lights = [segment.light(StreetQualityConfig()) for segment in monitor.streets.driven()]
    assert lights[0] == GREEN
    assert lights[-1] == AMBER


def test_without_a_first_fix_there_is_no_place() -> None:
    positions = Positions()
    assert positions.on_odometry(np.zeros(3), START_NS) is None
    assert positions.frame is None


@given(st.floats(-3.1, 3.1), st.integers(3, 30))
def test_the_turn_between_two_tracks_is_found(yaw: float, count: int) -> None:
    rng = np.random.default_rng(count)
    source = rng.uniform(-50, 50, (count, 2))
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    np.testing.assert_allclose(planar_turn(source, source @ turn.T + [3.0, -4.0]), turn, atol=1e-9)


@given(st.integers(2, 12), st.floats(1.0, 80.0))
def test_a_cut_line_keeps_its_length_and_its_ends(count: int, step: float) -> None:
    line = np.cumsum(np.random.default_rng(count).uniform(-40, 40, (count, 2)), axis=0)
    pieces = cut_line(line, step)
    lengths = [np.linalg.norm(np.diff(piece, axis=0), axis=1).sum() for piece in pieces]
    assert sum(lengths) == pytest.approx(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    np.testing.assert_allclose([pieces[0][0], pieces[-1][-1]], [line[0], line[-1]], atol=1e-9)


LINE = [[115.83, -31.95], [115.84, -31.95, 12.0]]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("r.geojson", json.dumps({"type": "LineString", "coordinates": LINE})),
        ("r.json", json.dumps({"type": "FeatureCollection", "features": [
            {"type": "Feature", "geometry": {"type": "MultiLineString", "coordinates": [LINE]}},
            {"type": "Feature", "geometry": {"type": "Point", "coordinates": [0, 0]}}]})),
        ("r.csv", "name,Latitude,Longitude\na,-31.95,115.83\nb,-31.95,115.84\n"),
    ],
)  # fmt: skip
def test_routes_are_read_from_geojson_and_csv(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    (line,) = read_route(tmp_path / name)
    np.testing.assert_allclose(line, [[-31.95, 115.83], [-31.95, 115.84]])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("r.csv", "a,b\n1,2\n3,4\n"),
        ("r.geojson", "{"),
        ("r.geojson", '{"type": "Point", "coordinates": [1, 2]}'),
        ("r.csv", "lat,lon\n391000,6465000\n391100,6465000\n"),
    ],
)
def test_a_route_that_is_none_is_refused_in_one_line(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=name):
        read_route(tmp_path / name)
