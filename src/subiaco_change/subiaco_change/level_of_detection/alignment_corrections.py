"""Corrections beyond the rigid transform of two epochs, and how they are reported."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from subiaco_change.level_of_detection.common_frame import CommonFrame
from subiaco_change.level_of_detection.displacement_field import SmoothField
from subiaco_change.level_of_detection.registration_uncertainty import SigmaField, UncertaintyConfig
from subiaco_change.level_of_detection.vertical_bias import VerticalBiasConfig
from subiaco_change.records import Registration
from subiaco_change.registration.warp import WarpConfig
from subiaco_geo.config import StrictModel


class PlacingConfig(StrictModel):
    """What is removed and stated beyond the rigid transform."""

    vertical: VerticalBiasConfig = VerticalBiasConfig()
    warp: WarpConfig = WarpConfig()
    uncertainty: UncertaintyConfig = UncertaintyConfig()


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
