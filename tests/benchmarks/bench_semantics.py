# ruff: noqa: T201
"""Per-class figures of the labels on real and simulated points, beside plain threshold rules; time per step.

    python tests/benchmarks/bench_semantics.py oakland-tune oakland-report
    python tests/benchmarks/bench_semantics.py sim --surveys out/sim1 out/sim2 --epochs before after
    python tests/benchmarks/bench_semantics.py speed --surveys out/sim1

What was used to choose constants ends in ``-tune`` and is never reported as a result: Oakland aj, ak, al;
ISPRS 12, 21, 31; the first IGN tile; simulated seeds from 101 (config/seeds.yaml). Real data:
``../shared/data`` or $SUBIACO_TEST_DATA. With the package ``cloth-simulation-filter`` installed beside,
the same plain rules stand on its ground too.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import gzip
import multiprocessing
import os
import resource
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray
from results import keep, rounded

from subiaco_change.segmentation import classes
from subiaco_change.segmentation.classes import SemanticResult, SemanticsConfig, label_points
from subiaco_change.segmentation.features import EigenFeatureConfig, compute_features
from subiaco_change.segmentation.ground_model import fit_ground
from subiaco_change.segmentation.instances import InstanceConfig, segment
from subiaco_change.segmentation.superpoints import partition
from subiaco_change.visibility_evidence import EvidenceConfig, make_observer
from subiaco_geo.clouds import (
    PointCloud,
    from_world,
    sort_spatially,
    voxel_downsample,
    voxel_indices,
    voxel_keys,
)
from subiaco_geo.codes import Semantic
from subiaco_geo.maps import load_epoch

LEAF = 0.25
UNKNOWN = 255
NAMES = [s.label for s in Semantic]
DATA = Path(os.environ.get("SUBIACO_TEST_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


@dataclass(frozen=True)
class Sample:
    """A cloud with the true class (N,) uint8 of every point, 255 where nobody knows, and its true object."""

    name: str
    cloud: PointCloud
    truth: NDArray[np.uint8]
    objects: NDArray[np.int64] | None = None
    passed: NDArray[np.float64] | None = None


def thin(name: str, cloud: PointCloud, truth: NDArray[np.uint8], objects: NDArray[np.int64] | None) -> Sample:
    """Reduce to the working leaf; a voxel has the class of most of its points."""
    keys, inverse = np.unique(voxel_keys(voxel_indices(cloud.xyz, LEAF)), return_inverse=True)
    votes = np.zeros((len(keys), 6), dtype=np.int32)
    np.add.at(votes, (inverse, np.where(truth == UNKNOWN, 5, truth)), 1)
    winner = votes.argmax(axis=1)
    members = None
    if objects is not None:
        agrees = np.flatnonzero(truth == winner[inverse])
        members = np.full(len(keys), -1, dtype=np.int64)
        members[inverse[agrees]] = objects[agrees]
    return Sample(
        name, voxel_downsample(cloud, LEAF), np.where(winner == 5, UNKNOWN, winner).astype(np.uint8), members
    )


def oakland(*parts: str) -> Sample:
    """Street of Oakland part 3: joined pieces of one drive."""
    files = [DATA / "oakland_mls" / f"oakland_part3_{p}.xyz_label_conf.gz" for p in parts]
    rows = np.concatenate([np.loadtxt(f) for f in files])
    code = rows[:, 3].astype(int)
    truth = np.full(len(rows), UNKNOWN, dtype=np.uint8)
    family = code // 100
    for hundred, semantic in ((11, 4), (12, 0), (13, 2), (14, 1), (15, 3)):
        truth[family == hundred] = semantic
    truth[code == 1301] = 0  # grass
    return thin("oakland " + "+".join(parts), from_world(rows[:, :3]), truth, None)


def ign(tile: str) -> Sample:
    """Airborne tile of the IGN: no walls; unclassified points (cars among them) are left out."""
    import laspy

    las = laspy.read(DATA / "ign_lidarhd" / f"test_data_{tile}_LA93_IGN69.laz")
    code = np.asarray(las.classification)
    truth = np.full(len(code), UNKNOWN, dtype=np.uint8)
    for number, semantic in ((2, 0), (3, 2), (4, 2), (5, 2), (6, 1)):
        truth[code == number] = semantic
    return thin(f"ign {tile}", from_world(las.xyz), truth, None)


def isprs(number: int) -> Sample:
    """Airborne filter sample, all returns, not thinned (a point a square metre); ground or not."""
    everything, ground = (_float_pcd(f"samp{number}-utm{kind}") for kind in ("", "-ground"))
    rows = [a.view([("", a.dtype)] * 3).ravel() for a in (everything, ground)]
    truth = np.where(np.isin(*rows), 0, 4).astype(np.uint8)
    return Sample(f"isprs {number}", from_world(everything.astype(np.float64)), truth)


def _float_pcd(name: str) -> NDArray[np.float32]:
    """Read a PCD of float x y z, which the package refuses: UTM northings in it step by 0.5 m."""
    import open3d

    with tempfile.NamedTemporaryFile(suffix=".pcd") as file:
        file.write(gzip.decompress((DATA / "isprs_filter" / f"{name}.pcd.gz").read_bytes()))
        file.flush()
        cloud = open3d.t.io.read_point_cloud(file.name)
    return np.ascontiguousarray(cloud.point.positions.numpy())


def simulated(path: Path, epoch: str = "before") -> Sample:
    """One epoch of a simulated survey: its fused map with visibility layer.

    The trail of a moving object is labelled mobile, and no instance is expected of it.
    """
    survey = load_epoch(path / epoch)
    fields = survey.cloud.fields
    with (path / "truth" / "objects.csv").open(newline="") as stream:
        standing = [int(row["object_id"]) for row in csv.DictReader(stream)]
    objects = fields["object"].astype(np.int64)
    observer = make_observer(survey, EvidenceConfig())
    return Sample(
        f"simulated {path.name} {epoch}",
        PointCloud(survey.cloud.xyz),
        fields["true_class"].astype(np.uint8),
        np.where(np.isin(objects, standing), objects, -1),
        observer.passes(survey.cloud.world()),
    )


SETS: dict[str, Callable[[], list[Sample]]] = {
    "oakland-tune": lambda: [oakland("aj", "ak", "al")],
    "oakland-report": lambda: [oakland("am", "an", "ao", "ap")],
    "ign-tune": lambda: [ign("77050_627755")],
    "ign-report": lambda: [ign("77050_627760"), ign("77055_627755")],
    "isprs-tune": lambda: [isprs(n) for n in (12, 21, 31)],
    "isprs-report": lambda: [isprs(n) for n in (11, 22, 23, 24)],
}


def threshold_rules(cloud: PointCloud) -> NDArray[np.uint8]:
    """Plain thresholds of the paper's public code: 5 m cells, normals, their variance."""
    order = sort_spatially(cloud.xyz)
    xyz = cloud.xyz[order]
    features = compute_features(xyz, EigenFeatureConfig())
    cell = np.unique(voxel_keys(voxel_indices(xyz * [1, 1, 0], 5.0)), return_inverse=True)[1]
    by_cell = np.lexsort((xyz[:, 2], cell))
    starts = np.searchsorted(cell[by_cell], np.arange(cell.max() + 1))
    rank = starts + (0.05 * np.bincount(cell)).astype(int)
    height = xyz[:, 2] - xyz[by_cell[rank], 2][cell]
    level = np.abs(features.normals[:, 2])
    variance = features.normals[features.neighbours].var(axis=1).sum(axis=1)
    label = np.full(len(xyz), Semantic.OTHER, dtype=np.uint8)
    label[(variance > 0.15) & (height > 0.5)] = Semantic.VEGETATION
    label[(level < 0.25) & (height > 2.0)] = Semantic.BUILDING
    label[(height < 0.3) & (level > 0.85)] = Semantic.GROUND
    back = np.empty_like(label)
    back[order] = label
    return back


def cloth_rules(cloud: PointCloud) -> NDArray[np.uint8] | None:
    """Give ground to a cloth filter, the rest to the plain rules; None where the filter is not installed."""
    try:
        import CSF
    except ImportError:
        return None
    cloth = CSF.CSF()
    cloth.params.bSloopSmooth = False
    cloth.params.cloth_resolution = 0.5
    cloth.setPointCloud(cloud.xyz)
    ground, rest = CSF.VecInt(), CSF.VecInt()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):  # it writes cloth_nodes.txt
        cloth.do_filtering(ground, rest, False)
    label = threshold_rules(cloud)
    label[label == Semantic.GROUND] = Semantic.OTHER
    label[np.array(ground, dtype=np.int64)] = Semantic.GROUND
    return label


def confusion(truth: NDArray[np.uint8], found: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Count (5, 5) points, rows true, columns found."""
    known = truth != UNKNOWN
    pair = truth[known].astype(np.int64) * 5 + found[known]
    return np.bincount(pair, minlength=25).reshape(5, 5)


def ious(matrix: NDArray[np.int64]) -> NDArray[np.float64]:
    """Intersection over union (5,) in percent; NaN for a class that is neither there nor found."""
    union = matrix.sum(axis=0) + matrix.sum(axis=1) - np.diag(matrix)
    return 100 * np.where(matrix.sum(axis=1) > 0, np.diag(matrix) / np.maximum(union, 1), np.nan)


def panoptic(sample: Sample, semantic: NDArray[np.uint8], instance: NDArray[np.int32]) -> NDArray[np.float64]:
    """Matches of building, vegetation, mobile (3, 2): the sum of IoU > 0.5, and TP + FP/2 + FN/2."""
    values = np.zeros((3, 2))
    if sample.objects is None:
        return values
    for kind in (1, 2, 3):
        mine = np.where((semantic == kind) & (instance >= 0), instance, -1)
        yours = np.where((sample.truth == kind), sample.objects, -1)
        ids, a = np.unique(mine, return_inverse=True)
        names, b = np.unique(yours, return_inverse=True)
        table = np.zeros((len(ids), len(names)), dtype=np.int64)
        np.add.at(table, (a, b), 1)
        union = table.sum(axis=1)[:, None] + table.sum(axis=0) - table
        iou = (table / union)[ids >= 0][:, names >= 0]
        size = table.sum(axis=0)[names >= 0]
        seen = (size >= 40) | (iou > 0.5).any(axis=0)  # a few stray returns are no object to be found
        values[kind - 1] = iou[iou > 0.5].sum(), 0.5 * (iou.shape[0] + seen.sum())
    return values


def qualities(matches: NDArray[np.float64]) -> str:
    """Panoptic quality in percent of building, vegetation, mobile."""
    return ", ".join(f"{100 * a / b:.1f}" if b else "–" for a, b in matches)


def row(values: NDArray[np.float64]) -> str:
    return " | ".join("–" if np.isnan(v) else f"{v:.1f}" for v in values)


def report(samples: Iterable[Sample], pictures: Path | None) -> None:
    """Print one table row a sample and method, then all points pooled and the confusion of the labels."""
    print(f"\n| sample | points | method | {' | '.join(NAMES)} | CPU s | PQ building, plant, vehicle |")
    print("|---" * 10 + "|")
    total, matches = np.zeros((5, 5), dtype=np.int64), np.zeros((3, 2))
    for sample in samples:
        peers = {"plain rules": threshold_rules(sample.cloud), "CSF + plain": cloth_rules(sample.cloud)}
        start = time.process_time()
        result = label_points(sample.cloud, SemanticsConfig(), sample.passed)
        semantic, instance = segment(sample.cloud, result, InstanceConfig())
        spent = time.process_time() - start
        matrix = confusion(sample.truth, semantic)
        total += matrix
        found_objects = panoptic(sample, semantic, instance)
        matches += found_objects
        head = f"| {sample.name} | {len(sample.cloud)} |"
        print(f"{head} ours | {row(ious(matrix))} | {spent:.1f} | {qualities(found_objects)} |")
        for name, found in peers.items():
            if found is None:
                continue
            print(f"{head} {name} | {row(ious(confusion(sample.truth, found)))} | | |")
            if sample.name.startswith("isprs"):
                wrong = (found == Semantic.GROUND) != (sample.truth == Semantic.GROUND)
                print(f"  {sample.name}: total error of {name} {100 * wrong.mean():.1f} %")
        if sample.name.startswith("isprs"):
            print(f"  {sample.name}: total error {filter_errors(sample, result)}")
        if pictures is not None:
            draw(sample, semantic, pictures / f"{sample.name.replace(' ', '_')}.png")
    print(f"| all pooled | {total.sum()} | ours | {row(ious(total))} | | {qualities(matches)} |")
    print("confusion, rows true:\n" + str(total))


def filter_errors(sample: Sample, result: SemanticResult) -> str:
    """Ground or not: by the 0.5 m band around the model that filter comparisons use, and by our labels."""
    is_ground = sample.truth == Semantic.GROUND
    slope = result.ground.normal(sample.cloud.xyz[:, :2])[:, 2]
    band = np.abs(result.height_above_ground) * slope < 0.5
    label = result.semantic == Semantic.GROUND
    text = []
    for name, found in (("0.5 m band", band), ("labels", label)):
        lost, won = (is_ground & ~found).mean(), (~is_ground & found).mean()
        text.append(
            f"{name} {100 * (lost + won):.1f} % (ground lost {100 * lost:.1f}, gained {100 * won:.1f})"
        )
    return "; ".join(text)


COLOURS = np.array(
    [[150, 130, 110], [220, 60, 50], [50, 150, 60], [40, 80, 220], [240, 190, 30], [200, 200, 200]]
)


def draw(sample: Sample, semantic: NDArray[np.uint8], path: Path) -> None:
    """Truth, labels, and wrong points from above (highest point of each pixel)."""
    import matplotlib.pyplot as plt

    truth = np.where(sample.truth == UNKNOWN, 5, sample.truth)
    wrong = (sample.truth != UNKNOWN) & (sample.truth != semantic)
    figure, axes = plt.subplots(1, 3, figsize=(21, 8), sharex=True, sharey=True)
    order = np.argsort(sample.cloud.xyz[:, 2])
    x, y = sample.cloud.xyz[order, :2].T
    shown = (
        COLOURS[truth],
        COLOURS[semantic],
        np.where(wrong[:, None], COLOURS[semantic], 235),
    )
    for axis, colour, title in zip(
        axes, shown, ("truth", "labels", "wrong, coloured as labelled"), strict=True
    ):
        axis.scatter(x, y, s=0.6, c=colour[order] / 255, linewidths=0)
        axis.set(title=f"{sample.name}: {title}", aspect="equal")
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=70)
    plt.close(figure)


def draw_steps(sample: Sample, path: Path, half: float = 30.0) -> None:
    """Draw every step from above on one block of 60 m."""
    import matplotlib.pyplot as plt

    result = label_points(sample.cloud, SemanticsConfig(), sample.passed)
    _, instance = segment(sample.cloud, result, InstanceConfig())
    moved = np.flatnonzero(result.moving)
    middle = (
        sample.cloud.xyz[moved[len(moved) // 2], :2] if len(moved) else np.median(sample.cloud.xyz[:, :2], 0)
    )
    block = np.flatnonzero((np.abs(sample.cloud.xyz[:, :2] - middle) < half).all(axis=1))
    block = block[np.argsort(sample.cloud.xyz[block, 2])]
    x, y = sample.cloud.xyz[block, :2].T
    shape = compute_features(sample.cloud.xyz[block], EigenFeatureConfig())
    mixed = np.random.default_rng(0).permutation(int(max(result.superpoint.max(), instance.max())) + 1)
    shown = {
        "1 height above ground": np.clip(result.height_above_ground[block], 0, 8),
        "2 roughness": np.clip(shape.roughness, 0, 0.15),
        "3 superpoints": mixed[result.superpoint[block]] % 20,
        "4 trails (passes a return)": result.moving[block],
        "5 classes": COLOURS[result.semantic[block]] / 255,
        "6 objects": np.where(instance[block] >= 0, 1 + mixed[instance[block]] % 19, 0),
    }
    figure, axes = plt.subplots(2, 3, figsize=(18, 12), sharex=True, sharey=True)
    for axis, (title, values) in zip(axes.ravel(), shown.items(), strict=True):
        colours = {"cmap": "tab20" if title[0] in "36" else "viridis"} if np.ndim(values) == 1 else {}
        axis.scatter(x, y, s=0.8, c=values, linewidths=0, **colours)
        axis.set(title=title, aspect="equal")
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=60)
    plt.close(figure)


@dataclass(frozen=True)
class Cost:
    """CPU seconds of every step and the peak memory [MB] above that of the cloud alone."""

    points: int
    seconds: dict[str, float]
    megabytes: float


def speed(samples: list[Sample], millions: list[float], path: Path | None) -> None:
    """CPU seconds of every step and peak memory over streets side by side, with their exponents in points.

    Every size has a process of its own, so that it has a peak of its own.
    """
    context = multiprocessing.get_context("spawn")
    clouds = [sample.cloud.xyz for sample in samples]
    costs = []
    for million in millions:
        with ProcessPoolExecutor(1, mp_context=context) as executor:
            costs.append(executor.submit(cost, clouds, round(million * 1e6)).result())
    table = [{"points": c.points, **c.seconds, "peak MB": c.megabytes} for c in costs]
    print(f"\n| {' | '.join(table[0])} |\n" + "|---" * len(table[0]) + "|")
    for line in table:
        print(f"| {' | '.join(f'{value:.4g}' for value in line.values())} |")
    logs = {key: np.log([max(line[key], 1e-3) for line in table]) for key in table[0]}
    powers = (
        {k: float(np.polyfit(logs["points"], v, 1)[0]) for k, v in logs.items()} if len(table) > 1 else {}
    )
    remarks = [f"{key} grows with points to the power {power:.2f}" for key, power in powers.items()][1:]
    print("\n".join(remarks))
    keep(path, [{key: rounded(value) for key, value in line.items()} for line in table], {}, remarks)


def cost(clouds: list[NDArray[np.float64]], count: int) -> Cost:
    """Label and part so many points of streets side by side, compiled code loaded beforehand."""
    cloud = side_by_side(clouds, count)
    small = PointCloud(cloud.xyz[:20_000])
    segment(small, label_points(small, SemanticsConfig()), InstanceConfig())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds: dict[str, float] = {}
    with timed(classes, STEPS, seconds):
        start = time.process_time()
        result = label_points(cloud, SemanticsConfig())
        labelled = time.process_time()
    segment(cloud, result, InstanceConfig())
    seconds["objects"] = time.process_time() - labelled
    seconds["all"] = time.process_time() - start
    return Cost(count, seconds, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e3)


def energies(sample: Sample, count: int = 60_000) -> None:
    """Energy and time of the superpoints of part of a map, beside one region and single points."""
    xyz = sample.cloud.xyz[sort_spatially(sample.cloud.xyz)[:count]]
    config = SemanticsConfig()
    features = compute_features(xyz, config.features)
    height = xyz[:, 2] - fit_ground(xyz, config.ground).height(xyz[:, :2])
    values = classes._superpoint_features(features, height, config)
    partition(values[:1000], features.neighbours[:1000] % 1000, config.superpoints)  # compiled
    start = time.process_time()
    found = partition(values, features.neighbours, config.superpoints)
    spent = time.process_time() - start
    print(
        f"{len(xyz)} points: {int(found.labels.max()) + 1} superpoints, energy {found.energy:.0f}, "
        f"{spent:.2f} CPU s; one region {found.energy_one:.0f}, single points {found.energy_single:.0f}"
    )


STEPS = (
    "fit_ground",
    "compute_features",
    "partition",
    "_find_ground",
    "moving_points",
    "building_planes",
    "free_boxes",
    "thick_walls",
    "within_roofs",
    "attach_parts",
    "_split_rest",
    "release_false_vehicles",
    "_scores",
)


@contextlib.contextmanager
def timed(module: ModuleType, names: tuple[str, ...], seconds: dict[str, float]) -> Iterator[None]:
    """Add up the CPU seconds of functions of a module while the context lasts."""
    plain = {name: getattr(module, name) for name in names}

    def wrap(name: str) -> Callable[..., object]:
        def call(*arguments: object) -> object:
            start = time.process_time()
            try:
                return plain[name](*arguments)
            finally:
                key = name.strip("_")
                seconds[key] = seconds.get(key, 0.0) + time.process_time() - start

        return call

    for name in names:
        setattr(module, name, wrap(name))
    try:
        yield
    finally:
        for name, function in plain.items():
            setattr(module, name, function)


def side_by_side(clouds: list[NDArray[np.float64]], count: int) -> PointCloud:
    """Streets in turn, in rows of four, cut off at the number of points."""
    step = np.max([np.ptp(xyz, axis=0) for xyz in clouds], axis=0) * [1.05, 1.05, 0]
    parts: list[NDArray[np.float64]] = []
    while sum(map(len, parts)) < count:
        xyz, place = clouds[len(parts) % len(clouds)], len(parts)
        parts.append(xyz - xyz.min(axis=0) + step * [place % 4, place // 4, 0])
    return PointCloud(np.concatenate(parts)[:count])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sets", nargs="+", choices=[*SETS, "sim", "speed", "energy", "steps"])
    parser.add_argument(
        "--surveys", nargs="*", type=Path, default=[], help="outputs of subiaco simulate --maps-only"
    )
    parser.add_argument("--epochs", nargs="*", default=["before", "after"], help="epochs of the surveys")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of truth, labels and wrong points")
    parser.add_argument(
        "--millions", nargs="*", type=float, default=[0.25, 0.5, 1.0, 2.0, 4.0, 8.0], help="sizes for speed"
    )
    parser.add_argument("--json", type=Path, help="leave the rows there, for bench.py")
    arguments = parser.parse_args()
    for name in arguments.sets:
        if name == "speed":
            streets = [simulated(p, e) for p in arguments.surveys for e in arguments.epochs]
            speed(streets, arguments.millions, arguments.json)
            continue
        if name == "energy":
            energies(simulated(arguments.surveys[0]))
            continue
        if name == "steps":
            draw_steps(simulated(arguments.surveys[0]), arguments.pictures / "semantics_steps.png")
            continue
        samples: Iterable[Sample]
        if name == "sim":
            samples = (simulated(p, e) for p in arguments.surveys for e in arguments.epochs)
        else:
            samples = SETS[name]()
        report(samples, arguments.pictures)


if __name__ == "__main__":
    main()
