"""A folder in which the commands of the documentation find the files that they name: one tiny survey."""

from __future__ import annotations

import itertools
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from subiaco_geo.cloud_io import read_cloud, write_cloud
from subiaco_geo.clouds import PointCloud, from_world

ROOT = Path(__file__).resolve().parents[2]
OUTPUT = ("-o", "--output")


class World:
    """Files that the documentation names, made from one tiny survey when a command asks for them."""

    def __init__(self, root: Path) -> None:
        self.root, self.made = root, root / "made"
        self.made.mkdir()
        for folder in ("config", "scripts", "docs", "ros2_ws"):
            (root / folder).symlink_to(ROOT / folder)
        for seed, name in ((1, "before"), (2, "after"), (3, "between")):
            (self.made / name).mkdir()
            world = boxes(np.random.default_rng(seed)) + np.array([391_200.0, 6_464_300.0, 12.0])
            write_cloud(self.made / name / "map.ply", from_world(world, crs="EPSG:7850"))

    def makers(self) -> dict[str, Callable[[Path], object]]:
        """Return what makes a file or folder, by the pattern of its name; the first that fits counts."""
        before, after = self.made / "before", self.made / "after"
        return {
            r"out/(before|2019|2023)": lambda path: shutil.copytree(before, path),
            r"out/(after|2025)|out/map": lambda path: shutil.copytree(after, path),
            r"out/2022": lambda path: shutil.copytree(self.made / "between", path),
            r"out/change": self.change,
            r".*\.tum": tum,
            r"before\.laz": lambda path: laz(before, path),
            r"after\.laz": lambda path: laz(after, path),
            r"points\.csv": lambda path: control(after, path),
            r".*\.tif": geoid,
            r"lots\.gpkg": lambda path: lots(after, path),
            r"logo\.png": lambda path: shutil.copy(ROOT / "docs/pictures/graph.png", path),
        }

    def change(self, path: Path) -> None:
        """Put a change directory of the two maps at a path."""
        from subiaco_bringup.cli.main import run

        kept = self.made / "change"
        if not kept.exists():
            maps = [str(self.made / epoch) for epoch in ("before", "after")]
            assert run(["change", *maps, "-o", str(kept), "--workers", "1", "-q"]) == 0
        shutil.copytree(kept, path)

    def provide(self, words: list[str]) -> None:
        """Make every file that a command names and that is not there yet; outputs are removed."""
        written = set(outputs(words))
        inputs = {word for i, word in enumerate(words) if words[i - 1] not in OUTPUT}
        if not {"--overwrite", "--resume"} & set(words):
            for name in written - inputs:
                remove(self.root / name)
        for word in sorted(inputs | {name.split("=")[-1] for name in inputs}):
            path = self.root / word
            maker = next((m for p, m in self.makers().items() if re.fullmatch(p, word)), None)
            if maker is not None and not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                maker(path)


def outputs(words: list[str]) -> list[str]:
    """Return the files and folders that a command is told to write."""
    return [word for option, word in itertools.pairwise(words) if option in OUTPUT]


def remove(path: Path) -> None:
    """Remove a file, a link or a folder."""
    if path.is_symlink() or path.is_file():
        path.unlink()
    elif path.exists():
        shutil.rmtree(path)


def tum(path: Path) -> None:
    """Write a drive of 40 m through the street of boxes, two metres above the ground."""
    east = np.linspace(0.0, 40.0, 41)
    lines = [f"{1.7e9 + i:.3f} {391_200.0 + x:.3f} 6464316.000 14.000 0 0 0 1" for i, x in enumerate(east)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def points(survey: Path) -> PointCloud:
    """Return the cloud of a fused map."""
    return read_cloud(survey / "map.ply")


def laz(survey: Path, path: Path) -> None:
    """Write a fused map as LAZ, as another system would deliver it."""
    cloud = points(survey)
    write_cloud(path, PointCloud(cloud.xyz, cloud.origin, cloud.crs))


def control(survey: Path, path: Path) -> None:
    """Write three points of the ground of a map as control points."""
    cloud = points(survey)
    world = np.asarray(cloud.xyz, dtype=np.float64) + cloud.origin
    ground = world[world[:, 2] < np.quantile(world[:, 2], 0.2)]
    lines = [f"p{i},{x:.3f},{y:.3f},{z:.3f}" for i, (x, y, z) in enumerate(ground[:: len(ground) // 2])]
    path.write_text("\n".join(["name,east,north,height", *lines]) + "\n", encoding="utf-8")


def geoid(path: Path) -> None:
    """Write a geoid of -32 m around Perth as GeoTIFF, in cells of one degree."""
    import rasterio
    from rasterio.transform import from_origin

    heights = np.full((6, 6), -32.0, dtype=np.float32)
    form = {"driver": "GTiff", "width": 6, "height": 6, "count": 1, "dtype": "float32", "crs": "EPSG:4326"}
    with rasterio.open(path, "w", transform=from_origin(113.0, -29.0, 1.0, 1.0), **form) as raster:
        raster.write(heights, 1)
        raster.set_band_description(1, "geoid_undulation")
        raster.set_band_unit(1, "metre")


def lots(survey: Path, path: Path) -> None:
    """Write two lots, north and south of the middle of the drive."""
    import geopandas
    from shapely.geometry import box

    cloud = points(survey)
    east, north = (cloud.xyz.mean(axis=0) + cloud.origin)[:2]
    shapes = [box(east - 60, north, east + 60, north + 60), box(east - 60, north - 60, east + 60, north)]
    frame = geopandas.GeoDataFrame({"lot": ["1", "2"]}, geometry=shapes, crs=cloud.crs)
    frame.to_file(path, driver="GPKG")


def boxes(rng: np.random.Generator) -> np.ndarray:
    """Return points (N, 3) of a floor of 40 m x 30 m with three boxes [m]."""
    parts = [rng.uniform([0, 0, 0], [40, 30, 0.02], (12_000, 3))]
    for west, south, width, depth, height in [(4, 4, 8, 6, 5), (22, 5, 5, 9, 3), (12, 20, 12, 5, 4)]:
        box = rng.uniform([west, south, 0], [west + width, south + depth, height], (5000, 3))
        side = rng.integers(0, 5, len(box))
        for number, (axis, value) in enumerate(
            [(0, west), (0, west + width), (1, south), (1, south + depth), (2, height)]
        ):
            box[side == number, axis] = value
        parts.append(box)
    return np.concatenate(parts) + rng.normal(0.0, 0.01, (12_000 + 3 * 5000, 3))
