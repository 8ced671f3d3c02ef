"""Faults of a bag that make a map impossible or wrong: frames, fixes, packets, further LiDARs."""

from __future__ import annotations

from typing import Any

import numpy as np

from subiaco_geo.bags import BagReader
from subiaco_geo.crs_area import crs_at, require_inside
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.topics import FIX, IMU_PACKETS, LIDAR_PACKETS, MESSAGE_TYPES, POINTS, TF_STATIC, types_of
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.pose_graph.gnss import enough_to_place
from subiaco_mapping.preprocessing.conversions import check_frames, fix_from_msg

_EARTH = 6_371_000.0  # [m]
_FASTEST = 100.0  # between two fixes; no survey is driven so fast [m/s]
_FARTHEST = 200.0  # that fixes may step [m]
_SPOILT = 0.1  # share of fixes that jump above which they are useless
_LATE = 1.0  # after the recording, at which a LiDAR may begin [s]
_LATE_SHARE = 0.2  # of the recording without LiDAR at its beginning, that spoils it
_MALFORMED = 0.5  # share of malformed packets above which the packets are useless


def faults(reader: BagReader, facts: dict[str, Any], config: MappingConfig) -> tuple[list[str], list[str]]:
    """Return what forbids mapping a bag, and what asks for care.

    Parameters
    ----------
    reader : BagReader
        Topics by our names.
    facts : dict
        With ``lidar``: packet counts, where packets come.
    config : MappingConfig
    """
    forbids, cares = _packets(facts.get("lidar", {})), _other_lidars(reader)
    late, spoils = _late(facts)
    (forbids if spoils else cares).extend(late)
    if TF_STATIC in reader.topics:
        forbids += _frames(reader)
    if FIX in reader.topics:
        found = _fixes(reader, config)
        forbids += found[0]
        cares += found[1]
    return forbids, cares


def _packets(lidar: dict[str, Any]) -> list[str]:
    received, malformed = lidar.get("packets", 0), lidar.get("malformed", 0)
    if malformed > _MALFORMED * max(received, malformed, 1):
        share = f"{malformed} of {max(received, malformed)} LiDAR packets are malformed"
        return [share + "; record the metadata of this sensor with them, it tells how they are laid out"]
    return []


def _late(facts: dict[str, Any]) -> tuple[list[str], bool]:
    """Return what a LiDAR that begins after the recording costs, and whether that spoils the survey."""
    topics, whole = facts.get("topics", {}), facts.get("duration_s", 0.0)
    begun = [topics[t]["begins_s"] for t in (LIDAR_PACKETS, POINTS) if topics.get(t, {}).get("count")]
    begins = min(begun, default=0.0)
    if begins <= _LATE:
        return [], False
    share = begins / whole
    return [
        f"the LiDAR begins {begins:.1f} s after the recording ({share:.0%} of it); drive those streets again"
    ], share > _LATE_SHARE


def _frames(reader: BagReader) -> list[str]:
    if reader.topics[TF_STATIC].msg_type != MESSAGE_TYPES[TF_STATIC]:
        return [f"{TF_STATIC} is {reader.topics[TF_STATIC].msg_type}, not {MESSAGE_TYPES[TF_STATIC]}"]
    messages = [reader.deserialize(message) for message in reader.messages({TF_STATIC})]
    try:
        check_frames([item for message in messages for item in message.transforms])
    except InputError as error:
        return [str(error)]
    return []


def _other_lidars(reader: BagReader) -> list[str]:
    """Name LiDAR topics beside the one that is mapped."""
    ours = LIDAR_PACKETS if LIDAR_PACKETS in reader.topics else POINTS
    others = [
        name
        for name, info in reader.topics.items()
        if info.msg_type in types_of(ours) and name not in (ours, IMU_PACKETS) and info.count
        if ours == POINTS or "imu" not in name.lower()
    ]
    if not others or ours not in reader.topics:
        return []
    return [f"{', '.join(sorted(others))} is not mapped: one LiDAR is, {ours}; choose with --set topics"]


def _fixes(reader: BagReader, config: MappingConfig) -> tuple[list[str], list[str]]:
    read = (fix_from_msg(reader.deserialize(m), config.gnss) for m in reader.messages({FIX}))
    usable = sorted((fix for fix in read if fix.is_usable()), key=lambda fix: fix.time_ns)
    if not usable:
        return [], []
    place = np.array([[fix.latitude, fix.longitude] for fix in usable])
    nowhere = float((np.abs(place) < 1e-6).all(axis=1).mean())
    if nowhere > _SPOILT:
        return [f"{nowhere:.0%} of the fixes are at 0 N 0 E: the receiver has no solution but says so"], []
    steps = _steps(place)
    seconds = np.diff([fix.time_ns for fix in usable]) * 1e-9
    jumps = (steps > _FARTHEST) & (steps > _FASTEST * seconds)
    if jumps.sum() > _SPOILT * len(jumps):
        return [f"{int(jumps.sum())} of {len(usable)} fixes jump, by up to {steps.max() / 1e3:.0f} km"], []
    cares = [f"{int(jumps.sum())} fixes jump, by up to {steps.max() / 1e3:.1f} km"] if jumps.any() else []
    latitude, longitude = np.median(place, axis=0).tolist()
    north, east = _EARTH * np.radians(place).T * [[1.0], [np.cos(np.radians(latitude))]]
    too_few = enough_to_place(np.stack([east, north, np.zeros(len(place))], axis=1), config.gnss)
    if too_few is not None:
        cares.append(f"{too_few} to place the map: it will be local, without CRS")
    try:
        require_inside(latitude, longitude, crs_at(latitude, longitude, config.crs))
    except InputError as error:
        cares.append(str(error))
    return [], cares


def _steps(place: Floats) -> Floats:
    """Return the way (N - 1,) between latitudes and longitudes (N, 2) [deg], on the sphere [m]."""
    latitude, longitude = np.radians(place).T
    half = np.sin(np.diff(latitude) / 2) ** 2
    half += np.cos(latitude[1:]) * np.cos(latitude[:-1]) * np.sin(np.diff(longitude) / 2) ** 2
    return np.asarray(2.0 * _EARTH * np.arcsin(np.sqrt(np.clip(half, 0.0, 1.0))))
