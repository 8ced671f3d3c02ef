"""A moving OS1: every column has its own time and pose; ranges, intensities, second returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from ouster.sdk.core import SensorInfo, XYZLut

from subiaco_geo.frames import Floats, Ints
from subiaco_sim.config import LidarConfig
from subiaco_sim.footprint import PARTING, Echoes, Neighbours, merge, nothing, whole
from subiaco_sim.primitives import REFLECTIVITY, Material
from subiaco_sim.scene import Castable, Hits

SCAN_NS = 100_000_000
_STRENGTH = 56_000.0  # [m2]; a 10 % target across the beam returns half the time at 90 m
_POROUS = (Material.LEAF, Material.WIRE)  # narrower than a beam: some of its light goes by


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
    """Let the part of a beam that returns lie off its axis."""
    off = directions + sigma * rng.standard_normal(directions.shape, dtype=np.float32)
    return np.asarray(off / np.linalg.norm(off, axis=1, keepdims=True))


def _lambert(hits: Hits) -> Floats:
    """Return the part of the light that comes back towards the sensor (N,)."""
    return np.asarray(REFLECTIVITY[hits.material] * (0.03 + 0.97 * hits.cosine))


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
        self._neighbours = Neighbours(self.beams.direction)
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
        origins, axes = self._rays(T_enu_lidar)
        first, second = self._echoes(scene, origins, axes, rng)
        found = self._measure(first, rng)
        if not self._dual:
            return SimulatedScan(frame_id, times_ns, T_enu_lidar, found, None)
        if self._config.second_return:
            self._go_by(scene, origins, axes, first, second, rng)
        return SimulatedScan(frame_id, times_ns, T_enu_lidar, found, self._measure(second, rng))

    def _rays(self, T_enu_lidar: Floats) -> tuple[Floats, Floats]:
        directions = turned(T_enu_lidar, self.beams.direction)
        origins = turned(T_enu_lidar, self.beams.offset) + T_enu_lidar[:, :3, 3]
        return origins.reshape(-1, 3), directions.reshape(-1, 3)

    def _echoes(
        self, scene: Castable, origins: Floats, axes: Floats, rng: np.random.Generator
    ) -> tuple[Echoes, Echoes]:
        """Return what the light of every beam meets: the stronger echo and, at edges, the other one."""
        spread = self._config.divergence or 0.0
        hits = scene.cast(origins, _spread(axes, spread, rng) if spread else axes)
        first, second = whole(hits), nothing(len(origins))
        if spread:
            edge = self._neighbours.at_edges(hits.distance.reshape(self.beams.direction.shape[:2]))
            beside = scene.cast(origins[edge], _spread(axes[edge], spread, rng))
            on_axis = hits.rows(edge)
            strength = (self._strength(on_axis), self._strength(beside))
            stronger, weaker = merge(on_axis, beside, strength, spread)
            first.put(edge, stronger)
            second.put(edge, weaker)
        return first, second

    def _strength(self, hits: Hits) -> Floats:
        reached = (hits.distance > self._config.min_range) & (hits.distance < self._config.max_range)
        return np.asarray(np.where(reached, _lambert(hits) / hits.distance**2, 0.0))

    def _measure(self, echoes: Echoes, rng: np.random.Generator) -> Return:
        """Turn true distances into what the sensor would report."""
        config, hits, distance = self._config, echoes.hits, echoes.hits.distance
        found = np.isfinite(distance) & (distance < config.max_range) & (distance > config.min_range)
        metres = np.where(found, distance, 1.0)
        light = echoes.share * _lambert(hits)
        chance = 1 - np.exp(-_STRENGTH * light / metres**2)
        draw = rng.random((3, len(distance)), dtype=np.float32)
        found &= (draw[0] > config.dropout) & (draw[1] < chance)
        found &= (hits.material != Material.GLASS) | (draw[2] >= config.glass)
        swallowed = config.wet_road * (1.0 - hits.cosine)
        found &= (hits.material != Material.ASPHALT) | (draw[2] >= swallowed)
        sigma = config.range_sigma + config.range_sigma_slope * metres
        noisy = metres + sigma * rng.standard_normal(len(distance), dtype=np.float32)
        shape = self.beams.direction.shape[:2]
        signal = np.clip(3000.0 * light / (1 + (metres / 12.0) ** 2), 1, 65535)
        return Return(
            np.where(found, np.round(1000 * noisy), 0).astype(np.uint32).reshape(shape),
            np.where(found, np.clip(100 * light, 1, 255), 0).astype(np.uint8).reshape(shape),
            np.where(found, signal, 0).astype(np.uint16).reshape(shape),
            np.where(found, hits.object_id, -1).reshape(shape),
        )

    def _go_by(
        self,
        scene: Castable,
        origins: Floats,
        axes: Floats,
        first: Echoes,
        second: Echoes,
        rng: np.random.Generator,
    ) -> None:
        """Let some beams that met a leaf or a wire, and nothing else yet, go on to what lies behind it."""
        open_ = np.isin(first.hits.material, _POROUS) & np.isfinite(first.hits.distance)
        open_ &= np.isinf(second.hits.distance) & (rng.random(len(open_)) < self._config.second_return)
        through = np.flatnonzero(open_)
        step = first.hits.distance[through] + PARTING
        beyond = scene.cast(origins[through] + step[:, None] * axes[through], axes[through])
        beyond.distance[:] += step
        second.put(through, whole(beyond))
        second.share[through] = 0.5
