# ruff: noqa: T201
"""Coverage of the level of detection where nothing changed, and errors over stated sigmas; all simulated.

    for seed in 1 2 3 4 5; do
      subiaco simulate out/lod/$seed --preset default --seed $seed --duration 14 --maps-only \\
        --mode 512x10 --set map_every=2
    done
    python tests/benchmarks/bench_lod_coverage.py coverage out/lod/* --picture out/coverage.png
    python tests/benchmarks/bench_lod_coverage.py sigmas out/lod/*

``coverage`` bends the map of *before* as the simulator's switches do, registers every pair by the default
chain, and counts cylinder means under LoD95 on ground, buildings, fences and poles that nothing happened
to, at least 1.5 m from anything that something did happen to (plants always: leaves and wind); one
every 2 m. Classes are the true ones. ``pool`` joins the printed tables of several runs. ``sigmas`` cuts
every pair into squares and divides the registration errors by ``pose_std``. Constants are tuned on
tuning seeds (config/seeds.yaml) alone.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "change"))

from assembled_run import place

from subiaco_change.config import ChangeConfig
from subiaco_change.geometry import estimate_normals
from subiaco_change.level_of_detection.displacement_lod import combine, lod_of, measure_displacements
from subiaco_change.registration.pair import check_pair
from subiaco_change.registration.register import register
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Semantic
from subiaco_geo.errors import RegistrationError
from subiaco_geo.frames import Floats
from subiaco_geo.maps import load_epoch
from subiaco_geo.survey_map import SurveyMap
from subiaco_sim.config import MapErrorConfig
from subiaco_sim.drives import MAP_CRS, WORLD
from subiaco_sim.map_errors import MapWarp

SETTINGS = {
    "none": MapErrorConfig(),
    "drift 3 cm": MapErrorConfig(drift=0.03),
    "drift 8 cm, shear 6 cm": MapErrorConfig(drift=0.08, shear=0.06),
    "facades twice": MapErrorConfig(duplicates=0.2),
}
RANGES = (0.0, 8.0, 15.0, 25.0, 40.0, 80.0)
CLASSES = {"ground": Semantic.GROUND, "building": Semantic.BUILDING, "other": Semantic.OTHER}


@dataclass(frozen=True)
class Pair:
    """Both epochs at the working leaf with normals, and which points nothing happened to."""

    surveys: tuple[SurveyMap, SurveyMap]
    clouds: tuple[PointCloud, PointCloud]
    still: tuple[NDArray[np.bool_], NDArray[np.bool_]]


def doubled(survey: SurveyMap, poses: Floats, share: float) -> SurveyMap:
    """Let the facades along the middle of a drive stand twice, as ``maps.duplicates`` does."""
    cloud = survey.cloud
    _, pose = cKDTree(poses).query(cloud.world())
    middle = np.abs(pose / len(poses) - 0.5) < 0.5 * share
    second = cloud.select(middle & (cloud.fields["true_class"] == Semantic.BUILDING))
    aside = MapErrorConfig().duplicate_offset * np.array([0.8, 0.6, 0.0])
    fields = {k: np.concatenate([v, second.fields[k]]) for k, v in cloud.fields.items()}
    both = replace(cloud, xyz=np.concatenate([cloud.xyz, second.xyz + aside]), fields=fields)
    return replace(survey, cloud=both)


def drive(path: Path, epoch: str) -> Floats:
    """Return the true positions (M, 3) of the sensor in the world [m]."""
    return np.loadtxt(path / epoch / "truth" / "trajectory.tum")[:, 1:4]


def seed_of(path: Path) -> int:
    """Return the seed of a survey."""
    return int(yaml.safe_load((path / "truth" / "scene.yaml").read_text())["seed"])


def load_pair(path: Path, errors: MapErrorConfig, seed: int) -> Pair:
    """Load a survey, bending *before* as the simulator would have."""
    before, after = load_epoch(path / "before"), load_epoch(path / "after")
    if errors.duplicates:
        before = doubled(before, drive(path, "before"), errors.duplicates)
    world = before.cloud.world()
    enu = WORLD.points_from_map(world, MAP_CRS)
    warp = MapWarp(errors, np.median(enu, axis=0), seed)
    bent = WORLD.points_to_map(warp.apply(enu), MAP_CRS) if not warp.is_identity else world
    before = replace(before, cloud=replace(before.cloud, xyz=bent - before.cloud.origin))
    before, after, _ = check_pair(before, after)
    with (path / "truth" / "objects.csv").open() as file:
        quiet = {int(row["object_id"]) for row in csv.DictReader(file) if not row["event"]} | {0}
    clouds = [s.cloud.with_fields(normals=estimate_normals(s.cloud.xyz, 0.8)) for s in (before, after)]
    still = [
        np.isin(c.fields["object"], list(quiet)) & (c.fields["true_class"] != Semantic.VEGETATION)
        for c in clouds
    ]
    return Pair((before, after), (clouds[0], clouds[1]), (still[0], still[1]))


@dataclass(frozen=True)
class Counted:
    """Cylinder means: setting, class, range [m], |displacement|, LoD95 with and without floors [m]."""

    setting: NDArray[np.int64]
    semantic: NDArray[np.int64]
    range: Floats
    distance: Floats
    bare: Floats
    floored: Floats
    sigma: Floats

    def select(self, mask: NDArray[np.bool_]) -> Counted:
        return Counted(*(values[mask] for values in vars(self).values()))

    def shares(self) -> tuple[float, float]:
        """Return the shares under LoD95 without and with floors."""
        return float(np.mean(self.distance <= self.bare)), float(np.mean(self.distance <= self.floored))


def count_pair(pair: Pair, poses: tuple[Floats, Floats], setting: int, config: ChangeConfig) -> Counted:
    """Register, place and measure one pair."""
    registration = register(*pair.clouds, config.registration)
    classes = [np.asarray(c.fields["true_class"]) for c in pair.clouds]
    unsteady = [np.isin(c, (Semantic.VEGETATION, Semantic.MOBILE)) for c in classes]
    ground = [c == Semantic.GROUND for c in classes]
    placed = place(
        pair.clouds, registration, (ground[0], ground[1]), (unsteady[0], unsteady[1]),
        config.placing, config.lod, pair.surveys,
    )  # fmt: skip
    unfloored = replace(placed.sigma, floor=0.0)
    clouds = placed.before, pair.clouds[1]
    restless = [cKDTree(c.xyz[~s]) for c, s in zip(clouds, pair.still, strict=True)]
    parts = []
    for e in (0, 1):
        found = measure_displacements(clouds[e], clouds[1 - e], config.lod)
        chosen = spread(clouds[e], pair.still[e] & np.isfinite(found.distance))
        place_ = clouds[e].xyz[chosen]
        apart = np.minimum(*[tree.query(place_, distance_upper_bound=2.0)[0] for tree in restless])
        chosen = chosen[apart > 1.5]
        xyz, normals = clouds[e].xyz[chosen], np.asarray(clouds[e].fields["normals"])[chosen]
        sigma = unfloored.at(xyz, normals)
        lod = lod_of(
            found, placed.sigma.at(clouds[e].xyz, np.asarray(clouds[e].fields["normals"])), config.lod
        )
        parts.append(
            Counted(
                np.full(len(chosen), setting), classes[e][chosen].astype(np.int64),
                cKDTree(poses[e] - clouds[e].origin).query(xyz)[0], np.abs(found.distance[chosen]),
                combine(found.variance[chosen], sigma, config.lod.combine),
                lod[chosen].astype(np.float64), sigma,
            )
        )  # fmt: skip
    return joined(parts)


def spread(cloud: PointCloud, keep: NDArray[np.bool_], spacing: float = 2.0) -> NDArray[np.int64]:
    """Choose one point a cell of 2 m and kind (standing, lying), at random with a fixed seed."""
    index = np.random.default_rng(0).permutation(np.flatnonzero(keep))
    lies = np.abs(np.asarray(cloud.fields["normals"])[index, 2]) > 0.7
    cell = np.floor(cloud.xyz[index, :2] / spacing).astype(np.int64)
    _, first = np.unique(np.column_stack([cell, lies]), axis=0, return_index=True)
    return np.asarray(index[first])


def joined(parts: list[Counted]) -> Counted:
    """Concatenate counts."""
    return Counted(
        *(np.concatenate(columns) for columns in zip(*(vars(p).values() for p in parts), strict=True))
    )


def coverage(arguments: argparse.Namespace) -> None:
    """Print the share of unchanged means under LoD95, and draw the curve."""
    parts = []
    for path in arguments.surveys:
        seed = seed_of(path)
        for number, (name, errors) in enumerate(SETTINGS.items()):
            poses = drive(path, "before"), drive(path, "after")
            counted = count_pair(load_pair(path, errors, seed), poses, number, ChangeConfig())
            low, high = counted.shares()
            print(f"seed {seed}, {name}: {low:.3f} without floors, {high:.3f} with, n {len(counted.range)}")
            parts.append(counted)
    show(tables(joined(parts)), arguments.picture)


def cuts(total: Counted) -> Iterator[tuple[str, Counted]]:
    """Cut the counts by map error, class and range."""
    yield "all", total
    for number, name in enumerate(SETTINGS):
        yield f"map error: {name}", total.select(total.setting == number)
    for name, semantic in CLASSES.items():
        yield f"class: {name}", total.select(total.semantic == semantic)
    for low, high in pairwise(RANGES):
        yield f"range: {low:.0f} to {high:.0f} m", total.select((total.range >= low) & (total.range < high))


@dataclass(frozen=True)
class Row:
    """One cut: means, percent under LoD95 without and with floors, medians of sigma_reg and LoD95 [mm]."""

    name: str
    means: int
    bare: float
    floored: float
    sigma: float
    lod: float

    def text(self) -> str:
        """Return the row of the table."""
        return (
            f"| {self.name} | {self.means} | {self.bare:.1f} | {self.floored:.1f} | {self.sigma:.1f} "
            f"| {self.lod:.0f} |"
        )


def tables(total: Counted) -> list[Row]:
    """Reduce the counts to one row a cut."""
    return [
        Row(
            name,
            len(part.range),
            *(100 * share for share in part.shares()),
            1e3 * float(np.median(part.sigma)),
            1e3 * float(np.median(part.floored)),
        )
        for name, part in cuts(total)
        if len(part.range) > 0
    ]


def show(table: list[Row], picture: Path | None) -> None:
    """Print the table, and draw it."""
    print("\n| where | means | without floors, % | with, % | median sigma_reg, mm | median LoD95, mm |")
    print("|---" * 6 + "|")
    for row in table:
        print(row.text())
    if picture is not None:
        draw(table, picture)


def pool(arguments: argparse.Namespace) -> None:
    """Join tables that earlier runs printed, weighting by the means behind every row."""
    found: dict[str, list[list[float]]] = {}
    for path in arguments.surveys:
        for line in path.read_text().splitlines():
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            if len(cells) == 6 and cells[1].isdigit():
                found.setdefault(cells[0], []).append([float(cell) for cell in cells[1:]])
    table = []
    for name, values in found.items():
        array = np.array(values)
        joint = np.average(array[:, 1:], axis=0, weights=array[:, 0])
        table.append(Row(name, int(array[:, 0].sum()), *joint.tolist()))
    show(table, arguments.picture)


def draw(table: list[Row], path: Path) -> None:
    """Draw the shares over range, and by class and map error."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 4.2), sharey=True)
    for axis in axes:
        axis.axhspan(93, 97, color="0.88", zorder=0)
    over = [row for row in table if row.name.startswith("range")]
    labels = [row.name.removeprefix("range: ") for row in over]
    axes[0].plot(labels, [row.bare for row in over], "o-", color="C0", label="without floors")
    axes[0].plot(labels, [row.floored for row in over], "o:", color="C1", label="with floors")
    axes[0].set(xlabel="range to the nearest pose", ylabel="unchanged means under LoD95 [%]", ylim=(80, 100))
    axes[0].legend(loc="lower left")
    others = [row for row in table if row.name.startswith(("class", "map"))]
    place = np.arange(len(others))
    axes[1].plot(place, [row.bare for row in others], "o", color="C0")
    axes[1].plot(place, [row.floored for row in others], "o", color="C1")
    axes[1].set_xticks(place, [r.name.split(": ")[1] for r in others], rotation=25, ha="right", fontsize=8)
    axes[1].set_title("map error, and class", fontsize=10)
    figure.suptitle("Simulated. Grey: 93 to 97 %", fontsize=10)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    plt.close(figure)
    print(f"drawn: {path}")


def squares(pair: Pair, edge: float) -> Iterator[tuple[PointCloud, PointCloud]]:
    """Cut both epochs into squares of an edge [m] that both fill."""
    low = np.maximum(*[c.xyz[:, :2].min(axis=0) for c in pair.clouds])
    high = np.minimum(*[c.xyz[:, :2].max(axis=0) for c in pair.clouds])
    for x in np.arange(low[0], high[0] - edge, edge):
        for y in np.arange(low[1], high[1] - edge, edge):
            inside = [
                ((c.xyz[:, :2] >= (x, y)) & (c.xyz[:, :2] < (x + edge, y + edge))).all(axis=1)
                for c in pair.clouds
            ]
            if min(mask.sum() for mask in inside) > 8000:
                cut = [c.select(mask) for c, mask in zip(pair.clouds, inside, strict=True)]
                yield cut[0], cut[1]


def sigmas(arguments: argparse.Namespace) -> None:
    """Print how errors over stated standard deviations are distributed."""
    config = ChangeConfig().registration
    ratios, failed = [], 0
    for path in arguments.surveys:
        seed = seed_of(path)
        pair = load_pair(path, SETTINGS["none"], seed)
        for before, after in squares(pair, arguments.edge):
            try:
                found = register(before, after, config)
            except RegistrationError as error:
                failed += 1
                print(f"seed {seed}: refused: {error}")
                continue
            # The simulated maps lie where they should: the true transform is the identity.
            turn = Rotation.from_matrix(found.T_local[:3, :3]).as_rotvec()
            error_ = np.concatenate([turn, found.T_local[:3, 3]])
            ratios.append(error_ / found.pose_std)
            print(f"seed {seed}: {1e3 * np.linalg.norm(error_[3:]):.1f} mm, ratios {np.round(ratios[-1], 1)}")
    z = np.array(ratios)
    print(f"\n{len(z)} pairs, {failed} refused; error over stated sigma (unit normal: 1.00, 0.67, 95 %)\n")
    print("| component | RMS | median of absolute | under 1.96, % |")
    print("|---|---|---|---|")
    for name, column in [("rotation", z[:, :3]), ("translation", z[:, 3:]), ("all", z)]:
        size = np.abs(column)
        print(
            f"| {name} | {np.sqrt(np.mean(size**2)):.2f} | {np.median(size):.2f} "
            f"| {100 * np.mean(size < 1.96):.0f} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["coverage", "pool", "sigmas"])
    parser.add_argument(
        "surveys",
        nargs="+",
        type=Path,
        help="outputs of subiaco simulate --maps-only; for pool, printed tables",
    )
    parser.add_argument("--edge", type=float, default=50.0, help="of the squares of sigmas [m]")
    parser.add_argument("--picture", type=Path, help="where to draw the curve of coverage")
    arguments = parser.parse_args()
    {"coverage": coverage, "pool": pool, "sigmas": sigmas}[arguments.what](arguments)


if __name__ == "__main__":
    main()
