"""A real street twice, with real objects put into one of the two: what changed is known exactly."""

from __future__ import annotations

import tarfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from plain_fusion import add_scan, fused_cloud
from real_data import KittiScans
from scipy import ndimage
from scipy.spatial import cKDTree
from shapely.geometry.base import BaseGeometry

from subiaco_change.records import ChangeRecord, ChangeResult
from subiaco_geo.clouds import PointCloud, from_world, voxel_downsample
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats, transform_points
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import Trajectory
from subiaco_mapping.fusion.config import FusionConfig
from subiaco_mapping.fusion.outliers import beam_spacing
from subiaco_mapping.fusion.voxel_fusion import VoxelAccumulator, within

KINDS = ("building", "car", "fence", "pole", "tree")  # the hundreds of the file names
LEAF = 0.25
CELL = 0.5
TOP_DEG = 2.0  # highest beam of the HDL-64
REACH = 50.0
REPORTED = (Change.ADDED, Change.REMOVED, Change.INCREASED, Change.DECREASED)


@dataclass(frozen=True)
class RealObject:
    """A cut-out object: xyz (N, 3) [m] about the middle of its footprint, its lowest points at z = 0."""

    name: str
    kind: str
    xyz: Floats

    @property
    def height(self) -> float:
        """Height [m]."""
        return float(self.xyz[:, 2].max())

    @property
    def radius(self) -> float:
        """Radius of its footprint [m]."""
        return float(np.linalg.norm(self.xyz[:, :2], axis=1).max())


def read_objects(archive: Path, names: Sequence[str]) -> list[RealObject]:
    """Read objects of DALES by their numbers, in that order, at the leaf of the map."""
    with tarfile.open(archive) as tar:
        streams = {Path(m.name).stem: tar.extractfile(m) for m in tar if Path(m.name).stem in names}
        texts = {name: stream.read().decode() for name, stream in streams.items() if stream is not None}
    return [_cut_out(name, np.array(texts[name].split(), dtype=np.float64).reshape(-1, 3)) for name in names]


def _cut_out(name: str, xyz: Floats) -> RealObject:
    middle = 0.5 * (xyz.min(axis=0) + xyz.max(axis=0))
    middle[2] = np.quantile(xyz[:, 2], 0.01)
    thin = voxel_downsample(PointCloud(xyz - middle, np.zeros(3)), LEAF).xyz
    return RealObject(name, KINDS[int(name) // 100], thin)


#: Reads the points (N, 3) [m] and intensities (N,) of a scan in the frame of the scanner.
Reader = Callable[[int], tuple[Floats, NDArray[np.float32]]]


def fuse(scans: KittiScans, poses: Floats, which: Sequence[int], read: Reader | None = None) -> PointCloud:
    """Fuse some of the scans at given poses (77, 4, 4) into a map of its own; ``read`` may change them."""
    config = FusionConfig()
    accumulator = VoxelAccumulator(config.leaf)
    for i in which:
        xyz, intensity = (read or scans.scan)(i)
        reach = np.linalg.norm(xyz, axis=1)
        keep = within(xyz, config.max_range) & (reach > 1.0)
        add_scan(accumulator, xyz[keep].astype(np.float64), intensity[keep], poses[i])
    spacing = beam_spacing(scans.scan(which[0])[0].astype(np.float64), config.outlier_neighbours)
    cloud = fused_cloud(accumulator, config, 1, lambda p: p, lambda _, d: d, None, spacing)
    return replace(cloud, fields={"intensity": cloud.fields["intensity"]})


@dataclass(frozen=True)
class Ground:
    """Heights of the ground (rows, columns) from a corner [m], and where nothing stands on it."""

    corner: Floats
    height: Floats
    free: NDArray[np.bool_]

    def place(self, xy: Floats) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return rows and columns (N, 2) of points, and which are inside."""
        index = np.floor((xy - self.corner) / CELL).astype(np.int64)[:, ::-1]
        inside = ((index >= 0) & (index < np.array(self.height.shape))).all(axis=1)
        return np.clip(index, 0, np.array(self.height.shape) - 1), inside


def find_ground(xyz: Floats) -> Ground:
    """Find cells with level ground and nothing above it."""
    corner = xyz[:, :2].min(axis=0)
    index = np.floor((xyz[:, :2] - corner) / CELL).astype(np.int64)
    shape = tuple((index.max(axis=0) + 1).tolist())[::-1]
    low, high = np.full(shape, np.inf), np.full(shape, -np.inf)
    np.minimum.at(low, (index[:, 1], index[:, 0]), xyz[:, 2])
    np.maximum.at(high, (index[:, 1], index[:, 0]), xyz[:, 2])
    seen = np.isfinite(low)
    level = ndimage.minimum_filter(np.where(seen, low, np.inf), size=9)
    stands = seen & (high - level > 0.35)
    return Ground(corner, np.where(seen, low, level), seen & ~stands & np.isfinite(level))


@dataclass(frozen=True)
class Placed:
    """An object in the street: xyz (N, 3) in the map, what the scanner could have seen of it."""

    name: str
    kind: str
    xyz: Floats

    @property
    def outline(self) -> BaseGeometry:
        """Convex footprint."""
        return shapely.MultiPoint(self.xyz[:, :2]).convex_hull.buffer(0.2)

    @property
    def size(self) -> tuple[float, float, float]:
        """Length, width [m] of the axis-parallel box and height."""
        extent = np.ptp(self.xyz, axis=0)
        return float(extent[:2].max()), float(extent[:2].min()), float(extent[2])


def below_top_beam(xyz: Floats, sensors: Floats) -> NDArray[np.bool_]:
    """Tell which points (N, 3) some pose (M, 3) within reach saw below the scanner's highest beam."""
    step = xyz[:, None, :] - sensors[None, :, :]
    flat = np.linalg.norm(step[..., :2], axis=2)
    return np.asarray(((step[..., 2] < np.tan(np.radians(TOP_DEG)) * flat) & (flat < REACH)).any(axis=1))


@dataclass
class _Site:
    """Where objects may still stand: distance of every cell from objects that are there already [m]."""

    ground: Ground
    blocked: NDArray[np.bool_]
    clearance: Floats

    def fits(self, xyz: Floats) -> bool:
        """Tell whether points (N, 3) stand clear of everything, mostly on known ground."""
        index, inside = self.ground.place(xyz[:, :2])
        row, column = index.T
        return bool(
            inside.all()
            and self.clearance[row, column].min() > 0.9
            and self.ground.free[row, column].mean() > 0.6
        )

    def occupy(self, xyz: Floats) -> None:
        """Let an object stand."""
        index, _ = self.ground.place(xyz[:, :2])
        self.blocked[index[:, 0], index[:, 1]] = True
        self.clearance = CELL * ndimage.distance_transform_edt(~self.blocked)


def place_objects(objects: Sequence[RealObject], ground: Ground, sensors: Floats, seed: int) -> list[Placed]:
    """Put objects, in their order, on free ground 5 to 40 m from the drive; who fits nowhere is left out."""
    random = np.random.default_rng(seed)
    places = ground.corner + (np.argwhere(ground.free)[:, ::-1] + 0.5) * CELL
    distance = cKDTree(sensors[:, :2]).query(places)[0]
    places = places[(distance > 5.0) & (distance < 40.0)]
    blocked = np.isfinite(ground.height) & ~ground.free
    site = _Site(ground, blocked, CELL * ndimage.distance_transform_edt(~blocked))
    placed: list[Placed] = []
    for item in objects:
        found = _try_places(item, site, random.permutation(places)[:400], sensors)
        if found is not None:
            placed.append(found)
            site.occupy(found.xyz)
    return placed


def _try_places(item: RealObject, site: _Site, places: Floats, sensors: Floats) -> Placed | None:
    """Return the object at the first place where it fits, and where its points could be seen."""
    for place in places:
        index, _ = site.ground.place(place[None])
        xyz = item.xyz + np.append(place, site.ground.height[index[0, 0], index[0, 1]])
        if not site.fits(xyz):
            continue
        visible = xyz[below_top_beam(xyz, sensors)]
        if len(visible) >= 30 and len(visible) >= 0.25 * len(xyz):
            return Placed(item.name, item.kind, visible)
    return None


def moved(survey: SurveyMap, T_new_old: Floats) -> SurveyMap:
    """Give a map another local frame, as another drive would have."""
    assert survey.trajectory is not None
    cloud = from_world(transform_points(T_new_old, survey.cloud.world()), None, **survey.cloud.fields)
    poses = T_new_old @ survey.trajectory.poses
    return replace(survey, cloud=cloud, trajectory=Trajectory(survey.trajectory.times_ns, poses))


@dataclass(frozen=True)
class Found:
    """What became of one object: share of its points with the right label, its common label and class."""

    placed: Placed
    share: float
    label: str
    semantic: str

    @property
    def hit(self) -> bool:
        """Whether at least half of its points have the right label."""
        return self.share >= 0.5


def look_up(
    result: ChangeResult, placed: Sequence[Placed], change: Change, T_after_map: Floats
) -> list[Found]:
    """Read the labels at the points of the objects, in the epoch that has them."""
    cloud = result.after if change is Change.ADDED else result.before
    tree = cKDTree(cloud.world())
    found = []
    for item in placed:
        near = tree.query(transform_points(T_after_map, item.xyz))[1]
        labels = cloud.fields["change"][near]
        label = Change(int(np.bincount(labels).argmax())).label
        semantic = Semantic(int(np.bincount(cloud.fields["semantic"][near]).argmax())).label
        found.append(Found(item, float((labels == change).mean()), label, semantic))
    return found


def false_alarms(
    result: ChangeResult, placed: Sequence[Placed], T_after_map: Floats
) -> Iterator[ChangeRecord]:
    """Yield the rows that report a change where nothing was put."""
    outlines = [
        shapely.MultiPoint(transform_points(T_after_map, p.xyz)[:, :2]).convex_hull.buffer(1.0)
        for p in placed
    ]
    known = shapely.union_all(outlines)
    for record in result.records:
        if record.change in REPORTED and not record.footprint.intersects(known):
            yield record


def common_area(before: PointCloud, after: PointCloud) -> float:
    """Area [m2] of the 1 m columns that both epochs, in one frame, have points in."""
    columns = [
        {tuple(c) for c in np.unique(np.floor(cloud.world()[:, :2]).astype(np.int64), axis=0).tolist()}
        for cloud in (before, after)
    ]
    return float(len(columns[0] & columns[1]))
