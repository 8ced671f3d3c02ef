"""Verdict on a survey: usable or not, with a reason for every doubt."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from subiaco_geo.topics import FIX, IMU, LIDAR_PACKETS, POINTS, TF_STATIC
from subiaco_mapping.health_monitor.flags import MEANINGS
from subiaco_mapping.health_monitor.monitor import Monitor

USABLE, CARE, USELESS = "usable", "usable with care", "not usable"

#: Share of the recording from which a fault spoils all of it.
_SPOILT = 0.2
_LOST = 0.1
_REMEDIES = {
    "lidar_silent": "Drive those streets again",
    "lidar_slow": "Check the network and the load of the computer",
    "packet_loss": "Record with a larger socket buffer or fewer points",
    "imu_silent": "Scans of that time are deskewed by constant velocity",
    "imu_bad": "Correct the driver, or map without the IMU",
    "gnss_silent": "The odometry alone gives the position there",
    "without_rtk_fixed": "The odometry alone gives the position there",
    "poor_dop": "Positions and heights of that time are less accurate",
    "clock_step": "Map the parts before and after the step separately",
    "clock_offset": "Set decode.time_base or time_offset_ns, or set the host's clock",
    "clock_disagreement": "Set decode.time_base or the time_offset_ns of the sensor",
    "clock_drift": "Check PPS",
    "pps_lost": "Check the cable of the pulse",
    "not_utc": "Give the sensor PPS and NMEA, or set decode.time_offset_ns",
}
#: What the detail of a flag states, where the detail alone does not say.
_DETAILS = {"without_rtk_fixed": "state of the solution: ", "lidar_slow": "rate: ", "imu_slow": "rate: "}


@dataclass(frozen=True)
class SurveyVerdict:
    """The word, what forbids, and what asks for care."""

    word: str
    forbids: tuple[str, ...]
    cares: tuple[str, ...]

    def with_more(self, forbids: Sequence[str], cares: Sequence[str]) -> SurveyVerdict:
        """Return the verdict with further reasons."""
        return verdict_of((*forbids, *self.forbids), (*self.cares, *cares))


def verdict_of(forbids: Sequence[str], cares: Sequence[str]) -> SurveyVerdict:
    """Return the verdict that reasons make."""
    word = USELESS if forbids else CARE if cares else USABLE
    return SurveyVerdict(word, tuple(forbids), tuple(cares))


def judge(
    monitor: Monitor, topics: Collection[str], duration: float, point_times: bool = True
) -> SurveyVerdict:
    """Judge a survey by what the watch saw.

    Parameters
    ----------
    monitor : Monitor
        After the whole recording.
    topics : collection of str
        Recorded, by our names.
    duration : float
        [s]
    point_times : bool
        Clouds carry a time for each point (packets always do).
    """
    forbids, cares = _by_topics(topics, point_times)
    lost = _lost_share(monitor)
    if lost > _LOST:
        forbids.append(f"{lost:.0%} of the LiDAR packets lost")
    for name, stretches in monitor.flags.flagged(monitor.now_ns).items():
        text, spoils = _weighed(name, stretches, duration, topics)
        (forbids if spoils else cares).append(text)
    if FIX in topics and not any(state != "none" for state in monitor.gnss.states):
        cares.append(f"no usable fix on {FIX}: the map will be local, without CRS")
    return verdict_of(forbids, cares)


def _by_topics(topics: Collection[str], point_times: bool) -> tuple[list[str], list[str]]:
    forbids, cares = [], []
    if LIDAR_PACKETS not in topics and POINTS not in topics:
        forbids.append(f"no LiDAR topic ({LIDAR_PACKETS} or {POINTS}); name yours: --set topics.points=...")
    elif not point_times and LIDAR_PACKETS not in topics:
        forbids.append(f"{POINTS} has no time for each point; record it, or set deskewed: true if it is")
    if IMU not in topics:
        cares.append(f"no {IMU}: deskew falls back to constant velocity")
    if FIX not in topics:
        cares.append(f"no {FIX}: the map will be local, without CRS")
    if TF_STATIC not in topics:
        cares.append(f"no {TF_STATIC}: extrinsics must come from config/sensors.yaml")
    return forbids, cares


def _lost_share(monitor: Monitor) -> float:
    if monitor.packets is None:
        return 0.0
    sent = monitor.packets.lost + monitor.packets.received
    return monitor.packets.lost / sent if sent else 0.0


def _weighed(
    name: str, stretches: Sequence[Mapping[str, Any]], duration: float, topics: Collection[str]
) -> tuple[str, bool]:
    """Put a flag in words, and tell whether it spoils the survey."""
    spans = [stretch["end_s"] - stretch["start_s"] for stretch in stretches]
    share = sum(spans) / duration if duration > 0 else 1.0
    sources = sorted({str(stretch["source"]) for stretch in stretches if "source" in stretch})
    whose = f" ({', '.join(sources)})" if sources else ""
    times = "once" if len(stretches) == 1 else f"{len(stretches)} times"
    long = f", {sum(spans):.1f} s in all" if sum(spans) > 0 else ""
    detail = str(stretches[0].get("detail", ""))
    said = f" ({_DETAILS.get(name, '')}{detail})" if detail else ""
    meaning = MEANINGS[name].removeprefix("flag: ") if name in MEANINGS else name
    remedy = f" {_REMEDIES[name]}." if name in _REMEDIES else ""
    text = f"{meaning[0].upper()}{meaning[1:]}{whose}: {times}{long}{said}.{remedy}"
    clocks = name in ("clock_disagreement", "not_utc") and FIX in topics
    return text, share > _SPOILT and (name in ("lidar_silent", "packet_loss") or clocks)
