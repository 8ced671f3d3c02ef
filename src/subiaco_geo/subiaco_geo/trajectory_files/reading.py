"""Read the trajectory of a bare cloud in the form in which it was delivered, and test that it fits."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.free_space.sensor_view import SensorView, spin_axes
from subiaco_geo.trajectories import Trajectory, read_tum
from subiaco_geo.trajectory_files.attitude import offset_from_travel
from subiaco_geo.trajectory_files.cloud_sample import CloudSample, has_times, sample_cloud
from subiaco_geo.trajectory_files.formats import (
    DATED_NS,
    GPS_EPOCH_NS,
    WEEK_NS,
    Clock,
    FormatName,
    RecordedPath,
    TrajectoryFormat,
)
from subiaco_geo.trajectory_files.georeference import poses_of_lidar
from subiaco_geo.trajectory_files.rtklib import read_solution_path
from subiaco_geo.trajectory_files.sbet import read_sbet
from subiaco_geo.trajectory_files.tables import first_row, read_table

_LOG = logging.getLogger(__name__)
_SUFFIXES: dict[str, FormatName] = {".sbet": "sbet", ".out": "sbet", ".pos": "pos", ".tum": "tum"}
_ADJUSTED_NS, _FIRST_NS = 10**18, 900_000_000 * 10**9  # LAS takes a billion seconds off GPS time
_STEP_NS = 20_000_000  # more poses a second than 50 tell nothing of what was seen
_NEAR = 5.0  # points so close to a pose, in plan, show the ground under it [m]
_BELOW, _ABOVE = -1.0, 10.0  # of a LiDAR over the ground: lower is wrong, higher worth a word [m]
_REACH = 2_000.0  # no LiDAR of a survey sees farther [m]
_WEEK = WEEK_NS // 10**9
_SHARE = 0.5  # of the seconds of a cloud that its trajectory should cover
_ASTRAY = np.radians(30.0)
_LATE = 5.0  # beams so many times longer than the way to the path: the clocks differ
_LONG = 100.0  # and at least so long [m]
_VIEW, _RANGE = 0.001, 0.99  # shares of beams outside a side of the field of view, and within the range


@dataclass(frozen=True)
class BareTrajectory:
    """The trajectory of a bare cloud.

    Parameters
    ----------
    trajectory : Trajectory
        Poses of the LiDAR in the CRS of the cloud; times in UTC where they are dated.
    view : SensorView, optional
        Of the LiDAR, where the times of the points tell along which beam each was measured.
    """

    trajectory: Trajectory
    view: SensorView | None = None


def read_trajectory(
    path: Path,
    cloud: Path,
    crs: str | None,
    form: TrajectoryFormat | None = None,
    group: str = "trajectories",
) -> BareTrajectory:
    """Read a trajectory file for a cloud.

    Parameters
    ----------
    path : Path
        SBET, RTKLIB solution, table with named columns, or TUM.
    cloud : Path
        The cloud that was measured along it.
    crs : str, optional
        Of the cloud.
    form : TrajectoryFormat, optional
        What the file does not say itself.
    group : str
        Settings that errors name, such as ``trajectories.before``.

    Raises
    ------
    InputError
        The file is not of its format, cannot be brought to the CRS of the cloud, or does not belong to the
        cloud: elsewhere, below its ground, or at other times.
    """
    form = TrajectoryFormat() if form is None else form
    path = Path(path)
    kind = _kind_of(path) if form.kind == "auto" else form.kind
    recorded = _READERS[kind](path, form, group)
    if len(recorded.times_ns) < 2:
        raise InputError(f"{path}: holds fewer than 2 poses; give the whole trajectory, or leave it out")
    clock, times_ns = _dated(recorded, form)
    thin = np.arange(len(times_ns)) if kind == "tum" else _thinned(times_ns)
    turned = None if recorded.rotations is None else recorded.rotations[thin]
    recorded = RecordedPath(times_ns[thin], clock, recorded.positions[thin], recorded.geographic, turned)
    try:
        poses = poses_of_lidar(recorded, crs, form, group)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    if kind == "tum" and not has_times(cloud):
        return BareTrajectory(Trajectory(recorded.times_ns, poses))
    sample = sample_cloud(cloud)
    kept, of_week = _at_times_of(path, recorded, sample, form, group)
    times_ns, poses = recorded.times_ns[kept], poses[kept]
    _refuse_elsewhere(path, poses, sample, group)
    _say_astray(path, poses, recorded)
    stamps = _gps_seconds(times_ns, clock, form, of_week=of_week)
    view = None if stamps is None else _view(path, stamps, poses, sample, of_week=of_week, group=group)
    return BareTrajectory(Trajectory(_to_utc(times_ns, clock, form), poses), view)


def _tum(path: Path, form: TrajectoryFormat, _group: str) -> RecordedPath:
    found = read_tum(path)
    clock: Clock = "gps" if form.clock == "gps" else "utc"
    return RecordedPath(found.times_ns, clock, found.positions, False, found.poses[:, :3, :3])


def _sbet(path: Path, form: TrajectoryFormat, _group: str) -> RecordedPath:
    found = read_sbet(path)
    late = form.leap_seconds * 10**9 if form.clock == "utc" else 0
    return replace(found, times_ns=found.times_ns + late)


_READERS: dict[FormatName, Callable[[Path, TrajectoryFormat, str], RecordedPath]] = {
    "tum": _tum,
    "sbet": _sbet,
    "pos": lambda path, form, _group: read_solution_path(path, form.leap_seconds),
    "csv": read_table,
}


def _kind_of(path: Path) -> FormatName:
    """Tell the format by the ending, of texts by the first row: eight numbers are TUM."""
    known = _SUFFIXES.get(path.suffix.lower())
    if known is not None:
        return known
    words = first_row(path).split()
    try:
        return "tum" if len(words) == 8 and all(np.isfinite([float(word) for word in words])) else "csv"
    except ValueError:
        return "tum" if words and not path.suffix else "csv"


def _dated(recorded: RecordedPath, form: TrajectoryFormat) -> tuple[Clock, Ints]:
    """Tell the scale of the stamps, and return them in it [ns]."""
    times_ns = recorded.times_ns
    first = int(times_ns[0])
    if recorded.clock != "gps":
        return ("none" if first < DATED_NS else "utc"), times_ns
    if first >= 2 * WEEK_NS:
        return "gps", times_ns + (_ADJUSTED_NS if first < _FIRST_NS else 0)
    if form.gps_week is None:
        return "week", times_ns
    return "gps", times_ns + form.gps_week * WEEK_NS


def _thinned(times_ns: Ints) -> Ints:
    """Return the rows (M,) that stay when poses closer in time than 20 ms are thinned."""
    cells = (times_ns - times_ns[0]) // _STEP_NS
    return np.flatnonzero(np.concatenate([[True], np.diff(cells) > 0]))


def _to_utc(times_ns: Ints, clock: Clock, form: TrajectoryFormat) -> Ints:
    """Return UTC, seconds of an unknown week as they are [ns]."""
    return times_ns + (GPS_EPOCH_NS - form.leap_seconds * 10**9) if clock == "gps" else times_ns


def _gps_seconds(times_ns: Ints, clock: Clock, form: TrajectoryFormat, *, of_week: bool) -> Floats | None:
    """Return GPS seconds (N,), of the week where asked; None where the stamps have no date."""
    if clock == "none":
        return None
    if clock == "utc":
        times_ns = times_ns - (GPS_EPOCH_NS - form.leap_seconds * 10**9)
    return np.asarray((times_ns % WEEK_NS if of_week else times_ns) / 1e9)


def _at_times_of(
    path: Path, recorded: RecordedPath, sample: CloudSample, form: TrajectoryFormat, group: str
) -> tuple[Ints, bool]:
    """Return the rows (M,) during which the points were measured, and whether weeks were left out.

    Rows a second before and after count too. All rows where either has no times.
    """
    everything = np.arange(len(recorded.times_ns))
    of_week = sample.of_week or recorded.clock == "week"
    stamps = _gps_seconds(recorded.times_ns, recorded.clock, form, of_week=of_week)
    if sample.times is None or stamps is None or not form.match_times:
        return everything, of_week
    seconds = np.unique(sample.seconds % _WEEK) if of_week else sample.seconds
    around = np.unique(np.concatenate([seconds + offset for offset in (-1, 0, 1)]))
    kept = everything[np.isin(np.floor(stamps).astype(np.int64), around)]
    if len(kept) == 0:
        raise InputError(
            f"{path}: its times ({stamps.min():.0f} to {stamps.max():.0f} s) and the gps_time of the points "
            f"({seconds.min()} to {seconds.max()} s) have nothing in common; give the trajectory of this "
            f"cloud, set {group}.clock or {group}.gps_week, or {group}.match_times=false to use every pose"
        )
    covered = float(np.isin(seconds, np.unique(np.floor(stamps[kept]).astype(np.int64))).mean())
    if covered < _SHARE:
        _LOG.warning("%s: covers %.0f %% of the seconds in which the cloud was measured", path, 100 * covered)
    return kept, of_week


def _refuse_elsewhere(path: Path, poses: Floats, sample: CloudSample, group: str) -> None:
    """Refuse a trajectory away from the cloud, or under its ground."""
    tree = cKDTree(sample.world[:, :2])
    eyes = poses[:: max(len(poses) // 2000, 1), :3, 3]
    distance, _ = tree.query(eyes[:, :2])
    if distance.min() > _REACH:
        raise InputError(
            f"{path}: lies {distance.min() / 1000:.1f} km from the cloud; give its own trajectory, or state "
            f"its coordinate system with {group}.crs or {group}.declared_frame"
        )
    near = eyes[distance < _NEAR]
    around = tree.query_ball_point(near[:, :2], _NEAR)
    over = [eye[2] - np.quantile(sample.world[rows, 2], 0.1) for eye, rows in zip(near, around, strict=True)]
    if not over:
        return
    height = float(np.median(over))
    if height < _BELOW:
        raise InputError(
            f"{path}: lies {-height:.1f} m below the ground of the cloud: heights of two kinds, probably "
            f"above the ellipsoid and the geoid; give the geoid model of the cloud with {group}.geoid_grid"
        )
    if height > _ABOVE:
        _LOG.warning(
            "%s: lies %.0f m above the ground of the cloud; right for an aircraft, else heights are of two "
            "kinds: see %s.geoid_grid", path, height, group,
        )  # fmt: skip


def _say_astray(path: Path, poses: Floats, recorded: RecordedPath) -> None:
    """Warn where the body faces another way than it travels, as wrong conventions make it."""
    if recorded.rotations is None:
        return
    off = offset_from_travel(poses[:, :3, 3], poses[:, :3, :3])
    upright = float(np.abs(poses[:, 2, :3].mean(axis=0)).max())
    if off is not None and abs(off) > _ASTRAY and upright > np.cos(_ASTRAY):
        _LOG.warning(
            "%s: faces %.0f deg off its direction of travel; right for a LiDAR that is mounted so, else its "
            "convention of angles is another", path, np.degrees(off),
        )  # fmt: skip


def _view(
    path: Path, stamps: Floats, poses: Floats, sample: CloudSample, *, of_week: bool, group: str
) -> SensorView | None:
    """Return the field of view and range of the beams, each from the pose at the time of its point.

    None where the points have no times.
    """
    if sample.times is None:
        return None
    times = sample.times % _WEEK if of_week else sample.times
    order = np.argsort(stamps, kind="stable")
    at = np.searchsorted(stamps[order], times).clip(1, len(stamps) - 1)
    at -= (times - stamps[order][at - 1]) < (stamps[order][at] - times)
    rows = order[at]
    timely = np.abs(stamps[rows] - times) < 1.0
    rows, points = rows[timely], sample.world[timely]
    if len(rows) < 100:
        return None
    way = points - poses[rows, :3, 3]
    distance = np.linalg.norm(way, axis=1)
    _refuse_late(path, points, poses, distance, group)
    axes = spin_axes(poses[:, :3, :3])[rows]
    elevation = np.arcsin(np.clip(np.einsum("ij,ij->i", way, axes) / np.maximum(distance, 1e-9), -1.0, 1.0))
    low, high = np.quantile(elevation, [_VIEW, 1.0 - _VIEW])
    return SensorView(float(low), float(high), float(np.quantile(distance, _RANGE)))


def _refuse_late(path: Path, points: Floats, poses: Floats, distance: Floats, group: str) -> None:
    """Refuse clocks that differ: points far from where the LiDAR was then, and near its path."""
    nearest, _ = cKDTree(poses[:, :3, 3]).query(points)
    if np.median(distance) > max(_LONG, _LATE * float(np.median(nearest))):
        raise InputError(
            f"{path}: the points lie {np.median(distance):.0f} m from where the LiDAR was when they were "
            f"measured, and {np.median(nearest):.0f} m from its path: the clocks differ; set {group}.clock "
            f"(utc or gps) or {group}.leap_seconds"
        )
