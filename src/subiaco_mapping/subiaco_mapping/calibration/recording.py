"""A recording to what the calibration needs: odometry, IMU, fixes, and points near enough for facades."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats
from subiaco_geo.topics import FIX, IMU
from subiaco_mapping.calibration.facades import sampled
from subiaco_mapping.calibration.imu import ImuTrack, OdometryTrack
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.fusion.map_builder import ProgressCallback
from subiaco_mapping.measurements import DeskewedScan, Extrinsics, GnssFix, HeadingSample, OdometryPose
from subiaco_mapping.named_bags import open_bag
from subiaco_mapping.pipeline import run_sequence
from subiaco_mapping.preprocessing.conversions import imu_from_msg


@dataclass
class Collected:
    """What a sequence brings; takes the place of the back end."""

    config: MappingConfig
    extrinsics: Extrinsics = field(default_factory=Extrinsics)
    poses: list[OdometryPose] = field(default_factory=list)
    clouds: list[Floats] = field(default_factory=list)
    fixes: list[GnssFix] = field(default_factory=list)
    headings: list[HeadingSample] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)

    def start_sequence(self, name: str, extrinsics: Extrinsics | None = None) -> None:
        """Take the extrinsics and, as a fact, the name."""
        self.facts["name"] = name
        self.extrinsics = extrinsics or self.extrinsics

    def add_facts(self, **facts: Any) -> None:
        """Take what the front end says about itself."""
        self.facts.update(facts)

    def on_odometry(self, pose: OdometryPose, scan: DeskewedScan) -> None:
        """Take a registered scan; of its points few."""
        self.poses.append(pose)
        near = sampled(scan.xyz, self.config.calibration)
        placed = near @ pose.T_odom_lidar[:3, :3].T + pose.T_odom_lidar[:3, 3]
        self.clouds.append(placed.astype(np.float32))

    def on_fix(self, fix: GnssFix) -> None:
        """Take a fix."""
        self.fixes.append(fix)

    def on_heading(self, heading: HeadingSample) -> None:
        """Take a heading."""
        self.headings.append(heading)

    @property
    def odometry(self) -> OdometryTrack:
        """The chain of registered scans; one that failed begins a new segment."""
        failed = np.cumsum([pose.predicted for pose in self.poses])
        segments = np.array([pose.segment for pose in self.poses], dtype=np.int64)
        return OdometryTrack(
            np.array([pose.stamp_ns for pose in self.poses], dtype=np.int64),
            np.array([pose.T_odom_lidar for pose in self.poses]),
            segments + failed,
        )

    @property
    def points(self) -> Floats:
        """All points kept (N, 3), odometry frame [m]."""
        return np.concatenate(self.clouds).astype(np.float64)


def read_imu(bag: Path, config: MappingConfig) -> ImuTrack | None:
    """Return the IMU samples of a bag by increasing stamp, None where it has none."""
    with open_bag(bag, config.topics) as reader:
        if IMU not in reader.topics:
            return None
        samples = [imu_from_msg(reader.deserialize(message)) for message in reader.messages({IMU})]
    times_ns, first = np.unique([s.time_ns for s in samples], return_index=True)
    gyro, accel = (np.array([getattr(samples[i], name) for i in first]) for name in ("gyro", "accel"))
    finite = np.isfinite(gyro).all(axis=1) & np.isfinite(accel).all(axis=1)
    return ImuTrack(times_ns.astype(np.int64)[finite], gyro[finite], accel[finite])


def drive_through(bag: Path, config: MappingConfig, progress: ProgressCallback) -> Collected:
    """Run decoding, deskewing and odometry over a bag.

    Raises
    ------
    InputError
        See :func:`subiaco_mapping.pipeline.run_sequence`; or neither IMU nor fixes are in it.
    """
    collected = Collected(config)
    with open_bag(bag, config.topics) as reader:
        if IMU not in reader.topics and FIX not in reader.topics:
            raise InputError(f"{bag}: neither {IMU} nor {FIX}: nothing to calibrate against the LiDAR")
        run_sequence(reader, collected, config, progress)
    return collected
