"""Shifts between geodetic frames that are mistaken for each other, such as GDA94 for GDA2020."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from pyproj.transformer import TransformerGroup

from subiaco_geo.crs import horizontal, require_map_crs
from subiaco_geo.crs_area import area_contains
from subiaco_geo.frames import Floats

#: Frames that are fixed to a plate; the first that covers a place is the frame of its plate.
_PLATE_FRAMES = (
    ("GDA2020", "EPSG:7843"),
    ("GDA94", "EPSG:4939"),
    ("ETRS89", "EPSG:4937"),
    ("NAD83(2011)", "EPSG:6319"),
)
#: The frame of positions worldwide (WGS 84 of a receiver today agrees with it to centimetres).
_WORLD_FRAME = ("ITRF2014", "EPSG:7912")
_ANY_YEAR = 2020.0  # between frames that do not move against each other the year does not matter


@dataclass(frozen=True)
class DatumShift:
    """Shift of a survey in the frame ``before`` to one in ``after``: ``vector`` (3,), axes of the map [m]."""

    before: str
    after: str
    vector: Floats

    @property
    def size(self) -> float:
        """Length of the vector [m]."""
        return float(np.linalg.norm(self.vector))


@lru_cache(maxsize=64)
def _operation(source: str, target: str) -> Transformer | None:
    """Return the best offline operation between two geodetic frames, None where PROJ has only a guess."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # better operations may need grids that are not here
        group = TransformerGroup(CRS(source), CRS(target), always_xy=True, allow_ballpark=False)
    usable = [t for t in group.transformers if "ballpark" not in t.description.lower()]
    return usable[0] if usable else None


def known_shifts(
    place: Floats, crs: str, years: Sequence[float | None] = (None, None)
) -> Iterator[DatumShift]:
    """Yield what *before* would have to move by if the surveys were in two frames of their place.

    Parameters
    ----------
    place : (3,) float64
        East, north, height in ``crs`` [m].
    crs : str
        Of the map.
    years : (float or None, float or None)
        Decimal years of *before* and *after*; the world frame needs them, because plates move.
    """
    flat = horizontal(require_map_crs(crs))
    geodetic = flat.geodetic_crs
    if geodetic is None:
        return
    projection = Transformer.from_crs(geodetic.to_3d(), flat.to_3d(), always_xy=True)
    lon, lat, height = projection.transform(place[0], place[1], place[2], direction="INVERSE")
    covering = [frame for frame in _PLATE_FRAMES if area_contains(CRS(frame[1]), lat, lon)]
    if not np.isfinite([lon, lat, height]).all() or not covering:
        return
    # Where the same numbers of every frame and year lie in the frame of the plate.
    base, lies = covering[0][1], dict[tuple[str, int], Floats]()
    for name, code in (*covering, _WORLD_FRAME):
        for end, year in enumerate(years):
            if name == _WORLD_FRAME[0] and year is None:
                continue
            moved = _moved(code, base, (lon, lat, height), year or _ANY_YEAR)
            if moved is not None:
                lies[name, end] = np.array(projection.transform(*moved))
    for (name, end), own in lies.items():
        for (other, side), theirs in lies.items():
            if end == 0 and side == 1 and (name != other or name == _WORLD_FRAME[0]):
                yield DatumShift(name, other, own - theirs)


def _moved(
    source: str, target: str, lon_lat_h: tuple[float, float, float], year: float
) -> tuple[float, float, float] | None:
    operation = _operation(source, target) if source != target else None
    if operation is None:
        return lon_lat_h if source == target else None
    try:
        x, y, z, _ = operation.transform(*lon_lat_h, year, errcheck=True)
    except ProjError:
        return None
    return (x, y, z) if np.isfinite([x, y, z]).all() else None


def likely_shift(
    shift: Floats,
    place: Floats,
    crs: str,
    years: Sequence[float | None] = (None, None),
    tolerance: float = 0.15,
) -> DatumShift | None:
    """Return the known shift nearest to a measured one (3,) [m], None where none is within a tolerance.

    The tolerance [m] is at most a third of the shift itself, so that no small shift is named.
    """
    near = [
        (float(np.linalg.norm(known.vector - shift)), number, known)
        for number, known in enumerate(known_shifts(place, crs, years))
    ]
    if not near:
        return None
    distance, _, found = min(near)
    return found if distance <= min(tolerance, found.size / 3.0) else None
