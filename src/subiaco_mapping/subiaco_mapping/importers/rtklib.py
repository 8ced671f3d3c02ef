"""Solutions of RTKLIB (``.pos``) to fixes; see :mod:`subiaco_geo.trajectory_files.rtklib`."""

from __future__ import annotations

from pathlib import Path

from subiaco_geo.trajectory_files.rtklib import read_solution
from subiaco_mapping.importers.bag_messages import LogMessage, fix_message

#: Quality to our states: 2 RTK fixed, 1 float, 0 single and differential.
STATES = {1: 2, 2: 1, 3: 0, 4: 0, 5: 0, 6: 0}


def read_pos(path: Path, leap_seconds: int) -> list[LogMessage]:
    """Return the fixes of a solution in time order.

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
    return [
        fix_message(row.time_ns, row.place, row.covariance, STATES.get(row.quality, -1), known=row.known)
        for row in read_solution(path, leap_seconds)
    ]
