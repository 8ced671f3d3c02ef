"""The health monitor: takes every message and keeps the list of present faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from subiaco_geo.frames import Floats
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.health_monitor.clocks import ClockWatch
from subiaco_mapping.health_monitor.flags import MEANINGS, FlagHistory
from subiaco_mapping.health_monitor.packets import LossWindow, PacketWatch
from subiaco_mapping.health_monitor.positions import Positions
from subiaco_mapping.health_monitor.sensors import DiskWatch, GnssWatch, ImuWatch
from subiaco_mapping.health_monitor.streams import StreamWatch
from subiaco_mapping.health_monitor.street_quality import StreetQuality
from subiaco_mapping.manifest import LEGEND
from subiaco_mapping.measurements import GnssFix, ImuSample
from subiaco_mapping.recording.losses import PacketHeaders

SENSORS = ("lidar", "imu", "gnss")
_TICK_NS = 100_000_000


@dataclass(frozen=True)
class OdometryNote:
    """What the odometry says of one scan: position (3,) in its frame [m], and how it came about."""

    xyz: Floats
    degenerate: bool = False
    predicted: bool = False
    segment: int = 0
    columns: int = 0
    lost_columns: int = 0


@dataclass
class _Odometry:
    """The newest of the odometry, and when."""

    note: OdometryNote | None = None
    way: float = 0.0
    poses: int = 0
    predicted: int = 0
    degenerate: int = 0
    segments: set[int] = field(default_factory=set)


class Monitor:
    """Watch the streams of one survey.

    Every message has two times: ``now_ns`` never jumps (a steady clock, or the time of a
    replay), ``arrival_ns`` is what the host's clock said. Stretches are in ``now_ns``.

    Parameters
    ----------
    config : MappingConfig
        ``watch`` and what decoding and the manifest hold about clocks and limits.
    host_clock : bool
        ``arrival_ns`` tells something about clocks: false where a player decides when messages arrive.
    """

    def __init__(self, config: MappingConfig, *, host_clock: bool = True) -> None:
        self.config = config
        self.host_clock = host_clock
        limits = config.watch.streams
        self.flags = FlagHistory(config.watch.join_ns)
        self.streams = {
            "lidar": StreamWatch(limits.lidar_silent_ns),
            "imu": StreamWatch(limits.imu_silent_ns),
            "gnss": StreamWatch(limits.gnss_silent_ns),
            "odometry": StreamWatch(limits.odometry_silent_ns),
            "pps": StreamWatch(config.watch.clocks.pps_silent_ns),
        }
        self.clocks = ClockWatch(config.watch.clocks)
        self.packets: PacketWatch | None = None
        self._headers = PacketHeaders()
        self.loss = LossWindow()
        self.imu = ImuWatch(config.watch.imu)
        self.gnss = GnssWatch(config.watch.gnss)
        self.disk = DiskWatch(config.watch.disk)
        self.positions = Positions()
        self.streets = StreetQuality(config.watch.quality)
        self.odometry = _Odometry()
        self.start_ns: int | None = None
        self.now_ns = 0
        self._ticked_ns = 0
        self._pps_unlocked = ""

    def on_metadata(self, text: str) -> None:
        """Take the LiDAR's metadata; a second time it is ignored."""
        if self.packets is None:
            self.packets = PacketWatch(text, self.config.decode, self._headers)
            self._headers = PacketHeaders()

    def on_packet(self, raw: bytes | memoryview, now_ns: int, arrival_ns: int) -> None:
        """Take one serialised LiDAR packet message."""
        self._take("lidar", now_ns)
        if self.packets is None:
            self._headers.take(raw)
            return
        note = self.packets.take(raw)
        if note is not None:
            self.clocks.take("lidar", now_ns, note.stamp_ns, arrival_ns)
            self.loss.take(now_ns, 1.0, float(note.lost))
            self.flags.scans += note.new_turn

    def on_points(self, end_ns: int, now_ns: int, arrival_ns: int) -> None:
        """Take one cloud by the time of its last point."""
        self._take("lidar", now_ns)
        self.clocks.take("lidar", now_ns, end_ns, arrival_ns)
        self.flags.scans += 1

    def on_imu(self, sample: ImuSample, now_ns: int, arrival_ns: int) -> None:
        """Take one IMU sample."""
        self._take("imu", now_ns)
        self.clocks.take("imu", now_ns, sample.time_ns, arrival_ns)
        self.imu.take(sample, now_ns)

    def on_fix(self, fix: GnssFix, now_ns: int, arrival_ns: int) -> None:
        """Take one fix."""
        self._take("gnss", now_ns)
        self.clocks.take("gnss", now_ns, fix.time_ns, arrival_ns)
        self.gnss.take(fix, now_ns)
        self._at(self.positions.on_fix(fix, now_ns))

    def on_dop(self, hdop: float, pdop: float, now_ns: int) -> None:
        """Take dilutions of precision."""
        self.gnss.take_dop(hdop, pdop, now_ns)

    def on_time_reference(self, now_ns: int) -> None:
        """Take one pulse: a sensor_msgs/TimeReference."""
        self._take("pps", now_ns)

    def on_pps_lock(self, locked: bool, says: str, now_ns: int) -> None:
        """Take what a driver says about its lock on the pulse."""
        self._pps_unlocked = "" if locked else says
        self.tick(now_ns)

    def on_odometry(self, note: OdometryNote, now_ns: int) -> None:
        """Take the pose of one scan."""
        self._take("odometry", now_ns)
        last, known = self.odometry.note, self.odometry
        known.note = note
        known.poses += 1
        known.predicted += note.predicted
        known.degenerate += note.degenerate
        if last is not None and note.segment != last.segment:
            self.flags.event("segment_start", now_ns, "odometry began again")
            self.positions.broken()
        elif last is not None:
            step = float(((note.xyz - last.xyz) ** 2).sum() ** 0.5)
            known.way += step
            self.flags.way = known.way
        known.segments.add(note.segment)
        self.flags.set("degenerate", note.degenerate, now_ns)
        self.flags.set("unregistered", note.predicted, now_ns)
        if self.packets is None and note.columns:
            self.loss.take(now_ns, note.columns - note.lost_columns, note.lost_columns)
        self._at(self.positions.on_odometry(note.xyz, now_ns))

    def on_disk(self, free: float, now_ns: int) -> None:
        """Take the free space of the recording's disk [bytes]."""
        self.disk.take(free, now_ns)
        self.tick(now_ns)

    def on_recorder(self, stopped: bool, says: str, now_ns: int) -> None:
        """Take whether the recorder has stopped, with its reason."""
        self.flags.set("not_recorded", stopped, now_ns, says)

    def on_offer(self, reliable: bool, now_ns: int) -> None:
        """Take whether the packets' publisher sends again what is lost."""
        self.flags.set("best_effort", not reliable, now_ns, "packets", "lidar")

    def _take(self, stream: str, now_ns: int) -> None:
        if self.start_ns is None:
            self.start_ns = now_ns
        self.streams[stream].take(now_ns)
        if now_ns - self._ticked_ns >= _TICK_NS:
            self.tick(now_ns)

    def _at(self, place: Any) -> None:
        if place is None:
            return
        raised = {stretch.name for stretch in self.flags.raised()}
        last = self.streets.segments[-1].end_ns if self.streets.segments else place.time_ns
        events = {s.name for s in self.flags if s.end_ns == s.start_ns and s.start_ns >= last}
        self.streets.take(place, raised, events)

    def tick(self, now_ns: int) -> None:
        """Look at what does not come by itself: silence, rates, clocks, limits."""
        self._ticked_ns = self.now_ns = now_ns
        self._look_at_streams(now_ns)
        self._look_at_clocks(now_ns)
        self._look_at_pps(now_ns)
        self._look_at_values(now_ns)

    def _look_at_streams(self, now_ns: int) -> None:
        for name in SENSORS:
            stream = self.streams[name]
            silent = stream.silent(now_ns)
            gap = "" if stream.last_ns is None else f"since {(now_ns - stream.last_ns) * 1e-9:.1f} s"
            self.flags.set(f"{name}_silent", silent, now_ns, gap, since_ns=stream.last_ns or 0)
            slow = stream.slow(now_ns, self.config.watch.streams.min_rate)
            rates = f"{stream.rate(now_ns):.0f} of {stream.usual_rate:.0f} Hz" if slow else ""
            self.flags.set(f"{name}_slow", slow, now_ns, rates)
        silent = self.streams["odometry"].silent(now_ns) and not self.streams["lidar"].silent(now_ns)
        self.flags.set("odometry_silent", silent, now_ns)
        share = self.loss.share(now_ns)
        lost = share > self.config.watch.streams.max_lost
        self.flags.set("packet_loss", lost, now_ns, f"{share:.1%} of a second" if lost else "")

    def _look_at_clocks(self, now_ns: int) -> None:
        for name, watch in self.clocks.sensors.items():
            self.flags.set("not_utc", watch.not_utc, now_ns, "stamps are not UTC", name)
        if self.host_clock:
            self._compare_clocks(now_ns)

    def _compare_clocks(self, now_ns: int) -> None:
        limits = self.config.watch.clocks
        for step in self.clocks.steps(now_ns):
            self.flags.event("clock_step", step.when_ns, f"jumped by {step.size:+.3f} s", step.source)
        offsets = self.clocks.offsets(now_ns)
        for name in self.clocks.sensors:
            offset = offsets.get(name, 0.0)
            off = offset > limits.max_offset or offset < -limits.max_ahead
            self.flags.set("clock_offset", off, now_ns, f"arrives {offset:+.3f} s after its stamp", name)
        apart, which = self.clocks.disagreement(now_ns)
        detail = f"{which} by {apart:.3f} s"
        self.flags.set("clock_disagreement", apart > limits.max_disagreement, now_ns, detail)
        drifts = self.clocks.drifts(now_ns)
        for name in self.clocks.sensors:
            drift = drifts.get(name, 0.0)
            detail = f"moved {drift * 1e3:+.1f} ms against the others"
            self.flags.set("clock_drift", abs(drift) > limits.max_drift, now_ns, detail, name)

    def _look_at_pps(self, now_ns: int) -> None:
        pps = self.streams["pps"]
        silent = pps.silent(now_ns)
        says = self._pps_unlocked or ("the time reference has ended" if silent else "")
        self.flags.set("pps_lost", bool(says), now_ns, says, since_ns=(pps.last_ns or 0) if silent else 0)

    def _look_at_values(self, now_ns: int) -> None:
        fault = "" if self.streams["imu"].silent(now_ns) else self.imu.fault(now_ns)
        self.flags.set("imu_bad", bool(fault), now_ns, fault)
        self.flags.set("without_rtk_fixed", self.gnss.without_fixed(now_ns), now_ns, self.gnss.state)
        poor = "" if self.streams["gnss"].silent(now_ns) else self.gnss.poor(now_ns)
        self.flags.set("poor_dop", bool(poor), now_ns, poor)
        room = f"{self.disk.free / 1e9:.1f} GB free"
        self.flags.set("disk_full", self.disk.full(), now_ns, room)
        self.flags.set("disk_low", self.disk.low() and not self.disk.full(), now_ns, room)

    def manifest(self, name: str) -> dict[str, Any]:
        """Return the manifest so far; the mapping adds to it what it finds."""
        start_ns = self.start_ns if self.start_ns is not None else self.now_ns
        sequence: dict[str, Any] = {
            "scans": self.flags.scans,
            "length_m": round(self.odometry.way, 2),
            "start_s": round(start_ns * 1e-9, 3),
            "end_s": round(self.now_ns * 1e-9, 3),
            "segments": max(len(self.odometry.segments), 1),
            "flagged": self.flags.flagged(self.now_ns),
            "gnss": {"states": {state: {"received": n} for state, n in sorted(self.gnss.states.items())}},
            "streams": self._stream_facts(),
            "street_segments": self.streets.counts(),
        }
        if self.packets is not None:
            sequence["packets"] = self.packets.facts()
        return {"watched": True, "sequences": {name: sequence}, "legend": {**LEGEND, **MEANINGS}}

    def _stream_facts(self) -> dict[str, dict[str, float]]:
        return {
            name: {
                "messages": stream.count,
                "usual_rate_hz": round(stream.usual_rate, 1),
                "gaps": stream.gaps,
                "longest_gap_s": round(stream.longest_gap_ns * 1e-9, 3),
            }
            for name, stream in self.streams.items()
            if stream.count
        }


def merged_flags(
    first: dict[str, Sequence[dict[str, Any]]], second: dict[str, Sequence[dict[str, Any]]]
) -> dict[str, list[dict[str, Any]]]:
    """Return the stretches of both; where both hold a name, the second's stand: it saw the scans."""
    return {name: list(second.get(name, first.get(name, ()))) for name in {**first, **second}}
