"""What a seed draws of a street before anything stands on it: course, land, sensors, lanes, directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_geo.frames import Floats
from subiaco_sim.families.config import Family, StreetConfig
from subiaco_sim.families.foliage import Season, seasons_of
from subiaco_sim.families.land import lie_of_the_land
from subiaco_sim.scene_config import LANE_WIDTH
from subiaco_sim.sensors import SensorName

_STEP = 0.25  # spacing of the centreline [m]
_LANE = 1.7  # crown to the middle of the first lane [m]
_PAIRS = (
    (SensorName.OS1_128, SensorName.OS1_128),
    (SensorName.OS1_64, SensorName.OS1_128),
    (SensorName.OS1_128, SensorName.OS1_64),
    (SensorName.OS0_32, SensorName.OS1_128),
    (SensorName.HDL_32E, SensorName.OS1_64),
    (SensorName.OS1_64, SensorName.OS1_64),
)


@dataclass(frozen=True)
class StreetPlan:
    """A street as its seed draws it.

    ``widen`` is what a half of the road is wider than a plain one, ``footway`` the distance from the kerb to
    the building line [m]; ``aside`` is how far each drive keeps from the middle of its lane [m]; ``side`` is
    1 where traffic keeps left and -1 where it keeps right.
    """

    family: Family
    slope: tuple[float, float]
    lanes: int
    widen: float
    footway: float
    seasons: tuple[Season, Season]
    sensors: tuple[SensorName, SensorName]
    lane: tuple[int, int]
    aside: tuple[float, float]
    reverse_after: bool
    bends: tuple[
        tuple[float, float, float], ...
    ]  # of the course: amplitude [rad], wavelength [m], phase [rad]

    @property
    def side(self) -> int:
        """Return the side on which traffic keeps."""
        return 1 if self.family is Family.SUBURB else -1

    def lane_offset(self, number: int, lane: int) -> float:
        """Return how far left of the crown an epoch's drive keeps, in its own direction [m]."""
        return self.side * (_LANE + LANE_WIDTH * lane + self.aside[number])

    def route(self, length: float) -> Floats:
        """Return the dense centreline (N, 2), its middle at the origin [m]."""
        station = np.arange(0.0, length, _STEP)
        heading = np.zeros(len(station))
        for amplitude, wavelength, phase in self.bends:
            heading += amplitude * np.sin(2 * np.pi * station / wavelength + phase)
        steps = _STEP * np.column_stack([np.cos(heading), np.sin(heading)])
        route = np.cumsum(steps, axis=0)
        return np.asarray(route - route[len(route) // 2])


def plan_street(family: Family, *, hard: bool, config: StreetConfig, seed: int) -> StreetPlan:
    """Draw the plan of a street; ``hard`` asks for steep land and for sensors of different kinds."""
    suburb = family is Family.SUBURB
    rng = np.random.default_rng([seed, 31, int(suburb)])
    steepest = (0.07, 0.12) if hard else (0.0, 0.09)
    slope = lie_of_the_land(config.slope, steepest, rng)
    lanes = 2 if rng.random() < (0.25 if suburb else 0.15) else 1
    widen = float(rng.uniform(0.3, 1.4) if suburb else rng.uniform(0.9, 1.9)) + LANE_WIDTH * (lanes - 1)
    pairs = [pair for pair in _PAIRS if not hard or pair[0] is not pair[1]]
    bend = 0.22 if suburb else 0.1
    return StreetPlan(
        family=family,
        slope=slope,
        lanes=lanes,
        widen=widen,
        footway=float(rng.uniform(3.3, 3.9) if suburb else rng.uniform(2.2, 4.2)),
        seasons=seasons_of(config.foliage_ratio, config.sway, rng),
        sensors=pairs[int(rng.integers(len(pairs)))],
        lane=(int(rng.integers(lanes)), int(rng.integers(lanes))),
        aside=(float(rng.uniform(-0.4, 0.9)), float(rng.uniform(-0.4, 0.9))),
        reverse_after=bool(rng.random() < 0.5),
        bends=tuple(
            (float(rng.uniform(-bend, bend)), float(rng.uniform(140.0, 320.0)), float(rng.uniform(0, 6.28)))
            for _ in range(2)
        ),
    )
