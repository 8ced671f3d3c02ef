"""Certainty that an object is absent in the other epoch, from the beams that crossed its place.

A beam that crosses the place of a wall proves that the wall is gone; one that crosses the place of a hedge
may have found a gap. How many of its own survey's beams the object let by tells which of the two it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import expit, logit

from subiaco_change.decisions.voxel_objects import Free, ObjectInstance, join_voxels
from subiaco_change.method_numbers import NUMBERS
from subiaco_geo.frames import Floats

_PATCH = NUMBERS.absence.voxels_per_patch
_SURE = NUMBERS.absence.least_doubt


def absence(
    before: Sequence[ObjectInstance],
    after: Sequence[ObjectInstance],
    free: tuple[Free | None, Free | None],
    certain: tuple[float, float] = (1.0, 1.0),
) -> float:
    """Probability that the object is absent where the other epoch holds nothing.

    The mean log odds of the places, times the square root of the number of patches that they form: places
    next to one another are crossed by the same beams, so their errors are correlated. What all patches of an
    object have in common does not average out: the probability stays below ``certain``.

    Parameters
    ----------
    before, after : sequence of ObjectInstance
        Parts of the object in both epochs.
    free : (callable, callable)
        How probable *before* and *after* find it that places (N, 3) are free; None: certain.
    certain : (float, float)
        Probability that the evidence of *before* and of *after* is right as a whole: of a bare cloud nobody
        knows whence it was measured, and one hidden place tells of all the others.
    """
    chances, bound = [np.zeros(0)], 1.0
    for objects, known, whole in ((before, free[1], certain[1]), (after, free[0], certain[0])):
        if objects and known is not None:
            bound = min(bound, whole)
            voxels = join_voxels(objects)
            places = voxels.xyz[voxels.observed & ~voxels.occupied_in_other]
            chances.append(porous_chance(known(places), opacity(objects)))
    joined = np.concatenate(chances)
    return 1.0 if len(joined) == 0 else bound * pooled(float(joined.mean()), len(joined))


def pooled(mean: float, voxels: int) -> float:
    """Probability that places are free together: ``mean`` of so many voxels, four of which form a patch."""
    within = min(max(mean, _SURE), 1.0 - _SURE)
    return float(expit(logit(within) * max(voxels / _PATCH, 1.0) ** 0.5))


def opacity(objects: Sequence[ObjectInstance]) -> float | None:
    """Share of the beams of its own survey that an object returned; None where nothing counted them."""
    passed = np.concatenate([t.passed for t in objects])
    return None if len(passed) == 0 else float(1.0 / (1.0 + passed.mean()))


def porous_chance(chance: Floats, returned: float | None) -> Floats:
    """Probability (N,) that no object with this fraction of returned beams is at the places.

    ``chance`` (N,) is that of the place being free whatever stood there: (k + 1/2) / (k + 1) after k beams
    that crossed it. Had the object stood there, k beams would all have missed it with (1 - returned)^k.
    """
    if returned is None:
        return chance
    beams = np.maximum(chance - 0.5, 0.0) / np.maximum(1.0 - chance, _SURE)
    return np.asarray(1.0 / (1.0 + (1.0 - min(returned, 1.0 - _SURE)) ** beams))
