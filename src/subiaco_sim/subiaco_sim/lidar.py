"""A moving OS1-128: every column has its own time and pose; ranges, intensities, second returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from ouster.sdk.core import SensorInfo, XYZLut

from subiaco_geo.frames import Floats, Ints
from subiaco_sim.config import LidarConfig
from subiaco_sim.primitives import REFLECTIVITY, Material
from subiaco_sim.scene import Castable, Hits

SCAN_NS = 100_000_000
_STRENGTH = 56_000.0  # [m2]; a 10 % target across the beam returns half the time at 90 m
_SECOND_STEP = 0.25  # the sensor cannot part two returns nearer than this [m]


@dataclass(frozen=True)
class Beams:
    """Ray of every pixel: ``p_sensor = offset + range * direction`` (rows, columns, 3)."""

    direction: Floats
    offset: Floats


@dataclass(frozen=True)
class Return:
    """One return of a scan, (rows, columns); range 0 where there is none."""

    range_mm: NDArray[np.uint32]
    reflectivity: NDArray[np.uint8]
    signal: NDArray[np.uint16]
    object_id: Ints


@dataclass(frozen=True)
class SimulatedScan:
    """One revolution.

    ``T_enu_lidar`` (columns, 4, 4) holds the pose of every column.
    """

    frame_id: int
    times_ns: Ints
    T_enu_lidar: Floats
    first: Return
    second: Return | None


def beams_of(info: SensorInfo) -> Beams:
    """Return the rays of a sensor, from the same table that decoders use."""
    lut = XYZLut(info, False)
    shape = (info.h, info.w)
    near = np.asarray(lut(np.full(shape, 10_000, dtype=np.uint32)))
    far = np.asarray(lut(np.full(shape, 110_000, dtype=np.uint32)))
    direction = (far - near) / 100.0
    return Beams(direction, near - 10.0 * direction)


def column_times(start_ns: int, scan: int, columns: int) -> Ints:
    """Return the time of every column of a scan [ns], whole nanoseconds."""
    return start_ns + scan * SCAN_NS + np.arange(columns, dtype=np.int64) * SCAN_NS // columns


def points_of(beams: Beams, scan: SimulatedScan, ranges: Floats) -> Floats:
    """Return ENU points (rows, columns, 3) at given ranges [m]."""
    local = beams.offset + ranges[..., None] * beams.direction
    return turned(scan.T_enu_lidar, local) + scan.T_enu_lidar[:, :3, 3]


def turned(T_enu_lidar: Floats, vectors: Floats) -> Floats:
    """Rotate vectors (rows, columns, 3), each by the pose of its column (columns, 4, 4)."""
    by_column = np.matmul(T_enu_lidar[:, :3, :3], vectors.transpose(1, 2, 0))
    return np.ascontiguousarray(by_column.transpose(2, 0, 1))


def _spread(directions: Floats, sigma: float, rng: np.random.Generator) -> Floats:
    """Let the part of a beam that returns lie off its axis: at edges it belongs to either side."""
    off = directions + sigma * rng.standard_normal(directions.shape, dtype=np.float32)
    return np.asarray(off / np.linalg.norm(off, axis=1, keepdims=True))


class Lidar:
    """Casts scans into a compiled scene.

    Parameters
    ----------
    info : SensorInfo
    config : LidarConfig
    dual : bool
        Also give second returns.
    """

    def __init__(self, info: SensorInfo, config: LidarConfig, dual: bool) -> None:
        self.beams = beams_of(info)
        self._config = config
        self._dual = dual

    def scan(
        self,
        scene: Castable,
        frame_id: int,
        times_ns: Ints,
        T_enu_lidar: Floats,
        rng: np.random.Generator,
    ) -> SimulatedScan:
        """Simulate one revolution with a pose a column (columns, 4, 4)."""
        origins, directions = self._rays(T_enu_lidar)
        if self._config.divergence:
            directions = _spread(directions, self._config.divergence, rng)
        hits = scene.cast(origins, directions)
        first = self._measure(hits, hits.distance, rng)
        second = None
        if self._dual:
            second = self._second(scene, origins, directions, hits, first, rng)
        return SimulatedScan(frame_id, times_ns, T_enu_lidar, first, second)

    def _rays(self, T_enu_lidar: Floats) -> tuple[Floats, Floats]:
        directions = turned(T_enu_lidar, self.beams.direction)
        origins = turned(T_enu_lidar, self.beams.offset) + T_enu_lidar[:, :3, 3]
        return origins.reshape(-1, 3), directions.reshape(-1, 3)

    def _measure(self, hits: Hits, distance: Floats, rng: np.random.Generator) -> Return:
        """Turn true distances into what the sensor would report."""
        config = self._config
        found = np.isfinite(distance) & (distance < config.max_range) & (distance > config.min_range)
        metres = np.where(found, distance, 1.0)
        lambert = REFLECTIVITY[hits.material] * (0.03 + 0.97 * hits.cosine)
        chance = 1 - np.exp(-_STRENGTH * lambert / metres**2)
        draw = rng.random((3, len(distance)), dtype=np.float32)
        found &= (draw[0] > config.dropout) & (draw[1] < chance)
        found &= (hits.material != Material.GLASS) | (draw[2] < 0.5)
        swallowed = config.wet_road * (1.0 - hits.cosine)
        found &= (hits.material != Material.ASPHALT) | (draw[2] >= swallowed)
        sigma = config.range_sigma + config.range_sigma_slope * metres
        noisy = metres + sigma * rng.standard_normal(len(distance), dtype=np.float32)
        shape = self.beams.direction.shape[:2]
        signal = np.clip(3000.0 * lambert / (1 + (metres / 12.0) ** 2), 1, 65535)
        return Return(
            np.where(found, np.round(1000 * noisy), 0).astype(np.uint32).reshape(shape),
            np.where(found, np.clip(100 * lambert, 1, 255), 0).astype(np.uint8).reshape(shape),
            np.where(found, signal, 0).astype(np.uint16).reshape(shape),
            np.where(found, hits.object_id, -1).reshape(shape),
        )

    def _second(
        self,
        scene: Castable,
        origins: Floats,
        directions: Floats,
        hits: Hits,
        first: Return,
        rng: np.random.Generator,
    ) -> Return:
        """Let some beams that met a leaf go on to what lies behind it."""
        leafy = (hits.material == Material.LEAF) & (first.range_mm.ravel() > 0)
        through = np.flatnonzero(leafy & (rng.random(len(leafy)) < self._config.second_return))
        step = hits.distance[through] + _SECOND_STEP
        beyond = scene.cast(origins[through] + step[:, None] * directions[through], directions[through])
        full = Hits(
            np.full(len(leafy), np.inf),
            np.full(len(leafy), -1, dtype=np.int64),
            np.zeros(len(leafy), dtype=np.uint8),
            np.zeros(len(leafy)),
        )
        full.distance[through] = beyond.distance + step
        for name in ("object_id", "material", "cosine"):
            getattr(full, name)[through] = getattr(beyond, name)
        return self._measure(full, full.distance, rng)
