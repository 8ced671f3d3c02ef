# ruff: noqa: T201
"""Two maps of one real drive, in which nothing but traffic changed: every claim is a false one.

    source ros2_ws/env.sh
    python tests/benchmarks/bench_static_pairs.py DATA -o out/static --pairs even_odd halves bare_even_odd
    python tests/benchmarks/bench_static_pairs.py DATA -o out/static --drive 0027

DATA holds ``kitti_scans`` (drive 0005) and ``kitti_drive_0027`` (``$SUBIACO_TEST_DATA``). Parts of the sweeps
become bags, each is mapped by ``subiaco map`` on its own (maps are kept in the output folder and used again),
and pairs of maps are compared at the default settings; the ``fine`` pairs are bare clouds with a point every
0.08 m, as other fusions write them. Drive 0005 has deskewed scans and no fixes: where the
registration refuses a pair, the pair is compared at the transformation of the scans' reference poses, and the
table says so. Drive 0027 has sweeps as they were recorded, times of points, and fixes.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from kitti_drive import CRS, read_drive, write_drive
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "integration"))

from real_data import KITTI_PERIOD_NS, KITTI_START_NS, KittiScans, read_kitti
from real_street import REPORTED, common_area

from subiaco_bringup.cli.main import run
from subiaco_change.config import ChangeConfig
from subiaco_change.pipeline import detect_changes
from subiaco_change.records import ChangeResult
from subiaco_geo.bags import TYPESTORE, BagWriter
from subiaco_geo.errors import SubiacoError
from subiaco_geo.frames import Floats, invert_pose, make_pose
from subiaco_geo.maps import read_map
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.topics import MESSAGE_TYPES, POINTS

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Part:
    """Part of a drive: which scans, which of their points (N, 3) and lasers, and settings of the mapping."""

    scans: range
    points: Callable[[Floats], Mask] | None = None
    settings: tuple[str, ...] = ()
    every_ring: int = 1


def ahead(xyz: Floats) -> Mask:
    """Tell which points lie ahead of the scanner."""
    return np.asarray(xyz[:, 0] >= 0)


def behind(xyz: Floats) -> Mask:
    """Tell which points lie behind the scanner."""
    return ~ahead(xyz)


def second_rings(xyz: Floats) -> Mask:
    """Tell which points are of every second laser: they lie laser by laser, each from the front leftwards."""
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    laser = np.cumsum(np.abs(np.diff(azimuth, prepend=azimuth[:1])) > np.pi)
    return np.asarray(laser % 2 == 0)


COARSE = ("fusion.leaf=0.5",)
FINE = ("fusion.leaf=0.08",)
PARTS = {
    "even": Part(range(0, 77, 2)),
    "odd": Part(range(1, 77, 2)),
    "first": Part(range(45)),
    "second": Part(range(32, 77)),
    "ahead": Part(range(77), ahead),
    "behind": Part(range(77), behind),
    "rings": Part(range(1, 77, 2), second_rings),
    "coarse": Part(range(1, 77, 2), None, COARSE),
}
#: The same shares of drive 0027; every second ring is chosen by the laser.
PARTS_0027 = {
    "even": Part(range(0, 188, 2)),
    "odd": Part(range(1, 188, 2)),
    "first": Part(range(110)),
    "second": Part(range(78, 188)),
    "ahead": Part(range(188), ahead),
    "behind": Part(range(188), behind),
    "rings": Part(range(1, 188, 2), every_ring=2),
    "coarse": Part(range(1, 188, 2), None, COARSE),
}
for _parts_of_drive in (PARTS, PARTS_0027):
    for _name in ("first", "second", "ahead", "behind"):
        _parts_of_drive[f"fine_{_name}"] = replace(_parts_of_drive[_name], settings=FINE)
#: Parts of *before* and of *after*, and what of their maps is compared.
_PARTS = {
    "even_odd": ("even", "odd"),
    "halves": ("first", "second"),
    "ahead_behind": ("ahead", "behind"),
    "rings": ("even", "rings"),
}
PAIRS = {
    **{name: (*parts, "map") for name, parts in _PARTS.items()},
    "leaf": ("even", "coarse", "map"),
    **{f"bare_{name}": (*parts, "bare") for name, parts in _PARTS.items()},
    **{f"trajectory_{name}": (*parts, "trajectory") for name, parts in _PARTS.items()},
    "fine_halves": ("fine_first", "fine_second", "bare"),
    "fine_ahead_behind": ("fine_ahead", "fine_behind", "bare"),
}


def write_part(scans: KittiScans, part: Part, bag: Path) -> None:
    """Write a part of the drive as ``/lidar/points``."""

    def chosen(i: int) -> tuple[int, Floats, Floats]:
        xyz, intensity = scans.scan(i)
        kept = np.ones(len(xyz), dtype=bool) if part.points is None else part.points(xyz)
        return i, xyz[kept], intensity[kept]

    write_sweeps((chosen(i) for i in part.scans), bag)


def write_sweeps(sweeps: Iterable[tuple[int, Floats, Floats]], bag: Path) -> None:
    """Write sweeps as ``/lidar/points``: the number of each, its points (N, 3) [m] and intensities (N,)."""
    kinds = TYPESTORE.types
    field = kinds["sensor_msgs/msg/PointField"]
    fields = [field(name, 4 * i, 7, 1) for i, name in enumerate(("x", "y", "z", "intensity"))]
    with BagWriter(bag) as writer:
        for i, xyz, intensity in sweeps:
            stamp_ns = KITTI_START_NS + i * KITTI_PERIOD_NS
            stamp = kinds["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
            header = kinds["std_msgs/msg/Header"](stamp, "lidar_link")
            rows = np.column_stack([xyz, intensity]).astype("<f4")
            data = rows.view(np.uint8).ravel()
            cloud = kinds[MESSAGE_TYPES[POINTS]](
                header, 1, len(rows), fields, False, 16, 16 * len(rows), data, True
            )
            writer.write(POINTS, MESSAGE_TYPES[POINTS], cloud, stamp_ns)


class ShortDrive:
    """Drive 0005: 77 deskewed scans, and poses of another odometry."""

    parts = PARTS
    settings = ("deskewed=true",)

    def __init__(self, data: Path) -> None:
        self.scans = read_kitti(data / "kitti_scans")
        rows = np.loadtxt(data / "kitti_scans" / "kiss_icp_reference_poses.txt").reshape(-1, 3, 4)
        self.poses = make_pose(rows[:, :, :3], rows[:, :, 3])

    def write(self, part: Part, bag: Path) -> None:
        """Write the bag of a part."""
        write_part(self.scans, part, bag)

    def transform(self, first: Part, second: Part) -> Floats:
        """Return the transformation from the map of one part to that of another."""
        starts = [self.poses[part.scans[0]] for part in (first, second)]
        return invert_pose(starts[1]) @ starts[0]


class LongDrive:
    """Drive 0027: 188 sweeps with the times of their points, and fixes; its maps have a CRS."""

    parts = PARTS_0027
    settings = (f"crs={CRS}",)

    def __init__(self, data: Path) -> None:
        self.drive = read_drive(data)

    def write(self, part: Part, bag: Path) -> None:
        """Write the bag of a part."""
        chosen = set(part.scans)
        write_drive(self.drive, bag, lambda k, n: k in chosen, every_ring=part.every_ring, points=part.points)

    def transform(self, first: Part, second: Part) -> Floats:
        """Return the transformation between maps of one CRS."""
        return np.eye(4)


DRIVES: dict[str, Callable[[Path], ShortDrive | LongDrive]] = {"0005": ShortDrive, "0027": LongDrive}


def map_part(drive: ShortDrive | LongDrive, name: str, folder: Path) -> SurveyMap:
    """Map a part of a drive, or read the map made before."""
    if not (folder / name / "map.yaml").exists():
        bag = folder / f"{name}.bag"
        if not bag.exists():
            drive.write(drive.parts[name], bag)
        words = ["map", str(bag), "-o", str(folder / name), "--quiet"]
        for setting in (*drive.settings, *drive.parts[name].settings):
            words += ["--set", setting]
        if run(words) != 0:
            raise SystemExit(f"{name}: not mapped")
    return read_map(folder / name)


@dataclass(frozen=True)
class Score:
    """False claims of a pair, its common area [m2], and whether it was registered."""

    result: ChangeResult
    area: float
    registered: str

    def claims(self, above: float = 0.0) -> int:
        """Count the rows that claim a change above a confidence."""
        return sum(r.change in REPORTED and r.confidence > above for r in self.result.records)

    def line(self, name: str) -> str:
        """Return the row of the table."""
        rates = [f"{self.claims(c)} ({1000 * self.claims(c) / self.area:.2f})" for c in (0.0, 0.5, 0.9)]
        return f"| {name} | {self.area:.0f} | {self.registered} | {' | '.join(rates)} |"


def compare(before: SurveyMap, after: SurveyMap, T_after_before: Floats, kept: str) -> Score:
    """Compare two maps of the same drive at the default settings: whole, bare, or bare with a trajectory."""
    if kept != "map":
        before, after = (
            SurveyMap(survey.cloud, survey.trajectory if kept == "trajectory" else None)
            for survey in (before, after)
        )
    try:
        result, registered = detect_changes(before, after, ChangeConfig()), "yes"
    except SubiacoError as error:
        print("refused:", error)
        result = detect_changes(before, after, ChangeConfig(), transform=T_after_before)
        registered = "refused"
    return Score(result, common_area(result.before, result.after), registered)


def main() -> None:
    """Map the parts and compare the pairs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--drive", choices=DRIVES, default="0005")
    parser.add_argument("--pairs", nargs="+", choices=PAIRS, default=list(PAIRS))
    parser.add_argument("--rows", action="store_true", help="print every false claim")
    words = parser.parse_args()
    folder = words.output if words.drive == "0005" else words.output / words.drive
    folder.mkdir(parents=True, exist_ok=True)
    drive = DRIVES[words.drive](words.data)
    table = [
        "| pair | m2 | registered | claims (on 1000 m2) | above 0.5 | above 0.9 |",
        "|---|---|---|---|---|---|",
    ]
    for name in words.pairs:
        started = time.process_time()
        first, second, kept = PAIRS[name]
        surveys = [map_part(drive, part, folder) for part in (first, second)]
        T_after_before = drive.transform(drive.parts[first], drive.parts[second])
        score = compare(surveys[0], surveys[1], T_after_before, kept)
        table.append(score.line(name))
        print(table[-1], f"{time.process_time() - started:.0f} CPU s", flush=True)
        for r in score.result.records if words.rows else ():
            if r.change in REPORTED:
                print(
                    f"  {r.semantic.label} {r.change.label} {r.confidence:.2f} n {r.n_before}/{r.n_after}"
                    f" seen {r.observed_fraction:.2f} ({r.evidence})"
                    f" at {r.x:.1f} {r.y:.1f} {r.z:.1f}: {r.reason}"
                )
    print("\n".join(table))


if __name__ == "__main__":
    main()
