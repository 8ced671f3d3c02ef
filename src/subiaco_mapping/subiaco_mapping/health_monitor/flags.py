"""Flags: faults with their beginning and end, for the manifest."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

#: What every flag of the watch means; written into the manifest beside those of the mapping.
MEANINGS = {
    "lidar_silent": "flag: no LiDAR packet or cloud arrived (cable, power, network, driver)",
    "imu_silent": "flag: no IMU sample arrived",
    "gnss_silent": "flag: no fix message arrived (driver or receiver gone)",
    "lidar_slow": "flag: fewer LiDAR messages a second than usual",
    "imu_slow": "flag: fewer IMU samples a second than usual",
    "gnss_slow": "flag: fewer fix messages a second than usual",
    "odometry_silent": "flag: the LiDAR sends, but no pose comes out",
    "packet_loss": "flag: a larger share of the LiDAR's data lost than the limit",
    "clock_step": "flag: a clock jumped; source says whose (host: all sensors jumped together)",
    "clock_offset": "flag: stamps far from the host's clock",
    "clock_disagreement": "flag: the clocks of two sensors disagree",
    "clock_drift": "flag: a sensor's clock runs away from the others, as it does without PPS",
    "pps_lost": "flag: the time reference has ended, or a driver says that it is not locked",
    "not_utc": "flag: stamps are zero or count from switching on, not UTC",
    "out_of_order": "flag: stamps went backwards",
    "without_rtk_fixed": "flag: no RTK fixed solution for longer than the limit",
    "poor_dop": "flag: dilution of precision or stated standard deviation above the limit",
    "imu_bad": "flag: IMU values that cannot be (not finite, stuck, not gravity, wrong unit)",
    "degenerate": "flag: the scene did not hold the position in some direction",
    "unregistered": "flag: registration failed, the pose is predicted",
    "segment_start": "flag: the odometry broke and began again",
    "disk_low": "flag: the disk for the recording is nearly full",
    "disk_full": "flag: no room left for the recording",
    "not_recorded": "flag: the recorder has stopped, and says why",
    "best_effort": "flag: packets are offered without retransmission (best effort)",
    "node_died": "flag: a process of ours ended unasked; source says which",
}


@dataclass
class FlagInterval:
    """One flag from when to when; still up where ``end_ns`` is None."""

    name: str
    source: str
    start_ns: int
    end_ns: int | None
    detail: str
    way_start: float
    way_end: float
    scans_start: int
    scans_end: int


class FlagHistory:
    """Raise and lower flags; remember every stretch.

    Parameters
    ----------
    join_ns : int
        A flag raised again within this time goes on with its last stretch.
    """

    def __init__(self, join_ns: int) -> None:
        self._join_ns = join_ns
        self._open: dict[tuple[str, str], FlagInterval] = {}
        self._closed: list[FlagInterval] = []
        self._last: dict[tuple[str, str], FlagInterval] = {}
        self.way = 0.0
        self.scans = 0

    def set(
        self, name: str, raised: bool, now_ns: int, detail: str = "", source: str = "", since_ns: int = 0
    ) -> None:
        """Raise or lower a flag; ``since_ns`` is when it truly began, where that is known."""
        key = (name, source)
        found = self._open.get(key)
        if raised and found is None:
            self._raise(key, since_ns or now_ns, detail)
        elif raised and found is not None:
            found.detail = detail or found.detail
        elif found is not None:
            del self._open[key]
            found.end_ns, found.way_end, found.scans_end = now_ns, self.way, self.scans

    def event(self, name: str, now_ns: int, detail: str, source: str = "") -> None:
        """Note something that happened at one moment."""
        self.set(name, True, now_ns, detail, source)
        self.set(name, False, now_ns, source=source)

    def _raise(self, key: tuple[str, str], start_ns: int, detail: str) -> None:
        last = self._last.get(key)
        if last is not None and last.end_ns is not None and start_ns - last.end_ns <= self._join_ns:
            last.end_ns, last.detail = None, detail or last.detail
            self._open[key] = last
            return
        stretch = FlagInterval(*key, start_ns, None, detail, self.way, self.way, self.scans, self.scans)
        self._open[key] = self._last[key] = stretch
        self._closed.append(stretch)

    def raised(self) -> list[FlagInterval]:
        """Return what is up now, oldest first."""
        return sorted(self._open.values(), key=lambda stretch: stretch.start_ns)

    def __iter__(self) -> Iterator[FlagInterval]:
        return iter(self._closed)

    def flagged(self, now_ns: int) -> dict[str, list[dict[str, Any]]]:
        """Return every stretch by name, in the form of the mapping's manifest."""
        found: dict[str, list[dict[str, Any]]] = {}
        for stretch in sorted(self._closed, key=lambda stretch: stretch.start_ns):
            ended = stretch.end_ns is not None
            entry: dict[str, Any] = {
                "start_s": round(stretch.start_ns * 1e-9, 3),
                "end_s": round((stretch.end_ns if stretch.end_ns is not None else now_ns) * 1e-9, 3),
                "scans": (stretch.scans_end if ended else self.scans) - stretch.scans_start,
                "length_m": round((stretch.way_end if ended else self.way) - stretch.way_start, 2),
            }
            if stretch.source:
                entry["source"] = stretch.source
            if stretch.detail:
                entry["detail"] = stretch.detail
            found.setdefault(stretch.name, []).append(entry)
        return found
