# ruff: noqa: T201
"""A real drive with fixes, with every second stretch of them withheld, and without; beside kiss-icp.

    python tests/benchmarks/bench_kitti_drive.py $SUBIACO_TEST_DATA --json out/kitti_drive.json

Drive 0027 (188 sweeps, not deskewed): odometry is run once by each program on the same sweeps, ours then
goes through the pose graph with the fixes of every case. The reference is the position and attitude of the
INS: its positions step by 0.1 to 0.3 m within a second, its speed does not, so that the way driven is held
against the speed. Cases with fixes are compared as they lie, those without after a rigid alignment. Also
estimated: the clock of the fixes against the sweeps, for clocks put wrong on purpose, and the rotation of the
scanner in the INS, for scanners turned on purpose. Drive 0005 (77 sweeps):
the way that point to point and plane to plane find, beside the way by speed.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from kitti_drive import CRS, SIGMA, T_BASE_LIDAR, Drive, point_times, read_drive, withheld
from scipy.spatial.transform import Rotation

from subiaco_geo.frames import Floats, Ints, make_pose
from subiaco_geo.trajectories import Trajectory
from subiaco_geo.trajectory_errors import overlap, pose_errors, relative_error
from subiaco_mapping.backend import MappingBackend
from subiaco_mapping.calibration.antenna import AntennaFit, fit_antenna
from subiaco_mapping.calibration.attitude import BodyTrack, fit_body_rotation
from subiaco_mapping.calibration.config import CalibrationConfig
from subiaco_mapping.calibration.imu import OdometryTrack
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.measurements import Extrinsics, GnssFix, Returns, Scan
from subiaco_mapping.odometry.frontend import FrontendOutput, OdometryFrontend

WITHHELD_S = (10.0, 4.0)
Row = dict[str, object]
STRETCH = 50.0  # of the relative error [m]
CLOCKS = (0.0, 0.1, -0.1)  # added to the stamps of the fixes [s]
ROTATIONS = ((0.0, 0.0, 0.0), (0.0, 0.0, 3.0), (2.0, -2.0, 0.0))  # by which the scanner is turned [deg]
POINT_TO_POINT = {"refine": False, "convergence": 5e-4}


@dataclass(frozen=True)
class Run:
    """What one program made of the sweeps: its trajectory, and CPU seconds a sweep."""

    name: str
    trajectory: Trajectory
    seconds: float


def scans_of(drive: Drive) -> list[Scan]:
    """Return the sweeps with the times of their points."""
    found = []
    for k, stamp_ns in enumerate(drive.stamps_ns.tolist()):
        xyz = drive.sweep(k)
        xyz = xyz[np.linalg.norm(xyz, axis=1) > 1.0]
        times_ns, count = point_times(xyz, stamp_ns, drive.period_ns), len(xyz)
        first = Returns(xyz, times_ns, np.zeros(count, np.float32), np.zeros(count, np.uint16))
        found.append(Scan(int(times_ns.min()), int(times_ns.max()), first))
    return found


def our_odometry(scans: list[Scan], config: MappingConfig, name: str) -> tuple[Run, list[FrontendOutput]]:
    """Run our front end."""
    frontend, outputs, before = OdometryFrontend(config, Extrinsics(T_BASE_LIDAR)), [], time.process_time()
    for scan in scans:
        outputs += frontend.on_points(scan)
    outputs += frontend.finish()
    spent = (time.process_time() - before) / len(scans)
    stamps = np.array([output.pose.stamp_ns for output in outputs])
    return Run(name, Trajectory(stamps, np.array([o.pose.T_odom_lidar for o in outputs])), spent), outputs


def kiss_icp(scans: list[Scan]) -> Run:
    """Run kiss-icp with its own deskew and our limits of range; its poses are at the ends of the sweeps."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.max_range, config.data.min_range, config.data.deskew = 100.0, 1.0, True
    config.mapping.voxel_size, config.registration.max_num_threads = 1.0, 1
    program, poses, before = KissICP(config), [], time.process_time()
    for scan in scans:
        share = (scan.first.times_ns - scan.start_ns) / (scan.end_ns - scan.start_ns)
        program.register_frame(scan.first.xyz, share)
        poses.append(program.last_pose.copy())
    spent = (time.process_time() - before) / len(scans)
    return Run("kiss-icp", Trajectory(np.array([s.end_ns for s in scans]), np.array(poses)), spent)


def fixes_of(drive: Drive, kept: Floats, clock_s: float = 0.0) -> list[GnssFix]:
    """Return the positions of the INS as fixes."""
    covariance, shift = np.diag(np.square(SIGMA)), round(clock_s * 1e9)
    return [
        GnssFix(int(drive.ins_ns[k]) + shift, *drive.oxts[k, 1:4].tolist(), covariance, 2)
        for k in np.flatnonzero(kept)
    ]


def with_fixes(outputs: list[FrontendOutput], fixes: list[GnssFix]) -> Trajectory:
    """Solve the pose graph; return poses in the local frame, which lies at the first fix."""
    config = MappingConfig(crs=CRS)
    with tempfile.TemporaryDirectory() as spool:
        backend = MappingBackend(config, Extrinsics(T_BASE_LIDAR, None, np.zeros(3)), Path(spool))
        backend.start_sequence("drive")
        for output in outputs:
            backend.on_odometry(output.pose, output.scan)
        for fix in fixes:
            backend.on_fix(fix)
        solution = backend.optimize()
    (sequence,) = solution.sequences
    return Trajectory(sequence.stamps_ns, sequence.T_local_lidar)


def way_by_speed(drive: Drive, times_ns: Ints) -> float:
    """Return the way driven between the first and the last time, by the speed of the INS [m]."""
    fine = np.linspace(times_ns[0], times_ns[-1], 5000)
    seconds, known = (fine - drive.ins_ns[0]) * 1e-9, (drive.ins_ns - drive.ins_ns[0]) * 1e-9
    speed = np.interp(seconds, known, drive.oxts[:, 7])
    return float(np.trapezoid(speed, seconds))


def way(trajectory: Trajectory) -> float:
    """Return the length of a path [m]."""
    return float(np.linalg.norm(np.diff(trajectory.poses[:, :3, 3], axis=0), axis=1).sum())


def laid_over(found: Trajectory, truth: Trajectory) -> Trajectory:
    """Move a path rigidly over another (Kabsch); it may be all but straight, which leaves its roll open."""
    _, poses, true = overlap(found, truth)
    source, target = poses[:, :3, 3], true[:, :3, 3]
    left, _, right = np.linalg.svd((target - target.mean(axis=0)).T @ (source - source.mean(axis=0)))
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return Trajectory(
        found.times_ns, make_pose(turn, target.mean(axis=0) - turn @ source.mean(axis=0)) @ found.poses
    )


def judge(
    name: str, found: Trajectory, drive: Drive, *, align: bool, part: Floats | None = None
) -> dict[str, object]:
    """Return the errors of a trajectory; ``part`` (S,) marks the INS rows of which positions are compared."""
    truth = Trajectory(drive.ins_ns, drive.truth() @ T_BASE_LIDAR)
    found = laid_over(found, truth) if align else found
    errors = pose_errors(found, truth)
    row = np.clip(np.searchsorted(drive.ins_ns, errors.times_ns), 0, len(drive) - 1)
    chosen = np.ones(len(row), dtype=bool) if part is None else part[row]
    flat = np.linalg.norm(errors.offset[chosen, :2], axis=1)
    inside = Trajectory(errors.times_ns, found.at(errors.times_ns))
    relative = relative_error(found, truth, STRETCH)
    return {
        "case": name,
        "poses": int(chosen.sum()),
        "ape_horizontal_m": float(np.sqrt(np.mean(flat**2))),
        "ape_vertical_m": float(np.sqrt(np.mean(errors.offset[chosen, 2] ** 2))),
        "ape_largest_m": float(errors.distance[chosen].max()),
        "rpe_percent": relative["rpe_translation_percent"],
        "rpe_deg": relative["rpe_rotation_rmse_deg"],
        "way_over_speed": way(inside) / way_by_speed(drive, inside.times_ns),
    }


def clock(drive: Drive, run: Run, clock_s: float) -> AntennaFit:
    """Estimate the clock of fixes whose stamps are wrong by so much; the antenna's place is known to 2 cm."""
    track = OdometryTrack(
        run.trajectory.times_ns, run.trajectory.poses, np.zeros(len(run.trajectory), np.int64)
    )
    fixes = fixes_of(drive, np.ones(len(drive), dtype=bool), clock_s)
    config = MappingConfig()
    calibration = CalibrationConfig(prior_lever=0.02, prior_offset=0.2, max_gnss_offset=0.1)
    up = np.array([0.0, 0.0, 1.0])
    found = fit_antenna(track, fixes, [], T_BASE_LIDAR, np.zeros(3), up, config.gnss, calibration)
    assert found is not None
    return found


def body_rotation(drive: Drive, run: Run, put_deg: tuple[float, float, float]) -> Row:
    """Estimate the scanner's rotation in the INS; the scanner is turned by ``put_deg`` on purpose."""
    turned = make_pose(Rotation.from_euler("xyz", put_deg, degrees=True).as_matrix(), np.zeros(3))
    track = OdometryTrack(
        run.trajectory.times_ns, run.trajectory.poses @ turned, np.zeros(len(run.trajectory), np.int64)
    )
    found = fit_body_rotation(
        track, BodyTrack(drive.ins_ns, drive.truth()), T_BASE_LIDAR, CalibrationConfig(max_rotation_deg=1.0)
    )
    angles = Rotation.from_matrix(found.R_body_lidar).as_euler("xyz", degrees=True)
    row: Row = {"put_deg": " ".join(f"{v:g}" for v in put_deg)}
    for axis, angle, sigma, seen in zip(
        ("roll", "pitch", "yaw"), angles, np.degrees(found.sigma), found.observed, strict=True
    ):
        row[f"{axis}_deg"] = f"{angle:.2f} ({sigma:.2f}){'' if seen else ' kept'}"
    return {**row, "clock_s": found.offset_s, "clock_sigma_s": found.offset_sigma, "windows": found.windows}


def street(data: Path) -> dict[str, object]:
    """Return the ways over the 77 sweeps of drive 0005, the motion taken off by azimuth, and by speed [m]."""
    folder = data / "kitti_scans"
    with np.load(folder / "kitti_0926_scans_000_076.npz") as scans, np.load(folder / "oxts_0005.npz") as ins:
        count = len(scans["offsets"]) - 1
        drive = Drive(scans["xyz_i16"], float(scans["scale"]), scans["offsets"], ins["oxts"][:count])
        speeds = ins["oxts"]
    rows = np.loadtxt(folder / "kiss_icp_reference_poses.txt").reshape(-1, 3, 4)[:, :, 3]
    reference = float(np.linalg.norm(np.diff(rows, axis=0), axis=1).sum())
    swept, found = scans_of(drive), {}
    raw = [Scan(s.start_ns, s.end_ns, s.first, deskewed=True) for s in swept]
    for name, given in (("as they are", raw), ("straightened", swept)):
        for kind, changed in (("point to point", POINT_TO_POINT), ("plane to plane", {})):
            config = MappingConfig()
            config = config.model_copy(update={"odometry": config.odometry.model_copy(update=changed)})
            found[f"{kind}, {name}"] = way(our_odometry(given, config, kind)[0].trajectory)
    # scans as they are stand for when the scanner looks ahead, straightened ones for half a turn later
    times = {"when it looks ahead": drive.stamps_ns, "half a turn later": np.array([s.end_ns for s in swept])}
    whole = Drive(drive.xyz_i16, drive.scale, drive.offsets, speeds)
    by_speed = {name: way_by_speed(whole, stamps) for name, stamps in times.items()}
    return {"reference": reference, "found": found, "by_speed": by_speed}


def table(rows: list[dict[str, object]]) -> str:
    """Write rows as a table."""
    names = list(rows[0])
    lines = [" | ".join(names), " | ".join("---" for _ in names)]
    lines += [
        " | ".join(f"{v:.4f}" if isinstance(v, float) else str(v) for v in row.values()) for row in rows
    ]
    return "\n".join(f"| {line} |" for line in lines)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, help="folder of real recordings")
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args()
    drive = read_drive(given.data)
    scans = scans_of(drive)
    ours, outputs = our_odometry(scans, MappingConfig(), "odometry")
    peer = kiss_icp(scans)
    every = np.ones(len(drive), dtype=bool)
    rows = [judge("map, all fixes", with_fixes(outputs, fixes_of(drive, every)), drive, align=False)]
    for seconds in WITHHELD_S:
        left_out = withheld(drive, seconds)
        found = with_fixes(outputs, fixes_of(drive, ~left_out))
        name = f"map, every second {seconds:g} s withheld: there"
        rows.append(judge(name, found, drive, align=False, part=left_out))
    rows += [
        judge("odometry, no fixes", ours.trajectory, drive, align=True),
        judge("kiss-icp, no fixes", peer.trajectory, drive, align=True),
    ]
    clocks = []
    for put in CLOCKS:
        fit = clock(drive, ours, put)
        clocks.append(
            {"put_s": put, "found_s": fit.offset_s, "sigma_s": fit.offset_sigma, "scale": fit.scale}
        )
    rotations = [body_rotation(drive, ours, put) for put in ROTATIONS]
    figures = {"rows": rows, "clocks": clocks, "rotations": rotations, "street": street(given.data),
             "cpu_s_a_sweep": {"ours": ours.seconds, "kiss-icp": peer.seconds}}  # fmt: skip
    print(table(rows), table(clocks), table(rotations), json.dumps(figures["street"], indent=1), sep="\n\n")
    print(f"CPU seconds a sweep: ours {ours.seconds:.3f}, kiss-icp {peer.seconds:.3f}")
    if given.json is not None:
        given.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
