"""Fixes shaped like those of the drivers people have, read as what they mean."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from subiaco_mapping.pose_graph.config import GnssConfig
from subiaco_mapping.preprocessing.conversions import fix_from_msg
from subiaco_mapping.preprocessing.gnss_drivers import DriverName

UNKNOWN, APPROXIMATED, DIAGONAL, KNOWN = 0, 1, 2, 3


def message(status: int, sigma: float, kind: int, latitude: float = -31.95) -> Any:
    """Return a NavSatFix with a horizontal sigma [m] and a covariance type."""
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=1_760_000_000, nanosec=0), frame_id="gps"),
        status=SimpleNamespace(status=status, service=1),
        latitude=latitude,
        longitude=115.83,
        altitude=20.0,
        position_covariance=np.diag([sigma**2, sigma**2, (2 * sigma) ** 2]).ravel(),
        position_covariance_type=kind,
    )


def state(driver: DriverName, *given: Any) -> int:
    return fix_from_msg(message(*given), GnssConfig(driver=driver)).status


@pytest.mark.parametrize(
    ("sort", "given", "means"),
    [
        # ublox_gps: 2 only with a fixed carrier phase, 0 for all else; h_acc squared, diagonal known.
        ("fixed", (2, 0.014, DIAGONAL), 2),
        ("float", (0, 0.45, DIAGONAL), 1),
        ("single", (0, 2.1, DIAGONAL), 0),
        ("a lucky float is never fixed", (0, 0.08, DIAGONAL), 1),
        ("none", (-1, 99.0, DIAGONAL), -1),
    ],
)
def test_ublox(sort: str, given: tuple[Any, ...], means: int) -> None:
    assert state("ublox", *given) == means, sort


@pytest.mark.parametrize(
    ("sort", "given", "means"),
    [
        # nmea_navsat_driver: quality 4 and 5 are both 2, DGPS is 1; sigma: HDOP times a default, or GST.
        ("quality 4, HDOP 0.8", (2, 0.02 * 0.8, APPROXIMATED), 2),
        (
            "quality 5, HDOP 0.8: float, although its default sigma is that of a single fix",
            (2, 3.2, APPROXIMATED),
            0,
        ),
        ("quality 5 with GST", (2, 0.3, APPROXIMATED), 1),
        ("quality 2 (DGPS), default sigma 0.1 m x HDOP", (1, 0.09, APPROXIMATED), 0),
        ("quality 1", (0, 4.0, APPROXIMATED), 0),
        ("quality 0", (-1, 1e6, UNKNOWN), -1),
    ],
)
def test_nmea(sort: str, given: tuple[Any, ...], means: int) -> None:
    assert state("nmea", *given) == means, sort


@pytest.mark.parametrize(
    ("sort", "given", "means"),
    [
        # septentrio_gnss_driver: fixed, float, DGPS and PPP are all 2, SBAS is 1; covariance known.
        ("RTK fixed", (2, 0.012, KNOWN), 2),
        ("RTK float", (2, 0.6, KNOWN), 1),
        ("DGPS", (2, 1.8, KNOWN), 0),
        ("SBAS", (1, 0.9, KNOWN), 0),
        ("stand-alone", (0, 1.5, KNOWN), 0),
        ("no PVT", (-1, 0.0, UNKNOWN), -1),
    ],
)
def test_septentrio(sort: str, given: tuple[Any, ...], means: int) -> None:
    assert state("septentrio", *given) == means, sort


@pytest.mark.parametrize("status", [0, 1, 2])
def test_any_other_driver_is_judged_by_its_covariance_alone(status: int) -> None:
    assert [state("covariance", status, sigma, KNOWN) for sigma in (0.02, 0.5, 3.0)] == [2, 1, 0]
    for blank in (
        (status, 0.0, UNKNOWN),
        (status, 0.0, KNOWN),
        (status, math.nan, KNOWN),
        (status, 0.01, UNKNOWN),
    ):
        assert state("covariance", *blank) == 0, "nothing stated is never fixed"


def test_our_own_status_is_taken_at_its_word() -> None:
    assert [state("subiaco", status, 0.5, DIAGONAL) for status in (-2, -1, 0, 1, 2)] == [-2, -1, 0, 1, 2]


def test_do_not_use_values_of_a_receiver_are_no_fix() -> None:
    fix = fix_from_msg(message(0, 1.0, KNOWN, latitude=math.degrees(-2e10)), GnssConfig(driver="septentrio"))
    assert not fix.is_usable()
