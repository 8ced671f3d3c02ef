# ruff: noqa: T201
"""What the outlier test takes out of a map: noise put into a drive's scans, and what was there.

    subiaco map BAG -o MAP --keep-checkpoint
    python tests/benchmarks/bench_outliers.py MAP --set outlier_spacings=3

One recording. The simulator has neither rain nor reflections, so returns are put in here: half a percent
of the beams end early (drops, 4 m behind the first 1.5 m on average), 0.2 % lie 1.1 to 2 times as far as what
they met (echoes by way of a window), and a thousandth of the beams that met nothing return from anywhere. A
voxel is noise where no real return lies in it. Moving objects have left the map before (`fusion.moving`).
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from subiaco_geo.clouds import voxel_indices, voxel_keys
from subiaco_geo.frames import Floats, Ints
from subiaco_geo.trajectories import read_tum
from subiaco_mapping.checkpoint.checkpoint import checkpoint_folder
from subiaco_mapping.fusion.config import FusionConfig, MovingConfig
from subiaco_mapping.fusion.finishing import MapFusion
from subiaco_mapping.fusion.projection import Projection
from subiaco_mapping.preprocessing.config import DecodeConfig
from subiaco_mapping.preprocessing.scan_spool import Spool, SpooledScan

SEED = 1
SKY_RANGE = 40.0  # of `decode.sky_range`, which the spool's steps rest on [m]


def noisy(scan: SpooledScan, rng: np.random.Generator, limit: float) -> SpooledScan:
    """Return the scan with drops, echoes and stray returns."""
    reach = np.linalg.norm(scan.xyz, axis=1)
    drop = np.minimum(1.5 + rng.exponential(4.0, len(reach)), reach - 0.5)
    early = (rng.random(len(reach)) < 0.005) & (drop > 1.5)
    echo = reach * rng.uniform(1.1, 2.0, len(reach))
    late = (rng.random(len(reach)) < 0.002) & (echo < limit) & ~early
    scale = np.where(early, drop, np.where(late, echo, reach)) / np.maximum(reach, 1e-6)
    stray = scan.sky_xyz[rng.random(len(scan.sky_xyz)) < 0.001]
    stray = stray / np.linalg.norm(stray, axis=1)[:, None] * rng.uniform(3.0, limit, (len(stray), 1))
    return replace(
        scan,
        xyz=np.concatenate([scan.xyz * scale[:, None], stray]),
        intensity=np.concatenate([scan.intensity, np.zeros(len(stray), np.float32)]),
    )


def fused(spool: Spool, poses: Floats, config: FusionConfig, noise: bool) -> Ints:
    """Return the keys of the voxels that the map has."""
    rng = np.random.default_rng(SEED)
    with tempfile.TemporaryDirectory() as folder:
        fusion = MapFusion(Path(folder) / "f", config, Projection(None, None), poses[0, :3, 3])
        for k, pose in enumerate(poses):
            scan = spool.read(k)
            taken = noisy(scan, rng, config.max_range) if noise else scan
            fusion.add(taken, pose, np.eye(3), np.zeros(3))
        cloud = fusion.finish(1, lambda _: None).cloud
        return voxel_keys(voxel_indices(cloud.world(), config.leaf))


def columns(keys: Ints) -> int:
    """Count the columns of voxels."""
    return len(np.unique(keys >> 21))


def report(name: str, before: Ints, after: Ints, real: Ints) -> None:
    """Print what left between two maps."""
    true, left = np.intersect1d(before, real), np.setdiff1d(before, after)
    false = len(before) - len(true)
    taken = len(np.setdiff1d(left, real))
    lost = len(left) - taken
    bare = 1 - columns(np.intersect1d(after, real)) / columns(true)
    print(
        f"{name}: {len(left)} of {len(before)} voxels out; real voxels lost {lost / len(true):.3%}, ", end=""
    )
    print(f"columns of them bare {bare:.2%}")
    if false:
        share = (false - taken) / len(after)
        print(f"  noise: precision {taken / max(len(left), 1):.1%}, recall {taken / false:.1%}; ", end="")
        print(f"of the map {false / len(before):.2%} before, {share:.2%} after")


def main() -> None:
    """Print precision and recall, with noise and without."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="of fusion")
    given = parser.parse_args()
    config = FusionConfig.model_validate(dict(text.split("=", 1) for text in given.set))
    off = config.model_copy(update={"outlier_neighbours": 0})
    spool = Spool(checkpoint_folder(given.map) / "000", DecodeConfig().max_range, SKY_RANGE)
    poses = read_tum(given.map / "trajectory.tum").poses
    poses[:, :3, 3] -= np.round(poses[0, :3, 3], -1)
    all_stay = off.model_copy(update={"moving": MovingConfig(enabled=False)})
    real = fused(spool, poses, all_stay, noise=False)
    report(
        "as recorded", fused(spool, poses, off, noise=False), fused(spool, poses, config, noise=False), real
    )
    report("with noise", fused(spool, poses, off, noise=True), fused(spool, poses, config, noise=True), real)


if __name__ == "__main__":
    main()
