"""Calibrate a rig: odometry, IMU and antenna, over again with what was found, then the facades."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, invert_pose, make_pose
from subiaco_mapping.calibration.antenna import AntennaFit, fit_antenna
from subiaco_mapping.calibration.estimate import Parameter
from subiaco_mapping.calibration.facades import FacadeComparison, compare, find_facades
from subiaco_mapping.calibration.imu import ImuFit, ImuTrack, fit_imu
from subiaco_mapping.calibration.recording import Collected, drive_through, read_imu
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.fusion.map_builder import ProgressCallback, silent
from subiaco_mapping.measurements import Extrinsics
from subiaco_mapping.preprocessing.config import FramePose

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Rig:
    """Extrinsics and clocks; offsets are added to stamps.

    Parameters
    ----------
    extrinsics : Extrinsics
    imu_offset_ns, gnss_offset_ns : int
    heading_offset_deg : float
    """

    extrinsics: Extrinsics
    imu_offset_ns: int
    gnss_offset_ns: int
    heading_offset_deg: float


@dataclass(frozen=True)
class RigCalibration:
    """What a calibration found.

    Parameters
    ----------
    given, rig : Rig
        Before and after.
    parameters : tuple of Parameter
    notes : tuple of str
        What could not be estimated, and why.
    facades : FacadeComparison
        Of the map with the rig as given and as found.
    residuals : dict of str to float
        Spread of what was fitted.
    scans, fixes : int
        Used.
    """

    given: Rig
    rig: Rig
    parameters: tuple[Parameter, ...]
    notes: tuple[str, ...]
    facades: FacadeComparison
    residuals: dict[str, float]
    scans: int
    fixes: int


def _as_frame(pose: Floats) -> FramePose:
    angles = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz", degrees=True)
    return FramePose(translation=tuple(pose[:3, 3].tolist()), rotation_deg=tuple(angles.tolist()))


def with_rig(config: MappingConfig, rig: Rig) -> MappingConfig:
    """Return the configuration with the poses and clocks of a rig, which win over ``/tf_static``."""
    found = rig.extrinsics
    antenna = None if found.t_base_gnss is None else make_pose(np.eye(3), found.t_base_gnss)
    poses = {"lidar": found.T_base_lidar, "imu": found.T_base_imu, "gnss": antenna}
    frames = {name: _as_frame(pose) for name, pose in poses.items() if pose is not None}
    clock = {"time_offset_ns": rig.gnss_offset_ns, "heading_offset_deg": rig.heading_offset_deg}
    return config.model_copy(
        update={
            "sensors": config.sensors.model_copy(update={**frames, "override": True}),
            "deskew": config.deskew.model_copy(update={"imu_time_offset_ns": rig.imu_offset_ns}),
            "gnss": config.gnss.model_copy(update=clock),
        }
    )


def calibrate_rig(
    bag: Path, config: MappingConfig, progress: ProgressCallback | None = None
) -> RigCalibration:
    """Refine extrinsics and time offsets from a short recording with turns and changes of speed.

    Parameters
    ----------
    bag : Path
    config : MappingConfig
        With ``/tf_static`` it gives the rig to start from.
    progress : callable, optional

    Raises
    ------
    InputError
        No IMU and no fixes, too short, or extrinsics to start from are missing.
    """
    report = progress or silent
    imu = read_imu(bag, config)
    first = collected = drive_through(bag, config, report)
    given = rig = Rig(
        collected.extrinsics,
        config.deskew.imu_time_offset_ns,
        config.gnss.time_offset_ns,
        config.gnss.heading_offset_deg,
    )
    before: tuple[Parameter, ...] = ()
    for _ in range(config.calibration.passes):
        fits = _fits(collected, imu, given, config)
        rig = _rig(given, *fits)
        parameters, notes = _parameters(given, rig, *fits)
        collected = drive_through(bag, with_rig(config, rig), report)
        if _settled(before, parameters):
            break
        before = parameters
    facades = _compared(first, collected, fits[0], config)
    calibration = RigCalibration(
        given, rig, parameters, notes, facades, _residuals(*fits), len(first.poses), _count(fits[1])
    )
    _warn(calibration)
    return calibration


def _settled(before: tuple[Parameter, ...], after: tuple[Parameter, ...]) -> bool:
    """Tell whether the last pass moved nothing by more than half a sigma.

    Odometry deskewed with a wrong clock hides a third of its error, so that one pass is not enough.
    """
    moved = zip(before, after, strict=False)
    return bool(before) and all(abs(b.value - a.value) <= 0.5 * a.sigma for b, a in moved)


def _count(antenna: AntennaFit | None) -> int:
    return 0 if antenna is None else antenna.fixes


def _fits(
    collected: Collected, imu: ImuTrack | None, given: Rig, config: MappingConfig
) -> tuple[ImuFit | None, AntennaFit | None]:
    extrinsics, turned, antenna = given.extrinsics, None, None
    if len(collected.poses) < 2:
        raise InputError("fewer than two scans were registered; record longer")
    if imu is not None and extrinsics.T_base_imu is not None:
        T_lidar_imu = invert_pose(extrinsics.T_base_lidar) @ extrinsics.T_base_imu
        turned = fit_imu(
            collected.odometry,
            imu,
            T_lidar_imu[:3, :3],
            T_lidar_imu[:3, 3],
            given.imu_offset_ns * 1e-9,
            config.calibration,
        )
    if collected.fixes and extrinsics.t_base_gnss is not None:
        level = collected.poses[0].T_odom_lidar[:3, :3] @ extrinsics.T_base_lidar[2, :3]
        antenna = fit_antenna(
            collected.odometry,
            collected.fixes,
            collected.headings,
            extrinsics.T_base_lidar,
            extrinsics.t_base_gnss,
            level if turned is None else turned.up_odom,
            config.gnss,
            config.calibration,
        )
    return turned, antenna


def _rig(given: Rig, imu: ImuFit | None, antenna: AntennaFit | None) -> Rig:
    """Return the rig with what was found; all else as given."""
    extrinsics = given.extrinsics
    T_base_imu, t_base_gnss = extrinsics.T_base_imu, extrinsics.t_base_gnss
    imu_ns, gnss_ns, heading = given.imu_offset_ns, given.gnss_offset_ns, given.heading_offset_deg
    if imu is not None and T_base_imu is not None:
        T_base_imu = make_pose(extrinsics.T_base_lidar[:3, :3] @ imu.R_lidar_imu, T_base_imu[:3, 3])
        imu_ns = round(imu.offset_s * 1e9)
    if antenna is not None:
        t_base_gnss, gnss_ns = antenna.t_base_gnss, round(antenna.offset_s * 1e9)
        heading = heading if antenna.heading_offset is None else float(np.degrees(antenna.heading_offset))
    return Rig(Extrinsics(extrinsics.T_base_lidar, T_base_imu, t_base_gnss), imu_ns, gnss_ns, heading)


def _compared(
    first: Collected, last: Collected, imu: ImuFit | None, config: MappingConfig
) -> FacadeComparison:
    up = first.poses[0].T_odom_lidar[:3, :3] @ first.extrinsics.T_base_lidar[2, :3]
    up = up if imu is None else imu.up_odom
    before, after = (find_facades(c.points, up, config.calibration) for c in (first, last))
    return compare(before, after, config.calibration)


def _parameters(
    given: Rig, rig: Rig, imu: ImuFit | None, antenna: AntennaFit | None
) -> tuple[tuple[Parameter, ...], tuple[str, ...]]:
    found: list[Parameter] = []
    notes = ["LiDAR in base_link: kept, it defines base_link; IMU position: kept, mapping does not use it"]
    if imu is None:
        notes.append("IMU: not in the recording")
    else:
        turned = imu.R_lidar_imu @ given.extrinsics.R_lidar_imu.T
        change = np.degrees(Rotation.from_matrix(turned).as_rotvec())
        sigma = np.degrees(imu.rotation_sigma)
        for k, axis in enumerate("xyz"):
            name = f"IMU turned about LiDAR {axis}"
            observed = bool(imu.rotation_observed[k])
            found.append(Parameter(name, "deg", 0.0, float(change[k]), float(sigma[k]), observed))
        ms = (given.imu_offset_ns * 1e-6, rig.imu_offset_ns * 1e-6, imu.offset_sigma * 1e3)
        found.append(Parameter("added to IMU stamps", "ms", *ms, imu.offset_observed))
    if antenna is None or given.extrinsics.t_base_gnss is None:
        notes.append("antenna: kept, too few RTK fixed fixes over the scans")
        return tuple(found), tuple(notes)
    for k, axis in enumerate("xyz"):
        before, after = float(given.extrinsics.t_base_gnss[k]), float(antenna.t_base_gnss[k])
        sigma_m, observed = float(antenna.lever_sigma[k]), bool(antenna.lever_observed[k])
        name = f"antenna {axis} in base_link"
        found.append(Parameter(name, "m", before, after, sigma_m, observed))
    ms = (given.gnss_offset_ns * 1e-6, rig.gnss_offset_ns * 1e-6, antenna.offset_sigma * 1e3)
    found.append(Parameter("added to GNSS stamps", "ms", *ms, antenna.offset_observed))
    notes.append(
        f"way driven by the fixes over that by odometry: {1.0 + antenna.scale:.4f} (sigma "
        f"{antenna.scale_sigma:.4f}); not used, range offsets of a sensor do this"
    )
    if antenna.heading_offset is None or antenna.heading_sigma is None:
        notes.append("heading of the antenna baseline: kept, too few headings")
    else:
        found_deg, sigma_deg = np.degrees([antenna.heading_offset, antenna.heading_sigma]).tolist()
        name = "antenna baseline against base_link"
        found.append(Parameter(name, "deg", given.heading_offset_deg, found_deg, sigma_deg, True))
    return tuple(found), tuple(notes)


def _residuals(imu: ImuFit | None, antenna: AntennaFit | None) -> dict[str, float]:
    found = {}
    if imu is not None:
        found["rotation_a_scan_deg"] = float(np.degrees(imu.gyro_residual))
        found["velocity_m_s"] = imu.velocity_residual
    if antenna is not None:
        found["fixes_m"] = antenna.residual
    return found


def _warn(calibration: RigCalibration) -> None:
    kept = [p.name for p in calibration.parameters if not p.observed]
    if kept:
        logger.warning("the motion does not make observable, kept as given: %s", ", ".join(kept))
    facades = calibration.facades
    if facades.verdict == "thicker":
        logger.warning(
            "facades are thicker with what was found (%.1f to %.1f mm): do not use this rig",
            facades.before * 1e3,
            facades.after * 1e3,
        )
    elif facades.verdict != "thinner":
        logger.warning("facades do not bear the calibration out: %s", facades.verdict)
