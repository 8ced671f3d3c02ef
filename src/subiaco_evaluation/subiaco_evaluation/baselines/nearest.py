"""Nearest-neighbour differencing: against a level of detection, and against one threshold (C2C)."""

from __future__ import annotations

import numpy as np

from subiaco_change.geometry import build_index, nearest
from subiaco_change.level_of_detection.displacement_lod import LodConfig, combine, compare_epochs
from subiaco_evaluation.baselines.cells import CellVerdict, EpochCells, Pair, decide_from_points, mean_by_cell
from subiaco_evaluation.baselines.config import NearestConfig
from subiaco_evaluation.config import BaselineConfig
from subiaco_geo.frames import Floats

#: Distances beyond this many times the gate are all the same to a threshold.
_REACH = 1.5


def difference_by_lod(pair: Pair, config: BaselineConfig) -> CellVerdict:
    """Label cells whose points lie farther from the other epoch than they could be told to."""
    settings = config.nn
    gates, lods = [], []
    for own, other in ((pair.before, pair.after), (pair.after, pair.before)):
        lod = _lod(own, other, pair.registration.sigma_reg_m, settings)
        lods.append(lod)
        gates.append(np.maximum(settings.lod_factor * lod, settings.minimum))
    distances = _distances(pair, max(float(gate.max(initial=0.0)) for gate in gates))
    changed = (distances[0] > gates[0], distances[1] > gates[1])
    code, confidence = decide_from_points(pair, changed, config.cells, settings, settings.voids)
    return CellVerdict(code, confidence, _capped(pair, distances), mean_by_cell(pair, (lods[0], lods[1])))


def difference_by_threshold(pair: Pair, config: BaselineConfig) -> CellVerdict:
    """Label cells whose points lie farther from the other epoch than one threshold (C2C)."""
    settings = config.c2c
    distances = _distances(pair, settings.threshold)
    changed = (distances[0] > settings.threshold, distances[1] > settings.threshold)
    code, confidence = decide_from_points(pair, changed, config.cells, settings, settings.voids)
    distance = _capped(pair, distances)
    return CellVerdict(code, confidence, distance, np.full(distance.shape, np.nan))


def _distances(pair: Pair, gate: float) -> tuple[Floats, Floats]:
    """Return distances (N,) to the nearest point of the other epoch, infinite well beyond the gate [m]."""
    before, after = pair.before.cloud.xyz, pair.after.cloud.xyz
    reach = _REACH * gate
    return nearest(build_index(after, reach), before, reach)[1], nearest(
        build_index(before, reach), after, reach
    )[1]


def _capped(pair: Pair, distances: tuple[Floats, Floats]) -> Floats:
    """Return the mean distance by cell, of the points that have a neighbour in reach."""
    return mean_by_cell(pair, distances)


def _lod(own: EpochCells, other: EpochCells, sigma_reg: float, settings: NearestConfig) -> Floats:
    """Return LoD95 (N,); where the other epoch has no surface, from the own roughness and the floor.

    An infinite level would hide exactly what is new or gone.
    """
    lod = LodConfig(radius=settings.radius, noise=settings.noise)
    found = compare_epochs(own.cloud, other.cloud, sigma_reg, lod)
    spread = np.nan_to_num(found.s_self.astype(np.float64)) ** 2 / np.maximum(found.n_self, 1)
    alone = combine(np.maximum(spread, settings.noise**2) + settings.noise**2, sigma_reg, lod.combine)
    return np.where(np.isfinite(found.lod95), found.lod95, alone)
