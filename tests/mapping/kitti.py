"""The 77 real KITTI scans as a bag of clouds: 10 Hz stamps, already deskewed, no GNSS."""

from itertools import pairwise
from pathlib import Path

import numpy as np
from mapping_scenes import write_clouds


def kitti_clouds(folder: Path) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Points (N, 3) [m] and intensities of every scan."""
    with np.load(folder / "kitti_0926_scans_000_076.npz") as data:
        xyz = data["xyz_i16"].astype(np.float64) * float(data["scale"])
        intensity, offsets = data["intensity_u8"], data["offsets"]
    cuts = list(pairwise(offsets))
    return [xyz[a:b] for a, b in cuts], [intensity[a:b] for a, b in cuts]


def kitti_reference(folder: Path) -> np.ndarray:
    """Reference poses (77, 4, 4)."""
    rows = np.loadtxt(folder / "kiss_icp_reference_poses.txt").reshape(-1, 3, 4)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows
    return poses


def kitti_scans_to_bag(folder: Path, bag: Path, scans: int | None = None) -> None:
    """Write the first ``scans`` scans (all where None) as a /lidar/points bag."""
    clouds, intensities = kitti_clouds(folder)
    write_clouds(bag, clouds[:scans], intensities[:scans])
