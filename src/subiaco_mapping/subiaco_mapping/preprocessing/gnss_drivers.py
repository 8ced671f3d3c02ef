"""Meaning of the status of a NavSatFix, by driver.

Read in the sources of the drivers: ublox (``ublox_gps``) says 2 for carrier phase fixed and 0 for
float and single alike; ``nmea_navsat_driver`` says 2 for fixed and float alike and 1 for DGPS;
``septentrio_gnss_driver`` says 2 for fixed, float, DGPS and PPP. Where the status cannot tell, the
stated covariance does.
"""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np

from subiaco_geo.frames import Floats

FIXED, FLOAT, SINGLE, NONE = 2, 1, 0, -1

DriverName = Literal["subiaco", "ublox", "nmea", "septentrio", "covariance"]

#: Best state that each status can mean, and whether the covariance may say less.
_HABITS: dict[str, dict[int, tuple[int, bool]]] = {
    "subiaco": {2: (FIXED, False), 1: (FLOAT, False), 0: (SINGLE, False)},
    "ublox": {2: (FIXED, False), 1: (FLOAT, True), 0: (FLOAT, True)},
    "nmea": {2: (FIXED, True), 1: (SINGLE, False), 0: (SINGLE, False)},
    "septentrio": {2: (FIXED, True), 1: (SINGLE, False), 0: (SINGLE, False)},
    "covariance": {2: (FIXED, True), 1: (FIXED, True), 0: (FIXED, True)},
}


class StatusReading(Protocol):
    """Settings that say what the status of a fix means: the driver, and the limits of :func:`rtk_state`."""

    @property
    def driver(self) -> DriverName:
        """Driver that sends the fixes."""

    @property
    def fixed_below(self) -> float:
        """Horizontal standard deviation below which a fix counts as fixed [m]."""

    @property
    def float_below(self) -> float:
        """Horizontal standard deviation below which a fix counts as float [m]."""


def rtk_state(
    status: int,
    covariance: Floats,
    covariance_type: int,
    driver: DriverName,
    fixed_below: float,
    float_below: float,
) -> int:
    """Return 2 RTK fixed, 1 float, 0 single, or the negative status that says that there is no fix.

    Parameters
    ----------
    status : int
        As the driver gave it.
    covariance : (3, 3) float64
        East, north, up [m2].
    covariance_type : int
        Of the message; 0 is unknown, and then the status alone decides for the worst it can mean.
    driver : str
    fixed_below, float_below : float
        Horizontal standard deviation below which a solution counts as fixed, as float [m].
    """
    if status < 0:
        return status
    best, ask = _HABITS[driver][min(status, 2)]
    if not ask:
        return best
    variance = float(max(covariance[0, 0], covariance[1, 1]))
    if covariance_type == 0 or not np.isfinite(variance) or variance <= 0:
        return SINGLE
    sigma = variance**0.5
    stated = FIXED if sigma < fixed_below else FLOAT if sigma < float_below else SINGLE
    return min(best, stated)
