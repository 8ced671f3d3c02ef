"""Import of GNSS and IMU logs as CSV with UTC stamps.

The paper names what is in them (UTC stamps, quality indicators, orientation), not the columns:
their names are configuration. Heading is clockwise from true north, as receivers give it; the
message has yaw counter-clockwise from east.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from pydantic import Field

from subiaco_geo.bags import TYPESTORE
from subiaco_geo.config import StrictModel
from subiaco_geo.errors import InputError, reason_of
from subiaco_geo.frames import Floats
from subiaco_geo.topics import HEADING, IMU
from subiaco_geo.trajectory_files.rtklib import SUFFIX
from subiaco_mapping.importers.bag_messages import LogMessage, fix_message, header, message, stamp_ns
from subiaco_mapping.importers.rtklib import read_pos

_T = TYPESTORE.types
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
#: Quality of NMEA's GGA to our states: 4 RTK fixed, 5 float, 1 single, 2 differential, 3 PPS, 0 none.
GGA_STATES = {4: 2, 5: 1, 1: 0, 2: 0, 3: 0}
_UNKNOWN_M = {2: 0.02, 1: 0.5, 0: 3.0}  # sigma by state where a log has none [m]


class GnssColumns(StrictModel):
    """Columns of the GNSS log."""

    time: str = Field(
        "utc", description="Column with the time: ISO 8601 in UTC, or seconds or nanoseconds since 1970"
    )
    latitude: str = Field("latitude", description="Column with the latitude [deg]")
    longitude: str = Field("longitude", description="Column with the longitude [deg]")
    height: str = Field("height", description="Column with the ellipsoidal height [m]")
    quality: str = Field(
        "quality",
        description="Column with the fix quality as in NMEA GGA: 4 RTK fixed, 5 float, 1 single, 0 none",
    )
    sigma_east: str = Field(
        "sigma_east", description="Column with the standard deviation towards east [m]; may be absent"
    )
    sigma_north: str = Field(
        "sigma_north", description="Column with the standard deviation towards north [m]; may be absent"
    )
    sigma_up: str = Field(
        "sigma_up", description="Column with the vertical standard deviation [m]; may be absent"
    )
    heading: str = Field(
        "heading",
        description="Column with the heading of the antenna baseline from north [deg]; may be absent",
    )
    heading_sigma: str = Field(
        "heading_sigma", description="Column with the standard deviation of the heading [deg]; may be absent"
    )


class ImuColumns(StrictModel):
    """Columns of the IMU log."""

    time: str = Field(
        "utc", description="Column with the time: ISO 8601 in UTC, or seconds or nanoseconds since 1970"
    )
    gyro: tuple[str, str, str] = Field(
        ("gyro_x", "gyro_y", "gyro_z"), description="Columns with the angular rates about x, y, z [rad/s]"
    )
    accel: tuple[str, str, str] = Field(
        ("accel_x", "accel_y", "accel_z"), description="Columns with the specific forces along x, y, z [m/s2]"
    )


class LogsConfig(StrictModel):
    """CSV logs that ``subiaco import`` takes beside a recording."""

    gnss: GnssColumns = GnssColumns()
    imu: ImuColumns = ImuColumns()
    heading_sigma_deg: float = Field(
        0.2, gt=0, description="Standard deviation of headings for which the log states none [deg]"
    )
    leap_seconds: int = Field(
        18, ge=0, le=60, description="Offset GPS - UTC [s] for GPST stamps in .pos files of RTKLIB"
    )


def parse_time_ns(text: str) -> int:
    """Return nanoseconds since 1970 of an ISO 8601 stamp (UTC unless it says otherwise) or a number.

    Raises
    ------
    ValueError
        Neither.
    """
    text = text.strip()
    whole, _, part = text.partition(".")
    if whole.isdecimal() and (part.isdecimal() or not part):
        if len(whole) > 15:
            return stamp_ns(int(whole))
        return stamp_ns(int(whole) * 10**9 + int((part + "0" * 9)[:9]))
    stamp = datetime.fromisoformat(text)
    since = (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)) - _EPOCH
    return stamp_ns((since.days * 86400 + since.seconds) * 10**9 + since.microseconds * 1000)


def _rows(path: Path, needed: tuple[str, ...], key: str) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield line number and row of a CSV file.

    Raises
    ------
    InputError
        It cannot be read, or a column is missing.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            names = reader.fieldnames or ()
            missing = [name for name in needed if name not in names]
            if missing:
                found = " ".join(", ".join(names).split())[:300]
                raise InputError(
                    f"{path}: no column {missing[0]!r} (it has {found or 'none'}); "
                    f"name yours with --set {key}.FIELD=COLUMN"
                )
            for row in reader:
                yield reader.line_num, row
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"{path}: cannot be read as a CSV log ({reason_of(error)}); check the file"
        ) from error


def _imu(topic: str, time_ns: int, frame: str, yaw: float, variance: float, rates: list[float]) -> LogMessage:
    vector, unknown = _T["geometry_msgs/msg/Vector3"], np.zeros(9)
    absent = np.array([-1.0] + [0.0] * 8)
    covariance = np.diag([1e6, 1e6, variance]).ravel() if variance > 0 else absent
    turn = _T["geometry_msgs/msg/Quaternion"](
        x=0.0, y=0.0, z=float(np.sin(yaw / 2)), w=float(np.cos(yaw / 2))
    )
    return message(
        topic,
        time_ns,
        header=header(time_ns, frame),
        orientation=turn,
        orientation_covariance=covariance,
        angular_velocity=vector(*rates[:3]),
        angular_velocity_covariance=absent if topic == HEADING else unknown,
        linear_acceleration=vector(*rates[3:]),
        linear_acceleration_covariance=absent if topic == HEADING else unknown,
    )


def imu_message(time_ns: int, gyro: Floats, accel: Floats) -> LogMessage:
    """Return a sensor_msgs/Imu of rates (3,) [rad/s] and specific force (3,) [m/s2] in ``imu_link``."""
    return _imu(IMU, time_ns, "imu_link", 0.0, 0.0, [*map(float, gyro), *map(float, accel)])


def _number(row: dict[str, str], column: str) -> float:
    """Return a value, NaN where the column is absent or empty."""
    text = (row.get(column) or "").strip()
    return float(text) if text else float("nan")


def _fix(row: dict[str, str], time_ns: int, columns: GnssColumns) -> LogMessage:
    status = GGA_STATES.get(int(_number(row, columns.quality)), -1)
    place = [_number(row, name) for name in (columns.latitude, columns.longitude, columns.height)]
    names = (columns.sigma_east, columns.sigma_north, columns.sigma_up)
    sigma = np.array([_number(row, name) for name in names])
    known = bool(np.isfinite(sigma).all())
    sigma = sigma if known else np.full(3, _UNKNOWN_M.get(status, np.nan))
    return fix_message(time_ns, np.array(place), np.diag(sigma**2), status, known=known)


def read_gnss_log(path: Path, config: LogsConfig) -> list[LogMessage]:
    """Return fixes, and headings where the log has them, in time order; ``.pos`` is RTKLIB's.

    Raises
    ------
    InputError
        Names file, line or column at fault.
    """
    if path.suffix.lower() == SUFFIX:
        return read_pos(path, config.leap_seconds)
    columns, found = config.gnss, []
    needed = (columns.time, columns.latitude, columns.longitude, columns.height, columns.quality)
    for line, row in _rows(path, needed, "logs.gnss"):
        try:
            time_ns = parse_time_ns(row[columns.time])
            found.append(_fix(row, time_ns, columns))
            heading, sigma = _number(row, columns.heading), _number(row, columns.heading_sigma)
        except (ValueError, TypeError, AttributeError, OverflowError) as error:
            raise InputError(f"{path}: line {line}: {error}; correct or remove it") from error
        if np.isfinite(heading):
            sigma = sigma if sigma > 0 else config.heading_sigma_deg
            yaw = np.radians(90.0 - heading)
            found.append(_imu(HEADING, time_ns, "base_link", yaw, np.radians(sigma) ** 2, [0.0] * 6))
    return sorted(found, key=lambda message: message.time_ns)


def read_imu_log(path: Path, config: LogsConfig) -> list[LogMessage]:
    """Return IMU samples in time order.

    Raises
    ------
    InputError
        Names file, line or column at fault.
    """
    columns, found = config.imu, []
    for line, row in _rows(path, (columns.time, *columns.gyro, *columns.accel), "logs.imu"):
        try:
            gyro, accel = (
                np.array([float(row[name]) for name in names]) for names in (columns.gyro, columns.accel)
            )
            found.append(imu_message(parse_time_ns(row[columns.time]), gyro, accel))
        except (ValueError, TypeError, AttributeError, OverflowError) as error:
            raise InputError(f"{path}: line {line}: {error}; correct or remove it") from error
    return sorted(found, key=lambda message: message.time_ns)
