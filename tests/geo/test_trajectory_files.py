"""Trajectories of other systems: a drive with known poses comes back from every format, or is refused."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from subiaco_geo.crs import require_crs
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.geoid import ellipsoidal_heights, geoid_heights, undulations
from subiaco_geo.sources import open_epoch
from subiaco_geo.trajectories import Trajectory, write_tum
from subiaco_geo.trajectory_files.attitude import (
    directions_of_travel,
    offset_from_travel,
    rotation_from_enu,
    rotation_from_ned,
)
from subiaco_geo.trajectory_files.formats import GPS_EPOCH_NS, WEEK_NS, TrajectoryFormat
from subiaco_geo.trajectory_files.reading import read_trajectory

MGA = "EPSG:7850"
WEEK, START = 2340, 345_600.0  # GPS week, seconds of it
LEAP = 18
#: Of MGA zone 50 west of its meridian at 117 E: grid north lies east of true north here (southern half).
HERE = np.array([391_200.0, 6_464_300.0, -20.0])


def drive(count: int = 400, rate: float = 20.0) -> tuple[Floats, Floats, Floats]:
    """A drive round a bend at 10 m/s: seconds, map positions, and roll, pitch, true heading."""
    t = np.arange(count) / rate
    bearing = 0.3 + 0.06 * t  # of travel, clockwise from true north
    steps = 10.0 / rate * np.column_stack([np.sin(bearing), np.cos(bearing), 0.02 * np.ones(count)])
    true = np.cumsum(steps, axis=0)
    c = convergence()
    turn = np.array([[np.cos(c), np.sin(c), 0], [-np.sin(c), np.cos(c), 0], [0, 0, 1]])
    roll, pitch = 0.03 * np.sin(t), 0.02 + 0.0 * t
    return t, HERE + true @ turn.T, np.column_stack([roll, pitch, bearing])


def convergence() -> float:
    """Grid azimuth of true north at the drive [rad], from two places a second of arc apart."""
    back = Transformer.from_crs(7850, 7844, always_xy=True)
    lon, lat = back.transform(*HERE[:2])
    east, north = back.transform([lon, lon], [lat, lat + 1 / 3600], direction="INVERSE")
    return float(np.arctan2(east[1] - east[0], north[1] - north[0]))


def geographic(positions: Floats) -> Floats:
    lon, lat = Transformer.from_crs(7850, 7844, always_xy=True).transform(positions[:, 0], positions[:, 1])
    return np.column_stack([lat, lon, positions[:, 2]])


def expected(attitude: Floats) -> Floats:
    """Axes of the body (forward, left, up) in the grid, written out from the definitions of the angles."""
    roll, pitch, heading = attitude.T
    grid = heading + convergence()
    forward = np.column_stack([np.sin(grid) * np.cos(pitch), np.cos(grid) * np.cos(pitch), np.sin(pitch)])
    level_left = np.column_stack([-np.cos(grid), np.sin(grid), 0.0 * grid])
    up0 = np.cross(forward, level_left)
    left = np.cos(roll)[:, None] * level_left + np.sin(roll)[:, None] * up0
    return np.stack([forward, left, np.cross(forward, left)], axis=2)


def street(path: Path, positions: Floats, times: Floats | None = None, week: bool = False) -> Path:
    """A LAZ of the ground 2 m below the drive and of facades along it, measured within 20 m of each pose."""
    rng = np.random.default_rng(3)
    rows = np.repeat(np.arange(len(positions)), 20)
    away = rng.uniform(-20, 20, (len(rows), 2))
    ground = np.column_stack([positions[rows, :2] + away, positions[rows, 2] - 2.0])
    wall = rng.random(len(rows)) < 0.3
    ground[wall, 2] += rng.uniform(0, 8, wall.sum())
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.offsets, header.scales = np.floor(positions[0]), np.full(3, 0.001)
    header.add_crs(require_crs(MGA))
    if not week:
        header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    las = laspy.LasData(header)
    las.x, las.y, las.z = ground.T
    if times is not None:
        las.gps_time = times[rows]
    las.write(path)
    return path


def sbet(
    path: Path, t: Floats, positions: Floats, attitude: Floats, wander: float = 0.0, sign: int = 1
) -> Path:
    rows = np.zeros((len(t), 17))
    rows[:, 0] = START + t
    rows[:, 1:3] = np.radians(geographic(positions)[:, :2])
    rows[:, 3] = positions[:, 2]
    rows[:, 7:10] = attitude
    rows[:, 9] += sign * wander
    rows[:, 10] = wander
    path.write_bytes(rows.astype("<f8").tobytes())
    return path


def check(found: Trajectory, positions: Floats, attitude: Floats) -> None:
    np.testing.assert_allclose(found.positions, positions, atol=1e-3)
    np.testing.assert_allclose(found.poses[:, :3, :3], expected(attitude), atol=5e-5)


@pytest.mark.parametrize("name", ["sbet_mission.out", "drive.sbet"])
def test_an_sbet_gives_the_poses_of_the_drive_in_the_grid_of_the_cloud(tmp_path: Path, name: str) -> None:
    t, positions, attitude = drive()
    cloud = street(tmp_path / "cloud.laz", positions)
    found = read_trajectory(sbet(tmp_path / name, t, positions, attitude), cloud, MGA).trajectory
    check(found, positions, attitude)
    np.testing.assert_allclose(found.times_ns / 1e9, START + t, atol=1e-6)  # of an unknown week
    assert abs(np.degrees(convergence())) > 0.5


@pytest.mark.parametrize("sign", [1, -1])
def test_a_wander_angle_of_either_sign_is_taken_out_by_the_direction_of_travel(
    tmp_path: Path, sign: int
) -> None:
    t, positions, attitude = drive()
    cloud = street(tmp_path / "cloud.laz", positions)
    path = sbet(tmp_path / "drive.sbet", t, positions, attitude, wander=0.9, sign=sign)
    check(read_trajectory(path, cloud, MGA).trajectory, positions, attitude)


def test_times_are_dated_by_the_week_and_come_out_in_utc(tmp_path: Path) -> None:
    t, positions, attitude = drive()
    cloud = street(tmp_path / "cloud.laz", positions)
    form = TrajectoryFormat(gps_week=WEEK)
    found = read_trajectory(
        sbet(tmp_path / "drive.sbet", t, positions, attitude), cloud, MGA, form
    ).trajectory
    first = GPS_EPOCH_NS + WEEK * WEEK_NS + int(START - LEAP) * 10**9
    assert found.times_ns[0] == first
    assert str(np.datetime64(first, "ns"))[:19] == "2024-11-13T23:59:42"


@pytest.mark.parametrize(
    ("header", "convention"),
    [
        ("time,latitude,longitude,height,roll,pitch,heading", "ned"),
        ("UTC;Lat;Lon;h;Roll(deg);Pitch(deg);Heading(deg)", "ned"),
        ("# time latitude longitude height roll pitch yaw", "enu"),
        ("time\tx\ty\tz\tqx\tqy\tqz\tqw", "quaternion"),
    ],
)
def test_tables_of_every_separator_and_convention_give_the_same_poses(
    tmp_path: Path, header: str, convention: str
) -> None:
    t, positions, attitude = drive()
    places = positions if convention == "quaternion" else geographic(positions)
    angles = np.degrees(attitude)
    if convention == "enu":  # of true east; nose down is positive
        angles = np.column_stack([angles[:, 0], -angles[:, 1], 90.0 - angles[:, 2]])
    if convention == "quaternion":
        angles = Rotation.from_matrix(expected(attitude)).as_quat()
    rows = np.column_stack([1_700_000_000.0 + t, places, angles])
    delimiter = next((letter for letter in ",;\t" if letter in header), " ")
    lines = [
        delimiter.join(f"{value:.12g}" if k else f"{value:.3f}" for k, value in enumerate(row))
        for row in rows
    ]
    path = tmp_path / "drive.txt"
    path.write_text("\n".join([header, *lines]))
    cloud = street(tmp_path / "cloud.laz", positions)
    check(read_trajectory(path, cloud, MGA).trajectory, positions, attitude)


def test_a_table_in_another_grid_is_brought_to_that_of_the_cloud(tmp_path: Path) -> None:
    t, positions, attitude = drive()
    east, north = Transformer.from_crs(7850, 7851, always_xy=True).transform(positions[:, 0], positions[:, 1])
    quaternion = Rotation.from_matrix(expected(attitude)).as_quat()
    zone = np.column_stack([east, north, positions[:, 2]])
    rows = np.column_stack([1_700_000_000.0 + t, zone, quaternion])
    lines = "\n".join(",".join(repr(float(value)) for value in row) for row in rows)
    (tmp_path / "zone51.csv").write_text(f"time,x,y,z,qx,qy,qz,qw\n{lines}\n")
    cloud = street(tmp_path / "cloud.laz", positions)
    form = TrajectoryFormat(crs="EPSG:7851")
    found = read_trajectory(tmp_path / "zone51.csv", cloud, MGA, form).trajectory
    np.testing.assert_allclose(found.positions, positions, atol=2e-3)
    apart = Rotation.from_matrix(found.poses[:, :3, :3]) * Rotation.from_matrix(expected(attitude)).inv()
    shift = np.degrees(
        apart.as_euler("ZYX")
    )  # axes of zone 51 were written, so they turn by both convergences
    assert 2.5 < abs(shift[0, 0]) < 4.5
    np.testing.assert_allclose(shift[:, 1:], 0.0, atol=1e-6)


def test_a_solution_of_rtklib_is_level_and_faces_its_direction_of_travel(tmp_path: Path) -> None:
    t, positions, attitude = drive()
    places = geographic(positions)
    rows = [
        f"{WEEK} {START + s:.3f} {a:.10f} {o:.10f} {h:.4f} 1 9"
        for s, (a, o, h) in zip(t, places, strict=True)
    ]
    path = tmp_path / "drive.pos"
    path.write_text("\n".join(["%  GPST latitude(deg) longitude(deg) height(m) Q ns", *rows]))
    found = read_trajectory(path, street(tmp_path / "cloud.laz", positions), MGA).trajectory
    np.testing.assert_allclose(found.positions, positions, atol=2e-3)
    np.testing.assert_allclose(found.poses[:, 2, 2], 1.0)
    off = np.einsum("nij,nij->n", found.poses[:, :3, :1], expected(attitude)[:, :, :1])
    assert off.min() > np.cos(np.radians(3.0))
    assert found.times_ns[0] == GPS_EPOCH_NS + WEEK * WEEK_NS + int(START - LEAP) * 10**9


def test_the_lever_arm_and_the_mounting_lead_from_the_reference_point_to_the_lidar(tmp_path: Path) -> None:
    t, positions, attitude = drive()
    form = TrajectoryFormat(lever_arm=(0.5, -0.2, 1.1), mounting_deg=(0.0, 0.0, 90.0))
    cloud = street(tmp_path / "cloud.laz", positions)
    found = read_trajectory(
        sbet(tmp_path / "drive.sbet", t, positions, attitude), cloud, MGA, form
    ).trajectory
    body = expected(attitude)
    np.testing.assert_allclose(found.positions, positions + body @ [0.5, -0.2, 1.1], atol=1e-3)
    np.testing.assert_allclose(found.poses[:, :3, 0], body[:, :, 1], atol=5e-5)  # its x axis looks left


@pytest.mark.parametrize("week", [True, False])
def test_only_poses_of_the_seconds_in_which_points_were_measured_are_used(tmp_path: Path, week: bool) -> None:
    t, positions, attitude = drive()
    half = t < 10.0
    stamps = START + t if week else START + t + WEEK * 604_800 - 1e9
    cloud = street(tmp_path / "cloud.laz", positions[half], stamps[half], week)
    form = TrajectoryFormat(gps_week=None if week else WEEK)
    path = sbet(tmp_path / "drive.sbet", t, positions, attitude)
    found = read_trajectory(path, cloud, MGA, form)
    assert len(found.trajectory) == np.count_nonzero(t < 11.0)
    assert len(
        read_trajectory(path, cloud, MGA, form.model_copy(update={"match_times": False})).trajectory
    ) == len(t)
    assert found.view is not None
    low, high = np.degrees([found.view.elevation_min, found.view.elevation_max])
    assert -90 < low < -40  # ground right beside
    assert 40 < high < 90  # walls 6 m above, near
    assert 20 < found.view.useful_range < 30
    info = open_epoch(cloud, path, form).info
    assert info["sensor"]["useful_range_m"] == pytest.approx(found.view.useful_range, abs=0.06)


def test_a_trajectory_of_another_day_is_refused_with_both_times(tmp_path: Path) -> None:
    t, positions, attitude = drive()
    cloud = street(tmp_path / "cloud.laz", positions, START + t + 40_000.0, week=True)
    path = sbet(tmp_path / "drive.sbet", t, positions, attitude)
    with pytest.raises(
        InputError, match=r"drive.sbet: its times .*nothing in common.*trajectories.after.clock"
    ):
        read_trajectory(path, cloud, MGA, None, "trajectories.after")


def test_stamps_in_the_wrong_time_scale_are_refused_by_the_length_of_the_beams(tmp_path: Path) -> None:
    t, positions, attitude = drive(1200)
    cloud = street(tmp_path / "cloud.laz", positions, START + t, week=True)
    path = sbet(tmp_path / "drive.sbet", t, positions, attitude)
    assert len(read_trajectory(path, cloud, MGA).trajectory) == len(t)
    with pytest.raises(InputError, match=r"the clocks differ; set trajectories.clock"):
        read_trajectory(path, cloud, MGA, TrajectoryFormat(clock="utc"))


def gtx(path: Path) -> Path:
    """A geoid 30 m below the ellipsoid, 1 deg grid."""
    data = struct.pack(">4d2i", -33.0, 115.0, 1.0, 1.0, 3, 3)
    path.write_bytes(data + struct.pack(">9f", *[-30.0] * 9))
    return path


def test_heights_of_two_kinds_are_refused_and_brought_together_by_the_geoid(tmp_path: Path) -> None:
    t, positions, attitude = drive()
    above_geoid = positions + np.array([0, 0, 30.0])
    cloud = street(tmp_path / "cloud.laz", above_geoid)
    path = sbet(tmp_path / "drive.sbet", t, positions, attitude)
    with pytest.raises(InputError, match=r"lies 2[78]\.\d m below the ground.*geoid_grid"):
        read_trajectory(path, cloud, MGA)
    form = TrajectoryFormat(geoid_grid=gtx(tmp_path / "geoid.gtx"))
    check(read_trajectory(path, cloud, MGA, form).trajectory, above_geoid, attitude)


def test_heights_above_the_geoid_and_the_ellipsoid_are_inverse_to_each_other(tmp_path: Path) -> None:
    grid = gtx(tmp_path / "geoid.gtx")
    rows = np.array([[-32.0, 115.8, 12.0], [-31.5, 116.2, -3.0]])
    np.testing.assert_allclose(geoid_heights(ellipsoidal_heights(rows, grid), grid), rows, atol=1e-6)
    np.testing.assert_allclose(undulations(HERE[None, :2], MGA, grid), [-30.0], atol=1e-4)
    with pytest.raises(InputError, match="does not cover"):
        undulations(np.array([[500_000.0, 5_000_000.0]]), MGA, grid)


def test_other_places_other_files_and_clouds_without_crs_are_refused(tmp_path: Path) -> None:
    t, positions, attitude = drive()
    cloud = street(tmp_path / "cloud.laz", positions)
    far = sbet(tmp_path / "far.sbet", t, positions + np.array([9_000.0, 0, 0]), attitude)
    with pytest.raises(InputError, match=r"far.sbet: lies \d\.\d km from the cloud"):
        read_trajectory(far, cloud, MGA)
    near = sbet(tmp_path / "near.sbet", t, positions, attitude)
    with pytest.raises(InputError, match=r"near.sbet: the trajectory has latitude.*the cloud has no CRS"):
        read_trajectory(near, cloud, None)
    (tmp_path / "cut.sbet").write_bytes(near.read_bytes()[:-9])
    with pytest.raises(InputError, match=r"cut.sbet: \d+ bytes are no rows of 17 doubles"):
        read_trajectory(tmp_path / "cut.sbet", cloud, MGA)
    rows = np.frombuffer(near.read_bytes()).reshape(-1, 17).copy()
    rows[7, 1] = 90.0
    (tmp_path / "degrees.sbet").write_bytes(rows.tobytes())
    with pytest.raises(InputError, match=r"degrees.sbet: row 8 holds no latitude"):
        read_trajectory(tmp_path / "degrees.sbet", cloud, MGA)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time,x,y\n1,2,3\n", "no column of the height"),
        ("time,x,y,z\n1,2,3,4\n2,2,a,4\n", r"drive.csv:3: column y holds 'a'"),
        ("time,x,y,z\n1,2,3,4\n0,2,3,4\n", r"drive.csv:3: column time: time does not increase"),
        ("time,x,y,z\n1,2,3\n", r"drive.csv:2: 3 cells for 4 columns"),
        ("1,2,3,4\n2,2,3,4\n", "no line of column names"),
        ("time,lat,lon,h\n1,391200,6464300,4\n", "are no degrees"),
        ("", "no poses in it"),
    ],
)
def test_a_table_that_cannot_be_read_is_refused_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "drive.csv").write_text(text)
    cloud = street(tmp_path / "cloud.laz", drive()[1])
    with pytest.raises(InputError, match=said):
        read_trajectory(tmp_path / "drive.csv", cloud, MGA)


def test_a_tum_file_is_read_as_it_is_and_without_looking_at_the_cloud(tmp_path: Path) -> None:
    t, positions, attitude = drive()
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = expected(attitude), positions
    write_tum(
        tmp_path / "drive.txt",
        Trajectory((1_700_000_000 + t * 1.0).astype(np.int64) * 10**9 + np.arange(400), poses),
    )
    found = read_trajectory(tmp_path / "drive.txt", tmp_path / "absent.ply", None).trajectory
    np.testing.assert_allclose(found.poses[:, :3, :3], expected(attitude), atol=1e-6)


def test_both_conventions_of_angles_name_the_same_body() -> None:
    rng = np.random.default_rng(5)
    roll, pitch, heading = rng.uniform(-0.4, 0.4, 50), rng.uniform(-0.4, 0.4, 50), rng.uniform(-3, 3, 50)
    np.testing.assert_allclose(
        rotation_from_ned(roll, pitch, heading),
        rotation_from_enu(roll, -pitch, np.pi / 2 - heading),
        atol=1e-12,
    )


def test_a_vehicle_that_stands_keeps_its_direction() -> None:
    way = np.concatenate([np.linspace(0, 20, 41), np.full(30, 20.0), np.linspace(20, 25, 11)])
    positions = np.column_stack([0.6 * way, 0.8 * way, 0 * way])
    np.testing.assert_allclose(directions_of_travel(positions), np.arctan2(0.8, 0.6), atol=1e-9)
    assert offset_from_travel(positions, rotation_from_enu(*np.zeros((2, 82)), np.full(82, np.pi / 2))) == (
        pytest.approx(np.pi / 2 - np.arctan2(0.8, 0.6))
    )
    assert offset_from_travel(np.zeros((5, 3)), np.tile(np.eye(3), (5, 1, 1))) is None
