"""What moves while the vehicle passes: cars, vans, buses, trucks, motorcycles, bicycles, people on foot."""

from __future__ import annotations

import numpy as np

from subiaco_sim.families.plan import StreetPlan
from subiaco_sim.families.vehicles import Bus, Motorcycle, random_vehicle
from subiaco_sim.furniture import Person, Truck
from subiaco_sim.ground import ROAD_HALF
from subiaco_sim.movers import Mover
from subiaco_sim.scene import Shape
from subiaco_sim.scene_config import LANE_WIDTH


def street_traffic(
    first_id: int,
    length: float,
    plan: StreetPlan,
    amount: float,
    reverse_after: bool,
    rng: np.random.Generator,
) -> tuple[Mover, ...]:
    """Draw the traffic of both epochs: ``amount`` times a vehicle each 90 m and a person each 40 m."""
    made: list[Mover] = []
    for epoch, way in (("before", -1.0), ("after", 1.0 if reverse_after else -1.0)):
        for _ in range(int(amount * length / 90.0 + rng.random())):
            shape, radius, speeds = _vehicle(rng)
            lane = plan.side * (1.75 + LANE_WIDTH * int(rng.integers(plan.lanes)))
            speed, start = way * float(rng.uniform(*speeds)), float(rng.uniform(0, length))
            made.append(Mover(first_id + len(made), shape, epoch, start, speed, way * lane, radius))
        for _ in range(int(amount * length / 40.0 + rng.random())):
            pace = float(rng.uniform(0.8, 1.8)) * float(rng.choice([-1.0, 1.0]))
            offset = float(rng.choice([-1.0, 1.0])) * (
                ROAD_HALF + plan.widen + float(rng.uniform(1.0, plan.footway - 0.6))
            )
            person = Person(float(rng.uniform(1.2, 1.95)))
            made.append(
                Mover(first_id + len(made), person, epoch, float(rng.uniform(0, length)), pace, offset, 1.5)
            )
    return tuple(made)


def _vehicle(rng: np.random.Generator) -> tuple[Shape, float, tuple[float, float]]:
    """Draw a moving vehicle, the radius of a ball that holds it [m] and its range of speeds [m/s]."""
    drawn = rng.random()
    if drawn < 0.10:
        return Bus(), 6.8, (4.0, 9.0)
    if drawn < 0.22:
        return Motorcycle(), 1.8, (5.0, 12.0)
    if drawn < 0.36:
        return Person(cycling=True), 1.5, (3.0, 6.5)
    if drawn < 0.46:
        return Truck(), 4.6, (4.0, 10.0)
    return random_vehicle(rng), 4.6, (4.0, 11.0)
