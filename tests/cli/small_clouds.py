"""Tiny clouds near Subiaco, good and bad."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import PointCloud

ORIGIN = np.array([391_200.0, 6_464_300.0, 12.0])


def street(seed: int = 1) -> np.ndarray:
    """Return points (N, 3) of a floor of 40 m x 30 m with three boxes of different size [m]."""
    rng = np.random.default_rng(seed)
    parts = [rng.uniform([0, 0, 0], [40, 30, 0.02], (9000, 3))]
    for west, south, width, depth, height in [(4, 4, 8, 6, 5), (22, 5, 5, 9, 3), (12, 20, 12, 5, 4)]:
        box = rng.uniform([west, south, 0], [west + width, south + depth, height], (3000, 3))
        side = rng.integers(0, 5, len(box))
        for number, (axis, value) in enumerate(
            [(0, west), (0, west + width), (1, south), (1, south + depth), (2, height)]
        ):
            box[side == number, axis] = value
        parts.append(box)
    return np.concatenate(parts)


def write_street(
    path: Path, crs: str | None = "EPSG:7850", shift: tuple[float, float, float] = (0, 0, 0), seed: int = 1
) -> Path:
    write_cloud(path, PointCloud(street(seed) + shift, ORIGIN, crs))
    return path


def write_ply(path: Path, xyz: np.ndarray, kind: str = "double", comment: str = "") -> Path:
    """Write a binary PLY by hand, whatever it holds; ``comment`` is a whole header line."""
    lines = ["ply", "format binary_little_endian 1.0", *([comment] if comment else [])]
    lines += [f"element vertex {len(xyz)}", *(f"property {kind} {axis}" for axis in "xyz"), "end_header", ""]
    dtype = {"double": "<f8", "float": "<f4"}[kind]
    path.write_bytes("\n".join(lines).encode() + xyz.astype(dtype).tobytes())
    return path
