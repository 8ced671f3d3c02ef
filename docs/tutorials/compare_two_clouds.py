"""Compare two bare clouds and look at the table; the clouds are made here.

python docs/tutorials/compare_two_clouds.py out/tutorial
"""

import sys
from pathlib import Path

import numpy as np

import subiaco
from subiaco_geo.cloud_io import write_cloud
from subiaco_geo.clouds import from_world

folder = Path(sys.argv[1])
folder.mkdir(parents=True, exist_ok=True)
rng = np.random.default_rng(1)


def surface(low: tuple[float, float, float], high: tuple[float, float, float], count: int) -> np.ndarray:
    """Return points (N, 3) on the four walls and the top of a box between two corners [m]."""
    points = rng.uniform(low, high, (count, 3))
    face = rng.integers(0, 5, count)
    for number, (axis, corner) in enumerate([(0, low), (0, high), (1, low), (1, high), (2, high)]):
        points[face == number, axis] = corner[axis]
    return points


# 1. Two epochs: a flat block of 60 m x 40 m with three houses, of which one is gone in the later epoch.
ground = rng.uniform((0, 0, 0), (60, 40, 0.02), (15_000, 3))
houses = [
    surface((5, 5, 0), (17, 15, 6), 8_000),
    surface((30, 8, 0), (40, 20, 5), 8_000),
    surface((22, 28, 0), (36, 36, 4), 8_000),
]
place = np.array([391_200.0, 6_464_300.0, 12.0])
for name, standing in (("before", houses), ("after", [houses[0], houses[2]])):
    world = np.concatenate([ground, *standing]) + place
    world += rng.normal(0.0, 0.01, world.shape)
    write_cloud(folder / f"{name}.ply", from_world(world, crs="EPSG:7850"))

# 2. Compare them. The two clouds are aligned, so nothing has to be registered.
changes = subiaco.compare(folder / "before.ply", folder / "after.ply", folder / "change", transform=np.eye(4))

# 3. The table is a GeoDataFrame: one row an object, with its label, confidence, reason and footprint.
columns = ["object_id", "class", "label", "confidence", "delta_v_m3", "evidence"]
print(changes.table[columns].to_string(index=False))
for row in changes.table[changes.table["label"] == "Removed"].itertuples():
    points = changes.points(row.object_id, "before")
    print(f"object {row.object_id} is gone; it had {len(points)} points: {row.reason}")
print(f"open {changes.path / 'report.html'}")
