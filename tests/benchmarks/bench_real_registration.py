# ruff: noqa: T201
"""Registration of real clouds of every density at the defaults, where the transform is known.

    python tests/benchmarks/bench_real_registration.py pairs        # random halves: the transform is known
    python tests/benchmarks/bench_real_registration.py varied       # random pieces, densities and overlaps
    python tests/benchmarks/bench_real_registration.py changed      # most objects taken out of one epoch
    python tests/benchmarks/bench_real_registration.py wrong        # other places, wrong transforms
    python tests/benchmarks/bench_real_registration.py pairs --only autzen oakland

The clouds lie in ``$SUBIACO_TEST_DATA``, else in ``../shared/data``; clouds that are absent are left out.
A pair is two disjoint random halves of one cloud, so that both epochs show the same place and no point is
in both. *before* is moved by a known transform. Halves of one recording share the errors of that recording:
the table tells how exact the registration is, and not how well two surveys agree.
"""

from __future__ import annotations

import argparse
import gzip
import io
import itertools
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bench_airborne import told_apart
from results import keep, rounded
from scipy.spatial.transform import Rotation

from subiaco_change.registration.config import RegistrationConfig
from subiaco_change.registration.register import given_registration, register
from subiaco_geo.clouds import PointCloud, from_world, voxel_downsample
from subiaco_geo.errors import RegistrationError
from subiaco_geo.frames import Floats, invert_pose, make_pose, transform_points
from subiaco_geo.maps import load_epoch

DATA = Path(
    os.environ.get("SUBIACO_TEST_DATA", Path(__file__).resolve().parents[2].parent / "shared" / "data")
)
LEAF = 0.25
#: Known transforms of *before*: rotation vector [deg] and shift [m].
MOTIONS = {
    "none": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "0.7 m": ((0.1, -0.1, 0.5), (0.5, -0.4, 0.2)),
}


def autzen(west: float, east: float) -> Callable[[], Floats]:
    """Piece of an airborne crop between two distances [m] from its western edge."""

    def read() -> Floats:
        xyz = load_epoch(DATA / "autzen" / "autzen_crop_650x300m_rgb.laz").cloud.world()
        x = xyz[:, 0] - xyz[:, 0].min()
        y = xyz[:, 1] - xyz[:, 1].min()
        return np.asarray(xyz[(x >= west) & (x < east) & (y < 200.0)])

    return read


def ign() -> Floats:
    """Three airborne tiles of 50 m."""
    files = sorted((DATA / "ign_lidarhd").glob("*.laz"))
    return np.concatenate([load_epoch(path).cloud.world() for path in files])


def isprs(number: int) -> Callable[[], Floats]:
    """Airborne filter sample with a point a square metre."""

    def read() -> Floats:
        import tempfile

        import open3d

        packed = (DATA / "isprs_filter" / f"samp{number}-utm.pcd.gz").read_bytes()
        with tempfile.NamedTemporaryFile(suffix=".pcd") as file:
            file.write(gzip.decompress(packed))
            file.flush()
            return np.asarray(open3d.t.io.read_point_cloud(file.name).point.positions.numpy(), np.float64)

    return read


def oakland(*parts: str) -> Callable[[], Floats]:
    """Pieces of a street scanned from a car."""

    def read() -> Floats:
        texts = [
            gzip.decompress((DATA / "oakland_mls" / f"oakland_part3_{p}.xyz_label_conf.gz").read_bytes())
            for p in parts
        ]
        return np.concatenate([np.loadtxt(io.BytesIO(text))[:, :3] for text in texts])

    return read


def site(epoch: int) -> Callable[[], Floats]:
    """One epoch of a building site, scanned by hand."""
    path = DATA / "real_pair_site" / f"bike_parking_construction_{epoch}.ply"

    def read() -> Floats:
        return load_epoch(path).cloud.world()

    return read


def kitti(first: int) -> Callable[[], Floats]:
    """Every second sweep of a drive, fused with reference poses."""

    def read() -> Floats:
        with np.load(DATA / "kitti_scans" / "kitti_0926_scans_000_076.npz") as found:
            xyz, offsets, scale = found["xyz_i16"], found["offsets"], float(found["scale"])
        poses = np.loadtxt(DATA / "kitti_scans" / "kiss_icp_reference_poses.txt").reshape(-1, 3, 4)
        parts = []
        for i in range(first, len(poses), 2):
            own = xyz[offsets[i] : offsets[i + 1]].astype(np.float64) * scale
            own = own[np.linalg.norm(own, axis=1) < 50.0]
            parts.append(own @ poses[i, :, :3].T + poses[i, :, 3])
        return voxel_downsample(PointCloud(np.concatenate(parts)), 0.1).xyz

    return read


SOURCES: dict[str, Callable[[], Floats]] = {
    "autzen west (airborne)": autzen(0.0, 200.0),
    "autzen middle (airborne)": autzen(220.0, 420.0),
    "autzen east (airborne)": autzen(440.0, 650.0),
    "ign (airborne, dense)": ign,
    "isprs 11 (airborne, 1 m)": isprs(11),
    "isprs 12 (airborne, 1 m)": isprs(12),
    "isprs 21 (airborne, 1 m)": isprs(21),
    "isprs 22 (airborne, 1 m)": isprs(22),
    "isprs 23 (airborne, 1 m)": isprs(23),
    "isprs 31 (airborne, 1 m)": isprs(31),
    "oakland aj-al (mobile)": oakland("aj", "ak", "al"),
    "oakland am-ap (mobile)": oakland("am", "an", "ao", "ap"),
    "site (handheld)": site(1),
    "kitti (mobile, 77 sweeps)": kitti(0),
}
#: Small clouds, in which one building may hold most of the walls: for changed pairs alone.
PIECES = {f"oakland {name} (one piece)": oakland(name) for name in ("aj", "ak", "al", "am", "an", "ao", "ap")}


@dataclass(frozen=True)
class Pair:
    """Two clouds with world coordinates and their true ``T_after_before``."""

    name: str
    before: Floats
    after: Floats
    truth: Floats


def random_halves(xyz: Floats, seed: int) -> tuple[Floats, Floats]:
    first = np.random.default_rng(seed).random(len(xyz)) < 0.5
    return xyz[first], xyz[~first]


def motion(name: str, centre: Floats) -> Floats:
    """Return a named motion (4, 4) that turns about a centre (3,)."""
    turn, shift = MOTIONS[name]
    rotation = Rotation.from_rotvec(np.radians(turn)).as_matrix()
    return make_pose(rotation, np.asarray(shift) + centre - rotation @ centre)


def thinned(xyz: Floats, spacing: float | None) -> Floats:
    return xyz if spacing is None else voxel_downsample(PointCloud(xyz - xyz[0]), spacing).xyz + xyz[0]


def pairs_of(name: str, xyz: Floats) -> Iterator[Pair]:
    """Yield the pairs of one cloud: as dense as it is, thinned, and one epoch thinner than the other."""
    centre = np.median(xyz, axis=0)
    for label, spacing in (("", (None, None)), (" at 0.5 m", (0.5, 0.5)), (" against 0.5 m", (None, 0.5))):
        before, after = random_halves(xyz, 1)
        before, after = thinned(before, spacing[0]), thinned(after, spacing[1])
        for kind in MOTIONS:
            truth = motion(kind, centre)
            yield Pair(f"{name}{label}, {kind}", transform_points(invert_pose(truth), before), after, truth)


def varied_pairs(name: str, xyz: Floats, count: int) -> Iterator[Pair]:
    """Yield pairs of random pieces: edge, density of each epoch, overlap and motion are drawn.

    The piece is 40 m to the whole cloud wide. Of each epoch a random half of the points is taken, of which
    1, 1/2 or 1/4 is kept; the epochs overlap by half to all of the piece, and *before* lies up to 0.5 m and
    0.5 degrees aside.
    """
    low, high = xyz[:, :2].min(axis=0), xyz[:, :2].max(axis=0)
    for number in range(count):
        rng = np.random.default_rng([number, sum(map(ord, name))])
        edge = np.minimum(rng.uniform(40.0, max(float((high - low).max()), 60.0), 2), high - low)
        corner = low + rng.random(2) * (high - low - edge)
        inside = ((xyz[:, :2] >= corner) & (xyz[:, :2] <= corner + edge)).all(axis=1)
        before, after = random_halves(xyz[inside], number)
        shares = 0.5 ** rng.integers(0, 3, 2)
        overlap = rng.uniform(0.5, 1.0)
        axis = int(rng.integers(0, 2))
        cut = edge[axis] * (1.0 - overlap) / 2.0
        before = before[
            (before[:, axis] < corner[axis] + edge[axis] - cut) & (rng.random(len(before)) < shares[0])
        ]
        after = after[(after[:, axis] > corner[axis] + cut) & (rng.random(len(after)) < shares[1])]
        centre = np.median(xyz[inside], axis=0)
        tilt = rng.uniform(-0.1, 0.1, 3) + np.array([0.0, 0.0, rng.uniform(-0.4, 0.4)])
        turn = Rotation.from_rotvec(np.radians(tilt)).as_matrix()
        angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(0.0, 0.5)
        shift = np.array([length * np.cos(angle), length * np.sin(angle), rng.uniform(-0.2, 0.2)])
        truth = make_pose(turn, shift + centre - turn @ centre)
        kept = f"kept {shares[0]:.2f} and {shares[1]:.2f}"
        words = f"{edge[0]:.0f} x {edge[1]:.0f} m, {kept}, overlap {overlap:.2f}"
        yield Pair(f"{name} {number}: {words}", transform_points(invert_pose(truth), before), after, truth)


def changed_pairs(name: str, xyz: Floats, count: int) -> Iterator[Pair]:
    """Yield pairs of which one epoch lacks half of the objects over 2 m and 20 m2, or four fifths of them.

    Seeds 0 to ``count`` - 1 draw them; each pair is registered in both directions of time.
    """
    owner = told_apart(xyz).owner
    truth = motion("0.7 m", np.median(xyz, axis=0))
    for seed, share in itertools.product(range(count), (0.5, 0.8)):
        rng = np.random.default_rng(seed)
        gone = np.append(rng.random(int(owner.max()) + 1) < share, False)[owner]
        first = rng.random(len(xyz)) < 0.5
        whole, emptied = xyz[first], xyz[~first & ~gone]
        for words, before, after in (("taken out", whole, emptied), ("put in", emptied, whole)):
            title = f"{name}, {100 * gone.mean():.0f} % {words}, seed {seed}"
            yield Pair(title, transform_points(invert_pose(truth), before), after, truth)


def cloud(xyz: Floats) -> PointCloud:
    """Return a cloud at the working leaf, as the change run registers it."""
    return voxel_downsample(from_world(xyz), LEAF)


def error(found: Floats, truth: Floats, at: Floats) -> tuple[float, float]:
    """Shift at a place (3,) [m] and angle [deg] between a result and the truth."""
    delta = found @ invert_pose(truth)
    shift = float(np.linalg.norm(transform_points(delta, at[None])[0] - at))
    return shift, float(np.degrees(Rotation.from_matrix(delta[:3, :3]).magnitude()))


def measure(pair: Pair) -> dict[str, Any]:
    """Register one pair at the defaults and state its error."""
    before, after = cloud(pair.before), cloud(pair.after)
    row: dict[str, Any] = {"pair": pair.name, "points": f"{len(before)} + {len(after)}"}
    began = time.process_time()
    try:
        found = register(before, after, RegistrationConfig())
    except RegistrationError as reason:
        return row | {"verdict": f"refused: {reason}", "CPU s": rounded(time.process_time() - began)}
    shift, angle = error(found.T_after_before, pair.truth, found.origin)
    spacing = max(found.details["spacing_before_m"], found.details["spacing_after_m"])
    away = (
        transform_points(found.T_after_before @ invert_pose(pair.truth), found.origin[None])[0] - found.origin
    )
    normalised = float(np.max(np.abs(away) / np.maximum(found.pose_std[3:], 0.003)))
    verdict = "good" if shift < 0.02 else "WRONG" if normalised > 4.0 else "coarse"
    return row | {
        "spacing, m": rounded(spacing),
        "shift, mm": rounded(1e3 * shift),
        "angle, deg": rounded(angle, 2),
        "sigma_reg, mm": rounded(1e3 * found.sigma_reg_m),
        "over pose_std": rounded(normalised, 2),
        "verdict": verdict,
        "start": found.method.split(" +")[0],
        "warnings": "; ".join(found.warnings),
        "details": {k: rounded(v) for k, v in found.details.items()},
        "CPU s": rounded(time.process_time() - began),
    }


def wrong_pairs(name: str, xyz: Floats, other: Floats) -> Iterator[tuple[str, Floats, Floats, Floats | None]]:
    """Yield clouds that show different places, and transforms that are not true (None: register)."""
    before, after = random_halves(xyz, 1)
    moved = other - np.median(other, axis=0) + np.median(xyz, axis=0)
    yield f"{name}: another place", moved, after, None
    for shift in ((0.4, 0.0, 0.0), (0.0, 0.4, 0.0), (0.0, 0.0, 0.15), (3.0, 1.0, 0.0), (0.0, 12.0, 0.0)):
        yield f"{name}: given {shift}", before, after, make_pose(np.eye(3), np.array(shift))
    yield f"{name}: given the truth", before, after, np.eye(4)


def run_wrong(only: list[str]) -> list[dict[str, Any]]:
    """Print what is said of other places and of transforms that are not true."""
    rows = []
    known = [(name, read) for name, read in SOURCES.items() if wanted(name, only)]
    clouds = [(name, xyz) for name, xyz in ((name, load(read)) for name, read in known) if xyz is not None]
    for (name, xyz), (_, other) in zip(clouds, [*clouds[1:], clouds[0]], strict=True):
        for label, before, after, transform in wrong_pairs(name, xyz, other):
            pair = cloud(before), cloud(after)
            try:
                if transform is None:
                    found = register(*pair, RegistrationConfig())
                else:
                    found = given_registration(transform, *pair, RegistrationConfig())
                verdict = "WARNED" if found.warnings else "accepted"
                text = f"sigma {1e3 * found.sigma_reg_m:.0f} mm; {'; '.join(found.warnings)}"
            except RegistrationError as reason:
                verdict, text = "refused", str(reason)
            rows.append({"pair": label, "verdict": verdict, "words": text})
            print(f"{label}: {verdict}: {text}", flush=True)
    return rows


def wanted(name: str, only: list[str]) -> bool:
    return not only or any(word in name for word in only)


def load(read: Callable[[], Floats]) -> Floats | None:
    """Return the points of a source, None where its files are absent."""
    try:
        return read()
    except (OSError, ValueError, IndexError) as error:
        print(f"left out: {error}")
        return None


def run_pairs(job: str, only: list[str], words: list[str], count: int) -> list[dict[str, Any]]:
    """Register pairs of fixed densities, or so many drawn ones of every cloud."""
    rows = []
    drawn = {"varied": varied_pairs, "changed": changed_pairs}
    for name, read in {**SOURCES, **(PIECES if job == "changed" else {})}.items():
        xyz = load(read) if wanted(name, only) else None
        if xyz is None:
            continue
        for pair in drawn[job](name, xyz, count) if job in drawn else pairs_of(name, xyz):
            if all(word in pair.name for word in words):
                rows.append(measure(pair))
                print(rows[-1], flush=True)
    return rows


def table(rows: list[dict[str, Any]]) -> None:
    """Print one line a pair."""
    columns = [
        "pair",
        "points",
        "spacing, m",
        "shift, mm",
        "angle, deg",
        "sigma_reg, mm",
        "over pose_std",
        "CPU s",
        "verdict",
    ]
    print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    for row in rows:
        print("| " + " | ".join(str(row.get(column, "")) for column in columns) + " |")
    done = [row for row in rows if "shift, mm" in row]
    good = sum(row["verdict"] == "good" for row in done)
    print(f"{len(rows)} pairs: {good} within 20 mm, {len(rows) - len(done)} refused, "
          f"{sum(row['verdict'] == 'WRONG' for row in done)} wrong and unnoticed")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("job", choices=["pairs", "varied", "changed", "wrong"])
    parser.add_argument("--only", nargs="*", default=[], help="words, one of which a source's name holds")
    parser.add_argument("--words", nargs="*", default=[], help="words, all of which a pair's name holds")
    parser.add_argument("--count", type=int, default=4, help="drawn pairs, or seeds, of each cloud")
    parser.add_argument("--json", type=Path, help="leave the rows there")
    arguments = parser.parse_args()
    if arguments.job != "wrong":
        rows = run_pairs(arguments.job, arguments.only, arguments.words, arguments.count)
        table(rows)
    else:
        rows = run_wrong(arguments.only)
    keep(arguments.json, rows)


if __name__ == "__main__":
    main()
