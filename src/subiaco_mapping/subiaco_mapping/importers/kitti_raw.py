"""Raw folders of KITTI (``2011_09_26_drive_0027_sync``) to the messages of a survey bag.

Sweeps of a Velodyne HDL-64 in ``velodyne_points`` carry no times of their points: the scanner turns clockwise
seen from above and begins at the rear, so that the azimuth tells them, between the start and the end of the
sweep. ``oxts`` holds the INS: its position becomes the fix, with the accuracy that it states, and its own
frame is ``base_link``. Its rates and accelerations are taken where they come at 50 Hz or more, as in
unsynchronised drives. Stamps are taken as UTC.

The elevation angles of this scanner are 0.205 deg too low, as those who map with it have found (J.-E.
Deschaud, IMLS-SLAM, 2018). Left so, odometry pitches by 1.5 deg on 200 m of drive 0027; corrected, by less
than 0.1 deg.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.errors import InputError, reason_of
from subiaco_geo.frames import Floats, Ints, invert_pose, make_pose
from subiaco_mapping.importers.bag_messages import LogMessage, cloud_message, extrinsics_message, fix_message
from subiaco_mapping.importers.csv_logs import imu_message, parse_time_ns

#: To be added to the elevation of every beam [deg].
ELEVATION_DEG = 0.205
CALIBRATION = "calib_imu_to_velo.txt"
_STATES = {
    6: 2,
    5: 1,
    4: 0,
    3: 0,
    7: 0,
    8: 0,
    9: 0,
    10: 0,
}  # of the INS's position mode: 6 RTK integer, 5 float
_COLUMNS = 30
_ACCEL, _RATES, _ACCURACY, _MODE = slice(11, 14), slice(17, 20), 23, 27
_DENSE_NS = 20_000_000  # an IMU that comes more seldom cannot straighten a sweep
_SLOWEST_TURN_NS = 250_000_000


def kitti_messages(folder: Path) -> Iterator[LogMessage]:
    """Yield clouds, fixes, IMU samples and extrinsics of a drive in time order.

    Parameters
    ----------
    folder : Path
        With ``velodyne_points``, and ``oxts`` where there is one; ``calib_imu_to_velo.txt`` lies in it or
        above it.

    Raises
    ------
    InputError
        Something is missing or cannot be read; files and line are named.
    """
    sweeps = sorted((folder / "velodyne_points" / "data").glob("*.bin"))
    if not sweeps:
        drives = sorted(path.parent.name for path in folder.glob("*/velodyne_points"))
        one = f", for example {folder / drives[0]}" if drives else " of KITTI's raw data"
        raise InputError(f"{folder}: no velodyne_points/data/*.bin; give the folder of one drive{one}")
    start_ns, end_ns = _turns(folder / "velodyne_points", sweeps)
    streams: list[Iterator[LogMessage]] = [_clouds(sweeps, start_ns, end_ns)]
    if (folder / "oxts" / "data").is_dir():
        yield extrinsics_message(int(start_ns[0]), _frames(folder))
        times_ns, rows = _ins(folder / "oxts")
        streams.append(_fixes(times_ns, rows))
        if len(times_ns) > 1 and np.median(np.diff(times_ns)) <= _DENSE_NS:
            streams.append(_samples(times_ns, rows))
    yield from heapq.merge(*streams, key=lambda message: message.time_ns)


def _stamps(path: Path) -> Ints:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: cannot be read ({reason_of(error)}); it holds the stamps of the drive"
        ) from error
    found = []
    for number, line in enumerate(lines, 1):
        try:
            found.append(parse_time_ns(line[:29]) if line.strip() else 0)
        except ValueError as error:
            raise InputError(f"{path}: line {number}: {error}; correct or remove it") from error
    return np.array(found, dtype=np.int64)


def _turns(folder: Path, sweeps: list[Path]) -> tuple[Ints, Ints]:
    """Return when each sweep (S,) begins and ends; from the stamps alone where no ends are recorded."""
    rows = _numbers(sweeps)
    named = [folder / f"timestamps_{name}.txt" for name in ("start", "end")]
    if all(path.is_file() for path in named):
        start_ns, end_ns = (_of(path, rows) for path in named)
    else:
        middle_ns = _of(folder / "timestamps.txt", rows)
        steps = np.diff(middle_ns) / np.maximum(np.diff(rows), 1)
        turn_ns = float(np.median(steps)) if len(steps) else 1e8
        start_ns, end_ns = (middle_ns + round(share * turn_ns) for share in (-0.5, 0.5))
    lasts = end_ns - start_ns
    if (lasts <= 0).any() or (lasts > _SLOWEST_TURN_NS).any() or (np.diff(start_ns) <= 0).any():
        raise InputError(f"{folder}: stamps of the sweeps are not those of a turning scanner; check them")
    return start_ns, end_ns


def _numbers(files: list[Path]) -> Ints:
    """Return the numbers that files are named by; they tell the lines of their stamps."""
    try:
        return np.array([int(path.stem) for path in files], dtype=np.int64)
    except ValueError as error:
        raise InputError(f"{files[0].parent}: files are not named by their number ({error})") from error


def _of(path: Path, rows: Ints) -> Ints:
    stamps = _stamps(path)
    if rows.max() >= len(stamps) or (stamps[rows] == 0).any():
        raise InputError(f"{path}: {len(stamps)} stamps, but file number {rows.max()}; stamps are missing")
    return np.asarray(stamps[rows])


def _clouds(sweeps: list[Path], start_ns: Ints, end_ns: Ints) -> Iterator[LogMessage]:
    for path, start, end in zip(sweeps, start_ns.tolist(), end_ns.tolist(), strict=True):
        values = _points(path)
        share = 0.5 - np.arctan2(values[:, 1], values[:, 0]) / (2.0 * np.pi)
        times_ns = start + np.round(share * (end - start)).astype(np.int64)
        if len(values):
            xyz = raised(values[:, :3].astype(np.float64))
            yield cloud_message(xyz, times_ns, intensity=255.0 * values[:, 3])


def raised(xyz: Floats) -> Floats:
    """Return points (N, 3) of the scanner with corrected elevation angles [m]."""
    level = np.hypot(xyz[:, 0], xyz[:, 1])
    sine, cosine = np.sin(np.radians(ELEVATION_DEG)), np.cos(np.radians(ELEVATION_DEG))
    nearer = cosine - sine * xyz[:, 2] / np.maximum(level, 1e-9)
    return np.column_stack([xyz[:, :2] * nearer[:, None], sine * level + cosine * xyz[:, 2]])


def _points(path: Path) -> NDArray[np.float32]:
    data = path.read_bytes()
    if len(data) % 16:
        raise InputError(f"{path}: {len(data)} bytes are no rows of four float32; copy the file again")
    points = np.frombuffer(data, dtype="<f4").reshape(-1, 4)
    if not np.isfinite(points[:, :3]).all():
        raise InputError(f"{path}: coordinates that are not finite; copy the file again")
    return points


def _frames(folder: Path) -> dict[str, Floats]:
    """Return the poses of the sensors in the INS's frame."""
    path = next((p for p in (folder / CALIBRATION, folder.parent / CALIBRATION) if p.is_file()), None)
    if path is None:
        raise InputError(
            f"{folder}: no {CALIBRATION} in it or above it; it is in the calibration archive of the day"
        )
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        rows = dict(line.split(":", 1) for line in lines if ":" in line)
        rotation = np.array(rows["R"].split(), dtype=np.float64).reshape(3, 3)
        place = np.array(rows["T"].split(), dtype=np.float64).reshape(3)
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{path}: R or T cannot be read ({error}); copy the file again") from error
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise InputError(f"{path}: R is no rotation; copy the file again")
    T_velo_imu = make_pose(rotation, place)
    return {"lidar_link": invert_pose(T_velo_imu), "imu_link": np.eye(4), "gnss_link": np.eye(4)}


def _ins(folder: Path) -> tuple[Ints, Floats]:
    """Return times (N,) and rows (N, 30) of the INS."""
    files = sorted((folder / "data").glob("*.txt"))
    if not files:
        raise InputError(f"{folder}: no data/*.txt; take the folder away to map without fixes")
    rows = []
    for path in files:
        try:
            rows.append(np.array(path.read_text(encoding="utf-8").split()[:_COLUMNS], dtype=np.float64))
        except ValueError as error:
            raise InputError(f"{path}: {error}; copy the file again") from error
        if len(rows[-1]) < _COLUMNS:
            raise InputError(f"{path}: {len(rows[-1])} values, {_COLUMNS} are needed; copy the file again")
    return _of(folder / "timestamps.txt", _numbers(files)), np.array(rows)


def _fixes(times_ns: Ints, rows: Floats) -> Iterator[LogMessage]:
    for time_ns, row in zip(times_ns.tolist(), rows, strict=True):
        sigma = row[_ACCURACY]
        covariance = np.diag(np.square([sigma, sigma, 2.0 * sigma]))
        state = _STATES.get(int(row[_MODE]), -1)
        yield fix_message(time_ns, row[:3], covariance, state, known=bool(sigma > 0))


def _samples(times_ns: Ints, rows: Floats) -> Iterator[LogMessage]:
    for time_ns, row in zip(times_ns.tolist(), rows, strict=True):
        yield imu_message(time_ns, row[_RATES], row[_ACCEL])
