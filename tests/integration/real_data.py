"""Real recordings as survey bags, and a real street with real objects put into it and taken out of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.bags import TYPESTORE, BagWriter
from subiaco_geo.topics import MESSAGE_TYPES, POINTS

KITTI_START_NS = 1_317_042_000_000_000_000  # the recording has no times: a day of September 2011, 10 Hz
KITTI_PERIOD_NS = 100_000_000


@dataclass(frozen=True)
class KittiScans:
    """77 scans of a moving HDL-64: xyz (N, 3) [m], intensity (N,), scan i is ``offsets[i]:offsets[i+1]``."""

    xyz: NDArray[np.float32]
    intensity: NDArray[np.float32]
    offsets: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def scan(self, i: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return xyz and intensity of scan i."""
        part = slice(int(self.offsets[i]), int(self.offsets[i + 1]))
        return self.xyz[part], self.intensity[part]


def read_kitti(folder: Path) -> KittiScans:
    """Read the scans of ``kitti_scans``."""
    with np.load(folder / "kitti_0926_scans_000_076.npz") as data:
        xyz = (data["xyz_i16"] * np.float64(data["scale"])).astype(np.float32)
        return KittiScans(xyz, data["intensity_u8"].astype(np.float32), data["offsets"])


def write_kitti_bag(scans: KittiScans, bag: Path) -> None:
    """Write the scans as ``/lidar/points``, x y z intensity in float32, without point times."""
    kinds = TYPESTORE.types
    field = kinds["sensor_msgs/msg/PointField"]
    fields = [field(name, 4 * i, 7, 1) for i, name in enumerate(("x", "y", "z", "intensity"))]
    with BagWriter(bag) as writer:
        for i in range(len(scans)):
            xyz, intensity = scans.scan(i)
            stamp_ns = KITTI_START_NS + i * KITTI_PERIOD_NS
            stamp = kinds["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
            header = kinds["std_msgs/msg/Header"](stamp, "lidar_link")
            data = np.column_stack([xyz, intensity]).astype("<f4").view(np.uint8).ravel()
            cloud = kinds[MESSAGE_TYPES[POINTS]](
                header, 1, len(xyz), fields, False, 16, 16 * len(xyz), data, True
            )
            writer.write(POINTS, MESSAGE_TYPES[POINTS], cloud, stamp_ns)
