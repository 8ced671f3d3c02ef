"""Everything that one recording has contributed so far."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats, Ints
from subiaco_mapping.config import MappingConfig
from subiaco_mapping.loop_closure.submaps import SubmapBuilder
from subiaco_mapping.measurements import DeskewedScan, Extrinsics, GnssFix, HeadingSample, OdometryPose
from subiaco_mapping.preprocessing.scan_spool import Spool


@dataclass
class SequenceRecord:
    """One recording: its scans on disk, everything else in memory."""

    name: str
    extrinsics: Extrinsics
    spool: Spool
    submaps: SubmapBuilder | None = None
    poses: list[OdometryPose] = field(default_factory=list)
    accel: list[Floats] = field(default_factory=list)
    modes: list[str] = field(default_factory=list)
    columns: list[tuple[int, int]] = field(default_factory=list)  # lost, sent
    dropped_points: int = 0
    fixes: list[GnssFix] = field(default_factory=list)
    refused_fixes: int = 0
    headings: list[HeadingSample] = field(default_factory=list)
    refused_headings: int = 0
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def stamps_ns(self) -> Ints:
        """Stamps (S,) of the scans."""
        return np.array([pose.stamp_ns for pose in self.poses], dtype=np.int64)

    @property
    def T_odom_lidar(self) -> Floats:
        """Odometry (S, 4, 4)."""
        return np.array([pose.T_odom_lidar for pose in self.poses])

    def add(self, pose: OdometryPose, scan: DeskewedScan) -> None:
        """Take one registered scan, stamps increasing."""
        if self.poses and pose.stamp_ns <= self.poses[-1].stamp_ns:
            raise InputError(f"{self.name}: scan at {pose.stamp_ns} ns is not newer than the one before")
        self.spool.append(scan)
        if self.spool.left_out:
            self.facts["scans_without_room"] = self.spool.left_out
        if self.submaps is not None:
            self.submaps.add(pose, scan)
        self.poses.append(pose)
        self.accel.append(np.full(3, np.nan) if scan.accel is None else scan.accel)
        self.modes.append(scan.mode)
        self.columns.append((scan.lost_columns, scan.columns))
        self.dropped_points += scan.dropped_points

    def add_fix(self, fix: GnssFix) -> bool:
        """Take one fix; one without a solution or with NaN is counted, left out and answered False."""
        if fix.is_usable():
            self.fixes.append(fix)
            return True
        self.refused_fixes += 1
        return False

    def add_heading(self, heading: HeadingSample) -> bool:
        """Take one heading; one without a usable sigma is counted, left out and answered False."""
        if heading.is_usable():
            self.headings.append(heading)
            return True
        self.refused_headings += 1
        return False


def begin_sequence(name: str, extrinsics: Extrinsics, folder: Path, config: MappingConfig) -> SequenceRecord:
    """Return the empty record of a recording whose scans and submaps go to a folder."""
    reserve_bytes = round(config.fusion.reserve_gb * 1e9)
    ranges = config.decode.max_range, config.decode.sky_range
    spool = Spool(folder, *ranges, reserve_bytes, keep_pulses=config.fusion.full_density)
    submaps = SubmapBuilder(config.loops, folder / "submaps") if config.loops.enabled else None
    return SequenceRecord(name, extrinsics, spool, submaps)
