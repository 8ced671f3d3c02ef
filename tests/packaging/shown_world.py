"""A folder in which the commands of the documentation find the files that they name: one tiny survey."""

from __future__ import annotations

import itertools
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import shown_drive as drive
from shown_commands import SMALLER

from subiaco_geo.cloud_io import read_cloud, write_cloud
from subiaco_geo.clouds import PointCloud
from subiaco_geo.frames import Floats

ROOT = Path(__file__).resolve().parents[2]
OUTPUT = ("-o", "--output")
#: Commands that name what they write without an option: the position of that word.
WRITES = {"simulate": 2, "scripts/draw_survey.py": 3}


class World:
    """Files that the documentation names, made from one tiny survey when a command asks for them."""

    def __init__(self, root: Path) -> None:
        self.root, self.kept = root, root / "kept"
        self.kept.mkdir()
        for folder in ("config", "scripts", "docs", "ros2_ws"):
            (root / folder).symlink_to(ROOT / folder)

    def makers(self) -> dict[str, Callable[[Path], object]]:
        """Return what makes a file or folder, by the pattern of its name; the first that fits counts."""
        return {
            r"bags/20\d\d/loop0[12]": lambda path: shutil.copytree(self.bag(path), path),
            r"bags/am": drive.cut,
            r"bags/demo": lambda path: shutil.copytree(self.injected(), path),
            r"bags/\w+": lambda path: drive.recording(path, "2025", 0),
            r"surveys/\w+": lambda path: drive.recording(path / "bag", "2025", 0),
            r"drive\.(pcap|json)": lambda path: drive.capture(path.with_suffix(".pcap")),
            r"gnss\.csv": drive.gnss_log,
            r"imu\.csv": drive.imu_log,
            r"out/sim": lambda path: shutil.copytree(self.simulated(), path),
            r"out/demo/after": lambda path: shutil.copytree(self.injected(), path),
            r"out/(before|2019|2023)": lambda path: shutil.copytree(self.map("2023"), path),
            r"out/(after|map|2022|2025|demo/before)": lambda path: shutil.copytree(self.map("2025"), path),
            r"out/change": lambda path: shutil.copytree(self.change(), path),
            r"sbet_.*\.out": sbet,
            r"drive_.*\.csv": lambda path: table(self.map("2025"), path),
            r".*\.tum": tum,
            r"before\.laz": lambda path: laz(self.map("2023"), path),
            r"(after|airborne)\.laz": lambda path: laz(self.map("2025"), path),
            r"points\.csv": lambda path: control(self.map("2025"), path),
            r".*\.tif": geoid,
            r"lots\.gpkg": lambda path: lots(self.map("2025"), path),
            r"logo\.png": lambda path: shutil.copy(ROOT / "docs/pictures/graph.png", path),
        }

    def bag(self, path: Path) -> Path:
        """Return a recording that is named by epoch and loop."""
        kept = self.kept / path.relative_to(self.root)
        if not kept.exists():
            kept.parent.mkdir(parents=True, exist_ok=True)
            drive.recording(kept, path.parent.name, int(path.name[-1]) - 1)
        return kept

    def map(self, epoch: str) -> Path:
        """Return the map of an epoch."""
        bags = [f"bags/{epoch}/loop0{number}" for number in (1, 2)]
        return self.made(f"out/{epoch}", ["map", *bags, "--workers", "1"])

    def injected(self) -> Path:
        """Return a copy of the later map with known changes in it."""
        self.provide(["subiaco", "inject", "out/2025"])
        return self.made("out/2025_injected", ["inject", "out/2025", "--seed", "3"])

    def simulated(self) -> Path:
        """Return fused maps of a simulated survey with truth."""
        from subiaco_bringup.cli.main import run

        kept = self.kept / "sim/201"
        if not kept.exists():
            assert run(["simulate", str(kept), "--maps-only", *SMALLER["simulate"], "-q"]) == 0
        return kept

    def change(self) -> Path:
        """Return a change directory of the two maps."""
        self.provide(["subiaco", "change", "out/2023", "out/2025"])
        return self.made("out/change", ["change", "out/2023", "out/2025", "--workers", "1"])

    def made(self, name: str, words: list[str]) -> Path:
        """Return the first output of that name; a command makes it if no page has shown it so far."""
        kept = self.kept / name
        if not kept.exists():
            from subiaco_bringup.cli.main import run

            self.provide(["subiaco", *words])
            kept.parent.mkdir(parents=True, exist_ok=True)
            assert run([*words, "-o", str(kept), "-q"]) == 0
        return kept

    def keep(self, words: list[str]) -> None:
        """Keep the first output of each name, because later pages write other settings to that place."""
        for name in outputs(words):
            path, kept = self.root / name, self.kept / name
            if path.is_dir() and not kept.exists() and not name.startswith("bags/"):
                shutil.copytree(path, kept)

    def provide(self, words: list[str]) -> None:
        """Make every file that a command names and that is not there; maps are made as they were first."""
        written = set(outputs(words))
        inputs = {word for i, word in enumerate(words) if words[i - 1] not in OUTPUT}
        if not {"--overwrite", "--resume"} & set(words):
            for name in written - (inputs - {*words[2:3]} if words[1] in WRITES else inputs):
                remove(self.root / name)
        for word in sorted(inputs | {name.split("=")[-1] for name in inputs}):
            path = self.root / word
            maker = next((m for p, m in self.makers().items() if re.fullmatch(p, word)), None)
            if maker is None or word in written:
                continue
            if re.fullmatch(r"(bags|out)/20\d\d.*|out/map", word):
                remove(path)
            path.parent.mkdir(parents=True, exist_ok=True)
            if "config/drivers/ublox.yaml" in words and word.startswith("bags/"):
                drive.recording(path, "2025", 0, "/ublox_gps_node/fix", "gps")
            elif not path.exists():
                maker(path)


def outputs(words: list[str]) -> list[str]:
    """Return the files and folders that a command is told to write."""
    named = [word for option, word in itertools.pairwise(words) if option in OUTPUT]
    return [*named, words[WRITES[words[1]]]] if words[1] in WRITES else named


def remove(path: Path) -> None:
    """Remove a file, a link or a folder."""
    if path.is_symlink() or path.is_file():
        path.unlink()
    elif path.exists():
        shutil.rmtree(path)


def drive_past() -> tuple[Floats, Floats]:
    """Return times (N,) [s since 1970] and places (N, 3) of a drive through the street in EPSG:7850."""
    seconds = np.arange(0.0, 4.0, 0.1)
    return drive.STARTS["2025"] / drive.SECOND + seconds, drive.path(seconds, 16.0) + drive.CORNER


def tum(path: Path) -> None:
    """Write the drive as a trajectory in TUM form."""
    rows = np.column_stack([*drive_past(), np.zeros((40, 3)), np.ones(40)])
    np.savetxt(path, rows, fmt="%.6f")


def table(survey: Path, path: Path) -> None:
    """Write the drive as a table with named columns, in the grid of a map."""
    times, places = drive_past()
    rows = np.column_stack([times, places])
    np.savetxt(path, rows, fmt="%.4f", delimiter=",", header="time,easting,northing,height", comments="")


def sbet(path: Path) -> None:
    """Write the drive as an SBET: 17 doubles a row, seconds of the GPS week, radians."""
    times, places = drive_past()
    rows = np.zeros((len(times), 17))
    rows[:, 0] = times % (7 * 86_400)
    rows[:, 2], rows[:, 1] = np.radians(drive.TO_DEGREES.transform(places[:, 0], places[:, 1]))
    rows[:, 3], rows[:, 9] = places[:, 2], np.pi / 2
    path.write_bytes(rows.astype("<f8").tobytes())


def points(survey: Path) -> PointCloud:
    """Return the cloud of a fused map."""
    return read_cloud(survey / "map.ply")


def laz(survey: Path, path: Path) -> None:
    """Write a fused map as LAZ, as another system would deliver it."""
    cloud = points(survey)
    ground = cloud.xyz[:, 2] < np.quantile(cloud.xyz[:, 2], 0.2)
    fields = {"classification": np.where(ground, 2, 1).astype(np.uint8)}
    write_cloud(path, PointCloud(cloud.xyz, cloud.origin, cloud.crs, fields))


def control(survey: Path, path: Path) -> None:
    """Write six points of the ground beside the drive as control points."""
    cloud = points(survey)
    place = np.asarray(cloud.xyz, dtype=np.float64) + cloud.origin - drive.CORNER
    beside = (abs(place[:, 2]) < 0.1) & (abs(place[:, 1] - 16.0) < 2.5) & (abs(place[:, 0] - 20.0) < 12.0)
    ground = place[beside] + drive.CORNER
    lines = [f"p{i},{x:.3f},{y:.3f},{z:.3f}" for i, (x, y, z) in enumerate(ground[:: len(ground) // 5][:6])]
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
