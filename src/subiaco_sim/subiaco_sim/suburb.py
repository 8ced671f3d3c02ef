"""Lays out a suburb along a street: lots with houses, gardens, street trees, poles, parked cars."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import CubicSpline
from shapely import affinity
from shapely.geometry import LineString, Polygon
from shapely.geometry import box as shapely_box

from subiaco_geo.frames import Floats
from subiaco_sim.buildings import House, Shed
from subiaco_sim.furniture import Bin, Car, Fence, Pole
from subiaco_sim.ground import ROAD_HALF, Line, Road, Terrain
from subiaco_sim.plants import Hedge, Tree
from subiaco_sim.primitives import Material
from subiaco_sim.scene import BUILDING, MOBILE, OTHER, VEGETATION, Item, Placed, Shape

SETBACK = 13.0  # crown of the road to the front wall [m]


@dataclass(frozen=True)
class Lot:
    """A lot: front middle on the building line, direction of the street, which side."""

    s: float
    side: int
    x: float
    y: float
    yaw: float  # x along the street, -y towards the road
    bend: float = 0.0  # curvature of the street, positive where the lot is on the inside [1/m]


@dataclass
class Layout:
    """Items while the suburb is being laid out."""

    centreline: Floats
    rng: np.random.Generator
    setback: float = SETBACK  # crown of the road to the front wall [m]
    sides: tuple[int, ...] = (1, -1)  # of the centreline that are laid out, 1 is the left
    lines: list[Line] = field(default_factory=list)
    items: list[Item] = field(default_factory=list)
    taken: list[Polygon] = field(default_factory=list)

    def lots(self, frontage: float) -> Iterator[Lot]:
        """Yield the lots of this layout, one every ``frontage`` [m]."""
        return walk_lots(self.centreline, frontage, self.setback, self.sides)

    def add(self, kind: str, semantic: int, placed: Placed, *, area: Polygon | None = None) -> Item:
        """Add an item that stands in both epochs."""
        item = Item(len(self.items) + 1, kind, semantic, placed, placed)
        self.items.append(item)
        if area is not None:
            self.taken.append(area)
        return item

    def free(self, area: Polygon) -> bool:
        """Tell whether nothing stands there yet."""
        return not any(area.intersects(other) for other in self.taken)


def dense_route(waypoints: Floats, spacing: float = 0.25) -> Floats:
    """Smooth waypoints (N, 2) into a dense curve, points evenly spaced [m]."""
    closed = bool(np.allclose(waypoints[0], waypoints[-1]))
    chord = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(waypoints, axis=0), axis=1)))
    spline = CubicSpline(chord, waypoints, bc_type="periodic" if closed else "natural")
    fine = spline(np.linspace(0, chord[-1], int(chord[-1] * 20)))
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1)))
    target = np.arange(0.0, length[-1], spacing)
    return np.stack([np.interp(target, length, fine[:, k]) for k in range(2)], axis=1)


def rectangle(x: float, y: float, yaw: float, length: float, width: float) -> Polygon:
    """Return a turned rectangle as a polygon [m, rad]."""
    shape = shapely_box(-length / 2, -width / 2, length / 2, width / 2)
    return affinity.translate(affinity.rotate(shape, yaw, origin=(0, 0), use_radians=True), x, y)


def from_lot(lot: Lot, along: float, inward: float) -> tuple[float, float]:
    """Return the scene position [m] of a place ``along`` the street and ``inward`` of the front."""
    c, s = np.cos(lot.yaw), np.sin(lot.yaw)
    return float(lot.x + c * along - s * inward), float(lot.y + s * along + c * inward)


def walk_lots(
    centreline: Floats, frontage: float, setback: float = SETBACK, sides: tuple[int, ...] = (1, -1)
) -> Iterator[Lot]:
    """Yield lots beside a dense centreline, one every ``frontage`` [m]; none inside a sharp bend."""
    spacing = float(np.linalg.norm(centreline[1] - centreline[0]))
    step = int(frontage / spacing)
    for k in range(step // 2, len(centreline) - step // 2, step):
        ahead, behind = centreline[min(k + 8, len(centreline) - 1)], centreline[max(k - 8, 0)]
        heading = float(np.arctan2(*(ahead - behind)[::-1]))
        bend = _bend(behind, centreline[k], ahead)
        for side in sides:
            if side * bend * setback >= 1.0:
                continue
            yaw = heading + (0.0 if side > 0 else np.pi)
            normal = np.array([-np.sin(yaw), np.cos(yaw)])
            x, y = centreline[k] + setback * normal
            yield Lot(k * spacing, side, float(x), float(y), yaw, side * bend)


def _bend(behind: Floats, here: Floats, ahead: Floats) -> float:
    """Return the curvature of the circle through three places, positive to the left [1/m]."""
    a, b, c = here - behind, ahead - here, ahead - behind
    return float(2.0 * (a[0] * b[1] - a[1] * b[0]) / np.prod([np.linalg.norm(v) for v in (a, b, c)]))


def random_house(rng: np.random.Generator) -> House:
    """Draw a house."""
    roof = str(rng.choice(["gable", "hip", "flat"], p=[0.4, 0.45, 0.15]))
    walls = [Material.BRICK, Material.BRICK, Material.RENDER, Material.TIMBER]
    return House(
        width=float(rng.uniform(9.0, 11.5)),
        depth=float(rng.uniform(9.0, 13.0)),
        roof=roof,
        storeys=int(rng.choice([1, 1, 1, 2])),
        pitch=float(rng.uniform(0.35, 0.6)),
        veranda=float(rng.choice([0.0, 1.8, 2.2])),
        chimney=bool(rng.random() < 0.4) and roof != "flat",
        wall=walls[rng.integers(4)],
        cover=Material.SHEET_METAL if roof == "flat" or rng.random() < 0.3 else Material.TILE,
    )


def random_tree(rng: np.random.Generator, height: tuple[float, float]) -> Tree:
    """Draw a tree of a height range [m]."""
    total = float(rng.uniform(*height))
    crown = total * float(rng.uniform(0.55, 0.68))
    radius = crown * float(rng.uniform(0.42, 0.55))
    form, leaves = (int(v) for v in rng.integers(0, 2**31, 2))
    return Tree(total, radius, crown, 0.06 + 0.014 * total, form, leaves)


def lay_out(centreline: Floats, frontage: float, rng: np.random.Generator) -> Layout:
    """Lay out one street: houses, then gardens, then the street itself."""
    layout = Layout(centreline, rng)
    road = LineString(centreline).buffer(8.5)
    layout.taken.append(road)
    lots = [lot for lot in walk_lots(centreline, frontage) if _add_house(layout, lot, frontage)]
    for lot in lots:
        _add_garden(layout, lot, frontage)
    _add_street_furniture(layout)
    return layout


def _add_house(layout: Layout, lot: Lot, frontage: float) -> bool:
    house = random_house(layout.rng)
    back = float(layout.rng.uniform(0.0, 1.5))
    plot_x, plot_y = from_lot(lot, 0.0, 8.0)
    plot = rectangle(plot_x, plot_y, lot.yaw, frontage - 0.8, 20.0)
    if not layout.free(plot):
        return False
    x, y = from_lot(lot, 0.4, back + house.depth / 2)
    layout.add("house", BUILDING, Placed(house, x, y, lot.yaw), area=plot)
    return True


def _add_garden(layout: Layout, lot: Lot, frontage: float) -> None:
    rng = layout.rng

    def put(kind: str, semantic: int, shape: Shape, along: float, inward: float, turn: float = 0.0) -> None:
        x, y = from_lot(lot, along, inward)
        layout.add(kind, semantic, Placed(shape, x, y, lot.yaw + turn))

    put("fence", OTHER, Fence(19.0, 1.7), frontage / 2, 9.0, np.pi / 2)
    drawn = rng.random()
    if drawn < 0.3:
        put("hedge", VEGETATION, Hedge(frontage - 5.5, 0.9, 1.3, int(rng.integers(2**31))), -1.5, -5.2)
    elif drawn < 0.6:
        put("wall", OTHER, Fence(frontage - 5.0, 0.8, 0.22, Material.BRICK), -1.5, -5.5)
    if rng.random() < 0.55:
        put("garden tree", VEGETATION, random_tree(rng, (3.5, 6.0)), float(rng.uniform(-4.5, 2.0)), -3.3)
    if rng.random() < 0.5:
        put("back tree", VEGETATION, random_tree(rng, (7.0, 11.0)), float(rng.uniform(-5, 5)), 17.0)
    if rng.random() < 0.35:
        put("car", MOBILE, random_car(rng), 5.2, -2.8, np.pi / 2)
    if rng.random() < 0.3:
        put("shed", BUILDING, Shed(3.2, 2.6), float(rng.choice([-4.5, 4.5])), 15.5)
    if rng.random() < 0.4:
        put("bin", OTHER, Bin(), 3.4, -6.9)


def random_car(rng: np.random.Generator) -> Car:
    """Draw a car."""
    if rng.random() < 0.35:
        return Car(float(rng.uniform(4.6, 5.0)), 1.9, float(rng.uniform(1.75, 2.0)), tall=True)
    return Car(float(rng.uniform(4.0, 4.7)), 1.78, float(rng.uniform(1.42, 1.55)))


def _add_street_furniture(layout: Layout) -> None:
    """Street trees, light poles and cars at the kerb, at their own spacings."""
    rng = layout.rng
    for lot in walk_lots(layout.centreline, 9.5):
        x, y = from_lot(lot, float(rng.uniform(-1.5, 1.5)), ROAD_HALF + 0.85 - SETBACK)
        if rng.random() < 0.45:
            layout.add("street tree", VEGETATION, Placed(random_tree(rng, (5.0, 8.5)), x, y))
    for number, lot in enumerate(walk_lots(layout.centreline, 29.0)):
        if (number // 2 + number) % 2 == 0:
            x, y = from_lot(lot, 6.0, ROAD_HALF + 0.6 - SETBACK)
            layout.add("pole", OTHER, Placed(Pole(), x, y, lot.yaw - np.pi / 2))
    for lot in walk_lots(layout.centreline, 6.6):
        if rng.random() < 0.3:
            x, y = from_lot(lot, 0.0, ROAD_HALF - 1.05 - SETBACK)
            turn = 0.0 if rng.random() < 0.5 else np.pi
            layout.add("car", MOBILE, Placed(random_car(rng), x, y, lot.yaw + turn))


def make_terrain(
    road: Road, margin: float, cell: float, rng: np.random.Generator, steepest: float = 0.02
) -> Terrain:
    """Return sloping land around a street; ``steepest`` to the east, three quarters of it to the north."""
    centreline = road.centreline
    west, south = centreline.min(axis=0) - margin
    east, north = centreline.max(axis=0) + margin
    slope = (
        float(rng.uniform(-steepest, steepest)),
        float(rng.uniform(-0.75 * steepest, 0.75 * steepest)),
    )
    return Terrain(road, (float(west), float(south), float(east), float(north)), slope, cell)
