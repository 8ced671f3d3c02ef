"""Recordings of a tiny survey: a drive of four seconds past boxes on even ground, ray by ray."""

from __future__ import annotations

import datetime as dt
import sys
from pathlib import Path

import numpy as np
from pyproj import Transformer

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "fuzz"))

from subiaco_geo.bags import BagWriter
from subiaco_geo.frames import Floats
from subiaco_geo.topics import FIX, MESSAGE_TYPES, TF_STATIC
from subiaco_mapping.importers.bag_messages import LogMessage, cloud_message, extrinsics_message, fix_message
from subiaco_mapping.importers.csv_logs import imu_message

#: Where the street lies: easting, northing, ellipsoidal height of its corner [m], in EPSG:7850.
CORNER = np.array([391_200.0, 6_464_300.0, 12.0])
#: Boxes of the street (N, 6): west, south, ground, east, north, top [m] from the corner.
STREET = np.array(
    [
        [-8, -4, 0, 2, 8, 5], [4, 2, 0, 12, 10, 7], [15, 5, 0, 19, 11, 3], [22, -2, 0, 31, 9, 6],
        [35, 3, 0, 43, 11, 4],
        [-5, 22, 0, 3, 32, 4], [5, 25, 0, 11, 33, 8], [12, 20, 0, 24, 27, 5], [37, 23, 0, 47, 34, 6],
        [46, 6, 0, 54, 13, 5], [8, 12, 0, 8.6, 12.6, 6], [33, 13, 0, 37.5, 14.8, 1.5],
    ], dtype=float,
)  # fmt: skip
#: The box that is there in the later epoch alone.
NEW = np.array([[28.0, 19.0, 0.0, 33.0, 24.0, 3.5]])
SPEED, SCANS, RANGE = 9.0, 40, 45.0  # m/s, of one recording, m
SECOND = 10**9
STARTS = {"2023": 1_700_000_000 * SECOND, "2025": 1_750_000_000 * SECOND}
TO_DEGREES = Transformer.from_crs("EPSG:7850", "EPSG:7844", always_xy=True)


def rays() -> tuple[Floats, Floats]:
    """Return directions (N, 3) of one turn of 32 beams at 360 columns, and the share of the turn (N,)."""
    turn, height = np.meshgrid(np.arange(360) / 360, np.radians(np.linspace(-24.0, 20.0, 32)), indexing="ij")
    angle = -2.0 * np.pi * turn
    directions = np.stack(
        [np.cos(height) * np.cos(angle), np.cos(height) * np.sin(angle), np.sin(height)], axis=-1
    )
    return directions.reshape(-1, 3), turn.reshape(-1)


def ranges(places: Floats, directions: Floats, boxes: Floats) -> Floats:
    """Return the distance (N,) [m] from places (N, 3) along directions to ground or box, else inf."""
    with np.errstate(divide="ignore"):
        inverse = 1.0 / directions
    found = np.where(directions[:, 2] < 0, -places[:, 2] * inverse[:, 2], np.inf)
    for box in boxes:
        first, second = (box[:3] - places) * inverse, (box[3:] - places) * inverse
        near, far = np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
        found = np.minimum(found, np.where((near <= far) & (near > 0), near, np.inf))
    return found


def path(seconds: Floats, north: float) -> Floats:
    """Return places (N, 3) of the sensor on a drive to the east [m] from the corner."""
    east = 2.0 + SPEED * seconds
    return np.column_stack([east, np.full(len(east), north), np.full(len(east), 1.8)])


def fix(time_ns: int, place: Floats) -> LogMessage:
    """Return an RTK fix of the antenna, which is where the LiDAR is."""
    longitude, latitude = TO_DEGREES.transform(*(place + CORNER)[:2])
    where = np.array([latitude, longitude, place[2] + CORNER[2]])
    return fix_message(time_ns, where, np.diag([1e-4, 1e-4, 4e-4]), 2, known=True)


def messages(epoch: str, number: int) -> list[LogMessage]:
    """Return scans, fixes and inertial samples of one recording of an epoch, in time order."""
    rng = np.random.default_rng(number)
    start = STARTS[epoch] + number * 600 * SECOND
    boxes = np.concatenate([STREET, NEW]) if epoch == "2025" else STREET
    directions, turn = rays()
    found = []
    for scan in range(SCANS):
        seconds = (scan + turn) * 0.1
        reach = ranges(path(seconds, 16.0 + number), directions, boxes)
        seen = reach < RANGE
        returned = reach[seen] + rng.normal(0.0, 0.01, seen.sum())
        times = start + np.round(seconds[seen] * SECOND).astype(np.int64)
        found.append(cloud_message(directions[seen] * returned[:, None], times, np.full(seen.sum(), 40.0)))
    for sample in range(SCANS * 10):
        gyro, force = rng.normal(0.0, 0.001, 3), rng.normal([0.0, 0.0, 9.794], 0.01)
        found.append(imu_message(start + sample * SECOND // 100, gyro, force))
    for sample, place in enumerate(path(np.arange(SCANS) * 0.1, 16.0 + number)):
        found.append(fix(start + sample * SECOND // 10, place + rng.normal(0.0, 0.005, 3)))
    return sorted(found, key=lambda message: message.time_ns)


def recording(folder: Path, epoch: str, number: int, topic: str = FIX, antenna: str = "gnss_link") -> None:
    """Write a recording as a bag; the sensors lie 1.8 m above the ground, where base_link is."""
    found = messages(epoch, number)
    frames = {name: np.eye(4) for name in ("lidar_link", "imu_link", antenna)}
    static = extrinsics_message(found[0].time_ns, frames)
    with BagWriter(folder) as writer:
        writer.write_raw(TF_STATIC, MESSAGE_TYPES[TF_STATIC], static.cdr, static.time_ns, latched=True)
        for item in found:
            name = topic if item.topic == FIX else item.topic
            writer.write_raw(name, MESSAGE_TYPES[item.topic], item.cdr, item.time_ns)


def cut(folder: Path) -> None:
    """Write a recording whose file ends early, as a power failure leaves it."""
    recording(folder, "2025", 0)
    (file,) = folder.glob("*.mcap")
    data = file.read_bytes()
    file.write_bytes(data[: 2 * len(data) // 3])


def capture(file: Path) -> None:
    """Write a capture of two turns of an Ouster, with the JSON of the sensor beside it."""
    from fuzz_targets import small_sensor
    from ouster.sdk import core, pcap

    description, packets = small_sensor()
    form = core.PacketFormat(core.SensorInfo(description))
    sent = []
    for number, data in enumerate(packets):
        packet = core.LidarPacket(form)
        packet.buf[:] = np.frombuffer(data, np.uint8)
        packet.host_timestamp = STARTS["2025"] + number * SECOND // 1000
        sent.append(packet)
    pcap.record(iter(sent), str(file))
    file.with_suffix(".json").write_text(description, encoding="utf-8")


def gnss_log(file: Path) -> None:
    """Write fixes beside the capture as CSV."""
    times = [
        dt.datetime.fromtimestamp(STARTS["2025"] // SECOND + n / 10, dt.UTC).isoformat() for n in range(3)
    ]
    lines = [f"{time},-31.95,115.83,12.3,4" for time in times]
    file.write_text("\n".join(["utc,latitude,longitude,height,quality", *lines]) + "\n", encoding="utf-8")


def imu_log(file: Path) -> None:
    """Write inertial samples beside the capture as CSV."""
    lines = [f"{STARTS['2025'] // SECOND}.{n:02d},0,0,0,0,0,9.8" for n in range(30)]
    head = "utc,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"
    file.write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")
