"""Field of view and useful range of a sensor, as stated by a map or estimated from points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.free_space.azimuth_sector import Arcs
from subiaco_geo.free_space.numbers import FREE_SPACE

#: Entry of ``map.yaml``.
SENSOR = "sensor"
#: Of the entry: arcs of azimuths without beams, from the heading, first angle and extent [deg].
BLIND = "azimuth_blind_deg"
_FIELDS = ("elevation_min_deg", "elevation_max_deg", "useful_range_m")

_UPRIGHT = np.cos(np.radians(FREE_SPACE.spin_axis_deg))


@dataclass(frozen=True)
class SensorView:
    """Field of view about the spin axis of a LiDAR, and its useful range.

    Parameters
    ----------
    elevation_min, elevation_max : float
        Lowest and highest beam in the sensor's own axes [rad].
    useful_range : float
        So far an ordinary surface returns a beam [m].
    blind : tuple of (float, float)
        Arcs of azimuths into which no beam goes, from the heading of the vehicle
        (:func:`spin_headings`), counter-clockwise: first angle and extent [rad]. None where not known.
    """

    elevation_min: float
    elevation_max: float
    useful_range: float
    blind: Arcs | None = None

    def description(self) -> dict[str, Any]:
        """Return the entry ``sensor`` of ``map.yaml``."""
        low, high = np.degrees([self.elevation_min, self.elevation_max]).round(2).tolist()
        stated = dict(zip(_FIELDS, (low, high, round(float(self.useful_range), 1)), strict=True))
        if self.blind is None:
            return stated
        return {**stated, BLIND: np.degrees(np.reshape(self.blind, (-1, 2))).round(1).tolist()}


def described_view(info: Mapping[str, Any]) -> SensorView | None:
    """Read the entry ``sensor`` of ``map.yaml``; None where there is none.

    Raises
    ------
    InputError
        The entry lacks an angle or the range, or holds no numbers.

    Maps of earlier versions do not state blind azimuths.
    """
    entry = info.get(SENSOR)
    if entry is None:
        return None
    try:
        low, high, reach = (float(entry[name]) for name in _FIELDS)
    except (KeyError, TypeError, ValueError) as error:
        names = ", ".join(_FIELDS)
        raise InputError(f"map.yaml: sensor needs numbers for {names}; rebuild the map") from error
    if not (-90.0 <= low < high <= 90.0 and reach > 0):
        raise InputError(
            f"map.yaml: sensor covers {low} to {high} deg up to {reach} m, no field of view; rebuild the map"
        )
    return SensorView(
        float(np.radians(low)), float(np.radians(high)), reach, _described_arcs(entry.get(BLIND))
    )


def _described_arcs(stated: Any) -> Arcs | None:
    """Read blind azimuths of ``map.yaml`` [deg]; None where nothing is stated."""
    if stated is None:
        return None
    try:
        arcs = tuple((float(first), float(extent)) for first, extent in stated)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"map.yaml: sensor.{BLIND} needs pairs of a first angle and an extent; rebuild the map"
        ) from error
    if not all(np.isfinite(first) and 0.0 < extent <= 360.0 for first, extent in arcs):
        raise InputError(f"map.yaml: sensor.{BLIND} holds no arcs of azimuths; rebuild the map")
    return tuple((float(np.radians(first)), float(np.radians(extent))) for first, extent in arcs)


def spin_axes(rotations: Floats) -> Floats:
    """Return the spin axis (M, 3) of a sensor in the world, from its rotations (M, 3, 3).

    It is the body axis that is upright most of the way: programs differ in which one they call z, and some
    write the axes of a camera. Where none is upright the vertical stands in.
    """
    vertical = np.tile([0.0, 0.0, 1.0], (len(rotations), 1))
    if len(rotations) == 0:
        return vertical
    axis, mean = _upright_axis(rotations)
    if abs(mean) < _UPRIGHT:
        return vertical
    return np.ascontiguousarray(np.sign(mean) * rotations[:, :, axis])


def spin_headings(rotations: Floats) -> Floats:
    """Return the azimuth (M,) that a sensor faces in the world, from its rotations (M, 3, 3) [rad].

    It is that of the body axis that follows the upright one: x where z is upright, as vehicles have it, and z
    where y is, as cameras have it. Any axis that turns with the vehicle serves.
    """
    if len(rotations) == 0:
        return np.zeros(0)
    axis = rotations[:, :, (_upright_axis(rotations)[0] + 1) % 3]
    return np.asarray(np.arctan2(axis[:, 1], axis[:, 0]))


def upright_sense(rotations: Floats) -> int:
    """Return 1 where the z axis of a sensor points up most of the way, -1 where down, else 0.

    Azimuths about z of the sensor then run with those of the world, against them, or are none.
    """
    if len(rotations) == 0:
        return 0
    axis, mean = _upright_axis(rotations)
    return int(np.sign(mean)) if axis == 2 and abs(mean) >= _UPRIGHT else 0


def _upright_axis(rotations: Floats) -> tuple[int, float]:
    """Return the body axis that is upright most of the way, and its mean height as a ratio."""
    mean = rotations[:, 2, :].mean(axis=0)
    axis = int(np.argmax(np.abs(mean)))
    return axis, float(mean[axis])
