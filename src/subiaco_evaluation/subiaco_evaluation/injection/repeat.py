"""How a second pass over the same street differs, measured where two maps of one epoch overlap."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from subiaco_change.geometry import fit_planes
from subiaco_change.quantiles import median_and_spread
from subiaco_change.segmentation.ground_model import Mask
from subiaco_evaluation.injection.config import InjectionConfig, RepeatConfig
from subiaco_evaluation.injection.second_pass import resampled
from subiaco_evaluation.injection.source_objects import SourceScene
from subiaco_geo.clouds import PointCloud, voxel_downsample
from subiaco_geo.codes import Semantic
from subiaco_geo.errors import InputError
from subiaco_geo.frames import Floats

_OVERLAP = 1.0  # places this near a point of the other pass were seen by both [m]
_MET = 0.2  # a point this near was hit again [m]
_FLAT = 0.01  # curvature of a surface that tells the noise
_FEWEST = 2000  # points
_FEW_BEAMS = 2  # in voxels that tell how often one is hit again
_AGAIN = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
_FOLIAGE = np.array([0.02, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6])


def measured_repeat(scene: SourceScene, other: PointCloud, config: InjectionConfig) -> RepeatConfig:
    """Measure the noise of a second pass where another map of the same days overlaps.

    Parameters
    ----------
    scene : SourceScene
        The map that changes are put into.
    other : PointCloud
        A map of other sequences of that epoch, in the same frame.
    config : InjectionConfig
        ``repeat`` is kept for what cannot be measured.

    Returns
    -------
    RepeatConfig
        ``sigma`` from offsets along normals of flat surfaces; ``again`` and ``foliage`` such that our
        model misses as many points, on surfaces and in foliage, as the other pass did.

    Raises
    ------
    InputError
        Too little overlaps.
    """
    second = voxel_downsample(other.rebased(scene.cloud.origin), config.leaf).xyz
    distance, nearest = cKDTree(second).query(scene.cloud.xyz, distance_upper_bound=_OVERLAP)
    shared = np.isfinite(distance)
    if np.count_nonzero(shared) < _FEWEST:
        raise InputError(
            f"the other pass shares {np.count_nonzero(shared)} points with the map, {_FEWEST} are needed; "
            "give a map of the same streets and days, in the same CRS"
        )
    planes = fit_planes(scene.cloud.xyz, 0.8)
    flat = shared & (planes.curvature < _FLAT) & (distance < 2 * _MET)
    offset = second[nearest[flat]] - scene.cloud.xyz[flat]
    along = np.einsum("ij,ij->i", offset, planes.normals[flat])
    repeat = config.repeat
    if np.count_nonzero(flat) >= _FEWEST:
        _, spread = median_and_spread(along)
        repeat = repeat.model_copy(update={"sigma": round(spread / math.sqrt(2.0), 4)})
    leafy = scene.semantic == Semantic.VEGETATION
    few = np.asarray(scene.cloud.fields.get("n", np.ones(len(leafy)))) <= _FEW_BEAMS
    measured = (("again", _AGAIN, shared & few & ~leafy), ("foliage", _FOLIAGE, shared & leafy))
    for name, values, asked in measured:
        if np.count_nonzero(asked) >= _FEWEST // 4:
            met = float((distance[asked] < _MET).mean())
            modelled = _modelled(scene, config, asked)
            shares = [modelled(repeat.model_copy(update={name: float(v)})) for v in values]
            repeat = repeat.model_copy(update={name: round(_where(values, np.array(shares), met), 3)})
    return repeat


def _modelled(scene: SourceScene, config: InjectionConfig, asked: Mask) -> Callable[[RepeatConfig], float]:
    """Return how many of the points that are asked about the model hits again, by its parameters."""
    fields: dict[str, NDArray[np.generic]] = {**scene.cloud.fields, "semantic": scene.semantic}

    def share(tried: RepeatConfig) -> float:
        settings = config.model_copy(update={"repeat": tried})
        _, moved = resampled(scene.cloud.xyz, fields, settings, np.random.default_rng(config.seed))
        distance, _ = cKDTree(moved).query(scene.cloud.xyz[asked], distance_upper_bound=_MET)
        return float(np.isfinite(distance).mean())

    return share


def _where(values: Floats, shares: Floats, met: float) -> float:
    """Return the parameter at which a share that rises or falls with it is met."""
    order = np.argsort(shares)
    return float(np.interp(met, shares[order], values[order]))
