"""Point spacing of a cloud on its surfaces, which scales all neighbourhoods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import small_gicp

from subiaco_change.method_numbers import NUMBERS
from subiaco_geo.frames import Floats

#: Spacing of a street mapped at the working leaf, for which the radii in the configuration hold [m].
STREET_SPACING = NUMBERS.spacing.street_spacing
_NEIGHBOURS = NUMBERS.spacing.neighbours
_SAMPLE = NUMBERS.spacing.sample


def neighbour_spacings(xyz: Floats) -> Floats:
    """Return the spacing (K,) [m] at points drawn evenly from a cloud (N, 3); empty below 17 points.

    A disc that reaches the k-th neighbour at a distance d holds k points, so that each has an area of
    pi d^2 / k. The spacing is the edge of the square of that area.
    """
    if len(xyz) <= _NEIGHBOURS:
        return np.zeros(0)
    points = np.ascontiguousarray(xyz, dtype=np.float64)
    queries = np.ascontiguousarray(points[:: -(-len(points) // _SAMPLE)])
    tree = small_gicp.KdTree(small_gicp.PointCloud(points), num_threads=1)
    _, squared = tree.batch_knn_search(queries, _NEIGHBOURS + 1, num_threads=1)
    return np.asarray(np.sqrt(np.pi * np.asarray(squared)[:, -1] / _NEIGHBOURS))


def measure_spacing(xyz: Floats) -> float:
    """Return the median spacing [m] of a cloud (N, 3); infinite below 17 points."""
    found = neighbour_spacings(xyz)
    return float(np.median(found)) if len(found) else float("inf")


@dataclass(frozen=True)
class PointSpacing:
    """Median spacing of the points of both epochs at the working leaf [m]."""

    before: float
    after: float

    @property
    def coarser(self) -> float:
        """Spacing of the sparser epoch [m]: what a comparison of both can resolve."""
        return max(self.before, self.after)

    @property
    def scale(self) -> float:
        """Factor on radii and leaves that are meant for a mapped street, see :func:`spacing_scale`."""
        return spacing_scale(self.coarser)


def spacing_scale(*spacings: float) -> float:
    """Return the factor, 1 or more, by which the coarsest of these spacings [m] exceeds that of a street.

    A radius times this factor holds as many points of a surface as the radius does on a mapped street.
    A spacing that is not known (infinite) counts as that of a street.
    """
    known = [s for s in spacings if np.isfinite(s)]
    return max(1.0, *(s / STREET_SPACING for s in known)) if known else 1.0


def pair_spacing(before: Floats, after: Floats) -> PointSpacing:
    """Measure the spacing of two clouds (N, 3), (M, 3)."""
    return PointSpacing(measure_spacing(before), measure_spacing(after))


def joint_spacing(samples: Sequence[Floats]) -> float:
    """Return the median [m] of spacings measured on pieces of one cloud; infinite without any."""
    joined = np.concatenate([np.zeros(0), *samples])
    return float(np.median(joined)) if len(joined) else float("inf")
