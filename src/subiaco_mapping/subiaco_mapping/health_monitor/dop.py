"""Dilution of precision from messages that carry it."""

from __future__ import annotations

import math
from typing import Any


def dop_of_gps_fix(message: Any) -> tuple[float, float]:
    """Return HDOP and PDOP of a gps_msgs/GPSFix (Septentrio, gpsd); 0 there means unknown."""
    return _known(message.hdop), _known(message.pdop)


def dop_of_nmea(sentence: str) -> tuple[float, float] | None:
    """Return HDOP and PDOP of an NMEA GGA or GSA sentence; None for any other, or a damaged one."""
    body, star, check = sentence.strip().partition("*")
    if not body.startswith("$") or (star and not _sum_fits(body[1:], check)):
        return None
    fields = body.split(",")
    try:
        if fields[0].endswith("GGA"):
            return _known(float(fields[8])), math.nan
        if fields[0].endswith("GSA"):
            return _known(float(fields[16])), _known(float(fields[15]))
    except (IndexError, ValueError):
        pass
    return None


def _known(value: float) -> float:
    return float(value) if 0.0 < value < 99.0 else math.nan


def _sum_fits(body: str, check: str) -> bool:
    total = 0
    for character in body:
        total ^= ord(character)
    try:
        return int(check[:2], 16) == total
    except ValueError:
        return False
