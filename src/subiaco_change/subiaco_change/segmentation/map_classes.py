"""Classes of a part of a survey map, for the returns that were fused into it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from subiaco_change.segmentation.classes import SemanticsConfig, label_points
from subiaco_geo.clouds import PointCloud
from subiaco_geo.codes import Semantic
from subiaco_geo.frames import Floats

_FEWEST = 100  # points below which neighbourhoods say nothing


def map_classes(cloud: PointCloud, moved: Floats) -> NDArray[np.uint8]:
    """Return the class (N,) of every point of a part of a map.

    Parameters
    ----------
    cloud : PointCloud
        Points at the leaf of the map; z is up.
    moved : (N,) float64
        Probability that each point moved during the survey.

    Returns
    -------
    (N,) uint8
        :class:`~subiaco_geo.codes.Semantic`; *other* for all of a part with fewer than 100 points.
    """
    if len(cloud) < _FEWEST:
        return np.full(len(cloud), Semantic.OTHER, dtype=np.uint8)
    return label_points(cloud, SemanticsConfig(), moved=moved).semantic
