"""Control points and a reference cloud correct a survey whose GNSS is biased, and wrong ones are named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import from_world
from subiaco_geo.crs import EnuFrame
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, invert_pose, make_pose
from subiaco_mapping.absolute_positions.positioning import AbsoluteFacts
from subiaco_mapping.backend import MappingBackend
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.control_points import read_control, split_roles
from subiaco_mapping.measurements import DeskewedScan, Extrinsics, GnssFix, OdometryPose

FRAME = EnuFrame(-31.948, 115.825, 12.0)
MGA = "EPSG:7850"
START_NS, STEP = 1_760_000_000 * 10**9, 10**8
T_BASE_LIDAR = make_pose(np.eye(3), [0.0, 0.0, 2.0])
EXTRINSICS = Extrinsics(T_BASE_LIDAR, None, np.array([0.0, 0.0, 2.5]))
COUNT, SPEED = 160, 8.0
BIAS = np.array([0.0, 0.0, 0.3])


def poses() -> Floats:
    """Truth in ENU: 128 m of road towards the north-east, round a gentle bend, LiDAR 2 m above the ground."""
    t = np.arange(COUNT) * STEP / 1e9
    yaw = 0.6 + 0.02 * t
    way = np.cumsum(SPEED * STEP / 1e9 * np.column_stack([np.cos(yaw), np.sin(yaw)]), axis=0)
    turn = np.zeros((COUNT, 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(yaw)
    turn[:, 1, 0], turn[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    turn[:, 2, 2] = 1.0
    return make_pose(turn, np.column_stack([way, ground(way) + 2.0]))


def ground(xy: Floats) -> Floats:
    return np.asarray(0.02 * xy[..., 0] - 0.01 * xy[..., 1])


def street(seed: int = 1) -> Floats:
    """Ground and the walls of houses along the road, in ENU."""
    rng = np.random.default_rng(seed)
    middle = poses()[:, :3, 3]
    at = middle[rng.integers(0, COUNT, 60_000), :2] + rng.uniform(-14, 14, (60_000, 2))
    parts = [np.column_stack([at, ground(at)])]
    for k in range(5, COUNT, 12):
        pose = poses()[k]
        for side in (-1, 1):
            u, h = rng.uniform(0, 6, 900), rng.uniform(0, 5, 900)
            face = np.column_stack([u, np.full(900, side * (13.0 + k % 5)), h - 2.0])
            flank = np.column_stack([np.zeros(900), side * (13.0 + k % 5 + u), h - 2.0])
            parts += [p @ pose[:3, :3].T + pose[:3, 3] for p in (face, flank)]
    return np.concatenate(parts)


def survey(folder: Path, settings: dict[str, object], bias: Floats = BIAS) -> MappingBackend:
    """A back end fed with the drive: true odometry with a little noise, fixes off by ``bias``."""
    rng = np.random.default_rng(7)
    truth, points = poses(), street()
    backend = MappingBackend(MappingConfig.model_validate({"crs": MGA, **settings}), EXTRINSICS, folder)
    backend.start_sequence("drive")
    odometry = invert_pose(truth[0]) @ truth
    covariance = np.diag(np.repeat([2e-4**2, 0.004**2], 3))
    for k, pose in enumerate(truth):
        near = points[((points[:, :2] - pose[:2, 3]) ** 2).sum(axis=1) < 30.0**2]
        seen = near[rng.random(len(near)) < 0.1] + rng.normal(0, 0.01, (1, 3)) * 0.3
        xyz = (seen - pose[:3, 3]) @ pose[:3, :3]
        stamp = START_NS + k * STEP
        backend.on_odometry(
            OdometryPose(stamp, odometry[k], covariance, 100, 0.02, False, 0),
            DeskewedScan(stamp, xyz, np.zeros(len(xyz), np.float32), "gyro"),
        )
        if k % 2 == 0:
            antenna = pose[:3, 3] + [0, 0, 0.5] + bias + rng.normal(0, 0.01, 3)
            latitude, longitude, height = FRAME.to_geodetic(antenna[None])[0]
            backend.on_fix(GnssFix(stamp, latitude, longitude, height, np.eye(3) * 0.01**2, 2))
    return backend


def control_file(path: Path, wrong: dict[int, float] | None = None, picked_off: Floats | None = None) -> Path:
    """Nine points on the ground beside the road; ``picked_off`` is how far off the map has them."""
    truth = poses()
    lines = ["name,easting,northing,height,map_east,map_north,map_height"]
    for number, k in enumerate(np.linspace(15, COUNT - 15, 9).astype(int)):
        side = 4.0 if number % 2 else -5.0
        xy = truth[k, :2, 3] + side * truth[k, :2, 1]
        enu = np.append(xy, ground(xy))
        east, north, height = FRAME.points_to_map(enu[None], MGA)[0]
        height += (wrong or {}).get(number, 0.0)
        picked = ",,"
        if picked_off is not None:
            found = FRAME.points_to_map((enu + picked_off)[None], MGA)[0]
            picked = ",".join(f"{value:.3f}" for value in found)
        lines.append(f"P{number},{east:.4f},{north:.4f},{height:.4f},{picked}")
    path.write_text("\n".join(lines) + "\n")
    return path


def height_errors(backend: MappingBackend) -> Floats:
    solution = backend.optimize()
    assert solution.frame is not None
    geodetic = FRAME.to_geodetic(poses()[:, :3, 3])
    true = solution.frame.from_geodetic(*geodetic.T)
    return np.asarray(solution.sequences[0].T_local_lidar[:, :3, 3] - true)


def facts_of(backend: MappingBackend) -> AbsoluteFacts:
    found = backend.optimize().absolute
    assert found is not None
    return found


def test_a_height_bias_of_30_cm_of_gnss_falls_below_3_cm_at_check_points(tmp_path: Path) -> None:
    plain = survey(tmp_path / "plain", {})
    assert np.median(height_errors(plain)[:, 2]) == pytest.approx(0.3, abs=0.02)
    settings = {"control": {"file": control_file(tmp_path / "control.csv")}}
    backend = survey(tmp_path / "held", settings)
    assert np.abs(height_errors(backend)[:, 2]).max() < 0.03
    assert np.abs(height_errors(backend)[:, :2]).max() < 0.05  # heights alone: the plan stays
    facts = facts_of(backend)
    np.testing.assert_allclose(facts.gnss_offset, [0, 0, -0.3], atol=0.03)
    assert facts.doubtful == {}
    assert facts.refused == {}
    assert backend.optimize().sequences[0].fixes_contradicting < 5  # of fixes where control puts them
    built = backend.with_quality(backend.build_map())
    described = built.info["control"]
    assert described["check"]["vertical_points"] == 3
    assert described["check"]["rmse_vertical_m"] < 0.03
    assert described["check"]["vertical_95_m"] == pytest.approx(1.96 * described["check"]["rmse_vertical_m"])
    assert described["control"]["rmse_vertical_m"] < 0.03
    assert "Control points" in built.pages["quality.html"]
    assert "P1" in built.pages["quality.html"]


def test_picked_marks_bring_the_plan_to_control_too(tmp_path: Path) -> None:
    bias = np.array([0.25, -0.15, 0.3])
    file = control_file(tmp_path / "control.csv", picked_off=bias)
    backend = survey(tmp_path / "held", {"control": {"file": file}}, bias)
    errors = height_errors(backend)
    assert np.abs(np.median(errors, axis=0)).max() < 0.03
    described = facts_of(backend).described(backend.build_map().cloud)
    assert described["check"]["rmse_horizontal_m"] < 0.04
    np.testing.assert_allclose(described["gnss_offset_m"], -bias, atol=0.04)


def test_a_wrong_control_point_is_named_and_loses_its_weight(tmp_path: Path) -> None:
    file = control_file(tmp_path / "control.csv", wrong={3: 0.5, 6: 12.0})
    backend = survey(tmp_path / "held", {"control": {"file": file}})
    facts = facts_of(backend)
    assert facts.points is not None
    assert facts.points.roles[3] == facts.points.roles[6] == "control"
    assert facts.doubtful == {"P3": pytest.approx(0.5, abs=0.04)}
    assert set(facts.refused) == {"P6"}
    assert "lies -12." in facts.refused["P6"] or "no ground" in facts.refused["P6"]
    assert np.abs(height_errors(backend)[:, 2]).max() < 0.04
    assert [any(name in text for text in facts.warnings) for name in ("P3", "P6")] == [True, True]


def test_a_reference_cloud_holds_the_map_where_gnss_says_little(tmp_path: Path) -> None:
    reference = from_world(FRAME.points_to_map(street(seed=9), MGA), MGA)
    write_cloud(tmp_path / "reference.laz", reference)
    settings = {
        "reference": {"cloud": tmp_path / "reference.laz", "sigma": 0.02},
        "gnss": {"sigma_fixed": 0.5},
    }
    without = survey(tmp_path / "plain", {"gnss": {"sigma_fixed": 0.5}})
    assert np.median(height_errors(without)[:, 2]) == pytest.approx(0.3, abs=0.05)
    backend = survey(tmp_path / "held", settings)
    facts = facts_of(backend)
    assert facts.reference is not None
    assert facts.reference.counts["used"] >= 8
    assert np.abs(np.median(height_errors(backend), axis=0)).max() < 0.05


def test_a_reference_that_contradicts_a_sure_survey_is_refused_and_said(tmp_path: Path) -> None:
    reference = from_world(FRAME.points_to_map(street(seed=9) + np.array([0.0, 0.0, 0.8]), MGA), MGA)
    write_cloud(tmp_path / "reference.laz", reference)
    settings = {"reference": {"cloud": tmp_path / "reference.laz", "sigma": 0.02}}
    backend = survey(tmp_path / "held", settings, 0.0 * BIAS)
    facts = facts_of(backend)
    assert facts.reference is not None
    assert facts.reference.counts["used"] == 0
    assert any("contradicts the survey" in text and "-0.8" in text for text in facts.warnings)
    assert np.abs(np.median(height_errors(backend)[:, 2])) < 0.02


def test_a_reference_above_the_geoid_is_refused_before_it_is_fitted(tmp_path: Path) -> None:
    reference = from_world(FRAME.points_to_map(street(seed=9) + np.array([0.0, 0.0, 32.0]), MGA), MGA)
    write_cloud(tmp_path / "reference.laz", reference)
    backend = survey(tmp_path / "held", {"reference": {"cloud": tmp_path / "reference.laz"}})
    with pytest.raises(InputError, match=r"lies 3\d\.\d m below the reference.*reference.geoid_grid"):
        backend.optimize()


def test_control_that_acts_nowhere_is_refused_with_the_reason_of_each_point(tmp_path: Path) -> None:
    file = tmp_path / "control.csv"
    file.write_text("name,east,north,height\nFAR,391000,6464000,10\n")
    backend = survey(tmp_path / "held", {"control": {"file": file}})
    with pytest.raises(InputError, match=r"no control point acts on the map \(FAR: no scan came within"):
        backend.optimize()


def test_roles_sigmas_and_other_names_of_columns_are_read(tmp_path: Path) -> None:
    file = tmp_path / "c.csv"
    file.write_text(
        "Name,Easting,Northing,RL,sigma_h,sigma_v,role\nA,1,2,3,0.01,0.02,check\nB,1,2,4,,,control\n"
    )
    points = read_control(file, MGA)
    assert points.roles == ("check", "control")
    np.testing.assert_array_equal(points.surveyed[:, 2], [3, 4])
    np.testing.assert_array_equal(points.sigma, [[0.01, 0.02], [np.nan, np.nan]])
    assert split_roles(points, 3).roles == points.roles
    for text, said in [("A,1,2,3,0.01,0.02,tie", "role is 'tie'"), ("A,1,2,3,0,0.02,", "not above zero")]:
        file.write_text(f"name,east,north,height,sigma_h,sigma_v,role\n{text}\n")
        with pytest.raises(InputError, match=said):
            read_control(file, MGA)
    file.write_text("name,east,north,height\n" + "".join(f"P{k},{k},2,3\n" for k in range(7)))
    assert split_roles(read_control(file, MGA), 3).roles.count("check") == 2
