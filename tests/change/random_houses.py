"""Randomly drawn houses on a street, surveyed twice by a ray-caster: for properties of the decisions.

A house is a union of boxes under flat or pitched roofs between two neighbours; a survey drives along
the street, its beams are cast exactly, and what they meet becomes the points of one epoch.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import open3d as o3d

from subiaco_change.config import ChangeConfig
from subiaco_change.decisions.object_comparison import compare_objects
from subiaco_change.objects.voxel_objects import OTHERS, EpochView
from subiaco_change.tiling.decision_stages import object_rules, with_evidence
from subiaco_change.visibility_evidence import EvidenceConfig, make_observer
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Change, Semantic
from subiaco_geo.survey_map import SurveyMap
from subiaco_geo.trajectories import Trajectory
from subiaco_geo.voxel_traversal import VisibilityAccumulator

KINDS = ("observed", "trajectory", "shadow", "assumed")
ORIGIN = np.array([-40.0, -20.0, -5.0])
LEAF = 0.25
RANGE = 40.0  # of the sensor [m]
SKY = 30.0  # so far a beam into the sky counts as passed [m]


@dataclass(frozen=True)
class Box:
    """West, south, width, depth, height of the walls, and rise of a pitched roof above them [m]."""

    x: float
    y: float
    width: float
    depth: float
    height: float
    pitch: float = 0.0

    def mesh(self):
        """Triangles of walls and roof; the ridge runs along the longer side."""
        x0, y0, x1, y1, h = self.x, self.y, self.x + self.width, self.y + self.depth, self.height
        low = np.array([(x0, y0, 0), (x1, y0, 0), (x1, y1, 0), (x0, y1, 0)], dtype=float)
        high = low + np.array([0.0, 0.0, h])
        xm, ym = (x0 + x1) / 2, (y0 + y1) / 2
        along_x = self.width >= self.depth
        ends = [(x0, ym), (x1, ym)] if along_x else [(xm, y0), (xm, y1)]
        ridge = np.array([(*end, h + self.pitch) for end in ends])
        faces = [(i, (i + 1) % 4, 4 + (i + 1) % 4) for i in range(4)]
        faces += [(i, 4 + (i + 1) % 4, 4 + i) for i in range(4)]
        a, b = 8, 9
        if along_x:
            faces += [(4, 5, b), (4, b, a), (7, 6, b), (7, b, a), (4, 7, a), (5, 6, b)]
        else:
            faces += [(5, 6, b), (5, b, a), (4, 7, b), (4, b, a), (4, 5, a), (7, 6, b)]
        return np.concatenate([low, high, ridge]), np.array(faces)

    def columns(self, x, y):
        """Tops [m] at places (N,), 0 outside."""
        inside = (x >= self.x) & (x < self.x + self.width) & (y >= self.y) & (y < self.y + self.depth)
        along_x = self.width >= self.depth
        if along_x:
            share = 1 - np.abs(y - (self.y + self.depth / 2)) / (self.depth / 2)
        else:
            share = 1 - np.abs(x - (self.x + self.width / 2)) / (self.width / 2)
        return np.where(inside, self.height + self.pitch * np.clip(share, 0, 1), 0.0)


def volume(boxes, cell=0.1):
    """Volume of a union of boxes, as columns [m3]."""
    x, y = (v.ravel() + cell / 2 for v in np.meshgrid(np.arange(-20, 20, cell), np.arange(2, 35, cell)))
    return float(np.max([box.columns(x, y) for box in boxes], axis=0).sum() * cell**2)


@dataclass(frozen=True)
class Sensor:
    """Beams, columns of a turn [n], their noise [m], and how a drive passes: lane [m] and step [m].

    ``up``: elevation of the highest beam [deg].
    """

    beams: int = 96
    columns: int = 320
    noise: float = 0.02
    lane: float = 0.0
    step: float = 4.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)  # error of the registration [m]
    up: float = 22.5


@dataclass(frozen=True)
class Street:
    """The objects of an epoch: the house (or another object), and neighbours and parked vans around it."""

    house: tuple[Box, ...]
    around: tuple[Box, ...] = ()
    semantic: Semantic = Semantic.BUILDING  # of the house


@dataclass(frozen=True)
class Survey:
    """What an epoch saw: thinned points (N, 3), of what (0 ground, 1 house, 2 around), and evidence."""

    view: EpochView
    map: SurveyMap = field(repr=False)


def _scene(street):
    scene = o3d.t.geometry.RaycastingScene()
    kinds = []
    ground = np.array([(-80, -40, 0), (80, -40, 0), (80, 80, 0), (-80, 80, 0)], dtype=float)
    for kind, (vertices, faces) in [
        (0, (ground, np.array([(0, 1, 2), (0, 2, 3)]))),
        *((1, box.mesh()) for box in street.house),
        *((2, box.mesh()) for box in street.around),
    ]:
        scene.add_triangles(
            o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(faces.astype(np.uint32))
        )
        kinds.append(kind)
    return scene, np.array(kinds)


def survey(street, sensor, seed):
    """Drive past and return the :class:`Survey`."""
    rng = np.random.default_rng(seed)
    scene, kinds = _scene(street)
    eyes = np.arange(-28.0, 28.1, sensor.step) + rng.uniform(-0.5, 0.5) * sensor.step
    azimuth = np.linspace(0.02, np.pi - 0.02, sensor.columns // 2)
    elevation = np.deg2rad(np.linspace(-22.5, sensor.up, sensor.beams))
    az, el = (v.ravel() for v in np.meshgrid(azimuth, elevation))
    way = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], axis=1)
    starts = np.repeat(
        np.column_stack([eyes, np.full(len(eyes), sensor.lane), np.full(len(eyes), 2.1)]), len(way), axis=0
    )
    ways = np.tile(way, (len(eyes), 1))
    hits = scene.cast_rays(o3d.core.Tensor(np.hstack([starts, ways]).astype(np.float32)))
    t = hits["t_hit"].numpy().astype(np.float64)
    normal = hits["primitive_normals"].numpy().astype(np.float64)
    kind = kinds[np.minimum(hits["geometry_ids"].numpy(), len(kinds) - 1).astype(int)]
    returned = t < RANGE
    reach = np.where(returned, t + rng.normal(scale=sensor.noise, size=len(t)), SKY)
    ends = starts + reach[:, None] * ways + np.array(sensor.shift)
    starts = starts + np.array(sensor.shift)
    keep = returned | (ways[:, 2] > 0.05)
    near = (np.abs(starts[:, 0] - ends[:, 0]) < 60) & keep
    beams = VisibilityAccumulator(ORIGIN, 0.5)
    every = np.flatnonzero(near)[::2]
    beams.add(starts[every], ends[every], returned[every])
    facing = np.sign(np.einsum("ij,ij->i", normal, ways))
    normal = -normal * facing[:, None]
    xyz, index = _thinned(ends, np.flatnonzero(returned & (np.abs(ends[:, 0]) < 30)))
    cloud = PointCloud(xyz)
    poses = np.tile(np.eye(4), (len(eyes), 1, 1))
    poses[:, :3, 3] = np.column_stack(
        [eyes, np.full(len(eyes), sensor.lane), np.full(len(eyes), 2.1)]
    ) + np.array(sensor.shift)
    times = (np.arange(len(eyes)) * 10**8 + 10**18).astype(np.int64)
    own = kind[index]
    house = own == 1
    view = EpochView(
        xyz,
        normal[index],
        np.choose(own, [int(Semantic.GROUND), int(street.semantic), int(Semantic.BUILDING)]).astype(np.uint8),
        np.where(house, 0, np.where(own == 0, -1, OTHERS)).astype(np.int32),
        xyz[:, 2].copy(),
        np.full(len(xyz), 0.05),
        np.full(len(xyz), 0.8),
    )
    return Survey(view, SurveyMap(cloud, Trajectory(times, poses), beams.grid()))


def _thinned(ends, index):
    cells = np.floor(ends[index] / LEAF).astype(np.int64)
    _, first, slot = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    count = np.bincount(slot.ravel())
    mean = np.stack([np.bincount(slot.ravel(), v) / count for v in ends[index].T], axis=1)
    return mean, index[first]


def compare(before, after, kind, config=None):
    """Return the decided objects of two surveys of one house, evidence of one kind.

    The rules know of the space what those of the change command know of it.
    """
    config = config or ChangeConfig()
    evidence = EvidenceConfig(source=kind)
    observers = [make_observer(s.map, evidence) for s in (before, after)]
    known = tuple(
        SimpleNamespace(
            empty=o.empty,
            free=o.free_probability,
            above=o.free_above,
            below_view=o.below_view,
            certain=o.certainty,
        )
        for o in observers
    )
    rules = with_evidence(object_rules(config), known, (kind, kind))
    views = [
        replace(s.view, passed=o.passes(s.view.xyz)) for s, o in zip((before, after), observers, strict=True)
    ]
    return compare_objects(*views, observers[0].observed, observers[1].observed, rules)


def labels(changes):
    """Labels of the rows, that of the largest first."""
    return [change.decision.change for change in sorted(changes, key=lambda c: -c.measures.observed_voxels)]


def label_of(changes):
    """What the rows say of the house: the label of the largest, or what came or went beside it."""
    first, *others = labels(changes)
    if first is Change.UNCHANGED and set(others) & {Change.ADDED, Change.REMOVED}:
        return Change.INCREASED if Change.ADDED in others else Change.DECREASED
    return first


#: Label that says the opposite.
OPPOSITE = {
    Change.INCREASED: (Change.DECREASED, Change.REMOVED),
    Change.DECREASED: (Change.INCREASED, Change.ADDED),
}


def draw_street(rng):
    """Draw a house, its neighbours and sometimes a parked van."""
    width, depth = rng.uniform(8, 16), rng.uniform(8, 13)
    height = rng.choice([2.8, 3.2, 5.6, 6.2])
    pitch = rng.choice([0.0, rng.uniform(1.2, 2.6)])
    setback = rng.uniform(7, 12)
    house = Box(-width / 2, setback, width, depth, height, pitch)
    around = []
    for side in (-1, 1):
        gap = rng.uniform(1.5, 8.0)
        w, h = rng.uniform(8, 14), rng.uniform(2.8, 6.0)
        x = -width / 2 - gap - w if side < 0 else width / 2 + gap
        around.append(Box(x, setback + rng.uniform(-2, 2), w, rng.uniform(8, 12), h, rng.choice([0.0, 1.8])))
    around.append(Box(-30.0, setback + 26, 60.0, 1.0, 2.0))  # a wall behind
    return Street((house,), tuple(around))


#: What is built: a storey; or a wing beside the house, in front of it, or behind it and reaching into a gap.
BUILT = ("storey", "side", "front", "corner")


def draw_extension(rng, kinds=BUILT, least=0.15):
    """Draw a street, the same street with its house extended by ``least`` to 60 %, and what was built.

    One of ``kinds``, of which ``roof`` is a roof raised by 0.6 m and more.
    """
    kind = str(rng.choice(kinds))
    for _ in range(500):
        street = draw_street(rng)
        house = street.house[0]
        built = _built(kind, street, rng, least)
        if built is None:
            continue
        grown = (built,) if kind in RISES else (house, built)
        if least <= volume(grown) / volume(street.house) - 1 <= 0.6:
            return street, replace(street, house=grown), kind
    raise AssertionError(f"no {kind} fits")


#: Smallest rise [m] of what is built on top of a house.
RISES = {"storey": 0.9, "roof": 0.6}


def _built(kind, street, rng, least):
    """A storey on the house of a street, or a wing; None where it does not fit."""
    house, whole = street.house[0], volume(street.house)
    share = rng.uniform(least, 0.5)
    if kind in RISES:
        rise = max(share * whole / (house.width * house.depth), RISES[kind])
        return replace(house, height=house.height + rise)
    height = min(house.height, rng.uniform(2.6, 3.4))
    make = {"front": _front, "side": _side, "corner": _corner}[kind]
    return make(street, share * whole / height, height, rng)


def _front(street, area, height, rng):
    house = street.house[0]
    width = rng.uniform(0.3, 0.8) * house.width
    depth = area / width
    if not 2.0 <= depth <= house.y - 3.5:
        return None
    return Box(house.x + rng.uniform(0, house.width - width), house.y - depth, width, depth, height)


def _gap(street, side):
    """Room between the house and its neighbour [m]."""
    house, beside = street.house[0], street.around[0 if side < 0 else 1]
    return house.x - (beside.x + beside.width) if side < 0 else beside.x - (house.x + house.width)


def _side(street, area, height, rng):
    house, side = street.house[0], rng.choice([-1, 1])
    depth = rng.uniform(0.4, 1.0) * house.depth
    width, south = area / depth, house.y + rng.uniform(0, house.depth - depth)
    if not 2.0 <= width <= _gap(street, side) - 0.8:
        return None
    return Box(house.x - width if side < 0 else house.x + house.width, south, width, depth, height)


def _corner(street, area, height, rng):
    house, side = street.house[0], rng.choice([-1, 1])
    out = rng.uniform(1.5, 4.0)
    width = out + rng.uniform(0.0, 0.4) * house.width
    depth = area / width
    if out > _gap(street, side) - 0.8 or not 2.0 <= depth <= 8.0:
        return None
    west = house.x - out if side < 0 else house.x + house.width + out - width
    return Box(west, house.y + house.depth - rng.uniform(0.0, 2.0), width, depth, height)


def seen_share(without, added, survey_without):
    """Share of what was built that the survey without it looked through, by its counted beams."""
    rng = np.random.default_rng(0)
    top = added.height + added.pitch
    place = np.array([added.x, added.y, 0.0]) + rng.random((4000, 3)) * (added.width, added.depth, top)
    stands = np.max([box.columns(place[:, 0], place[:, 1]) for box in without.house], axis=0)
    new = (place[:, 2] < added.columns(place[:, 0], place[:, 1])) & (place[:, 2] > stands)
    hits, passes = survey_without.map.visibility.lookup(place[new])
    return float(((passes > 0) & (hits == 0)).mean())


def seen_extent(added, survey_with):
    """Smaller of the shares of length and width of what was built over which the survey has points."""
    xyz = survey_with.view.xyz[survey_with.view.instance == 0]
    low = np.array([added.x, added.y, 0.3])
    high = low + np.array([added.width, added.depth, added.height + added.pitch])
    inside = xyz[((xyz > low - 0.2) & (xyz < high + 0.2)).all(axis=1), :2]
    if len(inside) < 2:
        return 0.0
    return float((np.ptp(inside, axis=0) / (added.width, added.depth)).min())


def draw_sensor(rng):
    """Draw a sensor and a drive."""
    return Sensor(
        beams=int(rng.choice([48, 96])),
        lane=rng.uniform(-2.0, 2.0),
        step=rng.uniform(3.0, 5.0),
        shift=tuple(rng.normal(scale=0.03, size=3)),
    )


@dataclass(frozen=True)
class Case:
    """A house and what was built onto it, with a survey of either."""

    small: Street
    large: Street
    what: str  # of BUILT, or roof
    surveys: tuple[Survey, Survey] = field(repr=False)


def draw_case(seed, extended=True, kinds=BUILT, least=0.15):
    """Draw a street, an extension and two drives; without extension both drives see the house as it was."""
    rng = np.random.default_rng(seed)
    small, large, what = draw_extension(rng, kinds, least)
    sensors = draw_sensor(rng), draw_sensor(rng)
    second = large if extended else small
    return Case(
        small, large, what, (survey(small, sensors[0], 2 * seed), survey(second, sensors[1], 2 * seed + 1))
    )


def seen_from_street(case):
    """Tell whether one drive saw through half of what was built, and the other met most of its extent.

    Of a storey the walls and the roof are seen wherever those of the house are.
    """
    built = case.large.house[-1]
    return (
        seen_share(case.small, built, case.surveys[0]) >= 0.5 and seen_extent(built, case.surveys[1]) >= 0.7
    )
