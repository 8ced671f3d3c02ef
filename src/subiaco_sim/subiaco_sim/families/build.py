"""Builds the scene of a family preset: plan, layout, what time does, ground works, traffic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from subiaco_sim.families.config import Family, StreetConfig
from subiaco_sim.families.dense import lay_out_dense
from subiaco_sim.families.events import pass_time
from subiaco_sim.families.groundworks import work_the_street
from subiaco_sim.families.land import StreetLand
from subiaco_sim.families.plan import StreetPlan
from subiaco_sim.families.suburb import lay_out_suburb
from subiaco_sim.families.traffic import street_traffic
from subiaco_sim.ground import Patch, Road
from subiaco_sim.scene import Scene


@dataclass(frozen=True)
class StreetSize:
    """Length of the street, land on all sides of it and edge of the ground mesh [m]."""

    length: float
    margin: float
    cell: float


def build_street(
    plan: StreetPlan, size: StreetSize, config: StreetConfig, reverse_after: bool, seed: int
) -> Scene:
    """Build the scene of a plan; the same arguments give the same scene."""
    suburb = plan.family is Family.SUBURB
    rng = np.random.default_rng([seed, 37, int(suburb)])
    route = plan.route(size.length)
    raised: list[Patch] = []
    if suburb:
        layout, raised = lay_out_suburb(route, plan, rng)
    else:
        layout = lay_out_dense(route, plan, rng)
    west, south = route.min(axis=0) - size.margin
    east, north = route.max(axis=0) + size.margin
    bounds = (float(west), float(south), float(east), float(north))
    road = Road(route, plan.widen)
    land = StreetLand(
        road, bounds, plan.slope, size.cell, lines=tuple(layout.lines), raised=tuple(raised), paved=not suburb
    )
    items = pass_time(layout, plan.seasons, config.activity)
    ground = work_the_street(layout, len(items) + 1, plan.widen, plan.footway, config.activity)
    first = len(items) + len(ground) + 1
    movers = street_traffic(first, size.length, plan, config.traffic, reverse_after, rng)
    return Scene(land, tuple(items), tuple(ground), route, movers)
