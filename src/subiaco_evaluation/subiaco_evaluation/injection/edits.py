"""The edits: objects added, removed, moved, grown, cut, and ground raised or lowered, with their truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from subiaco_change.decisions.config import BuildingLimits, PlantLimits
from subiaco_change.segmentation.ground_model import Mask
from subiaco_evaluation.injection.config import InjectionConfig
from subiaco_evaluation.injection.occlusion import Lines, Sight
from subiaco_evaluation.injection.site import Site
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.frames import Floats, Ints

_SAME = 0.4  # so near a point of a thing that is reshaped, it stood already [m]
_COLUMN = 0.5  # columns in which bodies are compared [m]


@dataclass(frozen=True)
class Donor:
    """An object to put: ``xyz`` (N, 3) [m] with its foot at z = 0 and its middle at the origin.

    ``source`` (N,) names the map points it comes from, -1 for another cloud.
    ``facing`` is the direction [rad] in which the drive that saw it lay, NaN
    for an object that is known from all sides.
    """

    kind: str
    semantic: Semantic
    xyz: Floats
    source: Ints
    facing: float = float("nan")


@dataclass(frozen=True)
class Put:
    """Points (N, 3) that stand in the edited map alone, with their object, class and change.

    ``fresh`` (F, 3) are those that stand where nothing stood: they hide what is behind them.
    """

    xyz: Floats
    source: Ints
    object_id: int
    semantic: Semantic
    change: Change
    fresh: Floats


@dataclass
class Edited:
    """A labelled map and what has been done to it so far.

    ``xyz semantic instance`` are those of the map (N, ...), local frame;
    ``plan`` finds them from above; ``lines`` to them, ``blocked`` ones among
    them; ``gone`` and ``hidden``
    (N,) points that the edited map lacks, ``rise`` (N,) [m]; ``object_id
    change`` (N,) the truth of the points of the map.
    """

    xyz: Floats
    semantic: NDArray[np.uint8]
    instance: NDArray[np.int32]
    sight: Sight
    site: Site
    config: InjectionConfig
    random: np.random.Generator
    plan: cKDTree = field(init=False)
    lines: Lines = field(init=False)
    blocked: Mask = field(init=False)
    gone: Mask = field(init=False)
    hidden: Mask = field(init=False)
    rise: Floats = field(init=False)
    object_id: Ints = field(init=False)
    change: NDArray[np.uint8] = field(init=False)
    put: list[Put] = field(default_factory=list)
    rows: list[dict[str, object]] = field(default_factory=list)

    def __post_init__(self) -> None:
        size = len(self.xyz)
        self.plan = cKDTree(self.xyz[:, :2])
        self.lines = self.sight.lines(self.xyz)
        self.blocked = np.zeros(len(self.lines.point), dtype=bool)
        self.gone, self.hidden = np.zeros((2, size), dtype=bool)
        self.rise = np.zeros(size)
        self.object_id = np.zeros(size, dtype=np.int64)
        self.change = np.full(size, Change.UNCHANGED, dtype=np.uint8)

    def claim(self, members: Ints, change: Change) -> int:
        """Give points of the map an object of their own and its truth; return its id."""
        number = 1 + len(self.rows)
        self.object_id[members] = number
        self.change[members] = change
        return number

    def stand(self, put: Put) -> None:
        """Let points stand in the edited map: what they hide is hidden, their footprint is taken."""
        self.put.append(put)
        self.site.occupy(put.xyz[:, :2])
        if len(put.fresh):  # past the others the drive saw what it saw
            self.blocked |= self.sight.blocked(self.lines, self.xyz, put.fresh)
            self.hidden = self.lines.hidden(self.blocked)


def take_away(edited: Edited, members: Ints, kind: str) -> None:
    """Remove an object; what it hid stays unknown."""
    edited.claim(members, Change.REMOVED)
    edited.gone[members] = True
    body = edited.xyz[members]
    _row(edited, kind, Semantic(int(edited.semantic[members[0]])), Change.REMOVED, "removed", body)


def put_object(edited: Edited, donor: Donor, event: str = "inserted") -> bool:
    """Put an object on free ground where the drive sees it; False where it fits nowhere."""
    config, random = edited.config, edited.random
    places = edited.site.places(edited.sight.poses, config.max_range, config.clearance)
    if len(places) == 0:
        return False
    standing = np.concatenate([edited.xyz[~edited.gone & ~edited.hidden], *(p.xyz for p in edited.put)])
    tried = places[random.permutation(len(places))[: config.tries]]
    for place in tried:
        xyz = _turned(donor, place, edited.sight.poses, random) + place
        if not edited.site.fits(xyz[:, :2], config.clearance):
            continue
        seen = edited.sight.seen(xyz, np.concatenate([standing, xyz]))
        if np.count_nonzero(seen) < config.min_points // 2:
            continue
        number = 1 + len(edited.rows)
        edited.stand(Put(xyz[seen], donor.source[seen], number, donor.semantic, Change.ADDED, xyz[seen]))
        _row(edited, donor.kind, donor.semantic, Change.ADDED, event, xyz[seen])
        return True
    return False


def _turned(donor: Donor, place: Floats, poses: Floats, random: np.random.Generator) -> Floats:
    """Turn an object so that the drive sees the side of it that is known."""
    step = poses[np.argmin(np.linalg.norm(poses[:, :2] - place[:2], axis=1)), :2] - place[:2]
    known = not np.isnan(donor.facing)
    turn = np.arctan2(step[1], step[0]) - donor.facing if known else random.uniform(0, 2 * np.pi)
    cosine, sine = np.cos(turn), np.sin(turn)
    return np.asarray(donor.xyz @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]))


def reshape(edited: Edited, members: Ints, kind: str, change: Callable[[Floats], Floats], event: str) -> bool:
    """Replace the points of an object by others about its foot; the truth is measured on its columns.

    False, and nothing is done, where hardly a point would be left: what was seen of it is its top alone.
    """
    semantic = Semantic(int(edited.semantic[members[0]]))
    before = edited.xyz[members]
    foot = np.append(before[:, :2].mean(axis=0), edited.site.ground_below(before[:, :2]))
    if np.isnan(foot[2]):
        foot[2] = before[:, 2].min()
    after = change(before - foot) + foot
    if len(after) < edited.config.min_points // 4:
        return False
    rise, volume, share = compare_columns(before - foot, after - foot)
    rule: BuildingLimits | PlantLimits = getattr(edited.config.decisions, semantic.label)
    label = _decide(rise, share, rule)
    number = edited.claim(members, label)
    edited.gone[members] = True
    distance, nearest = cKDTree(before).query(after)
    source = members[nearest]
    edited.stand(Put(after, source, number, semantic, label, after[distance > _SAME]))
    _row(edited, kind, semantic, label, event, before, delta_h_m=rise, delta_v_m3=volume)
    return True


def grown(xyz: Floats, factor: float, leaf: float) -> Floats:
    """Stretch points (N, 3) upwards about z = 0, without gaps, or press them down (a factor below 1)."""
    copies = int(np.ceil(factor))
    steps = [xyz + np.array([0.0, 0.0, leaf * j / copies]) for j in range(copies)]
    tall = np.concatenate(steps) * np.array([1.0, 1.0, factor])
    return voxel_downsample(PointCloud(tall, np.zeros(3)), leaf).xyz


def grown_plant(xyz: Floats, factor: float, leaf: float) -> Floats:
    """Let a plant (N, 3) on z = 0 grow upwards, and half as much sideways; its old leaves stay."""
    larger = xyz * np.array([0.5 + 0.5 * factor, 0.5 + 0.5 * factor, 1.0])
    both = np.concatenate([xyz, grown(larger, factor, leaf)])
    return voxel_downsample(PointCloud(both, np.zeros(3)), leaf).xyz


def cut_off(xyz: Floats, share: float) -> Floats:
    """Drop the top share of the height of points (N, 3) above z = 0."""
    return xyz[xyz[:, 2] <= (1.0 - share) * np.quantile(xyz[:, 2], 0.98)]


def compare_columns(before: Floats, after: Floats) -> tuple[float, float, float]:
    """Return change of the 95 % height [m], of the column volume [m3], and its share of the volume."""
    first, second = _tops(before), _tops(after)
    volumes = [float(tops.sum()) * _COLUMN**2 for tops in (first, second)]
    rise = float(np.percentile(second, 95) - np.percentile(first, 95))
    return rise, volumes[1] - volumes[0], (volumes[1] - volumes[0]) / max(volumes[0], 1e-9)


def _tops(xyz: Floats) -> Floats:
    columns = np.floor(xyz[:, :2] / _COLUMN).astype(np.int64)
    _, column = np.unique(columns, axis=0, return_inverse=True)
    tops = np.zeros(column.max() + 1)
    np.maximum.at(tops, column.ravel(), np.maximum(xyz[:, 2], 0.0))
    return tops


def _decide(rise: float, share: float, rule: BuildingLimits | PlantLimits) -> Change:
    if rise > rule.height or share > rule.volume:
        return Change.INCREASED
    return Change.DECREASED if rise < -rule.height or share < -rule.volume else Change.UNCHANGED


def raise_ground(
    edited: Edited, centre: Floats, along: float, size: tuple[float, float], rise: float
) -> bool:
    """Raise or lower a rectangle (length, width) [m] of bare ground; False where something stands on it."""
    near = np.array(edited.plan.query_ball_point(centre[:2], np.hypot(*size) / 2), dtype=np.int64)
    offset = edited.xyz[near, :2] - centre[:2]
    cosine, sine = np.cos(along), np.sin(along)
    forward, aside = offset @ [cosine, sine], offset @ [-sine, cosine]
    near = near[(np.abs(forward) < size[0] / 2) & (np.abs(aside) < size[1] / 2)]
    is_ground = edited.semantic[near] == Semantic.GROUND
    members = near[is_ground & ~edited.gone[near] & ~edited.hidden[near]]
    area = size[0] * size[1]
    if (
        not is_ground.all()
        or (edited.object_id[members] > 0).any()
        or len(members) < area / edited.config.leaf
    ):
        return False
    ground = edited.config.ground
    large = area > ground.area and abs(rise) > ground.threshold
    change = (Change.INCREASED if rise > 0 else Change.DECREASED) if large else Change.UNCHANGED
    edited.claim(members, change)
    edited.rise[members] = rise
    edited.site.occupy(edited.xyz[members, :2])  # whatever stood there would float
    body = edited.xyz[members]
    _row(
        edited, "ground patch", Semantic.GROUND, change, "raised" if rise > 0 else "lowered", body,
        delta_h_m=rise, delta_v_m3=rise * area, area_m2=area,
    )  # fmt: skip
    return True


def _row(
    edited: Edited,
    kind: str,
    semantic: Semantic,
    change: Change,
    event: str,
    body: Floats,
    **measured: float,
) -> None:
    """Add a row of ``objects.csv``; places are local until they are written."""
    middle = body.mean(axis=0)
    extent = np.ptp(body, axis=0)
    row: dict[str, object] = {
        "object_id": 1 + len(edited.rows),
        "kind": kind,
        "class": int(semantic),
        "class_name": semantic.label,
        "change": int(change),
        "label": change.label,
        "event": event,
        "x": middle[0],
        "y": middle[1],
        "z": middle[2],
        "size_m": round(float(extent.max()), 3),
        "height_m": round(float(extent[2]), 3),
        "points": len(body),
    }
    edited.rows.append(row | {name: round(value, 3) for name, value in measured.items()})
