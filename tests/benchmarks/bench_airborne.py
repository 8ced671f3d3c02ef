# ruff: noqa: T201
"""Airborne clouds against themselves: shifted, thinned by half, buildings and trees taken out, trees planted.

    python tests/benchmarks/bench_airborne.py $SUBIACO_TEST_DATA
    python tests/benchmarks/bench_airborne.py $SUBIACO_TEST_DATA --kept 0.5     # before thinner than after
    python tests/benchmarks/bench_airborne.py $SUBIACO_TEST_DATA --crowns --spacing 1.0

Both epochs are random halves of one cloud, so that they share no point. *Before* lies 0.7 m off and is turned
by half a degree. From *after* a share of the objects is removed and ground put in their place, as high as the
ground around and as dense as the cloud; copies of trees are put on free ground. Objects are higher than 2 m
over more than 20 m2; roofs are distinguished from trees by the share of their points on local planes. This is
not the code under test. An object that holds more than a fifth of the points of all stays: a wood, or a hill
that the raster takes for one. With ``--crowns`` groups of trees are divided at the tops of the canopy, so
that single crowns are felled out of them; ``--spacing`` thins both halves to a distance between points.
Printed are the error of the registration at its defaults, how many objects are found (half of their points
over 1 m labelled Removed or Added: ground shines through crowns), and every claim that touches none of them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from subiaco_change.config import ChangeConfig
from subiaco_change.pipeline import detect_changes
from subiaco_change.records import ChangeRecord, ChangeResult
from subiaco_geo.clouds import from_world
from subiaco_geo.codes import Change
from subiaco_geo.errors import SubiacoError
from subiaco_geo.frames import Floats, Ints, invert_pose, make_pose, transform_points
from subiaco_geo.maps import load_epoch
from subiaco_geo.survey_map import SurveyMap

CELL = 1.0  # of the raster in which objects are told [m]
WINDOW = 41  # cells over which the lowest is ground
TALL, LEAST = 2.0, 20.0  # least height [m] and area [m2] of an object
FLAT, PLANAR = 0.12, 0.6  # distance from a local plane [m]; share of points so near that makes a roof
STEM = 1.0  # height over the lowest point of an object from which on its points count [m]
EVERY = 4  # one object of so many is removed
LARGEST = 0.2  # share of the points of all objects above which one stays
PLANTED, WIDEST = 8, 400.0  # trees put in, and the largest bounding box of one [m2]
TURN, SHIFT = (0.1, -0.1, 0.5), (0.5, -0.4, 0.2)  # rotation vector [deg] and shift [m] of *before*
CLAIMS = (Change.ADDED, Change.REMOVED, Change.INCREASED, Change.DECREASED)


@dataclass(frozen=True)
class Scene:
    """Points (N, 3) [m], heights above ground (N,), objects (N,) of points, -1 none; which are roofs (K,)."""

    xyz: Floats
    height: Floats
    owner: Ints
    roof: list[bool]


def clouds_of(data: Path) -> Iterator[tuple[str, Floats]]:
    """Yield the airborne clouds that lie in the folder of real recordings."""
    path = data / "autzen" / "autzen_crop_650x300m_rgb.laz"
    if path.exists():
        xyz = load_epoch(path).cloud.world()
        x, y = (xyz[:, k] - xyz[:, k].min() for k in (0, 1))
        for name, west in (("west", 0.0), ("middle", 220.0), ("east", 440.0)):
            yield f"autzen {name}", xyz[(x >= west) & (x < west + 200.0) & (y < 200.0)]
    tiles = sorted((data / "ign_lidarhd").glob("*.laz"))
    if tiles:
        yield "IGN", np.concatenate([load_epoch(tile).cloud.world() for tile in tiles])


def told_apart(xyz: Floats) -> Scene:
    """Tell objects by a raster of heights above the lowest cells around."""
    index = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / CELL).astype(np.int64)
    shape = tuple((index.max(axis=0) + 1).tolist())
    low = np.full(shape, np.inf)
    np.minimum.at(low, tuple(index.T), xyz[:, 2])
    nearest = ndimage.distance_transform_edt(~np.isfinite(low), return_distances=False, return_indices=True)
    filled = low[tuple(nearest)]
    ground = ndimage.gaussian_filter(ndimage.grey_opening(filled, size=(WINDOW, WINDOW)), 3.0)
    height = xyz[:, 2] - ground[tuple(index.T)]
    tall = np.zeros(shape, dtype=bool)
    tall[tuple(index[height > TALL].T)] = True
    labels, count = ndimage.label(ndimage.binary_opening(tall, np.ones((2, 2))))
    labels = np.where(tall & (labels == 0), ndimage.grey_dilation(labels, size=(3, 3)), labels)  # eaves
    owner = labels[tuple(index.T)] - 1
    owner[height < 0.3] = -1
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:] * CELL**2
    owner[np.isin(owner, np.flatnonzero(sizes < LEAST))] = -1
    owner = np.where(owner >= 0, np.unique(owner, return_inverse=True)[1] - int((owner < 0).any()), -1)
    roof = [_planar(xyz[owner == k]) for k in range(int(owner.max()) + 1)]
    return Scene(xyz, height, owner, roof)


def at_crowns(scene: Scene) -> Scene:
    """Divide trees into crowns: from the highest cell of the canopy down, each joins one that it touches."""
    index = np.floor((scene.xyz[:, :2] - scene.xyz[:, :2].min(axis=0)) / CELL).astype(np.int64)
    trees = (scene.owner >= 0) & ~np.array([*scene.roof, True])[scene.owner]
    canopy = np.zeros(tuple((index.max(axis=0) + 1).tolist()))
    np.maximum.at(canopy, tuple(index[trees].T), scene.height[trees])
    smooth = ndimage.gaussian_filter(ndimage.grey_closing(canopy, size=(3, 3)), 1.0)
    cells = np.argwhere(canopy > 0)
    crown, count = np.zeros(np.add(canopy.shape, 2), dtype=np.int64), 0
    for row, column in cells[np.argsort(-smooth[canopy > 0], kind="stable")].tolist():
        near = crown[row : row + 3, column : column + 3]
        count += not near.any()
        crown[row + 1, column + 1] = np.bincount(near[near > 0]).argmax() if near.any() else count
    small = np.bincount(crown.ravel(), minlength=count + 1) * CELL**2 < LEAST
    number = np.where(small, 0, np.cumsum(~small) - 1)[crown[1:-1, 1:-1]][tuple(index.T)]
    owner = np.where(trees, np.where(number > 0, len(scene.roof) + number - 1, -1), scene.owner)
    left, slot = np.unique(np.append(owner, -1), return_inverse=True)
    roof = [k < len(scene.roof) for k in left[1:].tolist()]
    return Scene(scene.xyz, scene.height, slot[:-1] - 1, roof)


def _planar(xyz: Floats) -> bool:
    """Tell whether most points (N, 3) lie on planes through their neighbours."""
    some = xyz[:: max(len(xyz) // 400, 1)]
    near = cKDTree(xyz).query(some, k=min(12, len(xyz)))[1]
    centred = xyz[near] - xyz[near].mean(axis=1, keepdims=True)
    least = np.sqrt(np.linalg.eigvalsh(np.einsum("nki,nkj->nij", centred, centred) / near.shape[1])[:, 0])
    return bool(np.mean(least < FLAT) >= PLANAR)


def planted(scene: Scene, kept: Ints, rng: np.random.Generator) -> list[Floats]:
    """Return trees (n, 3) of one half, put where nothing higher than 0.3 m stands within 2 m of them."""
    half = np.zeros(len(scene.xyz), dtype=bool)
    half[kept] = True
    ground = scene.xyz[np.abs(scene.height) < 0.3]
    flat, tall = cKDTree(ground[:, :2]), cKDTree(scene.xyz[scene.height >= 0.3, :2])
    put: list[Floats] = []
    for number in rng.permutation(len(scene.roof)).tolist():
        points = scene.xyz[half & (scene.owner == number)]
        extent = np.ptp(points[:, :2], axis=0) if len(points) else np.zeros(2)
        if scene.roof[number] or len(points) < 20 or np.prod(extent) > WIDEST or len(put) == PLANTED:
            continue
        centre, radius = np.median(points[:, :2], axis=0), 0.5 * float(np.hypot(*extent)) + 2.0
        for place in ground[rng.integers(0, len(ground), 200)]:
            there = place[:2]
            inside = (
                np.abs(there - np.median(ground[:, :2], axis=0)) < 0.4 * np.ptp(ground[:, :2], axis=0)
            ).all()
            apart = all(np.linalg.norm(there - tree[:, :2].mean(axis=0)) > 2.0 * radius for tree in put)
            if inside and apart and tall.query(there)[0] > radius:
                heights = (ground[flat.query(at)[1], 2] for at in (there, centre))
                put.append(points + np.append(there - centre, next(heights) - next(heights)))
                break
    return put


def emptied(scene: Scene, kept: Ints, removed: Ints, seed: int) -> Floats:
    """Return points (M, 3) of a half without objects, ground put in their place."""
    rng = np.random.default_rng(seed)
    gone = np.isin(scene.owner, removed)
    half = np.zeros(len(scene.xyz), dtype=bool)
    half[kept] = True
    ground = scene.xyz[half & (np.abs(scene.height) < 0.3)]
    tree = cKDTree(ground[:, :2])
    laid = [scene.xyz[half & ~gone]]
    for number in removed.tolist():
        beneath = half & gone & (scene.owner == number)
        xy = scene.xyz[beneath, :2] + rng.uniform(-0.3, 0.3, (int(beneath.sum()), 2))
        distance, near = tree.query(xy, k=12)
        weight = 1.0 / np.maximum(distance, 0.1)
        z = (ground[near, 2] * weight).sum(axis=1) / weight.sum(axis=1)
        laid.append(np.column_stack([xy, z + rng.normal(0.0, 0.03, len(xy))]))
    return np.concatenate(laid)


def _row(r: ChangeRecord) -> str:
    return (
        f"{r.semantic.label} {r.change.label} {r.confidence:.2f} n {r.n_before}/{r.n_after}"
        f" at {r.x:.1f} {r.y:.1f}: {r.reason}"
    )


@dataclass(frozen=True)
class Outcome:
    """A comparison: result, removed objects (roof, points in *before*), planted trees, pose error [m]."""

    result: ChangeResult
    removed: list[tuple[bool, Floats]]
    planted: list[Floats]
    shift: float

    def objects(self) -> list[tuple[bool, Change, Floats, float, list[str]]]:
        """Return of each changed object: roof, change, points, share with that label, rows that touch it."""
        result = self.result
        given = [(roof, Change.REMOVED, xyz, result.before) for roof, xyz in self.removed]
        given += [(False, Change.ADDED, xyz, result.after) for xyz in self.planted]
        found = []
        for roof, change, points, cloud in given:
            xyz = points[points[:, 2] > points[:, 2].min() + STEM]
            label = cloud.fields["change"][cKDTree(cloud.world()).query(xyz)[1]]
            outline = shapely.MultiPoint(xyz[:, :2]).convex_hull
            rows = [_row(r) for r in result.records if r.footprint.intersects(outline)]
            found.append((roof, change, xyz, float(np.mean(label == change)), rows))
        return found

    def area(self) -> float:
        """Return the area that *after* covers [m2]."""
        world = self.result.after.world()
        return float(len(np.unique(np.floor(world[:, :2]).astype(np.int64), axis=0)))

    def line(self, name: str, seconds: float) -> str:
        """Return the row of the table."""
        objects = self.objects()
        kinds = ((True, Change.REMOVED), (False, Change.REMOVED), (False, Change.ADDED))
        shares = [
            [share for roof, change, _, share, _ in objects if (roof, change) == kind] for kind in kinds
        ]
        told = " | ".join(f"{sum(s >= 0.5 for s in some)} of {len(some)}" for some in shares)
        false = self.false_claims()
        counts = [sum(r > c for r in false.values()) for c in (0.0, 0.5, 0.9)]
        rates = [f"{n} ({1000 * n / self.area():.2f})" for n in counts]
        return f"| {name} | {1e3 * self.shift:.0f} | {told} | {' | '.join(rates)} | {seconds:.0f} |"

    def false_claims(self) -> dict[str, float]:
        """Return claims that touch no changed object, in words, with their confidence."""
        changed = [*(xyz for _, xyz in self.removed), *self.planted]
        outlines = [shapely.MultiPoint(xyz[:, :2]).convex_hull.buffer(1.0) for xyz in changed]
        known = shapely.union_all(outlines)
        return {
            _row(r): r.confidence
            for r in self.result.records
            if r.change in CLAIMS and not r.footprint.intersects(known)
        }


def compare(
    xyz: Floats, seed: int, share: float = 1.0, *, crowns: bool = False, spacing: float = 0.0
) -> Outcome:
    """Compare a cloud with itself, objects removed and trees put in; a share of *before* is kept."""
    scene = at_crowns(told_apart(xyz)) if crowns else told_apart(xyz)
    rng = np.random.default_rng(seed)
    sizes = np.bincount(scene.owner[scene.owner >= 0], minlength=len(scene.roof))
    order = [k for k in rng.permutation(len(scene.roof)) if sizes[k] <= LARGEST * sizes.sum()]
    chosen = [k for kind in (True, False) for k in [n for n in order if scene.roof[n] == kind][::EVERY]]
    removed = np.array(chosen, dtype=np.int64)
    first = rng.random(len(xyz)) < 0.5
    second = np.flatnonzero(~first)
    if spacing:
        area = len(np.unique(np.floor(xyz[:, :2]).astype(np.int64), axis=0))
        thin = rng.random(len(xyz)) < 2.0 * area / spacing**2 / len(xyz)
        first, second = first & thin, second[thin[second]]
    centre = np.median(xyz, axis=0)
    turn = Rotation.from_rotvec(np.radians(TURN)).as_matrix()
    truth = make_pose(turn, np.asarray(SHIFT) + centre - turn @ centre)
    first &= rng.random(len(xyz)) < share
    before = transform_points(invert_pose(truth), xyz[first])
    trees = planted(scene, second, rng)
    after = np.concatenate([emptied(scene, second, removed, seed), *trees])
    epochs = (SurveyMap(from_world(points)) for points in (before, after))
    result = detect_changes(*epochs, ChangeConfig())
    given = result.registration
    found = given.T_local.copy()
    found[:3, 3] += given.origin - found[:3, :3] @ given.origin
    shift = float(np.linalg.norm(transform_points(found @ invert_pose(truth), centre[None])[0] - centre))
    own = [(scene.roof[k], xyz[first & (scene.owner == k)]) for k in chosen]
    return Outcome(result, [(roof, points) for roof, points in own if len(points) >= 5], trees, shift)


def main() -> None:
    """Compare every cloud with itself."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("data", type=Path)
    parser.add_argument("--only", nargs="*", default=[], help="words, one of which a cloud's name holds")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kept", type=float, default=1.0, help="share of the points of before that is kept")
    parser.add_argument("--crowns", action="store_true", help="fell single crowns out of groups of trees")
    parser.add_argument("--spacing", type=float, default=0.0, help="thin both to this distance of points [m]")
    parser.add_argument("--rows", action="store_true", help="print every false claim")
    words = parser.parse_args()
    head = "cloud | shift, mm | buildings found | felled trees found | new trees found"
    head += " | false claims (on 1000 m2)"
    table = [f"| {head} | above 0.5 | above 0.9 | CPU s |", "|---|---|---|---|---|---|---|---|---|"]
    for name, xyz in clouds_of(words.data):
        if words.only and not any(word in name for word in words.only):
            continue
        started = time.process_time()
        try:
            outcome = compare(xyz, words.seed, words.kept, crowns=words.crowns, spacing=words.spacing)
        except SubiacoError as error:
            table.append(f"| {name} | refused: {error} | | | | | | | |")
            continue
        table.append(outcome.line(name, time.process_time() - started))
        print(table[-1], flush=True)
        if words.rows:
            print(*(f"missed: {rows}" for *_, share, rows in outcome.objects() if share < 0.5), sep="\n")
            print(*outcome.false_claims(), sep="\n")
    print("\n".join(table))


if __name__ == "__main__":
    main()
