# ruff: noqa: T201
"""Registration of simulated pairs from starts up to the limits, against its peers; all figures are simulated.

    for seed in 1 2 3 4 5 6 7 8 9 10; do
      subiaco simulate out/reg/$seed --preset default --seed $seed --duration 10 --mode 512x10 \
        --set map_every=4 --maps-only
    done
    python tests/benchmarks/bench_registration.py pairs out/reg/* --rows out/reg/rows.csv
    python tests/benchmarks/bench_registration.py strangers out/reg/*
    python tests/benchmarks/bench_registration.py table out/reg/1 --rows out/reg/rows.csv --picture pairs.png
    python tests/benchmarks/bench_registration.py planes out/reg/1
    python tests/benchmarks/bench_registration.py speed out/reg/large

Of the two maps of a survey, each loses a third, so that they overlap by half; CRS and normals are
dropped; *before* is tilted by up to 12 degrees, turned by any yaw and moved by up to 200 m, the first
start of every survey being at the limits. ``--chains kiss`` needs kiss-matcher, which is no dependency of
ours: its wheel holds a clique solver under the GPL.
"""

from __future__ import annotations

import argparse
import csv
import time
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from results import keep, rounded
from scipy.spatial.transform import Rotation

from subiaco_change.geometry import Level
from subiaco_change.records import Registration
from subiaco_change.registration import register as chain
from subiaco_change.registration.coarse import StartPose
from subiaco_change.registration.config import RegistrationConfig
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change
from subiaco_geo.errors import RegistrationError
from subiaco_geo.frames import Floats, invert_pose, make_pose, transform_points
from subiaco_geo.maps import load_epoch

LIMIT_M, LIMIT_DEG = 0.02, 0.03


def load(survey: Path) -> tuple[PointCloud, PointCloud]:
    """Both maps about one origin in the middle of *after*, without CRS, with their true changes."""
    after = load_epoch(survey / "after" / "map.ply").cloud
    before = load_epoch(survey / "before" / "map.ply").cloud.rebased(after.origin)
    middle = np.median(after.xyz, axis=0)
    return bare(before, before.xyz - middle), bare(after, after.xyz - middle)


def bare(cloud: PointCloud, xyz: Floats) -> PointCloud:
    """Points (N, 3) with nothing but the true change of a cloud."""
    return PointCloud(xyz, fields={"true_change": cloud.fields["true_change"]})


def start(seed: int, number: int) -> Floats:
    """Return a random ``T_after_before`` within the limits; number 0 lies at them."""
    rng = np.random.default_rng([seed, number])
    tilt, shift = (12.0, 200.0) if number == 0 else (12.0 * rng.random(), 200.0 * rng.random())
    azimuth, heading, yaw = rng.uniform(-np.pi, np.pi, 3)
    tilting = Rotation.from_rotvec(np.radians(tilt) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
    turn = (Rotation.from_rotvec([0.0, 0.0, yaw]) * tilting).as_matrix()
    return make_pose(turn, np.array([shift * np.cos(heading), shift * np.sin(heading), rng.uniform(-20, 20)]))


def halves(before: PointCloud, after: PointCloud, number: int) -> tuple[PointCloud, PointCloud]:
    """Cut a third off either end, so that what is left overlaps by half."""
    axis, sign = number % 2, 1.0 if number % 4 < 2 else -1.0
    along = [sign * cloud.xyz[:, axis] for cloud in (before, after)]
    low, high = min(a.min() for a in along), max(a.max() for a in along)
    return (
        before.select(along[0] < low + (high - low) * 2 / 3),
        after.select(along[1] > low + (high - low) / 3),
    )


def pair(survey: Path, seed: int, number: int) -> tuple[PointCloud, PointCloud, Floats]:
    """One pair of clouds in frames of their own, and their true ``T_after_before``."""
    truth = start(seed, number)
    before, after = halves(*load(survey), number)
    return bare(before, transform_points(invert_pose(truth), before.xyz)), after, truth


def error(found: Registration, truth: Floats) -> tuple[Floats, float]:
    """Displacement (3,) at the overlap's centroid [m] and angle [deg] between a result and the truth."""
    delta = found.T_after_before @ invert_pose(truth)
    shift = transform_points(delta, found.origin[None])[0] - found.origin
    return shift, float(np.degrees(Rotation.from_matrix(delta[:3, :3]).magnitude()))


def propose_by_kiss(before: Level, after: Level, *_: object) -> list[StartPose]:
    """KISS-Matcher with its own defaults at 1 m, as the coarse stage."""
    import kiss_matcher

    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(1.0))
    found = matcher.estimate(before.xyz.astype(np.float32), after.xyz.astype(np.float32))
    pose = make_pose(np.asarray(found.rotation, dtype=np.float64), np.asarray(found.translation).ravel())
    return [StartPose(pose, float(matcher.get_num_final_inliers()))] if found.valid else []


CHAINS = {"ours": "pictures", "paper": "features", "kiss": "features"}


def run(name: str, before: PointCloud, after: PointCloud) -> Registration:
    """Register by a chain that differs in the coarse stage alone."""
    config = RegistrationConfig(coarse="always", coarse_method=CHAINS[name])  # type: ignore[arg-type]
    if name != "kiss":
        return chain.register(before, after, config)
    with mock.patch.object(chain, "propose_by_features", propose_by_kiss):
        return chain.register(before, after, config)


@dataclass
class Row:
    """One registration; ``refused`` holds the reason of an error."""

    survey: str
    number: int
    chain: str
    shift: float = np.nan
    angle: float = np.nan
    sigma: float = np.nan
    normalised: float = np.nan  # largest |error| over stated standard deviation of x, y, z
    cpu: float = np.nan
    refused: str = ""

    @property
    def good(self) -> bool:
        return self.shift < LIMIT_M and self.angle < LIMIT_DEG


def measured(row: Row, found: Registration, truth: Floats) -> Row:
    shift, row.angle = error(found, truth)
    row.shift, row.sigma = float(np.linalg.norm(shift)), found.sigma_reg_m
    row.normalised = float(np.max(np.abs(shift) / found.pose_std[3:]))
    return row


def run_pairs(surveys: list[Path], chains: list[str], starts: int, again: bool, out: Path) -> None:
    """Append one line a pair and chain to a CSV; ``again`` adds ours without the true changes."""
    out.parent.mkdir(parents=True, exist_ok=True)
    for survey in surveys:
        for number in range(starts):
            before, after, truth = pair(survey, int(survey.name.strip("sim") or 0), number)
            for name in chains:
                rows = [Row(survey.name, number, name)]
                begin = time.process_time()
                try:
                    found = run(name, before, after)
                    rows = [measured(rows[0], found, truth)]
                    rows[0].cpu = time.process_time() - begin
                    if again and name == "ours":
                        rows.append(second(Row(survey.name, number, "second"), found, before, after, truth))
                except RegistrationError as reason:
                    rows[0].refused, rows[0].cpu = str(reason), time.process_time() - begin
                with out.open("a", newline="") as file:
                    csv.writer(file).writerows(list(asdict(row).values()) for row in rows)
                print(*rows, sep="\n", flush=True)


def second(row: Row, first: Registration, before: PointCloud, after: PointCloud, truth: Floats) -> Row:
    """Decision 2 with the true changes in place of those that a first pass finds."""
    begin = time.process_time()
    changed = [
        ~np.isin(cloud.fields["true_change"], (Change.UNCHANGED, Change.UNOBSERVED))
        for cloud in (before, after)
    ]
    found = chain.register(before, after, RegistrationConfig(), changed[0], changed[1], start=first)
    row = measured(row, found, truth)
    row.cpu = time.process_time() - begin
    return row


def run_strangers(surveys: list[Path]) -> None:
    """Register *before* of one survey to *after* of the next: nothing but an error is right."""
    for one, other in pairwise([*surveys, surveys[0]]):
        before, after = load(one)[0], load(other)[1]
        try:
            found = run("ours", before, after)
            print(f"{one.name} to {other.name}: ACCEPTED, {found.details}", flush=True)
        except RegistrationError as reason:
            print(f"{one.name} to {other.name}: refused: {reason}", flush=True)


def read_rows(path: Path) -> list[Row]:
    kinds = {f.name: {"int": int, "float": float}.get(str(f.type), str) for f in fields(Row)}
    with path.open(newline="") as file:
        return [
            Row(*(kind(v) for kind, v in zip(kinds.values(), line, strict=True))) for line in csv.reader(file)
        ]


def table(rows: list[Row]) -> None:
    """Print one line a chain."""
    print("| chain | pairs | within limits | refused | wrong and unnoticed | shift, median / worst [mm] "
          "| angle, median / worst [deg] | shift over sigma, median / 95 % | CPU s, median |")  # fmt: skip
    print("|---" * 9 + "|")
    for name in dict.fromkeys(row.chain for row in rows):
        mine = [row for row in rows if row.chain == name]
        done = [row for row in mine if not row.refused]
        shift, angle = np.array([r.shift for r in done]) * 1e3, np.array([r.angle for r in done])
        ratio = np.array([r.shift / r.sigma for r in done])
        good = sum(row.good for row in done)
        print(
            f"| {name} | {len(mine)} | {good} | {len(mine) - len(done)} | {len(done) - good} "
            f"| {np.median(shift):.1f} / {shift.max():.1f} | {np.median(angle):.4f} / {angle.max():.4f} "
            f"| {np.median(ratio):.2f} / {np.quantile(ratio, 0.95):.2f} "
            f"| {np.median([r.cpu for r in mine]):.1f} |"
        )


def draw(survey: Path, rows: list[Row], path: Path) -> None:
    """Draw a pair as it comes, as it is registered, and the errors of all pairs."""
    import matplotlib.pyplot as plt

    before, after, _ = pair(survey, int(survey.name.strip("sim") or 0), 0)
    found = run("ours", before, after)
    moved = transform_points(found.T_after_before, before.xyz)
    figure, axes = plt.subplots(1, 3, figsize=(21, 7))
    shown = (("as they come: tilted 12 deg, 200 m apart", before.xyz), ("registered", moved))
    for axis, (title, xyz) in zip(axes, shown, strict=False):
        for points, colour, name in ((after.xyz, "#d95f02", "after"), (xyz, "#1b6ca8", "before")):
            some = points[:: max(len(points) // 60_000, 1)]
            axis.scatter(some[:, 0], some[:, 1], s=0.4, c=colour, linewidths=0, label=name)
        axis.set(title=title, aspect="equal", xlabel="x [m]", ylabel="y [m]")
        axis.legend(markerscale=20, loc="upper right")
    for name, marker in (("ours", "o"), ("paper", "x"), ("kiss", "+")):
        mine = [row for row in rows if row.chain == name and not row.refused]
        label = f"{name}: {len(mine)} of {sum(row.chain == name for row in rows)}"
        axes[2].scatter([1e3 * r.shift for r in mine], [r.angle for r in mine], marker=marker, label=label)
    axes[2].axvline(1e3 * LIMIT_M, c="grey", ls="--")
    axes[2].axhline(LIMIT_DEG, c="grey", ls="--")
    axes[2].set(title="errors of the pairs (simulated), and the limits", xlabel="shift at the centroid [mm]")
    axes[2].set(ylabel="angle [deg]", xlim=(0, None), ylim=(0, None))
    axes[2].legend()
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=60)


def run_planes(survey: Path) -> None:
    """Print what the plane-to-plane term changes, by its weight."""
    before, after, truth = pair(survey, int(survey.name.strip("sim") or 0), 0)
    first = run("ours", before, after)
    plain = None
    for weight in (0.0, 0.1, 1e2, 1e4, 1e5):
        found = chain.register(before, after, RegistrationConfig(plane_weight=weight), start=first)
        plain = plain or found
        shift, angle = error(found, truth)
        moved, turned = error(found, plain.T_after_before)
        print(
            f"lambda {weight:g}: error {1e3 * np.linalg.norm(shift):.3f} mm {angle:.5f} deg; "
            f"moved by {1e3 * np.linalg.norm(moved):.6f} mm, {turned:.7f} deg"
        )


def by_small_gicp(before: Floats, after: Floats, pose: Floats) -> Floats:
    """VGICP from voxels of 4 m to 0.5 m."""
    import small_gicp

    for voxel, leaf in ((4.0, 1.0), (2.0, 0.5), (1.0, 0.25), (0.5, 0.25)):
        pose = small_gicp.align(
            after, before, pose, registration_type="VGICP", voxel_resolution=voxel, num_threads=1,
            downsampling_resolution=leaf, max_correspondence_distance=2.0 * voxel,
        ).T_target_source  # fmt: skip
    return np.asarray(pose)


def by_open3d(before: Floats, after: Floats, pose: Floats) -> Floats:
    """Point-to-plane ICP with Tukey's weights on 1, 0.5 and 0.25 m."""
    import open3d as o3d

    icp = o3d.pipelines.registration
    for leaf in (1.0, 0.5, 0.25):
        clouds = []
        for xyz in (before, after):
            cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz)).voxel_down_sample(leaf)
            cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(max(0.8, 2.5 * leaf), 30))
            clouds.append(cloud)
        method = icp.TransformationEstimationPointToPlane(icp.TukeyLoss(0.3))
        pose = icp.registration_icp(clouds[0], clouds[1], 2.0 * leaf, pose, method).transformation
    return np.asarray(pose)


def by_us(before: Floats, after: Floats, pose: Floats) -> Floats:
    """Our chain without its search, with outlier removal, checks and uncertainty."""
    clouds = [PointCloud(xyz, np.zeros(3), "EPSG:7850") for xyz in (transform_points(pose, before), after)]
    return chain.register(*clouds, RegistrationConfig()).T_after_before @ pose


def by_search(before: Floats, after: Floats, _: Floats) -> Floats:
    """Our chain with its search, told nothing."""
    config = RegistrationConfig(coarse="always")
    return chain.register(PointCloud(before), PointCloud(after), config).T_after_before


PEERS = {
    "ours, from the start": by_us,
    "ours, search": by_search,
    "small_gicp VGICP pyramid": by_small_gicp,
    "Open3D ICP pyramid": by_open3d,
}


def dense(survey: Path, count: int) -> list[Floats]:
    """Points (count, 3) of each epoch before they are fused at 0.25 m, about the middle of *after*."""
    clouds = []
    for epoch in ("before", "after"):
        with np.load(survey / epoch / "truth" / "points.npz") as data:
            xyz = data["xyz"]
        clouds.append(xyz[np.sort(np.random.default_rng(0).permutation(len(xyz))[:count])])
    middle = np.median(clouds[1], axis=0)
    return [xyz - middle for xyz in clouds]


def run_speed(survey: Path, path: Path | None) -> None:
    """Print and keep time and error of ours and the peers on a million points each, from two starts."""
    before, after = dense(survey, 1_000_000)
    rows: list[dict[str, Any]] = []
    print(f"{len(before)} + {len(after)} points")
    for by in PEERS.values():  # compile before the clock starts
        by(before[::40], before[::40], np.eye(4)) if by is not by_search else None
    for degrees, metres in ((1.0, 0.5), (5.0, 4.0)):
        turn = Rotation.from_rotvec(np.radians([0.0, 0.0, degrees])).as_matrix()
        pose = make_pose(turn, np.array([metres, 0.0, 0.2]))
        for name, by in PEERS.items():
            wall, cpu = time.perf_counter(), time.process_time()
            rows.append({"start": f"{metres} m, {degrees} deg", "method": name})
            try:
                found = by(before, after, pose)
            except RegistrationError as reason:
                rows[-1]["CPU s"] = "refused"
                print(f"start {metres} m {degrees} deg, {name}: refused: {reason}")
                continue
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            shift = 1e3 * float(np.linalg.norm(found[:3, 3]))  # the origin lies in the middle
            angle = np.degrees(Rotation.from_matrix(found[:3, :3]).magnitude())
            print(f"start {metres} m {degrees} deg, {name}: {cpu:.1f} CPU s ({wall:.1f} s), "
                  f"error {shift:.1f} mm {angle:.4f} deg", flush=True)  # fmt: skip
            rows[-1] |= {"CPU s": rounded(cpu), "shift, mm": rounded(shift), "angle, deg": rounded(angle, 2)}
    for row in rows:
        peer = next(r for r in rows if r["start"] == row["start"] and "VGICP" in r["method"])
        if "refused" not in (row["CPU s"], peer["CPU s"]):
            row["of small_gicp VGICP"] = rounded(row["CPU s"] / peer["CPU s"], 2)
    absent = {"Open3D NDT": "Open3D has none; our own chain refines by NDT"}
    keep(
        path, rows, absent, [f"{len(before)} + {len(after)} points, one thread; Open3D takes those it likes"]
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("job", choices=["pairs", "strangers", "table", "planes", "speed"])
    parser.add_argument(
        "surveys", nargs="*", type=Path, help="outputs of simulate --maps-only, named by seed"
    )
    parser.add_argument("--chains", nargs="+", choices=list(CHAINS), default=["ours", "paper"])
    parser.add_argument("--starts", type=int, default=5)
    parser.add_argument("--second", action="store_true", help="ours once more without the true changes")
    parser.add_argument("--rows", type=Path, default=Path("out/reg/rows.csv"))
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--json", type=Path, help="leave the rows there, for bench.py")
    arguments = parser.parse_args()
    if arguments.job == "pairs":
        run_pairs(arguments.surveys, arguments.chains, arguments.starts, arguments.second, arguments.rows)
    elif arguments.job == "strangers":
        run_strangers(arguments.surveys)
    elif arguments.job == "table":
        table(read_rows(arguments.rows))
        if arguments.picture:
            draw(arguments.surveys[0], read_rows(arguments.rows), arguments.picture)
    elif arguments.job == "planes":
        run_planes(arguments.surveys[0])
    else:
        run_speed(arguments.surveys[0], arguments.json)


if __name__ == "__main__":
    main()
