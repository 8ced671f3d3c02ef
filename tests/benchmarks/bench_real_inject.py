# ruff: noqa: T201
"""Recall and false alarms of real objects put into a real street, by class and size, with the curve.

    python tests/benchmarks/bench_real_inject.py DATA -o out/real_inject --copies 6

DATA holds ``kitti_scans`` and ``dales_objects`` (``$SUBIACO_TEST_DATA``). The even and the odd of 77 KITTI
scans are fused into two maps at the reference poses. The even one is calibrated as ``subiaco calibrate``
does it: objects of DALES (airborne) are put, those of the street taken away, moved, grown and cut, ground is
raised and lowered, and what a second pass does is measured from the odd map (``--repeat``). A false alarm is
a row Added, Removed, Increased or Decreased most of whose judged points did not change so.
"""

from __future__ import annotations

import argparse
import sys
import tarfile
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).parents[1] / "integration"))

from real_data import read_kitti
from real_street import KINDS, common_area, fuse

from subiaco_change.config import ChangeConfig
from subiaco_evaluation.injection.calibrate import (
    MapCalibration,
    MapCalibrationConfig,
    calibrate,
    write_calibration,
)
from subiaco_evaluation.injection.config import InjectionConfig
from subiaco_evaluation.injection.inject import read_donors
from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.frames import make_pose
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import Trajectory

EDITS = {"inserted": 24, "removed": 4, "moved": 2, "grown": 4, "cut": 4, "patches": 6, "min_points": 60}
WIDEST = 5.0  # radius of an object that may fit into the street [m]
SIZES = (0.0, 1.0, 2.0, 4.0, 100.0)


def objects_folder(archive: Path, folder: Path) -> None:
    """Lay the objects of DALES into a folder as clouds that are named by class."""
    with tarfile.open(archive) as tar:
        for member in tar:
            stream, name = tar.extractfile(member), Path(member.name).stem
            if stream is not None and name.isdigit():
                xyz = np.array(stream.read().decode().split(), dtype=np.float64).reshape(-1, 3)
                write_cloud(folder / f"{KINDS[int(name) // 100]}_{name}.ply", PointCloud(xyz, np.zeros(3)))


def tell(result: MapCalibration, area: float) -> None:
    """Print recall by class and by size, and false alarms by class."""
    changes = pd.concat([result.changes, result.fresh_changes])
    changes["size"] = pd.cut(changes["magnitude_m"], SIZES)
    print(changes.groupby(["class_name", "kind"])["found"].agg(["sum", "size"]))
    whole = changes[changes["kind"] == "whole"]
    print(whole.groupby(["class_name", "size"], observed=True)["found"].agg(["sum", "size"]))
    claims = result.rows[result.rows["kind"] != "unchanged"]
    wrong = claims[~claims["right"]]
    copies = claims["survey"].nunique()
    print(claims.groupby("class")["right"].agg(["sum", "size"]))
    print(
        f"found {changes['found'].sum()} of {len(changes)}; "
        f"claims right {claims['right'].sum()} of {len(claims)}; "
        f"false alarms {len(wrong)} in {copies} copies, {1000 * len(wrong) / copies / area:.2f} on 1000 m2"
    )


def main() -> None:
    """Calibrate the real street."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--copies", type=int, default=6)
    words = parser.parse_args()
    started = time.process_time()
    rows = np.loadtxt(words.data / "kitti_scans" / "kiss_icp_reference_poses.txt").reshape(-1, 3, 4)
    poses = make_pose(rows[:, :, :3], rows[:, :, 3])
    scans = read_kitti(words.data / "kitti_scans")
    even, odd = (fuse(scans, poses, range(first, len(poses), 2)) for first in (0, 1))
    times = np.arange(0, len(poses), 2, dtype=np.int64) * 10**8
    survey = SurveyMap(even, Trajectory(times, poses[0::2]))
    config = MapCalibrationConfig(copies=words.copies - 1, fresh=1, injection=InjectionConfig(**EDITS))
    with tempfile.TemporaryDirectory() as folder:
        objects_folder(words.data / "dales_objects" / "dales_objects_even.tar.gz", Path(folder))
        read = read_donors(Path(folder), config.injection.leaf)
    donors = tuple(d for d in read if np.linalg.norm(d.xyz[:, :2], axis=1).max() < WIDEST)
    result = calibrate(survey, ChangeConfig(), config, donors, transform=np.eye(4), other=odd)
    print("second pass, measured:", result.repeat)
    tell(result, common_area(even, odd))
    write_calibration(words.output, result, config, Path("kitti_scans"), overwrite=True)
    print(pd.read_csv(words.output / "detectable.csv").to_string(index=False))
    print(f"{time.process_time() - started:.0f} CPU s")


if __name__ == "__main__":
    main()
