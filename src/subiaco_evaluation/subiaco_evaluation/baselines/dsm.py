"""Differencing of digital surface models: the highest point of every cell."""

from __future__ import annotations

import numpy as np

from subiaco_evaluation.baselines.cells import CellVerdict, Codes, Pair, clean, name_changes
from subiaco_evaluation.config import BaselineConfig
from subiaco_geo.codes import Change
from subiaco_geo.frames import Floats


def difference_surfaces(pair: Pair, config: BaselineConfig) -> CellVerdict:
    """Label cells by how far the highest point rose or sank.

    The method knows nothing of visibility: a cell without points in one
    epoch has no difference; ``dsm.voids`` makes it 255 or Unchanged, or fills
    it with the ground of that epoch.
    """
    settings = config.dsm
    rise = _filled_rise(pair) if settings.voids == "ground" else pair.rise
    up, down = (
        clean(np.nan_to_num(sign * rise, nan=0.0) > settings.threshold, settings, pair.grid.cell)
        for sign in (1.0, -1.0)
    )
    code = name_changes(pair, up, down, settings.voids)
    if settings.voids == "unobserved":
        code[np.isnan(rise)] = Change.UNOBSERVED
    return CellVerdict(code, _confidence(rise, settings.threshold, code), rise, np.full(rise.shape, np.nan))


def _filled_rise(pair: Pair) -> Floats:
    """Take the ground where one epoch has no points; NaN where neither has any."""
    tops = [np.where(side.count > 0, side.top, side.ground) for side in (pair.before, pair.after)]
    return np.where((pair.before.count > 0) | (pair.after.count > 0), tops[1] - tops[0], np.nan)


def _confidence(rise: Floats, threshold: float, code: Codes) -> Floats:
    """Return 0.5 at the threshold, 1 at no difference and at twice the threshold."""
    ratio = np.nan_to_num(np.abs(rise) / threshold, nan=1.0)
    changed = code < Change.UNCHANGED
    return np.asarray(0.5 + 0.5 * np.clip(np.where(changed, ratio - 1.0, 1.0 - ratio), 0.0, 1.0))
