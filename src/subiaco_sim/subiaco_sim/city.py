"""A city of blocks: loops around neighbouring blocks drive the street between them, one way each.

Every block is laid out from the seed and its own place alone, so two loops that share a street hold the
same things on it, and a loop needs no more than its block and the neighbours in sight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from shapely.geometry import LineString, box
from shapely.geometry.polygon import orient

from subiaco_geo.frames import Floats
from subiaco_sim.events import let_time_pass, work_the_ground
from subiaco_sim.ground import Line, Road
from subiaco_sim.neighbourhood import lay_out_crowded
from subiaco_sim.scene import GroundItem, Item
from subiaco_sim.scene_config import SceneConfig
from subiaco_sim.suburb import dense_route

CITY_ROW = 5  # loops side by side
BLOCK = (110.0, 84.0)  # from street to street, east and north [m]
_CORNER = 14.0  # radius of the way round a corner [m]
_AROUND = [(0, 0), *((e, n) for e in (-1, 0, 1) for n in (-1, 0, 1) if (e, n) != (0, 0))]


@dataclass(frozen=True)
class Tile:
    """What lies on a block and along its own side of the streets around it; ids are yet to be given."""

    items: list[Item]
    ground: list[GroundItem]
    lines: list[Line]


def city_block() -> Floats:
    """Once around a block, anticlockwise along the crown, corners rounded."""
    half_x, half_y = BLOCK[0] / 2, BLOCK[1] / 2
    rounded = box(-half_x, -half_y, half_x, half_y).buffer(-_CORNER).buffer(_CORNER, quad_segs=64)
    ring = LineString(orient(rounded).exterior.coords)
    start = ring.project(LineString([(0, 0), (0, -2 * half_y)]).intersection(ring))
    count = int(ring.length)
    stations = (start + np.linspace(0, ring.length, count + 1)) % ring.length
    points = np.array([ring.interpolate(s).coords[0] for s in stations])
    points[-1] = points[0]
    return points


def city_road(column: int, row: int, widen: float) -> Road:
    """Return the streets around a block and around its neighbours, crossings and corners included."""
    routes = [block_route(column + e, row + n) for e, n in _AROUND]
    reach = np.arange(-1.5, 1.5, 0.25 / BLOCK[0])
    east, north = ((reach + place) * size for place, size in zip((column, row), BLOCK, strict=True))
    for side in (-0.5, 0.5):
        routes.append(np.column_stack([east, np.full(len(east), (row + side) * BLOCK[1])]))
        routes.append(np.column_stack([np.full(len(north), (column + side) * BLOCK[0]), north]))
    return Road(np.concatenate(routes), widen)


def block_route(column: int, row: int) -> Floats:
    """Return the way round a block of the city, dense (N, 2) [m]."""
    return dense_route(city_block() + np.array([column, row]) * BLOCK)


def lay_out_tile(column: int, row: int, frontage: float, scene: SceneConfig, seed: int) -> Tile:
    """Lay out one block and let time pass on it; the same wherever it is looked at from."""
    rng = np.random.default_rng([seed, 7, 16 + column, 16 + row])
    layout = lay_out_crowded(block_route(column, row), frontage, rng, scene.character, sides=(1,))
    items = let_time_pass(layout, scene.seasons, scene.shares)
    return Tile(items, work_the_ground(layout, 0), layout.lines)


def city_tile(
    loop: int,
    frontage: float,
    scene: SceneConfig,
    seed: int,
    bounds: tuple[float, float, float, float],
) -> Tile:
    """Return what stands within the bounds (west, south, east, north) of a loop, ids given."""
    column, row = loop % CITY_ROW, loop // CITY_ROW
    near = [lay_out_tile(column + e, row + n, frontage, scene, seed) for e, n in _AROUND]

    def inside(x: float, y: float) -> bool:
        west, south, east, north = bounds
        return west + 2 < x < east - 2 and south + 2 < y < north - 2

    items = [
        i for tile in near for i in tile.items if all(inside(s.x, s.y) for s in (i.before, i.after) if s)
    ]
    ground = [g for tile in near for g in tile.ground if inside(g.patch.x, g.patch.y)]
    return Tile(
        [replace(item, object_id=1 + k) for k, item in enumerate(items)],
        [replace(item, object_id=1 + len(items) + k) for k, item in enumerate(ground)],
        [line for tile in near for line in tile.lines if inside(line.x, line.y)],
    )
