"""Two epochs in one frame and in cells, for the simple and the learned methods."""

from __future__ import annotations

import numpy as np

from subiaco_change.geometry import estimate_normals
from subiaco_change.level_of_detection.common_frame import CommonFrame
from subiaco_change.registration.pair import check_pair
from subiaco_change.registration.register import given_registration, register
from subiaco_evaluation.baselines.cells import Pair, make_pair
from subiaco_evaluation.config import BaselineConfig
from subiaco_geo.findings import Finding
from subiaco_geo.frames import Floats
from subiaco_geo.survey_map import SurveyMap


def prepare_pair(
    before: SurveyMap, after: SurveyMap, config: BaselineConfig, transform: Floats | None = None
) -> tuple[Pair, tuple[Finding, ...]]:
    """Bring two epochs into one frame, as the change stage does, and into cells; also returns findings.

    Parameters
    ----------
    before, after : SurveyMap
    config : BaselineConfig
    transform : (4, 4) float64, optional
        Given ``T_after_before`` in world coordinates; without it the epochs
        are registered by our own registration, once.
    """
    before, after, info = check_pair(before, after, config.leaf, aligned=_aligned(transform))
    clouds = [
        survey.cloud.with_fields(normals=estimate_normals(survey.cloud.xyz, config.normal_radius))
        for survey in (before, after)
    ]
    if transform is None:
        registration = register(clouds[0], clouds[1], config.registration)
    else:
        method = "identity" if np.array_equal(transform, np.eye(4)) else "given"
        registration = given_registration(transform, clouds[0], clouds[1], config.registration, method)
    moved = CommonFrame(registration, clouds[1].origin).bring(clouds[0])
    return make_pair(moved, clouds[1], registration, config), info.findings


def _aligned(transform: Floats | None) -> bool:
    """Tell whether the coordinates of both epochs are taken as they are."""
    return transform is None or np.array_equal(transform, np.eye(4))
