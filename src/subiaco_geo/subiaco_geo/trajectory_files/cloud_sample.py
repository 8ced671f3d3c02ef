"""A sample of a cloud file with the GPS times of its points, against which a trajectory is tested."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np

from subiaco_geo.cloud_parts import cloud_parts
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints

_SAMPLE = 100_000  # points
_PART = 1 << 20
_TIME = "gps_time"
_ADJUSTED = 1e9  # what LAS takes off GPS seconds [s]


@dataclass(frozen=True)
class CloudSample:
    """Some points of a cloud, and when all of its points were measured.

    Parameters
    ----------
    world : (M, 3) float64
        In the CRS of the cloud [m].
    times : (M,) float64, optional
        GPS seconds since 1980, or of the week; None where the points have no times.
    seconds : (S,) int64
        Whole seconds in which any point was measured, sorted.
    of_week : bool
        Whether these are seconds of the week.
    """

    world: Floats
    times: Floats | None
    seconds: Ints
    of_week: bool


def has_times(path: Path) -> bool:
    """Tell whether a LAS or LAZ file has a dimension of GPS times."""
    if path.suffix.lower() not in (".las", ".laz"):
        return False
    try:
        with laspy.open(path) as reader:
            return _TIME in set(reader.header.point_format.dimension_names)
    except Exception as error:  # laspy raises many kinds
        said = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: cut or not a LAS/LAZ file ({said}); copy or export it again") from error


def sample_cloud(path: Path) -> CloudSample:
    """Read a sample of a cloud file, part by part.

    Raises
    ------
    InputError
        As :func:`subiaco_geo.cloud_io.read_cloud`.
    """
    timed = has_times(path)
    of_week = timed and _of_week(path)
    worlds, times, seconds = [], [], [np.zeros(0, dtype=np.int64)]
    step = _step(path)
    for part in cloud_parts(path, (_TIME,) if timed else (), _PART):
        worlds.append(part.world()[::step])
        if timed:
            stamps = np.asarray(part.fields[_TIME], dtype=np.float64)
            stamps = stamps if of_week else stamps + _ADJUSTED
            times.append(stamps[::step])
            finite = stamps[np.isfinite(stamps) & (np.abs(stamps) < 1e11)]
            seconds.append(np.unique(np.floor(finite).astype(np.int64)))
    world = np.concatenate(worlds)
    known = np.unique(np.concatenate(seconds))
    if not timed or len(known) < 2:  # all equal: the dimension is there, and empty
        return CloudSample(world, None, np.zeros(0, dtype=np.int64), of_week=False)
    return CloudSample(world, np.concatenate(times), known, of_week)


def _of_week(path: Path) -> bool:
    with laspy.open(path) as reader:
        return reader.header.global_encoding.gps_time_type == laspy.header.GpsTimeType.WEEK_TIME


def _step(path: Path) -> int:
    """Return how many points one of the sample stands for; files that do not say are small enough."""
    if path.suffix.lower() not in (".las", ".laz"):
        return max(1, path.stat().st_size // (20 * _SAMPLE))
    with laspy.open(path) as reader:
        return max(1, int(reader.header.point_count) // _SAMPLE)
