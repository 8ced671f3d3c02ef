"""A descriptor of the surroundings that turns with the vehicle: highest points over a polar grid.

After the idea of Scan Context (Kim and Kim, IROS 2018), in our own implementation: levelled submaps
instead of single scans; all turns at once by FFT, so that a street driven the other way (180 degrees) is
found; and a view from either side lane, without which the other lane's drive is not (of 129 submaps of a
simulated block driven twice each way the best match was right for 68 without, 120 with it).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Floats
from subiaco_mapping.method_numbers import NUMBERS

RINGS, SECTORS = NUMBERS.loop_closure.rings, NUMBERS.loop_closure.sectors
LANE = NUMBERS.loop_closure.lane_offset
_LOWEST = NUMBERS.loop_closure.lowest_height

Spectrum = NDArray[np.complex128]


@dataclass(frozen=True)
class Descriptor:
    """Spectra along the sectors (RINGS, SECTORS // 2 + 1), of the place and from both side lanes."""

    place: Spectrum
    lanes: tuple[Spectrum, ...]


def heights(points: Floats, radius: float) -> Floats:
    """Return the highest point (RINGS, SECTORS) over a polar grid around the origin, 0 where empty [m]."""
    reach = np.hypot(points[:, 0], points[:, 1])
    chosen = reach < radius
    x, y, z = points[chosen].T
    ring = (reach[chosen] * (RINGS / radius)).astype(np.int64)
    sector = ((np.arctan2(y, x) + np.pi) * (SECTORS / (2 * np.pi))).astype(np.int64) % SECTORS
    found = np.zeros(RINGS * SECTORS)
    np.maximum.at(found, ring * SECTORS + sector, np.maximum(z - _LOWEST, 0.0))
    return found.reshape(RINGS, SECTORS)


def _spectrum(points: Floats, radius: float) -> Spectrum:
    grid = np.sqrt(heights(points, radius))
    grid -= grid.mean(axis=1, keepdims=True)
    return np.asarray(np.fft.rfft(grid / max(float(np.linalg.norm(grid)), 1e-9), axis=1))


def describe(points: Floats, radius: float) -> Descriptor:
    """Describe levelled points (N, 3), the sensor at the origin, x ahead, y left, z up [m]."""
    looks = [_spectrum(points + np.array([0.0, shift, 0.0]), radius) for shift in (0.0, -LANE, LANE)]
    return Descriptor(looks[0], tuple(looks))


def compare(one: Descriptor, others: list[Descriptor]) -> tuple[Floats, Floats]:
    """Compare a descriptor with others, over every turn and lane.

    Returns
    -------
    distance : (N,) float64
        1 - correlation at the best turn, 0 to 2.
    yaw : (N,) float64
        Turn about z that brings the other's points to the one's axes [rad], in steps of a sector.
    """
    if not others:
        return np.zeros(0), np.zeros(0)
    spectra = np.stack([other.place for other in others]).conj()
    alike = [np.fft.irfft(np.einsum("rf,nrf->nf", lane, spectra), n=SECTORS, axis=1) for lane in one.lanes]
    best = np.maximum.reduce(alike)
    turn = best.argmax(axis=1)
    yaw = (turn * (2 * np.pi / SECTORS) + np.pi) % (2 * np.pi) - np.pi
    return 1.0 - best[np.arange(len(others)), turn], yaw
