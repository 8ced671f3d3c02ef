"""Odometry of a bag kept on disk, so that variants of the fixes need not run it again."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from subiaco_geo.atomic import whole_directory
from subiaco_geo.bags import BagReader, packet_from_cdr
from subiaco_geo.topics import IMU, LIDAR_PACKETS
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.measurements import DeskewedScan, Extrinsics, OdometryPose
from subiaco_mapping.odometry.frontend import FrontendOutput, OdometryFrontend
from subiaco_mapping.pipeline import read_extrinsics, read_metadata
from subiaco_mapping.preprocessing.conversions import imu_from_msg
from subiaco_mapping.preprocessing.scan_spool import Spool

PACKET_LOSS = 0.05
IMU_HOLE_S = (45.0, 46.0)


@dataclass(frozen=True)
class CachedOdometry:
    """Registered scans of one bag; the points lie in ``spool``."""

    extrinsics: Extrinsics
    poses: list[OdometryPose]
    scans: list[DeskewedScan]  # without points
    spool: Spool

    def scan(self, k: int) -> DeskewedScan:
        """Return a scan with its points."""
        read = self.spool.read(k)
        return replace(
            self.scans[k],
            xyz=read.xyz,
            intensity=read.intensity,
            last_xyz=read.last_xyz,
            last_intensity=read.last_intensity,
            sky_xyz=read.sky_xyz,
        )


def cached_odometry(folder: Path, bag: Path, fault: str, config: MappingConfig) -> CachedOdometry:
    """Return the odometry of a bag under a fault: ``clean``, ``loss`` or ``imu``; from disk where it is."""
    if not folder.exists():
        with whole_directory(folder, overwrite=False) as inside:
            _run(inside, bag, fault, config)
    with (folder / "odometry.pickle").open("rb") as stream:
        extrinsics, poses, scans = pickle.load(stream)
    spool = Spool(folder / "scans", config.decode.max_range, config.decode.sky_range)
    return CachedOdometry(extrinsics, poses, scans, spool)


def _run(folder: Path, bag: Path, fault: str, config: MappingConfig) -> None:
    rng = np.random.default_rng(5)
    spool = Spool(folder / "scans", config.decode.max_range, config.decode.sky_range)
    poses: list[OdometryPose] = []
    scans: list[DeskewedScan] = []

    def keep(outputs: list[FrontendOutput]) -> None:
        none, flat = np.zeros((0, 3)), np.zeros(0, np.float32)
        for output in outputs:
            spool.append(output.scan)
            poses.append(output.pose)
            bare = {"xyz": none, "intensity": flat, "last_xyz": none, "last_intensity": flat}
            scans.append(replace(output.scan, sky_xyz=none, **bare))

    with BagReader(bag) as reader:
        extrinsics = read_extrinsics(reader, config)
        frontend = OdometryFrontend(config, extrinsics, read_metadata(reader))
        hole = [reader.start_ns + int(s * 1e9) for s in IMU_HOLE_S]
        for message in reader.messages({LIDAR_PACKETS, IMU}):
            if message.topic == LIDAR_PACKETS:
                if fault != "loss" or rng.uniform() >= PACKET_LOSS:
                    keep(frontend.on_packet(packet_from_cdr(message.raw)))
            elif fault != "imu" or not hole[0] <= message.log_time_ns < hole[1]:
                keep(frontend.on_imu(imu_from_msg(reader.deserialize(message))))
        keep(frontend.finish())
    with (folder / "odometry.pickle").open("wb") as stream:
        pickle.dump((extrinsics, poses, scans), stream)
