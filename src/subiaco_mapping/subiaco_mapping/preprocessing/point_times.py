"""Times of the points of a cloud, in any unit of its driver.

Velodyne's ``time`` is float32 seconds since (or before) the header, Ouster's ``t`` and Livox's
``offset_time`` uint32 nanoseconds, Hesai's and RoboSense's ``timestamp`` float64 seconds since 1970, Livox's
float64 nanoseconds since 1970; others count milli- or microseconds. A sweep lasts a fraction of a second,
and that tells the unit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Ints
from subiaco_geo.topics import POINTS
from subiaco_mapping.method_numbers import NUMBERS

TIME_FIELDS = ("t", "time", "timestamp", "time_stamp", "offset_time", "timeStamp")
#: Nanoseconds of each unit, the likelier one first: integers mostly count nanoseconds, floats seconds.
_UNITS_INTEGER = (1, 10**3, 10**6, 10**9)
_UNITS_FLOAT = (10**9, 10**6, 10**3, 1)
_SWEEP_NS = (300_000, 2_000_000_000)  # shortest (one packet) and longest cloud
_ABSOLUTE_NS = 10**17  # later than 1973: counted from 1970, not from the header
_FEW = NUMBERS.preprocessing.timed_points


def point_times(points: NDArray[np.void], header_ns: int, valid: NDArray[np.bool_]) -> Ints | None:
    """Return the time of every point (N,) [ns].

    Parameters
    ----------
    points : (N,) structured
    header_ns : int
        Stamp of the message, from where times that are not absolute count.
    valid : (N,) bool
        Points with coordinates; the others often have no time either.

    Returns
    -------
    (N,) int64 or None
        None where no field holds times.

    Raises
    ------
    InputError
        The field's values are no times of one sweep in any unit, or the same for all points.
    """
    name = next((field for field in TIME_FIELDS if field in (points.dtype.names or ())), None)
    if name is None:
        return None
    values = points[name]
    unit = _unit_ns(name, values[valid])
    times = _in_ns(values, unit)
    middle = int(np.median(times[valid])) if valid.any() else 0
    return times if middle > _ABSOLUTE_NS else times + header_ns


def _unit_ns(name: str, values: NDArray[Any]) -> int:
    """Return the unit [ns] in which the values (N,) last as long as a sweep."""
    whole = np.issubdtype(values.dtype, np.integer)
    units = _UNITS_INTEGER if whole else _UNITS_FLOAT
    usual = [unit for unit in units if _is_date(values, unit)] or [units[0]]
    if len(values) < _FEW:
        return usual[0]
    low, high = np.quantile(values.astype(np.float64), [0.005, 0.995])
    lasts = float(high - low)
    if lasts == 0.0:
        raise InputError(
            f"{POINTS}: field {name} is the same for all points of a cloud; let the driver write point "
            "times, or set deskewed: true if the clouds are already motion-compensated"
        )
    for unit in units:
        if _SWEEP_NS[0] <= lasts * unit <= _SWEEP_NS[1]:
            return unit
    raise InputError(
        f"{POINTS}: field {name} spans {lasts:g} in one cloud, which is no sweep in s, ms, us or ns; "
        "let the driver write float64 or uint32 point times"
    )


def _is_date(values: NDArray[Any], unit: int) -> bool:
    """Whether the values are of these decades if counted from 1970 in a unit."""
    if len(values) == 0:
        return False
    return bool(_ABSOLUTE_NS < float(np.median(values)) * unit < 5 * 10**18)


def _in_ns(values: NDArray[Any], unit: int) -> Ints:
    """Return values (N,) of a unit in nanoseconds, absolute seconds without loss; what is not finite is 0."""
    if np.issubdtype(values.dtype, np.integer):
        return np.asarray(values.astype(np.int64) * unit)
    finite = np.where(np.isfinite(values), values, 0).astype(np.float64)
    whole = np.floor(finite)
    return np.asarray(whole.astype(np.int64) * unit + np.round((finite - whole) * unit).astype(np.int64))
