# ruff: noqa: T201
"""Real objects put into a real drive beam by beam, or taken out of it: how many of them are found.

    source ros2_ws/env.sh
    python tests/benchmarks/bench_real_objects.py DATA -o out/static --rows

DATA holds ``kitti_scans`` and ``dales_objects`` (``$SUBIACO_TEST_DATA``). The even sweeps are mapped by
``subiaco map`` as they are, the odd ones with objects of DALES in them: beams end where they meet an object,
so that objects hide what is behind them and show the side that was seen. Both maps keep what beams passed.
Compared forwards the objects were put there, backwards they were taken out. Objects stand on ground that
nothing passed or covers in either map, 5 to 40 m from the drive. Counted are objects over 1 m that at least
30 beams met; an object is found when half of its points carry the label.
"""

from __future__ import annotations

import argparse
import sys
import tarfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "integration"))

from bench_static_pairs import PARTS, ShortDrive, map_part, write_sweeps
from real_data import KittiScans
from real_occlusion import FilledScans
from real_street import Found, Placed, common_area, find_ground, fuse, look_up, place_objects, read_objects
from real_street import false_alarms as alarms_of

from subiaco_bringup.cli.main import run
from subiaco_change.config import ChangeConfig
from subiaco_change.pipeline import detect_changes
from subiaco_geo.codes import Change
from subiaco_geo.frames import Floats, invert_pose, transform_points
from subiaco_geo.maps import read_map
from subiaco_geo.survey_map import SurveyMap

TALL = 1.0  # least height of an object that counts [m]
RADIUS = 5.0  # largest radius of an object that may fit into the street [m]


@dataclass(frozen=True)
class Street:
    """Maps without and with objects, and of each object the points that beams met, in the second map."""

    plain: SurveyMap
    filled: SurveyMap
    objects: list[Placed]


def small_objects(archive: Path, seed: int) -> list[str]:
    """Return the names of the objects of DALES that may fit, in a random order."""
    with tarfile.open(archive) as tar:
        names = sorted(Path(m.name).stem for m in tar if Path(m.name).stem.isdigit())
    objects = read_objects(archive, names)
    fit = [o.name for o in objects if o.radius < RADIUS and o.height > 0.5]
    return [str(n) for n in np.random.default_rng(seed).permutation(fit)]


def place(scans: KittiScans, poses: Floats, archive: Path, count: int, seed: int) -> list[Placed]:
    """Put objects on ground that is free in both halves of the sweeps, trails of traffic included."""
    clouds = [fuse(scans, poses, range(first, len(poses), 2)).world() for first in (0, 1)]
    objects = read_objects(archive, small_objects(archive, seed)[:count])
    return place_objects(objects, find_ground(np.concatenate(clouds)), poses[:, :3, 3], seed)


def filled_map(
    scans: KittiScans, poses: Floats, objects: list[Placed], folder: Path, seed: int
) -> tuple[SurveyMap, list[Placed]]:
    """Map the odd sweeps with objects in them; return the map and what of each object beams met."""
    which = PARTS["odd"].scans
    tall = {item.name: np.ptp(item.xyz[:, 2]) > TALL for item in objects}
    filled = FilledScans(scans, poses, objects, seed)
    sweeps = [(i, *filled.scan(i)) for i in which]
    if not (folder / "map" / "map.yaml").exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_sweeps(sweeps, folder / "bag")
        words = ["map", str(folder / "bag"), "-o", str(folder / "map"), "--set", "deskewed=true", "--quiet"]
        if run(words) != 0:
            raise SystemExit("the sweeps with objects were not mapped")
    survey = read_map(folder / "map")
    assert survey.trajectory is not None
    T_map_reference = survey.trajectory.poses[0] @ invert_pose(poses[which[0]])
    return survey, [
        replace(item, xyz=transform_points(T_map_reference, item.xyz))
        for item in filled.met()
        if tall[item.name]
    ]


def compare(street: Street, change: Change) -> tuple[list[Found], list[str], float]:
    """Compare the maps; return what became of the objects, false claims, and the common area [m2]."""
    epochs = (street.plain, street.filled) if change is Change.ADDED else (street.filled, street.plain)
    result = detect_changes(*epochs, ChangeConfig())
    moved = np.eye(4)
    if change is Change.REMOVED:  # the objects are in the frame of *before*, the result in that of *after*
        given = result.registration
        moved = given.T_local.copy()
        moved[:3, 3] += given.origin - moved[:3, :3] @ given.origin
    found = look_up(result, street.objects, change, moved)
    alarms = [
        f"{r.semantic.label} {r.change.label} {r.confidence:.2f} n {r.n_before}/{r.n_after}"
        f" at {r.x:.1f} {r.y:.1f}: {r.reason}"
        for r in alarms_of(result, street.objects, moved)
    ]
    return found, alarms, common_area(result.before, result.after)


def main() -> None:
    """Map the sweeps with objects, compare both ways, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--objects", type=int, default=40, help="objects that are tried")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rows", action="store_true", help="print every object and every false claim")
    words = parser.parse_args()
    words.output.mkdir(parents=True, exist_ok=True)
    drive = ShortDrive(words.data)
    archive = words.data / "dales_objects" / "dales_objects_even.tar.gz"
    placed = place(drive.scans, drive.poses, archive, words.objects, words.seed)
    plain = map_part(drive, "even", words.output)
    folder = words.output / f"objects_{words.objects}_{words.seed}"
    street = Street(plain, *filled_map(drive.scans, drive.poses, placed, folder, words.seed))
    table = ["| objects | found | of | false claims | on 1000 m2 |", "|---|---|---|---|---|"]
    for change, name in ((Change.ADDED, "put there"), (Change.REMOVED, "taken out")):
        found, alarms, area = compare(street, change)
        hits = sum(item.hit for item in found)
        table.append(f"| {name} | {hits} | {len(found)} | {len(alarms)} | {1000 * len(alarms) / area:.2f} |")
        for item in found if words.rows else ():
            size = " x ".join(f"{s:.1f}" for s in item.placed.size)
            told = "found" if item.hit else "MISSED"
            print(f"{item.placed.kind} {item.placed.name}, {size} m, {len(item.placed.xyz)} beams: {told},"
                  f" {item.share:.2f}, {item.semantic} {item.label}")  # fmt: skip
        print(*alarms, sep="\n")
    print("\n".join(table))


if __name__ == "__main__":
    main()
