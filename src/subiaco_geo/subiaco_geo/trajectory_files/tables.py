"""Tables of poses with named columns: commas, semicolons, tabs or blanks between the cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from subiaco_geo.errors import InputError, reason_of
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.trajectories import parse_seconds
from subiaco_geo.trajectory_files.attitude import rotation_from_enu, rotation_from_ned
from subiaco_geo.trajectory_files.formats import Clock, RecordedPath, TrajectoryFormat

_COMMENTS = "#%"
_DELIMITERS = ",;\t"


@dataclass(frozen=True)
class _Table:
    """Cells by row, their lines in the file, and the names of the columns."""

    path: Path
    names: tuple[str, ...]
    numbers: list[int]
    rows: list[list[str]]

    def find(self, wanted: Sequence[str]) -> int | None:
        """Return the position of the first of some names, None where there is none."""
        plain = [name.lower() for name in self.names]
        short = [name.split("(")[0].split("[")[0].strip() for name in plain]
        for name in wanted:
            for listed in (plain, short):
                if name.lower() in listed:
                    return listed.index(name.lower())
        return None

    def cells(self, column: int) -> list[str]:
        """Return the cells of a column."""
        return [row[column] for row in self.rows]

    def values(self, column: int) -> Floats:
        """Return the numbers (N,) of a column."""
        try:
            found = np.array(self.cells(column), dtype=np.float64)
        except ValueError:
            found = np.array([_number(cell) for cell in self.cells(column)])
        bad = np.flatnonzero(~np.isfinite(found))
        if len(bad):
            raise InputError(
                f"{self.path}:{self.numbers[bad[0]]}: column {self.names[column]} holds "
                f"{self.rows[bad[0]][column][:40]!r}, not a number; correct or remove the row"
            )
        return found


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def first_row(path: Path) -> str:
    """Return the first line of a text file that is no comment, empty where there is none.

    Raises
    ------
    InputError
        The file cannot be read, or is no text.
    """
    try:
        with path.open(encoding="utf-8-sig") as stream:
            lines = (line.strip() for line in stream)
            return next((line for line in lines if line and line[0] not in _COMMENTS), "")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: no poses could be read ({reason_of(error)}); give a text file of poses, or .sbet"
        ) from error


def read_table(path: Path, form: TrajectoryFormat, group: str) -> RecordedPath:
    """Read a table of poses.

    Parameters
    ----------
    path : Path
    form : TrajectoryFormat
    group : str
        Settings that errors name, such as ``trajectories.before``.

    Raises
    ------
    InputError
        Not a table, a column that is missing, a cell that is no number, or times that go back.
    """
    table = _open_table(path, group)
    names = form.columns
    time = _needed(table, "time", names.time, group)
    times_ns, clock = _times(table, time, form)
    back = np.flatnonzero(np.diff(times_ns) <= 0)
    if len(back):
        raise InputError(
            f"{path}:{table.numbers[back[0] + 1]}: column {table.names[time]}: time does not increase; sort "
            "the rows by time"
        )
    positions, geographic = _positions(table, form, group)
    return RecordedPath(times_ns, clock, positions, geographic, _rotations(table, form, group))


def _open_table(path: Path, group: str) -> _Table:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: no poses could be read ({reason_of(error)}); give a text file of poses, or .sbet"
        ) from error
    written = [(number, line.strip()) for number, line in enumerate(lines, 1) if line.strip()]
    comments = [line for _, line in written if line[0] in _COMMENTS]
    plain = [(number, line) for number, line in written if line[0] not in _COMMENTS]
    if not plain:
        raise InputError(f"{path}: no poses in it; give a table with a line of column names")
    delimiter = next((letter for letter in _DELIMITERS if letter in plain[-1][1]), None)
    names = _cells(plain[0][1], delimiter)
    if np.isfinite(_number(names[0])):  # numbers from the first line on: the names are in a comment
        above = comments[-1].lstrip(_COMMENTS).strip() if comments else ""
        names = _cells(above, delimiter if delimiter is None or delimiter in above else None) if above else []
    else:
        plain = plain[1:]
    rows = [_cells(line, delimiter) for _, line in plain]
    numbers = [number for number, _ in plain]
    if not names or not rows:
        raise InputError(
            f"{path}: no line of column names above the poses; name the columns in it, or state the format "
            f"with {group}.kind"
        )
    short = next((k for k, row in enumerate(rows) if len(row) < len(names)), None)
    if short is not None:
        raise InputError(
            f"{path}:{numbers[short]}: {len(rows[short])} cells for {len(names)} columns; correct the row"
        )
    return _Table(path, tuple(names), numbers, rows)


def _cells(line: str, delimiter: str | None) -> list[str]:
    return [cell.strip().strip('"') for cell in line.split(delimiter)]


def _needed(table: _Table, what: str, names: Sequence[str], group: str) -> int:
    found = table.find(names)
    if found is None:
        listed = ", ".join(table.names)[:200]
        raise InputError(
            f"{table.path}: no column of the {what} (it has {listed}); name yours with "
            f"--set {group}.columns.{what}=[COLUMN]"
        )
    return found


def _times(table: _Table, column: int, form: TrajectoryFormat) -> tuple[Ints, Clock]:
    found = np.zeros(len(table.rows), dtype=np.int64)
    dated = False
    for place, cell in enumerate(table.cells(column)):
        try:
            if any(letter in cell[1:] for letter in "-:T") and "e" not in cell.lower():
                found[place], dated = _date_ns(cell), True
            else:
                found[place] = parse_seconds(cell)
        except (ValueError, OverflowError) as error:
            raise InputError(
                f"{table.path}:{table.numbers[place]}: column {table.names[column]}: {error}; correct the row"
            ) from error
    gps = form.clock == "gps" or (form.clock == "auto" and table.names[column].lower().startswith("gps"))
    if dated:
        return found - (form.leap_seconds * 10**9 if form.clock == "gps" else 0), "utc"
    return found, "gps" if gps else "utc"


def _date_ns(text: str) -> int:
    stamp = datetime.fromisoformat(text)
    since = (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)) - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86400 + since.seconds) * 10**9 + since.microseconds * 1000


def _positions(table: _Table, form: TrajectoryFormat, group: str) -> tuple[Floats, bool]:
    names = form.columns
    latitude, longitude = table.find(names.latitude), table.find(names.longitude)
    height = _needed(table, "height", names.height, group)
    if latitude is None or longitude is None:
        east = _needed(table, "east", names.east, group)
        north = _needed(table, "north", names.north, group)
        return np.column_stack([table.values(c) for c in (east, north, height)]), False
    found = np.column_stack([table.values(c) for c in (latitude, longitude, height)])
    bad = np.flatnonzero((np.abs(found[:, 0]) > 90.0) | (np.abs(found[:, 1]) > 360.0))
    if len(bad):
        raise InputError(
            f"{table.path}:{table.numbers[bad[0]]}: latitude {found[bad[0], 0]:g}, longitude "
            f"{found[bad[0], 1]:g} are no degrees; name other columns with --set {group}.columns.latitude="
        )
    return found, True


def _rotations(table: _Table, form: TrajectoryFormat, group: str) -> Floats | None:
    names = form.columns
    parts = [table.find((name,)) for name in names.quaternion]
    found = [part for part in parts if part is not None]
    if len(found) == len(parts):
        quaternion = np.column_stack([table.values(part) for part in found])
        zero = np.flatnonzero(np.linalg.norm(quaternion, axis=1) < 1e-6)
        if len(zero):
            raise InputError(
                f"{table.path}:{table.numbers[zero[0]]}: the quaternion is zero; export it again"
            )
        return np.asarray(Rotation.from_quat(quaternion).as_matrix())
    heading, yaw = table.find(names.heading), table.find(names.yaw)
    turned = heading if form.attitude == "ned" or (form.attitude == "auto" and heading is not None) else yaw
    turned = turned if turned is not None else (heading if yaw is None else yaw)
    if turned is None:
        if form.attitude != "auto":
            _needed(table, "heading" if form.attitude == "ned" else "yaw", (), group)
        return None
    ned = form.attitude == "ned" or (form.attitude == "auto" and turned == heading)
    scale = np.pi / 180.0 if form.angles == "deg" else 1.0
    level = np.zeros(len(table.rows))
    roll, pitch = (
        level if column is None else scale * table.values(column)
        for column in (table.find(names.roll), table.find(names.pitch))
    )
    turn = scale * table.values(turned)
    return rotation_from_ned(roll, pitch, turn) if ned else rotation_from_enu(roll, pitch, turn)
