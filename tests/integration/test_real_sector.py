"""Azimuths into which half a sweep looks, estimated from a real drive of 29 m in a town street."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from real_data import read_kitti

from subiaco_geo.frames import Floats, make_pose
from subiaco_geo.free_space.azimuth_sector import Arcs, in_arcs
from subiaco_geo.free_space.view_estimation import blind_arcs


def estimate(shared_data: Path, kept: Callable[[Floats], np.ndarray]) -> Arcs:
    """Estimate the blind arcs of every second sweep, of which only some points (N, 3) are kept."""
    folder = shared_data / "kitti_scans"
    scans = read_kitti(folder)
    rows = np.loadtxt(folder / "kiss_icp_reference_poses.txt").reshape(-1, 3, 4)
    poses = make_pose(rows[:, :, :3], rows[:, :, 3])
    columns = []
    for i in range(0, len(scans), 2):
        xyz = scans.scan(i)[0].astype(np.float64)
        world = xyz[kept(xyz)] @ poses[i, :3, :3].T + poses[i, :3, 3]
        columns.append(np.unique(np.floor(2.0 * world[:, :2]), axis=0) / 2.0 + 0.25)
    return blind_arcs(poses[::2], np.concatenate(columns), 60.0)


@pytest.mark.parametrize("side", [1, -1], ids=["ahead", "behind"])
def test_half_sweeps_of_a_real_drive_show_where_they_did_not_look(shared_data: Path, side: int) -> None:
    arcs = estimate(shared_data, lambda xyz: side * xyz[:, 0] >= 0)
    azimuth = np.radians(np.arange(360.0))
    blind, ahead = in_arcs(azimuth, arcs), side * np.cos(azimuth)
    assert blind[ahead < -0.35].all()  # 20 deg beside the edge of the view, and farther
    assert not blind[ahead > 0.35].any()


def test_whole_sweeps_of_a_real_drive_have_no_blind_azimuth(shared_data: Path) -> None:
    assert estimate(shared_data, lambda xyz: np.ones(len(xyz), dtype=bool)) == ()
