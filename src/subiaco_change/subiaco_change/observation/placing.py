"""Two registered epochs in one frame, with what can be told apart at every point."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from subiaco_change.observation.common_frame import CommonFrame
from subiaco_change.observation.lod import Displacements, LodConfig, lod_of, measure_displacements
from subiaco_change.observation.smooth_field import SmoothField, block_grid
from subiaco_change.observation.uncertainty import (
    PoseErrors,
    SigmaField,
    UncertaintyConfig,
    pose_errors,
    sigma_field,
    spread_residuals,
)
from subiaco_change.observation.vertical_bias import VerticalBiasConfig, estimate_vertical_bias
from subiaco_change.records import Registration
from subiaco_change.registration.warp import Residuals, WarpConfig, estimate_warp
from subiaco_change.semantics.ground import Mask
from subiaco_geo.clouds import PointCloud
from subiaco_geo.config import StrictModel
from subiaco_geo.maps import SurveyMap

_LOG = logging.getLogger(__name__)


class PlacingConfig(StrictModel):
    """What is removed and stated beyond the rigid transform."""

    vertical: VerticalBiasConfig = VerticalBiasConfig()
    warp: WarpConfig = WarpConfig()
    uncertainty: UncertaintyConfig = UncertaintyConfig()


@dataclass(frozen=True)
class Placed:
    """Both epochs in the common frame.

    Parameters
    ----------
    frame : CommonFrame
        Its registration states the median of sigma_reg over the points.
    before : PointCloud
    sigma : SigmaField
    lods : tuple of (N,) float32
        LoD95 at the points of *before* and of *after* [m].
    """

    frame: CommonFrame
    before: PointCloud
    sigma: SigmaField
    lods: tuple[NDArray[np.float32], NDArray[np.float32]]


def place(
    clouds: tuple[PointCloud, PointCloud],
    registration: Registration,
    surveys: tuple[SurveyMap, SurveyMap],
    ground: tuple[Mask, Mask],
    unsteady: tuple[Mask, Mask],
    config: PlacingConfig,
    lod: LodConfig,
) -> Placed:
    """Bring *before* to *after*, remove smooth biases, and state what is left.

    Parameters
    ----------
    clouds : tuple of PointCloud
        Each in its own frame, with normals.
    registration : Registration
    surveys : tuple of SurveyMap
        The maps that the clouds are of: for their pose covariances.
    ground : tuple of (N,) bool
        Points of the ground.
    unsteady : tuple of (N,) bool
        Points that say nothing about the registration: plants, vehicles, known changes.
    config : PlacingConfig
    lod : LodConfig
    """
    after = clouds[1]
    frame = CommonFrame(registration, after.origin)
    rigid = frame.bring(clouds[0])
    bias = estimate_vertical_bias(
        rigid.xyz[ground[0]], after.xyz[ground[1]], after.origin, config.vertical
    )  # fmt: skip
    frame = frame.corrected(bias)
    if config.warp.enabled:
        frame = frame.corrected(_warp(frame.bring(clouds[0]), after, unsteady, config, lod))
    before = frame.bring(clouds[0])
    found = measure_displacements(before, after, lod), measure_displacements(after, before, lod)
    poses = _poses(frame, surveys) if config.uncertainty.pose_covariance else ()
    sigma = sigma_field(
        (before, after), found, registration, config.uncertainty, poses=poses, exclude=unsteady
    )
    values = [sigma.at(c.xyz, np.asarray(c.fields["normals"])) for c in (before, after)]
    stated = stated_registration(registration, values[0], bias)
    lods = lod_of(found[0], values[0], lod), lod_of(found[1], values[1], lod)
    return Placed(replace(frame, registration=stated), before, sigma, lods)


def _warp(
    before: PointCloud,
    after: PointCloud,
    unsteady: tuple[Mask, Mask],
    config: PlacingConfig,
    lod: LodConfig,
) -> SmoothField:
    found: Displacements = measure_displacements(before, after, lod)
    chosen = spread_residuals(before, found, config.uncertainty, unsteady[0])
    grid = block_grid((before.xyz, after.xyz), config.warp.block, after.origin)
    normals = np.asarray(before.fields["normals"])[chosen]
    warp = estimate_warp(Residuals(before.xyz[chosen], normals, found.distance[chosen]), grid, config.warp)
    _LOG.info("residual warp: up to %.3f m", float(np.linalg.norm(warp.values, axis=2).max()))
    return warp


def _poses(frame: CommonFrame, surveys: tuple[SurveyMap, SurveyMap]) -> tuple[PoseErrors, ...]:
    T_frame_after = np.eye(4)
    T_frame_after[:3, 3] = -frame.origin
    both = pose_errors(surveys[0], frame.T_frame_before), pose_errors(surveys[1], T_frame_after)
    return tuple(p for p in both if p is not None)


def stated_registration(
    registration: Registration, sigma: NDArray[np.float64], bias: SmoothField | None
) -> Registration:
    """State sigma_reg as the median over the points, and how it and the heights vary."""
    low, median, high = np.quantile(sigma, (0.05, 0.5, 0.95)).tolist()
    details = {**registration.details, "sigma_reg_p05_m": low, "sigma_reg_p95_m": high}
    if bias is not None:
        height = bias.values[:, :, 2]
        details |= {
            "vertical_bias_m": float(np.median(height)),
            "vertical_bias_min_m": float(height.min()),
            "vertical_bias_max_m": float(height.max()),
        }
    return replace(registration, sigma_reg_m=median, details=details)


def block_table(sigma: SigmaField, frame: CommonFrame) -> pd.DataFrame:
    """Report the registration block by block.

    Returns
    -------
    pandas.DataFrame
        ``east north`` of the centre in the world; ``sigma_standing_m`` and
        ``sigma_lying_m``, what the epochs lie apart on walls and on level
        surfaces beyond the noise of their points; ``n_standing n_lying``,
        residuals behind them (thin blocks borrow from their neighbours);
        ``shift_east_m shift_north_m shift_up_m``, what was added to *before*
        beyond the rigid transform.
    """
    origin = frame.origin
    centres = sigma.grid.centres()
    place = np.column_stack([centres, np.zeros(len(centres))])
    shift = np.zeros_like(place)
    for correction in frame.corrections:
        shift += correction.at(place)
    table = pd.DataFrame(
        {
            "east": centres[:, 0] + origin[0],
            "north": centres[:, 1] + origin[1],
            "sigma_standing_m": sigma.bias[:, 0],
            "sigma_lying_m": sigma.bias[:, 1],
            "n_standing": sigma.count[:, 0],
            "n_lying": sigma.count[:, 1],
            "shift_east_m": shift[:, 0],
            "shift_north_m": shift[:, 1],
            "shift_up_m": shift[:, 2],
        }
    )
    return table[sigma.count.sum(axis=1) > 0].reset_index(drop=True)
