"""M3C2 thresholding: mean distance in a cylinder along the normal, against its level of detection."""

from __future__ import annotations

import numpy as np

from subiaco_change.geometry import estimate_normals
from subiaco_change.level_of_detection.displacement_lod import LodConfig, LodResult, compare_epochs
from subiaco_change.segmentation.ground_model import Mask
from subiaco_evaluation.baselines.cells import CellVerdict, EpochCells, Pair, decide_from_points, mean_by_cell
from subiaco_evaluation.baselines.config import M3c2Config
from subiaco_evaluation.config import BaselineConfig
from subiaco_geo.clouds import PointCloud


def difference_along_normals(pair: Pair, config: BaselineConfig) -> CellVerdict:
    """Label cells whose points moved along their normal by more than M3C2 can be wrong.

    Every point is a core point. The registration error adds linearly, as
    Lague et al. have it. A point whose cylinder is empty in the other epoch
    has no distance; ``m3c2.no_counterpart`` says what becomes of it.
    """
    settings = config.m3c2
    clouds = [_with_normals(side, settings.normal_radius) for side in (pair.before, pair.after)]
    sigma = pair.registration.sigma_reg_m
    lod = _lod_config(settings)
    results = [compare_epochs(clouds[i], clouds[1 - i], sigma, lod) for i in (0, 1)]
    changed = (_changed(results[0], settings), _changed(results[1], settings))
    code, confidence = decide_from_points(pair, changed, config.cells, settings, settings.voids)
    # Seen from *before* the distance is after minus before; turn that of *after* round.
    distance = mean_by_cell(
        pair, (results[0].distance.astype(np.float64), -results[1].distance.astype(np.float64))
    )
    level = mean_by_cell(pair, (results[0].lod95.astype(np.float64), results[1].lod95.astype(np.float64)))
    return CellVerdict(code, confidence, distance, level)


def _with_normals(side: EpochCells, radius: float) -> PointCloud:
    return side.cloud.with_fields(normals=estimate_normals(side.cloud.xyz, radius))


def _lod_config(settings: M3c2Config) -> LodConfig:
    """Return the published form: every point counts whatever its normal, and error adds linearly."""
    return LodConfig(
        radius=settings.radius,
        self_half_length=settings.half_length,
        half_length=settings.half_length,
        min_count=settings.min_count,
        normal_agreement=0.0,
        noise=settings.noise,
        combine="linear",
        normal_radius=settings.normal_radius,
    )


def _changed(result: LodResult, settings: M3c2Config) -> Mask:
    known = np.isfinite(result.lod95)
    gate = np.maximum(np.where(known, result.lod95, 0.0), settings.minimum)
    moved = known & (np.abs(np.nan_to_num(result.distance)) > gate)
    if settings.no_counterpart == "unchanged":
        return np.asarray(moved)
    return np.asarray(moved | ((result.n_other == 0) & (result.n_self >= settings.min_count)))
