"""Surveyed control points as files hold them, in the CRS and the heights of a map."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from subiaco_geo.crs import transformer
from subiaco_geo.errors import InputError, reason_of
from subiaco_geo.frames import Floats
from subiaco_geo.geoid import undulations

SURVEYED = ("east", "north", "height")
PICKED = ("map_east", "map_north", "map_height")
_SIGMAS = ("sigma_h", "sigma_v")
_ALSO = {"easting": "east", "northing": "north", "rl": "height", "z": "height"}
#: What a point may be for: constraint, or check of the result.
ROLES = ("control", "check")


@dataclass(frozen=True)
class ControlPoints:
    """Surveyed points, in the CRS of the map.

    Parameters
    ----------
    names : tuple of str
    surveyed : (N, 3) float64
        East, north, ellipsoidal height [m].
    picked : (N, 3) float64
        Where a person found the points in the map [m]; NaN where nobody did.
    sigma : (N, 2) float64
        Horizontal and vertical standard deviation of the survey [m]; NaN where not stated.
    roles : tuple of str
        ``control``, ``check``, or empty where not stated.
    """

    names: tuple[str, ...]
    surveyed: Floats
    picked: Floats
    sigma: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    roles: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.sigma) != len(self.names):
            object.__setattr__(self, "sigma", np.full((len(self.names), 2), np.nan))
        if len(self.roles) != len(self.names):
            object.__setattr__(self, "roles", ("",) * len(self.names))

    def select(self, rows: list[int]) -> ControlPoints:
        """Return some of the points, in this order."""
        return ControlPoints(
            tuple(self.names[row] for row in rows),
            self.surveyed[rows],
            self.picked[rows],
            self.sigma[rows],
            tuple(self.roles[row] for row in rows),
        )


def read_control(
    path: Path, map_crs: str, crs: str | None = None, geoid_grid: Path | None = None
) -> ControlPoints:
    """Read ``name,east,north,height`` and what else is there.

    ``easting``, ``northing`` are known too; ``sigma_h``, ``sigma_v`` [m] and ``role`` are optional, and so
    are ``map_east,map_north,map_height`` where somebody found the point in the map. Files that separate
    cells by semicolons and write decimal commas, as some spreadsheets do, are read too.

    Parameters
    ----------
    path : Path
        CSV with a header line.
    map_crs : str
        CRS of the map.
    crs : str, optional
        CRS of the surveyed coordinates, that of the map where absent.
    geoid_grid : Path, optional
        Geoid model of the surveyed heights; without one they are ellipsoidal.

    Raises
    ------
    InputError
        A column or a number is missing, a role is unknown, a name is there twice, or PROJ cannot bring the
        points to the map.
    """
    rows = _rows(path)
    surveyed = _numbers(path, rows, SURVEYED)
    if not np.isfinite(surveyed).all():
        line = 2 + int(np.flatnonzero(~np.isfinite(surveyed).all(axis=1))[0])
        raise InputError(
            f"{path}: line {line}: a surveyed coordinate is missing; fill it in or drop the line"
        )
    if geoid_grid is not None:
        surveyed[:, 2] = surveyed[:, 2] + undulations(surveyed[:, :2], crs or map_crs, geoid_grid)
    if crs is not None:
        surveyed = transformer(crs, map_crs).apply(surveyed)
    sigma = _numbers(path, rows, _SIGMAS)
    wrong = np.flatnonzero((sigma <= 0).any(axis=1))
    if len(wrong):
        raise InputError(
            f"{path}: line {wrong[0] + 2}: a sigma is not above zero; give metres, or leave it out"
        )
    found = ControlPoints(
        tuple(row["name"].strip() for row in rows), surveyed, _numbers(path, rows, PICKED), sigma
    )
    return replace(found, roles=_roles(path, rows))


def _rows(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            first = stream.readline()
            semicolons = first.count(";") > first.count(",")
            stream.seek(0)
            raw = list(csv.DictReader(stream, delimiter=";" if semicolons else ","))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"{path}: cannot be read ({reason_of(error)}); give a CSV of control points"
        ) from error
    if not raw:
        raise InputError(f"{path}: holds no control points; give a CSV with {','.join(('name', *SURVEYED))}")
    names = {key: key.strip().lower() for key in raw[0] if key is not None}
    known = set(names.values())
    names = {key: name if _ALSO.get(name, name) in known - {name} else _ALSO.get(name, name)
             for key, name in names.items()}  # fmt: skip
    rows = [{names[key]: value or "" for key, value in row.items() if key in names} for row in raw]
    for column in ("name", *SURVEYED):
        if column not in rows[0]:
            raise InputError(f"{path}: column {column} is missing; expected name,{','.join(SURVEYED)}")
    if semicolons:  # then commas are decimal
        numbers = (*SURVEYED, *PICKED, *_SIGMAS)
        rows = [{k: v.replace(",", ".") if k in numbers else v for k, v in row.items()} for row in rows]
    seen: set[str] = set()
    for line, row in enumerate(rows, 2):
        if row["name"].strip() in seen:
            raise InputError(f"{path}: line {line}: point {row['name']!r} is there twice; rename one")
        seen.add(row["name"].strip())
    return rows


def _roles(path: Path, rows: list[dict[str, str]]) -> tuple[str, ...]:
    found = tuple(row.get("role", "").strip().lower() for row in rows)
    for line, role in enumerate(found, 2):
        if role not in ("", *ROLES):
            raise InputError(
                f"{path}: line {line}: role is {role!r}; give {' or '.join(ROLES)}, or leave it empty"
            )
    return found


def _numbers(path: Path, rows: list[dict[str, str]], columns: tuple[str, ...]) -> Floats:
    values = np.full((len(rows), len(columns)), np.nan)
    for line, row in enumerate(rows):
        for place, column in enumerate(columns):
            text = row.get(column, "").strip()
            try:
                values[line, place] = float(text) if text else np.nan
            except ValueError as error:
                raise InputError(f"{path}: line {line + 2}: {column} is {text!r}, not a number") from error
    return values


def split_roles(points: ControlPoints, every: int) -> ControlPoints:
    """Return the points with a role each; where none is stated, one in ``every`` is a check point.

    Fewer than four points without roles all constrain.
    """
    stated = any(points.roles)
    roles = []
    for row, role in enumerate(points.roles):
        held = not stated and len(points.names) > 3 and row % every == 1
        roles.append(role or ("check" if held else "control"))
    return replace(points, roles=tuple(roles))
