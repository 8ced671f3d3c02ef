"""Snapshot of the health monitor for /diagnostics and the terminal."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from subiaco_mapping.health_monitor.flags import FlagInterval
from subiaco_mapping.health_monitor.monitor import Monitor

OK, WARN, ERROR, STALE = 0, 1, 2, 3

#: Flags that belong to each line, and those of them that are errors.
_LINES: dict[str, tuple[str, ...]] = {
    "lidar": ("lidar_silent", "lidar_slow", "packet_loss", "best_effort"),
    "imu": ("imu_silent", "imu_slow", "imu_bad"),
    "gnss": ("gnss_silent", "gnss_slow", "without_rtk_fixed", "poor_dop"),
    "clocks": ("clock_step", "clock_offset", "clock_disagreement", "clock_drift", "pps_lost", "not_utc"),
    "odometry": ("odometry_silent", "degenerate", "unregistered", "segment_start"),
    "disk": ("disk_low", "disk_full", "not_recorded"),
    "nodes": ("node_died",),
}
_ERRORS = frozenset(
    {"lidar_silent", "imu_silent", "gnss_silent", "odometry_silent", "disk_full", "unregistered", "not_utc"}
    | {"not_recorded"}
)
_SHOWN_NS = 10_000_000_000


@dataclass(frozen=True)
class StatusLine:
    """One line of the picture: name, level (0 ok, 1 warning, 2 error, 3 not there), words, values."""

    name: str
    level: int
    message: str
    values: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Snapshot:
    """Everything at one moment.

    Parameters
    ----------
    time_ns : int
    light : str
        Of the street segment being driven.
    reasons : tuple of str
    lines : tuple of StatusLine
    again : int
        Segments to be driven again.
    counts : dict
        Segments by light.
    undriven : float
        Of the planned route [m]; NaN where there is none.
    """

    time_ns: int
    light: str
    reasons: tuple[str, ...]
    lines: tuple[StatusLine, ...]
    again: int
    counts: dict[str, int]
    undriven: float

    def as_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)


def _number(value: float, form: str, unit: str = "") -> str:
    return "unknown" if not np.isfinite(value) else f"{value:{form}}{unit}"


def take_snapshot(monitor: Monitor, undriven: float = float("nan")) -> Snapshot:
    """Return what there is to show now."""
    now_ns = monitor.now_ns
    values = {
        "lidar": _lidar(monitor, now_ns),
        "imu": _stream(monitor, "imu", now_ns) | {"out of order": str(monitor.imu.out_of_order)},
        "gnss": _gnss(monitor, now_ns),
        "clocks": _clocks(monitor, now_ns),
        "odometry": _odometry(monitor, now_ns),
        "disk": {
            "free": _number(monitor.disk.free / 1e9, ".1f", " GB"),
            "left": _number(monitor.disk.minutes, ".0f", " min"),
        },
        "nodes": {},
    }
    shown = [s for s in monitor.flags if s.end_ns is None or now_ns - s.end_ns < _SHOWN_NS]
    lines = tuple(
        _line(name, [s for s in shown if s.name in _LINES[name]], values[name], monitor) for name in _LINES
    )
    segments = monitor.streets.driven()
    quality = monitor.config.watch.quality
    return Snapshot(
        time_ns=now_ns,
        light=segments[-1].light(quality) if segments else "undriven",
        reasons=tuple(segments[-1].reasons(quality)) if segments else (),
        lines=lines,
        again=len(monitor.streets.again()),
        counts=monitor.streets.counts(),
        undriven=undriven,
    )


def _line(name: str, stretches: list[FlagInterval], values: dict[str, str], monitor: Monitor) -> StatusLine:
    stream = monitor.streams.get(name)
    if stream is not None and stream.count == 0:
        return StatusLine(name, STALE, "nothing yet", values)
    if not stretches:
        return StatusLine(name, OK, "ok", values)
    level = max(ERROR if s.name in _ERRORS and s.end_ns is None else WARN for s in stretches)
    words = []
    for stretch in stretches:
        whose = f" ({stretch.source})" if stretch.source else ""
        ended = "" if stretch.end_ns is None else " [over]"
        words.append(f"{stretch.name}{whose}: {stretch.detail}{ended}".rstrip(": "))
    return StatusLine(name, level, "; ".join(words), values)


def _stream(monitor: Monitor, name: str, now_ns: int) -> dict[str, str]:
    stream = monitor.streams[name]
    return {
        "rate": f"{stream.rate(now_ns):.1f} Hz",
        "gaps": str(stream.gaps),
        "longest gap": f"{stream.longest_gap_ns * 1e-9:.2f} s",
    }


def _lidar(monitor: Monitor, now_ns: int) -> dict[str, str]:
    values = _stream(monitor, "lidar", now_ns)
    if monitor.packets is not None:
        values["lost packets"] = str(monitor.packets.lost)
        values["clock source"] = monitor.packets.timestamp_mode or "unknown"
    values["lost now"] = f"{monitor.loss.share(now_ns):.1%}"
    return values


def _gnss(monitor: Monitor, now_ns: int) -> dict[str, str]:
    hdop, pdop = monitor.gnss.dop(now_ns)
    return _stream(monitor, "gnss", now_ns) | {
        "state": monitor.gnss.state,
        "sigma": _number(monitor.gnss.sigma(), ".3f", " m"),
        "HDOP": _number(hdop, ".1f"),
        "PDOP": _number(pdop, ".1f"),
    }


def _clocks(monitor: Monitor, now_ns: int) -> dict[str, str]:
    if not monitor.host_clock:
        return {"delays": "not judged while a bag is played"}
    values = {
        f"{name} delay": f"{offset * 1e3:+.1f} ms" for name, offset in monitor.clocks.offsets(now_ns).items()
    }
    pps = monitor.streams["pps"]
    lost = any(stretch.name == "pps_lost" for stretch in monitor.flags.raised())
    return values | {"PPS": "lost" if lost else "locked" if pps.count else "no time reference recorded"}


def _odometry(monitor: Monitor, now_ns: int) -> dict[str, str]:
    known = monitor.odometry
    values = {"rate": f"{monitor.streams['odometry'].rate(now_ns):.1f} Hz", "way": f"{known.way:.0f} m"}
    return values | {"degenerate": str(known.degenerate), "predicted": str(known.predicted)}
