"""Simulated streams of a drive, message by message, with faults as plain functions of time."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from ouster.sdk import core

from subiaco_geo.bags import packet_to_cdr
from subiaco_geo.crs import EnuFrame
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.health_monitor.monitor import Monitor, OdometryNote
from subiaco_mapping.measurements import GnssFix, ImuSample

START_NS = 1_760_000_000_000_000_000
HOME = EnuFrame(-31.95, 115.83, 20.0)
SPEED = 8.0
Clock = Callable[[float], float]
Span = tuple[float, float]


@cache
def small_sensor() -> core.SensorInfo:
    """A sensor of 16 beams, 512x10: 32 packets a turn."""
    from subiaco_sim.config import LidarMode
    from subiaco_sim.packets import sensor_info

    return sensor_info(LidarMode.COLUMNS_512, dual=False, beams=16)


def turn_packets(number: int, start_ns: int) -> list[bytes]:
    """Return the packets of one turn, as serialised messages."""
    info = small_sensor()
    frame = core.LidarFrame(info)
    frame.frame_id = number % 65536
    frame.timestamp[:] = start_ns + np.arange(512) * (100_000_000 // 512)
    frame.measurement_id[:] = np.arange(512)
    frame.status[:] = 1
    made = core.frame_to_packets(frame, core.PacketFormat(info), info.init_id, int(info.sn or 0))
    return [packet_to_cdr(bytes(packet.buf)) for packet in made]


def still(_seconds: float) -> float:
    return 0.0


@dataclass
class Drive:
    """A straight drive north. Times in seconds since the start.

    ``muted`` holds spans in which a sensor sends nothing; clocks add to true time [s]; delays are
    those of the drivers.
    """

    duration: float = 20.0
    muted: dict[str, list[Span]] = field(default_factory=dict)
    lidar_clock: Clock = still
    imu_clock: Clock = still
    gnss_clock: Clock = still
    host_clock: Clock = still
    packets: bool = False
    drop: Callable[[int], bool] = lambda _number: False
    status: Callable[[float], int] = lambda _seconds: 2
    sigma: float = 0.015
    accel: Callable[[float], np.ndarray] | None = None
    pps: bool = True
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(11))

    def _stream(self, name: str, period: float) -> Iterator[tuple[float, str]]:
        for k in range(int(self.duration / period)):
            seconds = k * period
            if not any(start <= seconds < stop for start, stop in self.muted.get(name, [])):
                yield seconds, name

    def run(self, monitor: Monitor, until: Callable[[float], None] = lambda _seconds: None) -> None:
        """Feed a monitor; ``until`` is called after every message with the time."""
        if self.packets:
            monitor.on_metadata(small_sensor().to_json_string())
        periods = {"lidar": 0.1, "imu": 0.01, "gnss": 0.2, "odometry": 0.1, "pps": 1.0, "tick": 0.1}
        if not self.pps:
            del periods["pps"]
        streams = [self._stream(name, period) for name, period in periods.items()]
        for seconds, name in heapq.merge(*streams):
            self._feed(monitor, name, seconds)
            until(seconds)

    def _times(self, seconds: float, clock: Clock, delay: float) -> tuple[int, int, int]:
        late = delay + float(self.rng.exponential(2e-4))
        now_ns = START_NS + int((seconds + late) * 1e9)
        arrival_ns = now_ns + int(self.host_clock(seconds) * 1e9)
        return START_NS + int((seconds + clock(seconds)) * 1e9), now_ns, arrival_ns

    def _feed(self, monitor: Monitor, name: str, seconds: float) -> None:
        if name == "tick":
            monitor.tick(START_NS + int(seconds * 1e9))
        elif name == "pps":
            monitor.on_time_reference(START_NS + int(seconds * 1e9))
        elif name == "lidar":
            self._feed_lidar(monitor, seconds)
        elif name == "imu":
            stamp_ns, now_ns, arrival_ns = self._times(seconds, self.imu_clock, 0.001)
            usual = np.array([0.02, 0.01, 9.81]) + self.rng.normal(0, 0.05, 3)
            accel = usual if self.accel is None else self.accel(seconds)
            monitor.on_imu(ImuSample(stamp_ns, self.rng.normal(0, 0.01, 3), accel), now_ns, arrival_ns)
        elif name == "gnss":
            stamp_ns, now_ns, arrival_ns = self._times(seconds, self.gnss_clock, 0.06)
            monitor.on_fix(self.fix(seconds, stamp_ns), now_ns, arrival_ns)
        else:
            now_ns = START_NS + int((seconds + 0.15) * 1e9)
            monitor.on_odometry(OdometryNote(np.array([SPEED * seconds, 0.0, 0.0])), now_ns)

    def _feed_lidar(self, monitor: Monitor, seconds: float) -> None:
        stamp_ns, now_ns, arrival_ns = self._times(seconds, self.lidar_clock, 0.0005)
        if not self.packets:
            monitor.on_points(stamp_ns, now_ns, arrival_ns)
            return
        turn = round(seconds * 10)
        for k, raw in enumerate(turn_packets(turn, stamp_ns)):
            after_ns = (k + 1) * 3_125_000
            if not self.drop(turn * 32 + k):
                monitor.on_packet(raw, now_ns + after_ns, arrival_ns + after_ns)

    def fix(self, seconds: float, stamp_ns: int) -> GnssFix:
        """Return the fix of a place on the way."""
        latitude, longitude, height = HOME.to_geodetic([[0.0, SPEED * seconds, 0.0]])[0]
        covariance = np.diag([self.sigma, self.sigma, 2 * self.sigma]) ** 2
        return GnssFix(stamp_ns, latitude, longitude, height, covariance, self.status(seconds))


def watched(
    drive: Drive, config: MappingConfig | None = None, *, host_clock: bool = True
) -> tuple[Monitor, dict[str, float]]:
    """Run a drive; return the monitor and when [s] each flag was first up."""
    monitor = Monitor(config or MappingConfig(), host_clock=host_clock)
    first: dict[str, float] = {}

    def note(seconds: float) -> None:
        for stretch in monitor.flags:
            first.setdefault(stretch.name, seconds)

    drive.run(monitor, note)
    return monitor, first
