"""Solutions of RTKLIB (``.pos``) as rows.

Its quality is not NMEA's: 1 fixed, 2 float, 3 SBAS, 4 DGPS, 5 single, 6 PPP. Standard deviations of pairs of
axes carry the sign of their covariance. Times are GPST, UTC or JST, as the header says, as a date or as week
and seconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from subiaco_geo.errors import InputError, reason_of
from subiaco_geo.frames import Floats
from subiaco_geo.trajectory_files.formats import GPS_EPOCH_NS, WEEK_NS, RecordedPath

SUFFIX = ".pos"
_JST_NS = 9 * 3600 * 10**9
_NEEDED = ("latitude", "longitude", "height", "Q")
_VARIANCES = (("sdn", 1, 1), ("sde", 0, 0), ("sdu", 2, 2), ("sdne", 0, 1), ("sdeu", 0, 2), ("sdun", 1, 2))
_MOST_NS = 2**31 * 10**9


@dataclass(frozen=True)
class Solution:
    """One row of a solution.

    Parameters
    ----------
    time_ns : int
        UTC.
    place : (3,) float64
        Latitude, longitude [deg], ellipsoidal height [m].
    covariance : (3, 3) float64
        East, north, up [m2].
    quality : int
        As RTKLIB numbers it.
    known : bool
        Whether standard deviations were written.
    """

    time_ns: int
    place: Floats
    covariance: Floats
    quality: int
    known: bool


@dataclass(frozen=True)
class _Layout:
    """Names of the columns after the time, the time's system, and what parts a line."""

    names: tuple[str, ...]
    system: str
    comma: bool

    def split(self, line: str) -> list[str]:
        """Return the cells of a line."""
        return [cell.strip() for cell in line.split(",")] if self.comma else line.split()


def read_solution(path: Path, leap_seconds: int) -> list[Solution]:
    """Return the rows of a solution in time order.

    Parameters
    ----------
    path : Path
    leap_seconds : int
        GPS less UTC [s].

    Raises
    ------
    InputError
        No header, positions that are not latitude, longitude and ellipsoidal height in degrees, or a line
        that cannot be read.
    """
    found = []
    layout: _Layout | None = None
    for number, line in _lines(path):
        if line.startswith("%"):
            layout = _header(path, line, layout)
            continue
        if layout is None:
            raise InputError(f"{path}: no header line '%  GPST latitude(deg) ...'; save it with its header")
        try:
            found.append(_solution(layout, layout.split(line), leap_seconds))
        except (ValueError, IndexError, OverflowError) as error:
            raise InputError(f"{path}: line {number}: {error}; correct or remove it") from error
    if not found:
        raise InputError(f"{path}: no solution in it; check the processing in RTKLIB")
    return sorted(found, key=lambda solution: solution.time_ns)


def read_solution_path(path: Path, leap_seconds: int) -> RecordedPath:
    """Read a solution as a path: positions alone, one at a time.

    Raises
    ------
    InputError
        As :func:`read_solution`, or positions that are no numbers.
    """
    solutions = read_solution(path, leap_seconds)
    times_ns = np.array([solution.time_ns for solution in solutions], dtype=np.int64)
    positions = np.array([solution.place for solution in solutions])
    if not np.isfinite(positions).all() or np.any(np.abs(positions[:, 0]) > 90.0):
        raise InputError(f"{path}: a position is no latitude and longitude; correct or remove it")
    kept = np.concatenate([[True], np.diff(times_ns) > 0])
    return RecordedPath(times_ns[kept], "utc", positions[kept], geographic=True)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read as an RTKLIB solution ({reason_of(error)}); check the file"
        ) from error
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip():
            yield number, line.strip()


def _header(path: Path, line: str, layout: _Layout | None) -> _Layout | None:
    """Return the layout where a comment names the columns, else the one known before."""
    if "geodetic" in line.lower().split("lat/lon/height", 1)[-1][:20]:
        raise InputError(
            f"{path}: its heights are above the geoid; save the solution with ellipsoidal heights"
        )
    comma = "," in line and "Q=" not in line
    words = [word.strip() for word in line.lstrip("% ").split("," if comma else None)]
    if not words or words[0] not in ("GPST", "UTC", "JST"):
        return layout
    names = tuple(word.split("(")[0] for word in words[1:] if word)
    units = {word.split("(")[0]: word for word in words[1:]}
    missing = [name for name in _NEEDED if name not in names]
    if missing or "(deg)" not in units["latitude"]:
        wrong = missing[0] if missing else "latitude in degrees"
        raise InputError(f"{path}: no column {wrong}; save the solution as Lat/Lon/Height in decimal degrees")
    return _Layout(names, words[0], comma)


def _solution(layout: _Layout, cells: list[str], leap_seconds: int) -> Solution:
    time_ns = _time_ns(cells, layout.system, leap_seconds)
    row = dict(zip(layout.names, cells[2:], strict=False))
    values = {name: float(row[name]) for name in row if name in _NEEDED or name.startswith("sd")}
    if not set(_NEEDED) <= set(values):
        raise ValueError(f"{len(cells)} cells, {len(layout.names) + 2} are named")
    place = np.array([values["latitude"], values["longitude"], values["height"]])
    known = all(values.get(name, 0.0) > 0 for name in ("sdn", "sde", "sdu"))
    return Solution(time_ns, place, _covariance(values), int(values["Q"]), known)


def _covariance(values: dict[str, float]) -> Floats:
    """Return east, north, up (3, 3) [m2]; covariances only where they leave it positive."""
    found = np.zeros((3, 3))
    for name, row, column in _VARIANCES:
        sd = values.get(name, 0.0)
        found[row, column] = found[column, row] = sd * abs(sd)
    if not (np.isfinite(found).all() and np.linalg.eigvalsh(found)[0] > 0):
        return np.diag(np.diagonal(found))
    return found


def _time_ns(cells: list[str], system: str, leap_seconds: int) -> int:
    """Return UTC of ``2025/07/08 19:34:18.499`` or of ``2374 243258.499`` [ns]."""
    first, second = cells[0], cells[1]
    if "/" in first:
        clock, _, part = second.partition(".")
        stamp = datetime.strptime(f"{first} {clock}", "%Y/%m/%d %H:%M:%S").replace(tzinfo=UTC)
        since = stamp - datetime(1970, 1, 1, tzinfo=UTC)
        time_ns = since // timedelta(seconds=1) * 10**9 + int((part + "0" * 9)[:9])
    else:
        seconds, _, part = second.partition(".")
        time_ns = GPS_EPOCH_NS + int(first) * WEEK_NS + int(seconds) * 10**9 + int((part + "0" * 9)[:9])
    time_ns -= {"JST": _JST_NS, "GPST": leap_seconds * 10**9}.get(system, 0)
    if not 0 <= time_ns < _MOST_NS:
        raise ValueError(f"{time_ns} ns is no time between 1970 and 2038")
    return time_ns
