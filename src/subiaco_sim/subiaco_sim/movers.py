"""What moves while the vehicle drives by: cars, trucks, cyclists, people on foot. They leave trails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from subiaco_geo.frames import Floats
from subiaco_sim.furniture import Person, Truck
from subiaco_sim.ground import Terrain
from subiaco_sim.scene import Castable, CompiledScene, Hits, Moving, Shape, compile_meshes
from subiaco_sim.scene_config import LANE_WIDTH, Character
from subiaco_sim.suburb import random_car

_NEAR = 70.0  # movers farther from the sensor are not cast [m]


@dataclass(frozen=True)
class Mover:
    """Something that travels along the route.

    ``station`` at time zero and ``speed`` run along the centreline (negative
    speed: against it), ``offset`` is positive to the left [m, m/s].
    """

    object_id: int
    shape: Shape
    epoch: str
    station: float
    speed: float
    offset: float
    radius: float

    def at(self, route: Floats, seconds: float) -> tuple[float, float, float]:
        """Return x, y [m] and heading [rad]; it goes round when it comes to the end."""
        spacing = float(np.linalg.norm(route[1] - route[0]))
        k = int((self.station + self.speed * seconds) / spacing) % (len(route) - 2)
        step = route[k + 1] - route[k]
        heading = float(np.arctan2(step[1], step[0]))
        x, y = route[k] + self.offset * np.array([-np.sin(heading), np.cos(heading)])
        return float(x), float(y), heading if self.speed >= 0 else heading + np.pi


@dataclass(frozen=True)
class MovingScene:
    """A standing scene and what moves in it, frozen at one time."""

    standing: CompiledScene
    moving: CompiledScene
    centres: Floats  # (M, 3)
    radii: Floats  # (M,)

    def cast(self, origins: Floats, directions: Floats) -> Hits:
        """Cast rays (N, 3) and return what they met first."""
        hits = self.standing.cast(origins, directions)
        near = np.flatnonzero(self._might_meet(origins, directions))
        if len(near) == 0:
            return hits
        met = self.moving.cast(origins[near], directions[near])
        ahead = met.distance < hits.distance[near]
        won = near[ahead]
        for name in ("distance", "object_id", "material", "cosine"):
            getattr(hits, name)[won] = getattr(met, name)[ahead]
        return hits

    def _might_meet(self, origins: Floats, directions: Floats) -> NDArray[np.bool_]:
        """Tell which rays may pass through the ball about a mover; all begin near one another."""
        eye = origins.mean(axis=0)
        slack = np.linalg.norm(origins - eye, axis=1).max(initial=0.0) + 0.01
        ahead = directions.astype(np.float32)
        found = np.zeros(len(origins), dtype=np.bool_)
        for towards, reach in zip((self.centres - eye).astype(np.float32), self.radii + slack, strict=True):
            clear = float(towards @ towards) - reach**2
            found |= ahead @ towards > (np.sqrt(clear) if clear > 0 else -np.inf)
        return found


def freeze(
    standing: CompiledScene,
    movers: Sequence[Moving],
    terrain: Terrain,
    route: Floats,
    seconds: float,
    eye: Floats,
) -> Castable:
    """Return the scene at a time, with the movers that are near the sensor at ``eye`` (3,)."""
    meshes, centres, radii = [], [], []
    for mover in movers:
        x, y, heading = mover.at(route, seconds)
        if np.hypot(x - eye[0], y - eye[1]) < _NEAR:
            z = terrain.height_at(x, y)
            mesh = terrain.laid(mover.shape.mesh().placed(x, y, z, heading), x, y)
            meshes.append((mover.object_id, mesh))
            centres.append((x, y, z + 1.2))
            radii.append(mover.radius)
    if not meshes:
        return standing
    return MovingScene(standing, compile_meshes(meshes, standing.threads), np.array(centres), np.array(radii))


def random_movers(
    first_id: int,
    route_length: float,
    character: Character,
    ways: tuple[float, float],
    rng: np.random.Generator,
) -> tuple[Mover, ...]:
    """Draw the traffic of both epochs, either way (1 or -1): a vehicle each 90 m, a person each 60 m."""
    made: list[Mover] = []
    for epoch, way in zip(("before", "after"), ways, strict=True):
        for _ in range(max(1, round(route_length / 90))):
            made.append(_vehicle(first_id + len(made), epoch, way, route_length, character.lanes, rng))
        for _ in range(max(1, round(route_length / 60))):
            made.append(_person(first_id + len(made), epoch, route_length, character.widen, rng))
    return tuple(made)


def _vehicle(
    number: int, epoch: str, way: float, length: float, lanes: int, rng: np.random.Generator
) -> Mover:
    """Draw oncoming traffic: on the other side, against the way of the survey vehicle."""
    shape = Truck() if rng.random() < 0.2 else random_car(rng)
    speed = way * float(rng.uniform(5.0, 11.0))
    lane = 1.75 + LANE_WIDTH * int(rng.integers(lanes))
    return Mover(number, shape, epoch, float(rng.uniform(0, length)), speed, way * lane, 4.2)


def _person(number: int, epoch: str, length: float, widen: float, rng: np.random.Generator) -> Mover:
    cycling = bool(rng.random() < 0.3)
    pace = rng.uniform(3.5, 6.0) if cycling else rng.uniform(0.9, 1.7)
    way, side = rng.choice([-1.0, 1.0], 2)
    offset = side * (widen + float(rng.uniform(5.5, 6.8)))
    return Mover(
        number, Person(cycling=cycling), epoch, float(rng.uniform(0, length)), way * pace, offset, 1.5
    )
